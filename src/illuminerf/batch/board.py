"""How far every job, light and stage is: status.json for programs, status.html for people, both kept up to date."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

from illuminerf.batch.status_page import status_page
from illuminerf.batch.steps import Outcome, Step
from illuminerf.workflow.config import to_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say
from illuminerf.workflow.storage import Storage

STATUS, PAGE = "status.json", "status.html"
State = Literal["waiting", "running", "done", "failed", "blocked"]
_SCHEMA = 1
_WRITE_EVERY_SECONDS = 5.0
_MOST_OF_THE_TIME = 20
"""So many times longer than the last writing took, the next one waits: large boards on slow storage."""


@dataclass
class Cell:
    """One stage of one job under one light."""

    job: str
    light: str
    stage: str
    num_steps: int = 0
    """Shares of its views, and one more that seals them; 1 where it is not shared."""
    num_done: int = 0
    num_running: int = 0
    seconds: float = 0.0
    """Of finished steps, added up."""
    since: float | None = None
    """When it began to run, in seconds since 1970; None: not running."""
    attempts: int = 0
    """How often a step failed and was tried again."""
    error: str = ""
    failed_at: float | None = None
    is_blocked: bool = False
    """Whether a stage that it needs failed."""

    @property
    def state(self) -> State:
        if self.failed_at is not None:
            return "failed"
        if self.is_blocked:
            return "blocked"
        if self.num_running:
            return "running"
        return "done" if self.num_done == self.num_steps else "waiting"


@dataclass
class Board:
    """All cells, in the order of the jobs."""

    storage: Storage
    cells: dict[tuple[str, str, str], Cell] = field(default_factory=dict)
    now: Callable[[], float] = time.time
    _due: float = 0.0

    def expect(self, steps: Iterable[Step]) -> None:
        """Make room for steps that are to come."""
        for step in steps:
            key = step.job, step.light, step.stage
            self.cells.setdefault(key, Cell(*key)).num_steps += 1

    def start(self, step: Step) -> None:
        """A step runs from now on."""
        cell = self._cell(step)
        cell.num_running += 1
        cell.since = cell.since or self.now()

    def end(self, step: Step, outcome: Outcome, again: bool = False) -> None:
        """A step came back, well or not; `again`: it will be tried once more."""
        cell = self._cell(step)
        cell.num_running -= 1
        cell.since = cell.since if cell.num_running else None
        cell.seconds += outcome.seconds
        cell.error = outcome.error
        if not outcome.error:
            cell.num_done += 1
        elif again:
            cell.attempts += 1
        else:
            cell.failed_at = self.now()

    def was_done(self, step: Step) -> None:
        """An earlier run did this step."""
        self._cell(step).num_done += 1

    def fail(self, step: Step, error: str) -> None:
        """A step cannot be done."""
        cell = self._cell(step)
        cell.error, cell.failed_at = error, self.now()

    def block(self, step: Step) -> None:
        """A step will not be done, since one that it needs failed."""
        self._cell(step).is_blocked = True

    def stop(self) -> None:
        """Nothing runs any more."""
        for cell in self.cells.values():
            cell.num_running, cell.since = 0, None

    def states(self, job: str) -> set[State]:
        """The states of a job's cells."""
        return {cell.state for cell in self.cells.values() if cell.job == job}

    def write(self, is_last: bool = False) -> None:
        """Write both files, unless that was done just now."""
        if self.now() < self._due and not is_last:
            return
        start = self.now()
        content = self.content(is_last)
        try:
            self.storage.write_json(STATUS, content)
            self.storage.write(PAGE, status_page(content, 0 if is_last else int(_WRITE_EVERY_SECONDS)))
        except UserError as error:  # the work matters more, and the next time may be better
            say(f"the status is not up to date: {error}")
        self._due = self.now() + max(_WRITE_EVERY_SECONDS, _MOST_OF_THE_TIME * (self.now() - start))

    def content(self, is_last: bool) -> dict[str, Any]:
        """What status.json holds."""
        cells = [to_json(cell) | {"state": cell.state} for cell in self.cells.values()]
        return {"schema": _SCHEMA, "updated": self.now(), "is_over": is_last, "cells": cells}

    def _cell(self, step: Step) -> Cell:
        return self.cells[step.job, step.light, step.stage]


def read_status(storage: Storage) -> dict[str, Any]:
    """What the last batch in this place wrote of itself.

    Raises:
        UserError: there was none, or another release wrote it.
    """
    content = storage.read_json(STATUS)
    if content is None:
        raise UserError(f"{storage.url} has no {STATUS}", fix="run the batch first, without --status")
    if content.get("schema") != _SCHEMA:
        raise UserError(f"{storage.url}/{STATUS} is another release's", got=str(content.get("schema")))
    return dict(content)
