"""Artefact folders: what a stage made, from what, and whether it is finished.

A folder holds the stage's typed files and
    config.json      the stage and its config
    inputs.json      the fingerprints of what it was made from
    provenance.json  versions, device, seconds, peak memory
    checksums.json   the sha256 of every file
    DONE             the artefact's own fingerprint; written last, by an atomic rename
Same key and DONE: load. Same key, unfinished: resume. Another key: refuse and say which field differs. Keys of earlier
schemas are read as today's (`migrations`). Files are compared with their checksums before they are used: a stage's own
when it loads them, an input's when it is named.
"""

import hashlib
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from illuminerf.workflow.atomic import (
    JOURNAL,
    explained_errors,
    read_json,
    recorded_writes,
    remove_partial_files,
    write_bytes,
    write_json,
)
from illuminerf.workflow.checksums import (
    OWN_FILES,
    file_digest,
    first_damaged,
    folder_digest,
    is_artefact,
    is_litter,
    seal_digest,
    sealed_digest,
    verify,
    verify_once,
    written_digests,
)
from illuminerf.workflow.config import first_difference, to_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.migrations import SCHEMA, upgraded
from illuminerf.workflow.progress import say

__all__ = ["Artefact", "InUse", "fingerprint", "locked", "open_artefact", "provenance", "read_metrics", "verify"]
_VERSIONED = ("illuminerf", "torch", "numpy", "mitsuba", "diffusers", "numba", "trimesh")


class InUse(UserError):
    """Another process works on the folder; it will not for ever."""


@dataclass
class Artefact:
    """One artefact folder while a stage works on it."""

    path: Path
    stage: str
    is_done: bool
    finished: bool = False
    metrics: dict[str, Any] = field(default_factory=dict)

    def finish(self, metrics: dict[str, Any] | None = None) -> None:
        """Say that every file is in place; the folder is sealed when the `with` block ends well."""
        self.finished = True
        self.metrics = metrics or {}


@contextmanager
def open_artefact(
    out: Path, stage: str, config: Any, inputs: dict[str, Path | str], is_shared: bool = False
) -> Iterator[Artefact]:
    """Open `out` for `stage`: to load (`is_done`), to go on, or to start.

    Args:
        out: the artefact's folder; made where absent.
        stage: the stage's name, for example "estimate_geometry".
        config: the stage's frozen dataclass.
        inputs: by role, the paths this artefact is made from (artefact folders or files), or literal strings.
        is_shared: several processes work on it at once, each on units of its own; whoever finds everything in place
            calls `finish`.

    Raises:
        UserError: the folder was made by another stage, config or input, or another process is working on it.
    """
    out = Path(out)
    key = {"schema": SCHEMA, "stage": stage, "config": to_json(config)}
    with explained_errors(out):
        made_from = {role: fingerprint(source) for role, source in sorted(inputs.items())}
        if _check_key(out, key, made_from):
            yield Artefact(out, stage, is_done=True, finished=True)
            return
        with locked(out, is_shared) as lock, recorded_writes(out):
            if not is_shared:  # else they may be another process's, just being written
                remove_partial_files(out)
            remove_damaged(out, is_shared)
            write_json(out / "config.json", key)
            write_json(out / "inputs.json", made_from)
            artefact = Artefact(out, stage, is_done=False)
            start = time.monotonic()
            yield artefact
            if artefact.finished and is_shared:
                _wait_for_others(lock)
                remove_partial_files(out)
            if artefact.finished and not (out / "DONE").exists():
                _seal(artefact, seconds=time.monotonic() - start)


def fingerprint(source: Path | str) -> str:
    """A sha256 that names an input's content: an artefact's own, a file's, a folder's, or a string's.

    Raises:
        UserError: the path is missing, or an artefact folder is unfinished or corrupt.
    """
    if isinstance(source, str):
        return hashlib.sha256(source.encode()).hexdigest()
    if source.is_dir() and is_artefact(source):
        if not (source / "DONE").exists():
            raise UserError(
                f"{source} is unfinished",
                fix="run the stage that makes it again; it goes on where it stopped",
            )
        verify_once(source)
        return sealed_digest(source)
    if source.is_dir():
        return folder_digest(source)
    if source.is_file():
        return file_digest(source)
    raise UserError(f"{source} does not exist", fix="check the path")


