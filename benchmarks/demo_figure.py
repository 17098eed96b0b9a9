"""The README's picture of the demo, from a finished run.

    python benchmarks/demo_figure.py runs/demo docs/images/demo.png

Columns: photograph, diffuse cue, sharpest GGX cue, one sample of the diffusion model, then another, unseen view: ours
(each channel rescaled by the benchmark's rule) and the truth. All over white.
"""

import argparse
from pathlib import Path

import numpy as np

from illuminerf.data.capture import load_capture
from illuminerf.demo import TARGET_LIGHT
from illuminerf.run_folder import RunFolder
from illuminerf.scene.images import composite, read_exr, read_png, srgb_from_linear, write_png


def main() -> None:
    """Compose and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, nargs="+", default=[0, 17])
    arguments = parser.parse_args()
    run = RunFolder(arguments.run)
    light, views = run.light(TARGET_LIGHT), load_capture(run.capture).views
    compared = sorted((arguments.run / "lights" / TARGET_LIGHT / "scores" / "side_by_side").glob("*.png"))
    rows = []
    for number, view in enumerate(arguments.views):
        photograph, alpha = views.srgb[view], views.alpha[view][..., None]
        cue = read_exr(light.cues[view])
        names = [name.rsplit(".", 1)[0] for name in cue if name.endswith(".R")]
        diffuse, sharp = (np.stack([cue[f"{name}.{c}"] for c in "RGB"], -1) for name in names[:2])
        over_white = [
            composite(photograph, views.alpha[view], 1.0),
            *(srgb_from_linear(np.clip(part, 0, 1)) + 1 - alpha for part in (diffuse, sharp)),
            read_png(light.samples[view * (len(light.samples) // len(views))])[..., :3] + 1 - alpha,
        ]
        pair = read_png(compared[number * 2])
        rows.append(np.hstack([*over_white, pair[:, : 2 * pair.shape[0], :3]]))
    write_png(arguments.out, np.clip(np.vstack(rows), 0, 1))


if __name__ == "__main__":
    main()
