"""The package is imported, and help is there, without anything that takes seconds to import."""

import builtins
import subprocess
import sys
from typing import Any

import pytest

import illuminerf
from illuminerf import cli, commands, entry

HEAVY = ("torch", "numpy", "mitsuba", "drjit", "diffusers", "transformers", "viser", "numba", "scipy", "skimage", "ray")


def imported_by(code: str) -> set[str]:
    """Which heavy packages a fresh interpreter has imported after running `code`."""
    code += f"\nimport sys; print('imported:', *[name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split("imported:")[1].split())


def test_the_package_and_its_help_import_nothing_heavy() -> None:
    assert imported_by("import illuminerf") == set()
    asked = (
        "import contextlib\nfrom illuminerf.entry import main\nwith contextlib.suppress(SystemExit): main(['--help'])"
    )
    assert imported_by(asked) == set()
    assert imported_by("import illuminerf.workflow.errors, numpy") == {"numpy"}, "what is imported would be seen"


def test_the_overview_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(commands.SUMMARIES) == list(cli.COMMANDS)
    assert {group: list(names) for group, names in commands.GROUPS.items()} == {
        group: list(names) for group, names in cli.GROUPS.items()
    }
    for arguments, status in ((["--help"], 0), ([], 2)):
        with pytest.raises(SystemExit) as stop:
            entry.main(arguments)
        assert stop.value.code == status
        printed = capsys.readouterr().out
        assert all(f"\n  {name} " in printed for name in (*cli.COMMANDS, *cli.GROUPS))
        assert max(map(len, printed.splitlines())) <= 120


def told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What is printed at once for arguments that must be refused."""
    with pytest.raises(SystemExit) as stop:
        entry.main(arguments)
    assert stop.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["relit", "photos"], "relight"),
        (["Relight"], "relight"),
        (["capure"], "capture"),
        (["rotatelight"], "rotate-light"),
        (["lights", "previw"], "lights preview"),
        (["light", "list"], "lights"),
        (["wibble"], ""),
    ],
)
def test_a_mistyped_command_is_one_line_with_what_was_meant(
    arguments: list[str], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = told(arguments, capsys)
    assert said.startswith("error: there is no command '") and said.count("\n") == 1 and "--help" in said
    assert f"Did you mean {meant}" in said if meant else "Did you mean" not in said


def test_a_mistyped_command_costs_no_time() -> None:
    code = "import contextlib\nfrom illuminerf.entry import main\nwith contextlib.suppress(SystemExit): main(['relit'])"
    assert imported_by(code) == set()


def test_commands_that_exist_are_let_through() -> None:
    for arguments in (["rotate_light"], ["relight", "previw"], ["lights"], ["lights", "--help"], ["--tyro"]):
        assert entry.unknown_command(arguments) == ""
    assert entry.unknown_command(["lights", "polish"])


def test_version_and_help_in_the_words_people_try(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--version"], ["-V"], ["version"], ["help"], ["help", "presets"]):
        with pytest.raises(SystemExit) as stop:
            entry.main(arguments)
        assert stop.value.code == 0
        assert ("usage: illuminerf" if "help" in arguments else illuminerf.__version__) in capsys.readouterr().out


def test_the_overview_fits_a_narrow_terminal() -> None:
    assert max(map(len, entry.overview(60).splitlines())) <= 60 < max(map(len, entry.overview().splitlines()))


def test_hints_about_a_mistyped_option_are_of_the_same_command(capsys: pytest.CaptureFixture[str]) -> None:
    said = told(["relight", "photos", "--lights", "evening", "--out", "run"], capsys)
    assert "--light " in said and "training-pairs" not in said and len(said.splitlines()) < 40


def test_ctrl_c_during_the_imports_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = builtins.__import__

    def interrupted(name: str, *arguments: Any, **named: Any) -> Any:
        if name == "illuminerf" and "cli" in (arguments[2] or ()):
            raise KeyboardInterrupt
        return real(name, *arguments, **named)

    monkeypatch.setattr(builtins, "__import__", interrupted)
    with pytest.raises(SystemExit) as stop:
        entry.main(["presets"])
    assert stop.value.code == 130 and "run the same command again" in capsys.readouterr().err


def test_everything_else_goes_to_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    entry.main(["presets"])
    assert "embedded" in capsys.readouterr().err
