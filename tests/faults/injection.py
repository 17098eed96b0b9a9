"""Faults of files, made to happen: the n-th file operation below a folder kills the process or fails.

Operations are counted by Python's audit hooks (open, rename, remove, mkdir, chmod, listing) and in `os.fsync`. Writes
of C++ libraries go past these; for them a limit on the size of files makes the write itself fail.
"""

import errno
import json
import os
import resource
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from illuminerf.workflow import progress
from illuminerf.workflow.errors import UserError

FaultKind = Literal["none", "kill", "EIO", "ENOSPC", "size", "later"]
_EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "os.scandir", "os.listdir")
_PATIENCE_SECONDS = 240.0


@dataclass(frozen=True)
class Fault:
    """What goes wrong in a child process."""

    kind: FaultKind = "none"
    """kill: SIGKILL; EIO, ENOSPC: the operation fails; size: no file may grow beyond `at` bytes; later: SIGKILL after
    `at` milliseconds."""
    at: int = 0
    """Number of the operation, from 1."""


@dataclass(frozen=True)
class Outcome:
    """How a child process ended."""

    status: Literal["done", "user error", "escaped", "killed", "hung"]
    message: str = ""
    operations: int = 0
    """File operations that were counted."""
    seconds: float = 0.0


class _Injector:
    def __init__(self, root: Path, fault: Fault) -> None:
        self.root, self.fault, self.count = str(root), fault, 0

    def install(self) -> None:
        sys.addaudithook(self._audit)  # for the rest of this process
        fsync = os.fsync

        def counted(handle: int) -> None:
            self._operation(None)
            fsync(handle)

        os.fsync = counted

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in _EVENTS and isinstance(arguments[0], (str, os.PathLike)):
            path = os.fspath(arguments[0])
            if isinstance(path, str) and path.startswith(self.root):
                self._operation(path)

    def _operation(self, path: str | None) -> None:
        self.count += 1
        if self.count != self.fault.at:
            return
        if self.fault.kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        elif self.fault.kind in ("EIO", "ENOSPC"):
            number = getattr(errno, self.fault.kind)
            raise OSError(number, os.strerror(number), path)


def start(work: Callable[[], object], root: Path, fault: Fault | None = None) -> tuple[int, int]:
    """Do `work` in a fork of this process, with a fault among the operations below `root`; (pid, pipe)."""
    fault = fault or Fault()
    reading, writing = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writing)
        return pid, reading
    os.close(reading)
    status, message = "done", ""
    injector = _Injector(root, fault)
    try:
        progress.be_quiet()
        injector.install()
        if fault.kind == "size":
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (fault.at, fault.at))
        elif fault.kind == "later":
            signal.setitimer(signal.ITIMER_REAL, max(fault.at, 1) / 1000)
            signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        work()
    except UserError as error:
        status, message = "user error", str(error)
    except BaseException:
        status, message = "escaped", traceback.format_exc()
    signal.setitimer(signal.ITIMER_REAL, 0)
    content = json.dumps({"status": status, "message": message[-3000:], "operations": injector.count}).encode()
    os.write(writing, content)
    os._exit(0)


def finish(child: tuple[int, int]) -> Outcome:
    """Wait for what `start` started."""
    pid, reading = child
    began = time.monotonic()
    content, is_open = b"", True
    while is_open:
        left = _PATIENCE_SECONDS - (time.monotonic() - began)
        ready = select.select([reading], [], [], max(left, 0))[0]
        if not ready:
            os.kill(pid, signal.SIGKILL)
        piece = os.read(reading, 2**16) if ready else b""
        content, is_open = content + piece, bool(piece)
    os.close(reading)
    _, ended = os.waitpid(pid, 0)
    seconds = time.monotonic() - began
    if content:
        return Outcome(**json.loads(content), seconds=seconds)
    is_hung = seconds >= _PATIENCE_SECONDS
    is_killed = os.WIFSIGNALED(ended) and os.WTERMSIG(ended) == signal.SIGKILL
    if is_hung or is_killed:
        return Outcome("hung" if is_hung else "killed", seconds=seconds)
    return Outcome("escaped", f"the process ended with the wait status {ended}", seconds=seconds)


def in_child(work: Callable[[], object], root: Path, fault: Fault | None = None) -> Outcome:
    """`start` and `finish`."""
    return finish(start(work, root, fault))
