"""Progress with time left: a bar on a terminal, one line now and then in a log."""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from illuminerf.workflow.heartbeat import alive

Item = TypeVar("Item")
_LOG_EVERY_SECONDS = 15.0
_NARROW, _NARROW_BAR, _BAR, _TIME_WIDTH = 100, 10, 30, 7
console = Console(stderr=True, soft_wrap=True)


class StepProgress:
    """Counts steps of one named piece of work."""

    def __init__(self, description: str, total: int, completed: int = 0) -> None:
        self.description, self.total, self.completed = description, total, completed
        self._start, self._first = time.monotonic(), completed
        self._last_line = self._start
        self._bar: Progress | None = None
        if console.is_terminal and not console.quiet and console.width >= 40:
            is_narrow = console.width < _NARROW
            bar, times = (_NARROW_BAR if is_narrow else _BAR), [TimeRemainingColumn()]
            columns = [TextColumn("{task.description}", markup=False), BarColumn(bar_width=bar), MofNCompleteColumn()]
            columns += times if is_narrow else [TimeElapsedColumn(), *times]
            used = len(description) + bar + 2 * len(str(total)) + 1 + (len(columns) - 3) * _TIME_WIDTH
            self._room = console.width - used - len(columns)
            self._bar = Progress(*columns, TextColumn("{task.fields[note]}", markup=False), console=console)
            self._task = self._bar.add_task(description, total=total, completed=completed, note="")

    def advance(self, steps: int = 1, **numbers: float) -> None:
        """Count `steps` more; `numbers` are shown beside the bar, e.g. psnr=27.1."""
        alive()
        self.completed += steps
        parts = [f"{name} {value:.4g}" for name, value in numbers.items()]
        while self._bar is not None and parts and len(" ".join(parts)) > self._room:
            parts.pop()  # else counts and time would be cut off
        note = " ".join(parts)
        if self._bar is not None:
            self._bar.update(self._task, completed=self.completed, note=note)
            return
        now = time.monotonic()
        if console.quiet:
            return
        if now - self._last_line >= _LOG_EVERY_SECONDS or self.completed == self.total:
            self._last_line = now
            rate = (self.completed - self._first) / max(now - self._start, 1e-9)
            left = (self.total - self.completed) / rate if rate > 0 else float("nan")
            line = f"{self.description}: {self.completed}/{self.total}, {left:.0f} s left {note}".rstrip()
            print(line, file=sys.stderr, flush=True)


@contextmanager
def step_progress(description: str, total: int, completed: int = 0) -> Iterator[StepProgress]:
    """Show progress over `total` steps, of which `completed` were done by an earlier run."""
    progress = StepProgress(description, total, completed)
    if progress._bar is None:
        yield progress
        return
    with progress._bar:
        yield progress


def track(iterable: Iterable[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Iterate with progress."""
    if total is None:
        total = len(iterable) if isinstance(iterable, Sized) else 0
    with step_progress(description, total) as progress:
        for item in iterable:
            yield item
            progress.advance()


def be_quiet() -> None:
    """Show nothing from now on: another process speaks for all."""
    console.quiet = True


def say(message: str, *, markup: bool = False) -> None:
    """Tell the person at the terminal something, above any bar.

    Args:
        message: printed as it stands, brackets and all.
        markup: the message has Rich's markup, such as [bold]; what it holds of names, paths and other people's words
            must then have gone through `rich.markup.escape`, or it loses its brackets or does not print at all.
    """
    console.print(message, highlight=False, markup=markup, emoji=False)


def show_table(table: Table) -> None:
    """Print a table with all words and numbers whole; where the terminal is too narrow for that it runs past the edge.

    Rich would cut them, widest column first, and half a figure tells nothing.
    """
    unbound = console.options.update(max_width=10_000)
    for column in table.columns:
        cells = (column.header, *column.cells, column.footer)
        column.min_width = max(console.measure(cell, options=unbound).minimum for cell in cells)
    console.print(table, crop=False, soft_wrap=False)
