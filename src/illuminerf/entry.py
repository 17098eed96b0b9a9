"""Where the command `illuminerf` starts: help in a moment, everything else by `cli`, whose imports take seconds."""

import sys

from illuminerf.commands import GROUPS, SUMMARIES

_WIDTH = 28


def main(arguments: list[str] | None = None) -> None:
    """Print what commands there are where no other thing is asked for, else run the command line."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments in ([], ["-h"], ["--help"]):
        print(overview())
        sys.exit(0 if arguments else 2)
    from illuminerf import cli

    cli.main(arguments)


def overview() -> str:
    """All commands with a line each."""
    lines = ["usage: illuminerf COMMAND [OPTIONS]", "", "Relight photographed objects.", "", "commands:"]
    lines += [f"  {name:<{_WIDTH}}{summary}" for name, summary in SUMMARIES.items()]
    lines += ["", "groups of commands:"]
    lines += [f"  {group:<{_WIDTH}}{', '.join(names)}" for group, names in GROUPS.items()]
    return "\n".join([*lines, "", "illuminerf COMMAND --help tells the options of one."])
