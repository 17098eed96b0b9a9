"""Readers under spoilt inputs: what each gives, how long it takes, how much memory.

Every input must give a result or a UserError, within `SECONDS` of computing and `GIGABYTES`. Inputs are read in a
process that may crash (`Worker`), under the eyes of the one that forked it (`watched`).
"""

import hashlib
import mmap
import os
import random
import resource
import shutil
import signal
import struct
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from illuminerf.workflow.errors import UserError
from tests.fuzz.readers import Reader

SECONDS = 20.0
"""Of computing, for one input: a machine may be busy."""
_PATIENCE = 15.0
"""Times that, by the clock: who neither computes nor ends has hung as well."""
GIGABYTES = 4.0
"""Resident memory of the process that reads, beyond what it has before."""
_PER_PROCESS = 20_000
_OWN_MISTAKE = 97
"""Exit status of a fork in which this code, not a reader, went wrong."""
_STATE = struct.Struct("<5Qd")
"""What a worker tells: the input it is at, inputs begun (a sign of life), distinct ones, results, errors, slowest."""


@dataclass(frozen=True)
class Escape:
    """An input that gave neither a result nor a UserError."""

    reader: str
    kind: str
    """Name of the exception; "hang", "memory", or "crash" where the process ended."""
    seed: int
    """Of an input that was spoilt by a seed; else its number."""
    where: str
    file: str = ""
    """The input itself, where it was kept."""


@dataclass
class Tally:
    """What came of many inputs."""

    tried: int = 0
    distinct: int = 0
    """Of each process those that differ; a process has at most `_PER_PROCESS`."""
    results: int = 0
    errors: int = 0
    slowest: float = 0.0
    """Seconds of computing."""
    seconds: float = 0.0
    """Of computing, for all, with what it takes to spoil inputs and to start processes."""

    def add(self, more: "Tally") -> None:
        """Count another run's inputs too."""
        self.tried += more.tried
        self.distinct += more.distinct
        self.results += more.results
        self.errors += more.errors
        self.slowest = max(self.slowest, more.slowest)
        self.seconds += more.seconds


@dataclass
class Task:
    """Where a reader works, and until when."""

    reader: Reader
    folder: Path
    """Of the spoilt file; made anew by every process."""
    ends: float
    """By `time.monotonic`."""
    keep: Path | None = None
    """Folder for inputs that escape."""
    tally: Tally = field(default_factory=Tally)
    escapes: list[Escape] = field(default_factory=list)


