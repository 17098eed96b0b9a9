"""Checksums of an artefact's files: recorded when it is sealed, compared before it is used.

`checksums.json` holds the sha256 of every file by name, `DONE` one sha256 over names and checksums. Folders of earlier
versions have DONE alone; they are compared too, without telling which file differs.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from illuminerf.workflow.atomic import JOURNAL, read_json, write_json
from illuminerf.workflow.errors import UserError

CHECKSUMS = "checksums.json"
_DIGEST_LENGTH = 64
OWN_FILES = ("config.json", "inputs.json", "provenance.json", CHECKSUMS, "DONE")
# provenance differs between two runs that made the same thing, so it stays out of the fingerprint
_NOT_CONTENT = ("provenance.json", CHECKSUMS, "DONE")
_LITTER = ("Thumbs.db", "desktop.ini")
_States = tuple[tuple[str, int, int, int], ...]
_compared: dict[Path, _States] = {}


def file_digest(path: Path) -> str:
    """The sha256 of a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def folder_digest(folder: Path) -> str:
    """One sha256 for all files of a folder that is no artefact."""
    return _combined(_file_digests(folder))


def is_litter(name: str) -> bool:
    """Whether a file of that name is none of a folder's content: hidden, or a file manager's."""
    return name.startswith(".") or name in _LITTER


def is_artefact(folder: Path) -> bool:
    """Whether a stage made the folder, even where one of the files that say so is gone."""
    return sum((folder / name).exists() for name in ("config.json", "inputs.json", "DONE")) >= 2


def seal_digest(out: Path) -> str:
    """Record the checksums of a folder whose files are all in place; what DONE must hold.

    Raises:
        UserError: a file is not what was written to it.
    """
    digests, written = _file_digests(out, _NOT_CONTENT), written_digests(out)
    for name, digest in digests.items():
        if digest not in written.get(name, {digest}):
            raise UserError(f"{out / name} changed while {out} was being made", fix="run the same command again")
    write_json(out / CHECKSUMS, digests | {"provenance.json": file_digest(out / "provenance.json")})
    return _combined(digests)


def sealed_digest(out: Path) -> str:
    """What DONE holds."""
    return (out / "DONE").read_bytes().decode("ascii", "replace").strip()


def verify(out: Path) -> None:
    """Compare an artefact's files with what its stage wrote.

    Raises:
        UserError: a file was changed, truncated or removed since the stage finished; names it where that is on record.
    """
    digests = _file_digests(out, _NOT_CONTENT)
    is_as_sealed = _combined(digests) == sealed_digest(out)
    damaged = _damaged(out, digests, is_as_sealed)
    if damaged is not None:
        raise UserError(
            f"{out} is corrupt" + (f": {damaged} is not what the stage wrote" if damaged else ""),
            fix=f"delete {out} and run the command that made it again",
        )


def _damaged(out: Path, digests: dict[str, str], is_as_sealed: bool) -> str | None:
    """The first file that is not as recorded, missing or new, "" where nothing is on record; None where all is well."""
    if not (out / CHECKSUMS).exists():
        return None if is_as_sealed else ""
    recorded = _recorded(out)
    if recorded is None:
        return CHECKSUMS
    of_provenance = recorded.pop("provenance.json", "")
    differing = next((name for name in sorted({*digests, *recorded}) if digests.get(name) != recorded.get(name)), None)
    if not is_as_sealed:
        return differing or "DONE"
    if differing is not None:  # but the files are those that DONE stands for
        return CHECKSUMS
    provenance = out / "provenance.json"
    return None if provenance.is_file() and file_digest(provenance) == of_provenance else provenance.name


def verify_once(out: Path) -> None:
    """`verify`, where this process has not done so since any of the files was touched.

    Raises:
        UserError: as `verify`.
    """
    key, state = out.resolve(), _state(out)
    if _compared.get(key) != state:
        verify(out)
        _compared[key] = state


def _state(out: Path) -> _States:
    found = ((path.as_posix(), path.stat()) for path in _contents(out))
    return tuple((name, stat.st_size, stat.st_mtime_ns, stat.st_ino) for name, stat in found)


def _contents(folder: Path) -> Iterator[Path]:
    """Its files in order, without hidden ones (.lock, .written, .DS_Store) and other litter."""
    for path in sorted(folder.rglob("*")):
        if not is_litter(path.name) and path.is_file():
            yield path


def _file_digests(folder: Path, exclude: tuple[str, ...] = ()) -> dict[str, str]:
    named = ((path.relative_to(folder).as_posix(), path) for path in _contents(folder))
    return {name: file_digest(path) for name, path in named if name not in exclude}


def _combined(digests: dict[str, str]) -> str:
    whole = hashlib.sha256()
    for name in sorted(digests, key=PurePosixPath):
        whole.update(f"{name}\0{digests[name]}\n".encode())
    return whole.hexdigest()


def _recorded(out: Path) -> dict[str, str] | None:
    """What `checksums.json` says; None where it is absent or makes no sense."""
    try:
        found = read_json(out / CHECKSUMS)
    except UserError:
        return None
    is_sane = isinstance(found, dict) and all(isinstance(value, str) for value in found.values())
    return found if is_sane else None


def written_digests(out: Path) -> dict[str, set[str]]:
    """By name, the checksums of all that was written to an unfinished folder; see `atomic.recorded_writes`."""
    journal = out / JOURNAL
    found: dict[str, set[str]] = {}
    for line in journal.read_bytes().decode("utf-8", "replace").splitlines() if journal.exists() else []:
        digest, _, name = line.partition("  ")
        if len(digest) == _DIGEST_LENGTH and name and not name.startswith("/") and ".." not in name.split("/"):
            found.setdefault(name, set()).add(digest)
    return found


def first_damaged(out: Path) -> Path | None:
    """The first file of an unfinished folder that is none of what was written under its name."""
    for name, digests in written_digests(out).items():
        path = out / name
        is_listed = not path.is_file() or file_digest(path) in digests
        # another process may have written it since the list was read
        if not is_listed and file_digest(path) not in written_digests(out)[name]:
            return path
    return None