def remove_damaged(out: Path, is_shared: bool = False) -> None:
    """Begin an unfinished folder again where a file in it is not as it was written: what depends on what, only its
    stage knows.

    Raises:
        UserError: there is such a file, and other processes work on the folder.
    """
    damaged = first_damaged(out)
    if damaged is None:
        return
    if is_shared:
        raise UserError(f"{damaged} is damaged", fix=f"stop all processes that work on {out}, delete it and run again")
    say(f"{damaged} is damaged: {out} is made again from the start")
    for name in written_digests(out).keys() - {"config.json", "inputs.json"}:
        (out / name).unlink(missing_ok=True)
    (out / JOURNAL).unlink()


def _check_key(out: Path, key: dict[str, Any], made_from: dict[str, str]) -> bool:
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file", wanted="a folder", fix="choose another --out")
    config_file, inputs_file = out / "config.json", out / "inputs.json"
    if not config_file.exists():
        strangers = [entry.name for entry in out.iterdir() if is_stranger(entry.name)] if out.exists() else []
        if strangers:
            raise UserError(
                f"{out} holds files that are not a run of this program",
                got=sorted(strangers)[0],
                fix="choose an empty or a new folder with --out",
            )
        return False
    old_inputs = read_json(inputs_file) if inputs_file.exists() else made_from
    refuse_other_key(str(out), upgraded(read_json(config_file), str(out)), key, old_inputs, made_from)
    if not (out / "DONE").exists():
        return False
    verify_once(out)
    return True


def is_stranger(name: str) -> bool:
    """Whether no stage writes a file of this name first of all; what a kill left half written is none."""
    return name not in OWN_FILES and not is_litter(name)


def refuse_other_key(
    out: str, old_key: Any, key: dict[str, Any], old_inputs: dict[str, str], made_from: dict[str, str]
) -> None:
    """Raise a UserError that names what differs where a folder was made by another stage, config or input."""
    difference = first_difference(old_key, key)
    if difference is None:
        changed = next((role for role in made_from if old_inputs.get(role) != made_from[role]), None)
        difference = f"its input '{changed}' has changed" if changed else None
    if difference:
        raise UserError(
            f"{out} was made with other settings: {difference}",
            fix="choose another --out, delete that folder, or use the settings it was made with",
        )


def _seal(artefact: Artefact, seconds: float) -> None:
    out = artefact.path
    write_json(out / "provenance.json", provenance(seconds, artefact.metrics))
    write_bytes(out / "DONE", (seal_digest(out) + "\n").encode())
    (out / JOURNAL).unlink(missing_ok=True)


def provenance(seconds: float, metrics: dict[str, Any]) -> dict[str, Any]:
    """Where, with what and how long something was made: versions, commit, seconds, peak memory, measurements."""
    return {
        "versions": {name: _version(name) for name in _VERSIONED},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "commit": _commit(),
        "seconds": round(seconds, 3),
        "peak_memory_gb": round(peak_memory_gb(), 3),
        "metrics": metrics,
    }


def read_metrics(out: Path) -> dict[str, Any]:
    """What the stage measured, with `seconds` and `peak_memory_gb` of the process that finished it."""
    recorded = read_json(out / "provenance.json")
    return {
        **recorded["metrics"],
        "seconds": recorded["seconds"],
        "peak_memory_gb": recorded["peak_memory_gb"],
    }


def peak_memory_gb() -> float:
    """Largest resident size of this process so far, in GB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e9 if sys.platform == "darwin" else 1e6)


@contextmanager
def locked(out: Path, is_shared: bool = False) -> Iterator[int]:
    """Keep two processes from working on one artefact, unless both share it; the kernel drops the lock when a process
    dies."""
    import fcntl

    try:
        out.mkdir(parents=True, exist_ok=True)
        handle = os.open(out / ".lock", os.O_CREAT | os.O_RDWR, 0o644)
    except OSError as error:
        raise UserError(f"{out} cannot be written", got=str(error.strerror), fix="choose another --out") from error
    try:
        try:
            fcntl.flock(handle, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InUse(f"another process is working on {out}", fix="wait for it or choose another --out") from error
        yield handle
    finally:
        os.close(handle)


def _wait_for_others(lock: int) -> None:
    """Turn a shared lock into one's own: everything is in place, so the others are about to leave."""
    import fcntl

    fcntl.flock(lock, fcntl.LOCK_EX)


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "absent"


def _commit() -> str:
    """The commit of the source tree this runs from, or "release" where it is installed from a wheel."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "release"
    return done.stdout.strip()
