"""Progress counts as a sign of life, inside of a watched worker only."""

from typing import Any

import pytest

from illuminerf.workflow import heartbeat
from illuminerf.workflow.progress import StepProgress


class Watchdog:
    """In place of faulthandler."""

    def __init__(self) -> None:
        self.calls: list[Any] = []

    def dump_traceback_later(self, seconds: float, exit: bool, file: Any) -> None:
        self.calls.append(seconds)

    def cancel_dump_traceback_later(self) -> None:
        self.calls.append("off")


def test_progress_keeps_a_worker_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    dog = Watchdog()
    monkeypatch.setattr(heartbeat, "faulthandler", dog)
    steps = StepProgress("work", 3)
    steps.advance()
    assert dog.calls == [], "nobody watches"
    with heartbeat.watched(7.0):
        steps.advance()
    steps.advance()
    assert dog.calls == [7.0, 7.0, "off"]
