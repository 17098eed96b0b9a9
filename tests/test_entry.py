"""The package is imported, and help is there, without anything that takes seconds to import."""

import subprocess
import sys

import pytest

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


def test_everything_else_goes_to_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    entry.main(["presets"])
    assert "embedded" in capsys.readouterr().err
