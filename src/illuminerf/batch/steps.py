"""One step of one job: the unit that is scheduled, retried and shown, and what a worker does about it.

Where the job's `out` is a folder that the worker sees, stages work in it, and a step that was cut off goes on from what
it had written. Elsewhere (S3 and the like) a worker fetches what the stage needs, works in a folder of its own, and
stores the stage's folder with DONE last; a step that was cut off is done again.
"""

import fcntl
import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from illuminerf.batch.jobs import Job
from illuminerf.batch.outcome import present_job
from illuminerf.batch.stages import STAGES_OF_OBJECT, Place, Stage, stage_folder, stages_of
from illuminerf.workflow.artefact import InUse
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.transfer import TransferError, fetch_folder, store_files, store_folder

REPORT = "report"
Present = Callable[[Path, Job, tuple[str, ...], tuple[str, ...]], list[str]]
_SHARDS = "shards"
_WRITTEN_LAST = {"provenance.json", "checksums.json", "DONE"}
_SCRATCH_PREFIX = "illuminerf-step-"


@dataclass(frozen=True, order=True)
class Step:
    """A stage of a job, or a share of its views."""

    job: str
    light: str
    """Its name; "" for stages that all lights share."""
    stage: str
    shard: str = ""
    """i/n; "": the whole stage, or what seals its shares."""

    @property
    def folder(self) -> str:
        """The stage's folder in the run."""
        return stage_folder(self.stage, self.light)

    @property
    def marker(self) -> str:
        """File in the run that says that this share of the views is stored."""
        return f"{_SHARDS}/{self.folder}/{self.shard.replace('/', '-of-')}"

    def __str__(self) -> str:
        share = f" {self.shard}" if self.shard else ""
        return " / ".join(part for part in (self.job, self.light, self.stage) if part) + share


@dataclass(frozen=True)
class Task:
    """What a worker is told."""

    step: Step
    job: Job
    is_shared: bool = False
    """Whether other steps do shares of this stage."""
    lights: tuple[str, ...] = ()
    """Of the report: the lights that are finished."""
    scratch: str = ""
    """Folder for what a worker fetches; "": the system's."""


@dataclass(frozen=True)
class Outcome:
    """What became of a step."""

    seconds: float
    error: str = ""
    """What went wrong; "": nothing."""
    may_pass: bool = False
    """Whether the machine, the network or the storage is to blame, so that the step is worth another try."""
    details: str = field(default="", repr=False)
    """Traceback of an error that nobody foresaw."""


def run_step(task: Task) -> Outcome:
    """Do a step in this process."""
    return attempt(task, stages_of(task.job))


def attempt(task: Task, stages: Mapping[str, Stage], present: Present = present_job) -> Outcome:
    """Do a step of a table of stages; whatever goes wrong is told, so that it costs no other job.

    Args:
        task: the step.
        stages: the job's table.
        present: makes what the job shows.
    """
    start = time.monotonic()

    def failed(error: BaseException, may_pass: bool, details: str = "") -> Outcome:
        said = str(error) if isinstance(error, (UserError, TransferError)) else f"{type(error).__name__}: {error}"
        return Outcome(time.monotonic() - start, said, may_pass, details)

    try:
        with _workplace(task) as (place, storage):
            if task.step.stage == REPORT:
                _report(task, place, storage, stages, present)
            else:
                _stage(task, place, storage, stages)
    except (TransferError, InUse, OSError, MemoryError) as error:
        return failed(error, may_pass=True)
    except UserError as error:
        return failed(error, may_pass=_is_the_machines(error.__cause__))
    except Exception as error:  # a fault of the program in one job must not end the others
        return failed(error, type(error).__name__ == "OutOfMemoryError", traceback.format_exc())
    return Outcome(time.monotonic() - start)


def _is_the_machines(cause: BaseException | None) -> bool:
    """Whether what lies behind an error is a disk or a network that may be well again later."""
    lasting = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
    return isinstance(cause, OSError) and not isinstance(cause, lasting)


@contextmanager
def _workplace(task: Task) -> Iterator[tuple[Place, Storage | None]]:
    """Where the step works, and the storage that things are fetched from and stored in; None where it works in it."""
    storage, step = Storage(task.job.out), task.step
    parent = Path(task.scratch or tempfile.gettempdir())
    parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(parent)
    with tempfile.TemporaryDirectory(prefix=_SCRATCH_PREFIX, dir=parent) as scratch, _held(Path(scratch)):
        run = storage.path or Path(scratch) / step.job
        shard = step.shard or ("0/1" if task.is_shared else "")
        place = Place(task.job, run, step.light, shard, Path(scratch) / "inputs")
        yield place, None if storage.path else storage


def _stage(task: Task, place: Place, storage: Storage | None, stages: Mapping[str, Stage]) -> None:
    step = task.step
    stage = stages[step.stage]
    if storage is None:
        stage.run(place)
        return
    for need in stage.needs:
        fetch_folder(storage, stage_folder(need, step.light), place.folder(need))
    seals = task.is_shared and not step.shard
    there = fetch_folder(storage, step.folder, place.folder(step.stage)) if seals else set()
    stage.run(place)
    store_folder(place.folder(step.stage), storage, step.folder, there - _WRITTEN_LAST)
    if step.shard:
        storage.write(step.marker, b"")
    elif seals:
        folder = step.marker.rpartition("/")[0]
        for name in storage.names(folder):
            storage.remove(f"{folder}/{name}")


def _report(task: Task, place: Place, storage: Storage | None, stages: Mapping[str, Stage], present: Present) -> None:
    if storage is not None:
        for stage in stages:
            for light in ("",) if stage in STAGES_OF_OBJECT else task.lights:
                folder = stage_folder(stage, light)
                fetch_folder(storage, folder, place.run / folder, _is_shown(stage))
    made = present(place.run, task.job, task.lights, tuple(stages))
    if storage is not None:
        store_files(place.run, made, storage)


def _is_shown(stage: str) -> Callable[[str], bool]:
    """Which files of a stage a report needs: not the large ones that it shows nothing of."""

    def is_wanted(name: str) -> bool:
        if stage == "cues" and name.startswith("cues/"):
            return name == "cues/000.exr"
        return not name.endswith((".safetensors", ".ply")) and not name.startswith("linear/")

    return is_wanted


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Keep `_remove_abandoned` of other workers off a folder for as long as this process lives."""
    handle = os.open(folder / ".held", os.O_CREAT | os.O_RDWR, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_SH)
        yield
    finally:
        os.close(handle)


def _remove_abandoned(parent: Path) -> None:
    """Delete what workers that were killed had fetched."""
    for folder in parent.glob(f"{_SCRATCH_PREFIX}*"):
        try:
            handle = os.open(folder / ".held", os.O_RDWR)
        except OSError:  # just made or just removed, or another user's
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            continue
        else:
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(handle)
