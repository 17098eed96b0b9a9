"""Readers under spoilt inputs: what each gives, how long it takes, how much memory.

Every input must give a result or a UserError, within `SECONDS` of computing and `GIGABYTES`.
"""

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
from collections.abc import Iterator
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Escape:
    """An input that gave neither a result nor a UserError."""

    reader: str
    kind: str
    """Name of the exception; "hang", "memory", or "crash" where the process ended."""
    seed: int
    where: str


@dataclass
class Tally:
    """What came of many inputs."""

    tried: int = 0
    results: int = 0
    errors: int = 0
    slowest: float = 0.0
    """Seconds."""


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
    (folder / reader.file).write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            reader.read(folder)
        except UserError:
            return "error"
    return "result"


def fuzz(reader: Reader, folder: Path, first: int, count: int, seconds: float) -> tuple[Tally, list[Escape]]:
    """Try the inputs of `count` seeds from `first`, in processes that may crash, until the time is over."""
    tally, escapes = Tally(), []
    ends, at = time.monotonic() + seconds, first
    while at < first + count and time.monotonic() < ends:
        at, found = _in_process(reader, folder, at, min(at + _PER_PROCESS, first + count), ends, tally)
        escapes += found
    return tally, escapes


def _in_process(
    reader: Reader, folder: Path, first: int, end: int, ends: float, tally: Tally
) -> tuple[int, list[Escape]]:
    """Seeds from `first` to `end` in a fork; the next seed and what escaped."""
    shared = mmap.mmap(-1, 64)
    log = folder.parent / "escapes"
    log.unlink(missing_ok=True)
    pid = os.fork()
    if pid == 0:
        try:
            _work(reader, folder, range(first, end), ends, shared, log)
        except BaseException:
            traceback.print_exc()
        os._exit(1)
    is_hung = False
    seen, since, computed = -1, time.monotonic(), 0.0
    while True:
        ended, status = os.waitpid(pid, os.WNOHANG)
        at, results, errors, _, slowest = struct.unpack_from("<QQQQd", shared)
        if ended:
            break
        if at != seen:
            seen, since, computed = at, time.monotonic(), _computed(pid)
        elif _computed(pid) - computed > SECONDS + 1 or time.monotonic() - since > _PATIENCE * SECONDS:
            os.kill(pid, signal.SIGKILL)
            is_hung = True
        time.sleep(0.02)
    tally.results += results
    tally.errors += errors
    tally.slowest = max(tally.slowest, slowest)
    escapes = list(_logged(reader, log))
    if not (os.WIFEXITED(status) and os.WEXITSTATUS(status) == 0):
        escapes.append(Escape(reader.name, "hang" if is_hung else "crash", at, f"wait status {status}"))
        at += 1
    tally.tried += at - first
    return at, escapes


def _computed(pid: int) -> float:
    """Seconds that a process has computed; 0 where the system does not tell."""
    stat = Path(f"/proc/{pid}/stat")
    if not stat.exists():
        return 0.0
    fields = stat.read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _logged(reader: Reader, log: Path) -> Iterator[Escape]:
    for line in log.read_text(errors="replace").splitlines() if log.exists() else []:
        seed, kind, where = line.split("\t", 2)
        yield Escape(reader.name, kind, int(seed), where)


def _work(reader: Reader, folder: Path, seeds: range, ends: float, shared: mmap.mmap, log: Path) -> None:
    good = inputs_of(reader, folder)
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    results = errors = 0
    slowest = 0.0
    for seed in seeds:
        struct.pack_into("<QQQQd", shared, 0, seed, results, errors, 0, slowest)
        if time.monotonic() > ends:
            os._exit(0)
        began = time.process_time()
        try:
            outcome = read_one(reader, folder, spoilt(reader, good, seed))
            results, errors = results + (outcome == "result"), errors + (outcome == "error")
        except Exception as error:
            _note(log, seed, type(error).__name__, _place(error))
        took = time.process_time() - began
        slowest = max(slowest, took)
        if took > SECONDS:
            _note(log, seed, "hang", f"{took:.0f} s")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if peak - kilobytes > GIGABYTES * 2**20:
            _note(log, seed, "memory", f"{(peak - kilobytes) / 2**20:.1f} GB")
            kilobytes = peak
    struct.pack_into("<QQQQd", shared, 0, seeds.stop, results, errors, 0, slowest)
    os._exit(0)


def _note(log: Path, seed: int, kind: str, where: str) -> None:
    with open(log, "a", errors="replace") as stream:
        stream.write(f"{seed}\t{kind}\t{where}\n")


def _place(error: Exception) -> str:
    """The last line of ours and the message, in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "illuminerf" in frame.filename] or list(frames)
    text = " ".join(str(error).split())[:150]
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}: {text}"
