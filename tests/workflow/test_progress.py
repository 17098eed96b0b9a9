"""What is said is printed as it stands, unless it is our own markup."""

import pytest
from rich.errors import MarkupError
from rich.markup import escape
from rich.table import Table

from illuminerf import cli
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import console, say, show_table, track

NAMES = "left out [/b] of [red]: pip install 'illuminerf[cluster]' :warning: C:\\d"


def test_messages_are_printed_as_they_stand(capsys: pytest.CaptureFixture[str]) -> None:
    say(NAMES)
    assert capsys.readouterr().err == NAMES + "\n"


def test_own_markup_is_rendered_around_escaped_names(capsys: pytest.CaptureFixture[str]) -> None:
    say(f"[bold]{escape(NAMES)}[/bold]", markup=True)
    assert capsys.readouterr().err == NAMES + "\n"
    with pytest.raises(MarkupError):  # what escaping is for
        say(NAMES, markup=True)


def test_descriptions_may_hold_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track([1], "objects [/b]")) == [1]
    assert "objects [/b]: 1/1" in capsys.readouterr().err


def test_errors_and_warnings_keep_their_brackets(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails() -> None:
        cli.warnings.warn(NAMES, stacklevel=1)
        raise UserError(f"object {NAMES}", fix="pip install 'illuminerf[cluster]'")

    monkeypatch.setitem(cli.COMMANDS, "presets", fails)
    monkeypatch.setattr(cli.warnings, "showwarning", cli.warnings.showwarning)  # put back afterwards
    with cli.warnings.catch_warnings():
        cli.warnings.simplefilter("always")
        with pytest.raises(SystemExit) as stop:
            cli.main(["presets"])
    printed = capsys.readouterr().err
    assert stop.value.code == 2
    assert f"warning: {NAMES}\n" in printed and f"error: object {NAMES}" in printed
    assert "Fix: pip install 'illuminerf[cluster]'." in printed


def test_presets_keep_their_names(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["presets"])
    printed = capsys.readouterr().err
    assert "[bold]" not in printed and "embedded: " in printed


def test_tables_are_whole_on_narrow_terminals(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table(*[f"figure {number}" for number in range(12)])
    table.add_row(*[f"{number}.12345" for number in range(12)])
    console.print(table)  # what it is for
    assert "…" in capsys.readouterr().err
    show_table(table)
    shown = capsys.readouterr().err
    assert all(f"{number}.12345" in shown for number in range(12)) and "…" not in shown
