"""The status of a batch for people: an HTML page that loads itself anew, and a table for the terminal."""

import html
import time
from collections.abc import Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from illuminerf.scene.web_page import STYLE, web_page

_STATES = ("waiting", "running", "done", "failed", "blocked")
_COLOURS = {"running": "yellow", "done": "green", "failed": "bold red", "blocked": "magenta", "waiting": "dim"}
_STYLE = (
    STYLE
    + """
td { white-space: nowrap } td.waiting { opacity: .45 } td.running { background: #e6b40055 }
td.done { background: #2a9d4c44 } td.failed { background: #d62c2c88; font-weight: bold } td.blocked { opacity: .6 }
pre { white-space: pre-wrap; margin: .2rem 0 1rem }
"""
)


def status_page(content: dict[str, Any], refresh_seconds: int) -> bytes:
    """The page of what `board.Board.content` says; loaded anew every so many seconds, unless 0."""
    cells, updated = content["cells"], content["updated"]
    stages = _stages(cells)
    rows = []
    for (job, light), by_stage in _rows(cells).items():
        entries = "".join(_entry(by_stage.get(stage), updated) for stage in stages)
        rows.append(f"<tr><td>{html.escape(job)}</td><td>{html.escape(light or 'all lights')}</td>{entries}</tr>")
    head = "".join(f"<th>{stage.replace('_', ' ')}</th>" for stage in ("job", "light", *stages))
    body = (
        f"<h1>Batch: {'over' if content['is_over'] else 'under way'}</h1>"
        f"<p class=note>{_counted(cells)}; as of {_clock(updated)} UTC</p>"
        f"<table><tr>{head}</tr>{''.join(rows)}</table>{_errors(cells)}"
    )
    return web_page("batch", body, _STYLE, refresh_seconds=refresh_seconds)


def status_table(content: dict[str, Any]) -> Table:
    """The same for the terminal: a row per job, with its lights added up."""
    cells = content["cells"]
    stages = _stages(cells)
    is_over = "over" if content["is_over"] else "under way"
    table = Table(title=f"{is_over}: {_counted(cells)}; as of {_clock(content['updated'])} UTC")
    for name in ("job", *stages):
        table.add_column(escape(name.replace("_", " ")))
    for job in dict.fromkeys(cell["job"] for cell in cells):
        own = [cell for cell in cells if cell["job"] == job]
        texts = [_summary([cell for cell in own if cell["stage"] == stage]) for stage in stages]
        table.add_row(escape(job), *texts)
    return table


def failures(content: dict[str, Any]) -> list[str]:
    """A line for every stage that failed."""
    return [f"{_where(cell)}: {cell['error']}" for cell in content["cells"] if cell["state"] == "failed"]


def _rows(cells: Sequence[dict[str, Any]]) -> dict[tuple[str, str], dict[str, dict[str, Any]]]:
    rows: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for cell in cells:
        rows.setdefault((cell["job"], cell["light"]), {})[cell["stage"]] = cell
    return rows


def _stages(cells: Sequence[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(cell["stage"] for cell in cells))


def _entry(cell: dict[str, Any] | None, updated: float) -> str:
    if cell is None:
        return "<td></td>"
    parts = [cell["state"]]
    if cell["num_steps"] > 1 and cell["state"] in ("waiting", "running"):
        parts.append(f"{cell['num_done']}/{cell['num_steps']}")
    if cell["since"] is not None:
        parts.append(_duration(updated - cell["since"]))
    elif cell["seconds"]:
        parts.append(_duration(cell["seconds"]))
    if cell["attempts"]:
        parts.append(f"tried {cell['attempts'] + 1} times")
    return f"<td class={cell['state']} title='{html.escape(cell['error'], quote=True)}'>{', '.join(parts)}</td>"


def _errors(cells: Sequence[dict[str, Any]]) -> str:
    lines = []
    for cell in cells:
        if cell["error"]:
            when = f" at {_clock(cell['failed_at'])} UTC" if cell["failed_at"] is not None else ", tried again"
            lines.append(f"<b>{html.escape(_where(cell))}</b>{when}<pre>{html.escape(cell['error'])}</pre>")
    return f"<h2>Errors</h2>{''.join(lines)}" if lines else ""


def _summary(cells: Sequence[dict[str, Any]]) -> str:
    counts = {state: sum(cell["state"] == state for cell in cells) for state in _STATES}
    if not cells:
        return ""
    if len(cells) == 1:
        return f"[{_COLOURS[cells[0]['state']]}]{cells[0]['state']}[/]"
    return " ".join(f"[{_COLOURS[state]}]{count} {state}[/]" for state, count in counts.items() if count)


def _counted(cells: Sequence[dict[str, Any]]) -> str:
    counts = {state: sum(cell["state"] == state for cell in cells) for state in _STATES}
    return ", ".join(f"{count} {state}" for state, count in counts.items() if count) + f" of {len(cells)} stages"


def _where(cell: dict[str, Any]) -> str:
    return " / ".join(part for part in (cell["job"], cell["light"], cell["stage"]) if part)


def _clock(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(seconds))


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
