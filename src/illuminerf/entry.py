"""Where the command `illuminerf` starts: help in a moment, everything else by `cli`, whose imports take seconds."""

import difflib
import shutil
import sys
import textwrap

from illuminerf import __version__
from illuminerf.commands import GROUPS, SUMMARIES

_COLUMN, _WIDEST = 26, 120


def main(arguments: list[str] | None = None) -> None:
    """Print what commands there are where no other thing is asked for, else run the command line."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    if arguments in ([], ["-h"], ["--help"]):
        print(overview(shutil.get_terminal_size((_WIDEST, 24)).columns))
        sys.exit(0 if arguments else 2)
    if arguments in (["--version"], ["-V"], ["version"]):
        print(f"illuminerf {__version__}")
        sys.exit(0)
    if complaint := unknown_command(arguments):
        print(complaint, file=sys.stderr)
        sys.exit(2)
    try:
        from illuminerf import cli
    except KeyboardInterrupt:  # before `cli` can take care of it
        print("stopped; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    cli.main(arguments)


def overview(width: int = _WIDEST) -> str:
    """All commands with a line each, or several where the terminal is narrow."""
    lines = ["usage: illuminerf COMMAND [OPTIONS]", "", "Relight photographed objects.", "", "commands:"]
    lines += [_entry(name, summary, width) for name, summary in SUMMARIES.items()]
    lines += ["", "groups of commands:"]
    lines += [_entry(group, ", ".join(names), width) for group, names in GROUPS.items()]
    return "\n".join([*lines, "", "illuminerf COMMAND --help tells the options of one."])


def unknown_command(arguments: list[str]) -> str:
    """What to tell a person who names a command that does not exist, or an empty string."""
    first, *others = (word.replace("_", "-") for word in arguments[:2])
    if first in GROUPS:
        return _complaint(f"{first} ", others[0], list(GROUPS[first])) if others else ""
    return _complaint("", first, [*SUMMARIES, *GROUPS])


def _complaint(group: str, given: str, known: list[str]) -> str:
    if given in known or given.startswith("-"):
        return ""
    close = difflib.get_close_matches(given.lower(), known, n=2, cutoff=0.5)
    hint = f" Did you mean {' or '.join(group + name for name in close)}?" if close else ""
    return f"error: there is no command '{group}{given}'.{hint} Fix: see 'illuminerf {group}--help'."


def _entry(name: str, text: str, width: int) -> str:
    return textwrap.fill(
        text,
        max(min(width, _WIDEST), _COLUMN + 20),
        initial_indent=f"  {name:<{_COLUMN - 2}}",
        subsequent_indent=" " * _COLUMN,
        break_on_hyphens=False,
    )
