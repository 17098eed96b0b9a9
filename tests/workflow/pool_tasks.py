"""Tasks for the pool tests: importable by worker processes."""

import os
import signal
import time
from pathlib import Path


def square(value: int) -> int:
    return value * value


def fail(value: int) -> int:
    raise ValueError(f"no {value}")


def die(value: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return value


def die_once(marker: str) -> str:
    if not Path(marker).exists():
        Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def threads(_: int) -> str:
    return os.environ["OMP_NUM_THREADS"]
