"""Signs of life: a worker process that gives none for too long ends itself, so that its task can run elsewhere."""

import faulthandler
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

_watched: list[tuple[float, TextIO]] = []


def alive() -> None:
    """Called in between: the watchdog of this worker starts anew. Nothing happens outside of a worker.

    Every step of a progress bar calls it (`progress.StepProgress.advance`).
    """
    if _watched:
        seconds, nowhere = _watched[-1]
        faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)


@contextmanager
def watched(seconds: float) -> Iterator[None]:
    """End this process where `alive` is not called for so long inside the block."""
    with open(os.devnull, "w") as nowhere:
        _watched.append((seconds, nowhere))
        alive()
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            _watched.pop()
