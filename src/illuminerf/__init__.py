"""Open IllumiNeRF: relightable view synthesis without inverse rendering.

Photographs of an object under one unknown light go in; the same object, from any side, under any light, comes
out. `illuminerf.pipeline` holds the whole method on one page; `relight` below is its short form.
"""

import os
from collections.abc import Sequence
from pathlib import Path

__version__ = "0.1.0"

# Waiting OpenMP threads that spin starve everybody, themselves included, once cores are shared: a geometry step took
# fourteen times as long. Read when torch is imported; a value that is already set wins.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def relight(
    photos: str | Path,
    lights: Sequence[str | Path],
    out: str | Path,
    preset: str = "embedded",
    samples: int | None = None,
    size: int | None = None,
    seed: int = 0,
    device: str = "auto",
    mesh: str | Path | None = None,
) -> Path:
    """Relight a capture under each of `lights`: what `illuminerf relight` does.

    Args:
        photos: folder of posed photographs (see docs/captures.md).
        lights: equirectangular .exr or .hdr maps, or names of bundled lights; geometry is estimated once for all.
        out: folder of the run; called again with the same arguments it goes on where it stopped.
        preset: settings of all stages.
        samples: samples per photograph, S in the paper.
        size: longest side of the photographs in pixels.
        seed: of every random stream.
        device: "auto", "cpu" or "cuda".
        mesh: a mesh in the capture's world that takes the place of estimated geometry.

    Returns:
        `out`, with report.html, turntable.mp4, mesh.glb and, per light, the artefacts of every stage.

    Raises:
        illuminerf.workflow.errors.UserError: bad input, or `out` was made with other settings.
    """
    from illuminerf import pipeline, presets  # torch and diffusers take seconds to import

    settings = presets.customised(preset, samples=samples, size=size, seed=seed, device=device)
    jobs = [pipeline.LightJob(Path(light)) for light in lights]
    pipeline.relight(Path(photos), jobs, settings, Path(out), None if mesh is None else Path(mesh))
    return Path(out)
