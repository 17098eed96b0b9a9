"""Commands that write benchmark data: made-up, or rebuilt from what is public."""

from pathlib import Path
from typing import Annotated

import tyro

from illuminerf.stages import render_synthetic_orb
from illuminerf.workflow.progress import say

_SYNTHETIC_ORB = render_synthetic_orb.Config()


def synthetic_orb_command(
    out: tyro.conf.Positional[Path],
    config: Annotated[render_synthetic_orb.Config, tyro.conf.arg(name="")] = _SYNTHETIC_ORB,
) -> None:
    """Render a small data set in Stanford-ORB's layout from formulas, to try the benchmark on.

    Args:
        out: Folder; run the same command again to go on after an interruption.
        config: Size and quality.
    """
    render_synthetic_orb.run(config, out)
    say(f"done: {out}")
