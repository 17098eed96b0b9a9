"""Commands that write benchmark data: made-up, or rebuilt from what is public."""

from pathlib import Path
from typing import Annotated

import tyro

from illuminerf.stages import render_synthetic_orb, unpack_tensoir_gallery
from illuminerf.workflow.progress import say

_GALLERY = unpack_tensoir_gallery.Config()
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


def tensoir_gallery_command(
    videos: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    cameras: Path,
    config: Annotated[unpack_tensoir_gallery.Config, tyro.conf.arg(name="")] = _GALLERY,
) -> None:
    """Rebuild the TensoIR benchmark in its official layout from the paper's public gallery videos, and beside it the
    published renderings that lie there.

    Args:
        videos: static/tensoir_results of the repository of the paper's project page.
        out: Folder; run the same command again to go on after an interruption.
        cameras: Folder with transforms_train.json and transforms_test.json of NeRF-synthetic's lego.
        config: What is unpacked.
    """
    unpack_tensoir_gallery.run(videos, cameras, config, out)
    say(f"done: {out}")