def inputs_of(reader: Reader, folder: Path) -> list[bytes]:
    """Make `folder` ready for a reader; its good inputs."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return reader.seeds(folder)


def spoilt(reader: Reader, seeds: list[bytes], seed: int) -> bytes:
    """The input of a seed."""
    draw = random.Random(f"{reader.name} {seed}")
    return reader.mutate(draw.choice(seeds), draw, draw.choice(seeds))


def read_one(reader: Reader, folder: Path, content: bytes) -> str:
    """ "result" or "error"; anything but a UserError is raised."""
    with open(folder / reader.file, "wb", buffering=0) as stream:
        stream.write(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            reader.read(folder)
        except UserError:
            return "error"
    return "result"


def fuzz(
    reader: Reader, folder: Path, first: int, count: int, seconds: float, keep: Path | None = None
) -> tuple[Tally, list[Escape]]:
    """Try the inputs of `count` seeds from `first`, in processes that may crash, until the time is over."""
    task = Task(reader, folder, time.monotonic() + seconds, keep)
    at, end = first, first + count
    while at < end and time.monotonic() < task.ends:
        at = watched(task, at, min(at + _PER_PROCESS, end), _by_seeds)
    return task.tally, task.escapes


def replay(reader: Reader, folder: Path, content: bytes) -> list[Escape]:
    """Read one input as the others are read; its escape, if it is one still."""
    task = Task(reader, folder, time.monotonic() + 2 * _PATIENCE * SECONDS)
    watched(task, 0, 1, lambda worker: worker.read(content))
    return task.escapes


def _by_seeds(worker: "Worker") -> None:
    while worker.goes_on():
        worker.read(spoilt(worker.task.reader, worker.good, worker.at))


class Worker:
    """The process that reads: what it has done is in memory that the one who watches sees."""

    def __init__(self, task: Task, first: int, end: int, shared: mmap.mmap) -> None:
        self.task, self.at, self._end, self._shared = task, first, end, shared
        self.good = inputs_of(task.reader, task.folder)
        self._kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        self._begun = self._results = self._errors = 0
        self._slowest = 0.0
        self._seen: set[int] = set()
        warnings.simplefilter("ignore")

    def goes_on(self) -> bool:
        """Whether there is another input to be read, and time."""
        return self.at < self._end and time.monotonic() < self.task.ends

    def read(self, content: bytes, counts: bool = True) -> None:
        """Read one input and note what comes of it; one that was counted by another process before does not count."""
        self._begun += 1
        self._tell()
        began = time.process_time()
        try:
            outcome = read_one(self.task.reader, self.task.folder, content)
            self._results += counts and outcome == "result"
            self._errors += counts and outcome == "error"
        except (Exception, SystemExit) as error:
            self._note(type(error).__name__, _place(error), content)
        took = time.process_time() - began
        self._slowest = max(self._slowest, took)
        if took > SECONDS:
            self._note("hang", f"{took:.0f} s", content)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if peak - self._kilobytes > GIGABYTES * 2**20:
            self._note("memory", f"{(peak - self._kilobytes) / 2**20:.1f} GB", content)
            self._kilobytes = peak
        if counts:
            self.at += 1
            self._seen.add(hash(content))
        self._tell()

    def _tell(self) -> None:
        numbers = (self.at, self._begun, len(self._seen), self._results, self._errors)
        _STATE.pack_into(self._shared, 0, *numbers, self._slowest)

    def _note(self, kind: str, where: str, content: bytes) -> None:
        file = _kept(self.task, kind, content)
        with open(_log(self.task), "a", errors="replace") as stream:
            stream.write(f"{self.at}\t{kind}\t{file}\t{where}\n")


def watched(task: Task, first: int, end: int, work: Callable[[Worker], None]) -> int:
    """Let a fork `work` on the inputs from `first` to `end`; the number of the next input."""
    shared = mmap.mmap(-1, _STATE.size)
    _STATE.pack_into(shared, 0, first, 0, 0, 0, 0, 0.0)
    _log(task).unlink(missing_ok=True)
    pid = os.fork()
    if pid == 0:
        _work(task, first, end, shared, work)
    status, seconds, is_hung = _wait(pid, shared)
    at, begun, distinct, results, errors, slowest = _STATE.unpack_from(shared)
    task.escapes += _logged(task)
    if status != 0:
        at = _crashed(task, at, begun, "hang" if is_hung else "crash", status)
    task.tally.add(Tally(at - first, distinct, results, errors, slowest, seconds))
    return at


def _crashed(task: Task, at: int, begun: int, kind: str, status: int) -> int:
    """Note the input at which a process ended; the number of the next one."""
    if not begun or (os.WIFEXITED(status) and os.WEXITSTATUS(status) == _OWN_MISTAKE):
        raise RuntimeError(f"the fuzzer of {task.reader.name} failed: wait status {status}")
    content = (task.folder / task.reader.file).read_bytes()
    task.escapes.append(Escape(task.reader.name, kind, at, f"wait status {status}", _kept(task, kind, content)))
    return at + 1


def _work(task: Task, first: int, end: int, shared: mmap.mmap, work: Callable[[Worker], None]) -> None:
    """The fork's life: silent, whatever libraries have to say, but for its own mistakes."""
    status, said = _OWN_MISTAKE, os.dup(2)
    silence = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        work(Worker(task, first, end, shared))
        status = 0
    except BaseException:
        os.dup2(said, 2)
        traceback.print_exc()
    finally:
        os._exit(status)


def _wait(pid: int, shared: mmap.mmap) -> tuple[int, float, bool]:
    """The status with which a process ended, seconds that it computed, and whether it had to be stopped."""
    seen, since, computed, is_hung = -1, time.monotonic(), 0.0, False
    while True:
        ended, status, usage = os.wait4(pid, os.WNOHANG)
        if ended:
            return status, usage.ru_utime + usage.ru_stime, is_hung
        begun = _STATE.unpack_from(shared)[1]
        if begun != seen:
            seen, since, computed = begun, time.monotonic(), _computed(pid)
        elif _computed(pid) - computed > SECONDS + 1 or time.monotonic() - since > _PATIENCE * SECONDS:
            os.kill(pid, signal.SIGKILL)
            is_hung = True
        time.sleep(0.02)


def _computed(pid: int) -> float:
    """Seconds that a process has computed; 0 where the system does not tell."""
    stat = Path(f"/proc/{pid}/stat")
    if not stat.exists():
        return 0.0
    fields = stat.read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _log(task: Task) -> Path:
    return task.folder.parent / "log"


def _logged(task: Task) -> Iterator[Escape]:
    log = _log(task)
    for line in log.read_text(errors="replace").splitlines() if log.exists() else []:
        seed, kind, file, where = line.split("\t", 3)
        yield Escape(task.reader.name, kind, int(seed), where, file)


def _kept(task: Task, kind: str, content: bytes) -> str:
    """Write an input that escaped to the folder that has its reader's name; the path, or "" where none is kept."""
    if task.keep is None:
        return ""
    path = task.keep / task.reader.name / f"{kind}-{hashlib.sha256(content).hexdigest()[:16]}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return str(path)


def _place(error: BaseException) -> str:
    """The last line of ours and the message, in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "illuminerf" in frame.filename] or list(frames)
    text = " ".join(str(error).split())[:150]
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}: {text}"
