"""Open IllumiNeRF: relightable view synthesis without inverse rendering.

Photographs of an object under one unknown light go in; the same object, from any side, under any light, comes
out. `illuminerf.pipeline` holds the whole method on one page; `relight` below is its short form.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from illuminerf.films import Film
    from illuminerf.run_folder import RunFolder

__version__ = "0.1.0"

# Waiting OpenMP threads that spin starve everybody, themselves included, once cores are shared: a geometry step took
# fourteen times as long. Read when torch is imported; a value that is already set wins.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# numba takes every core, whatever torch was told (torchrun tells each process 1)
if os.environ.get("OMP_NUM_THREADS", "").isdecimal():
    os.environ.setdefault("NUMBA_NUM_THREADS", os.environ["OMP_NUM_THREADS"])


def relight(
    photos: str | Path,
    lights: Sequence[str | Path],
    out: str | Path,
    preset: str = "embedded",
    samples: int | None = None,
    size: int | None = None,
    seed: int = 0,
    device: str = "auto",
    rotate: float = 0.0,
    exposure: float = 0.0,
    background: str | None = None,
    model: str | None = None,
    mesh: str | Path | None = None,
) -> "RunFolder":
    """Relight a capture under each of `lights`: what `illuminerf relight` does.

    Args:
        photos: folder of posed photographs (see docs/captures.md).
        lights: equirectangular .exr or .hdr maps, or names of bundled lights; geometry is estimated once for all.
        out: folder of the run; called again with the same arguments it goes on where it stopped.
        preset: settings of all stages: "embedded", "demo", "dilightnet" or "paper".
        samples: samples per photograph, S in the paper.
        size: longest side of the photographs in pixels.
        seed: of every random stream.
        device: "auto", "cpu" or "cuda".
        mesh: a mesh in the capture's world that takes the place of estimated geometry.
        rotate: degrees by which the lights are turned about the vertical, counter-clockwise seen from above.
        exposure: stops by which the lights are made brighter.
        background: plain background to cut away where the photographs have no masks.
        model: another relighting model than the preset's: a folder, "embedded" or "dilightnet".

    Returns:
        The paths of everything: `.report`, `.video`, `.mesh`, `.photographs`, and in `.lights["sunset"]` that light's
        `.video`, `.mesh` (relit), `.ply`, `.frames`, `.radiance`, `.cues` and `.samples`.

    Raises:
        illuminerf.workflow.errors.UserError: bad input, or `out` was made with other settings.
    """
    from illuminerf import pipeline, presets  # torch and diffusers take seconds to import
    from illuminerf.run_folder import RunFolder

    settings = presets.customised(
        preset,
        samples=samples,
        size=size,
        seed=seed,
        device=device,
        rotate_degrees=rotate,
        exposure_stops=exposure,
        background=background,
        model=model,
    )
    jobs = [pipeline.LightJob(Path(light)) for light in lights]
    pipeline.relight(Path(photos), jobs, settings, Path(out), None if mesh is None else Path(mesh))
    return RunFolder(Path(out))


def render(
    run: "str | Path | RunFolder",
    out: str | Path,
    light: str | None = None,
    cameras: str | Path | None = None,
    size: int | None = None,
    views: int = 72,
    gif: bool = False,
    device: str = "auto",
) -> "Film":
    """Render a finished run along a camera path or a turntable: what `illuminerf render` does.

    Args:
        run: what `relight` returned, or its folder.
        out: folder of the views and the film.
        light: one of the run's lights; None where it has only one.
        cameras: cameras.json, transforms.json or nerfstudio's camera_path.json, in the world of the photographs' poses;
            None for a turntable.
        size: longest side of the images in pixels; None is the camera file's own, else the photographs'.
        views: frames of the turntable.
        gif: also write a GIF.
        device: "auto", "cpu" or "cuda".

    Returns:
        The paths of the film: `.video` (MP4), `.gif`, `.frames` (PNG with alpha), `.radiance` (linear EXR).

    Raises:
        illuminerf.workflow.errors.UserError: no such run, light or cameras, or `out` was made with other settings.
    """
    from illuminerf import films
    from illuminerf.run_folder import RunFolder

    folder = run if isinstance(run, RunFolder) else RunFolder(Path(run))
    path = None if cameras is None else Path(cameras)
    return films.render(folder, Path(out), light, path, size, views, gif, device)
