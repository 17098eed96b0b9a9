"""Tasks for the pool tests: importable by worker processes."""

import os
import signal
import time
from pathlib import Path

from illuminerf.workflow.heartbeat import alive


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


def sleep_alive(seconds: float) -> float:
    for _ in range(5):
        time.sleep(seconds / 5)
        alive()
    return seconds


def run_out_of_memory(_: int) -> None:
    raise MemoryError


def threads(_: int) -> int:
    import torch

    return torch.get_num_threads()
