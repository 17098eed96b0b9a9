"""Films of a finished run, along cameras that the caller chose."""

import dataclasses
from pathlib import Path

from illuminerf.data.camera_paths import read_camera_path
from illuminerf.data.capture import load_capture
from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.run_folder import RelitObject, RunFolder
from illuminerf.scene.images import read_png
from illuminerf.scene.video import write_gif, write_mp4
from illuminerf.stages import render_novel_views
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.errors import UserError

_SECONDS_PER_TURN = 4.0


@dataclasses.dataclass(frozen=True)
class Film:
    """Files of a rendered camera path."""

    video: Path
    """MP4, on white."""
    gif: Path | None
    """GIF, on white, where it was asked for."""
    frames: list[Path]
    """PNGs, sRGB with straight alpha."""
    radiance: list[Path]
    """EXRs, linear radiance, premultiplied, with alpha."""


def render(
    run: RunFolder,
    out: Path,
    light: str | None = None,
    cameras: Path | None = None,
    size: int | None = None,
    num_views: int = 72,
    gif: bool = False,
    device: str = "auto",
) -> Film:
    """Render a finished run along a camera path, or around its turntable.

    Args:
        run: the run.
        out: folder of the views and the film.
        light: one of the run's lights; None where it has only one.
        cameras: cameras.json, transforms.json or a nerfstudio camera path, in the world of the photographs' poses.
        size: longest side of the images in pixels; None is the file's own, or the photographs'.
        num_views: frames of the turntable where no cameras are given.
        gif: also write a GIF.
        device: auto, cpu or cuda.

    Raises:
        UserError: no such run or light, cameras that cannot be read, or `out` was made with other settings.
    """
    relit = run.light(light)
    if size is not None and size < 2 or num_views < 1:
        raise UserError("size and number of views must be positive", got=f"{size} and {num_views}")
    capture = load_capture(run.capture)
    photographed = capture.views.cameras
    height, width = photographed.height, photographed.width
    config = render_novel_views.Config(device=device)
    chosen, rate = None, None
    if cameras is not None:
        path, rate = read_camera_path(cameras, height, width)
        if size is not None:
            scale = size / max(path.height, path.width)
            path = path.resized(max(1, round(path.height * scale)), max(1, round(path.width * scale)))
        chosen = out / "unit_ball_cameras.json"
        write_json(chosen, capture.unit_ball_cameras(path).to_dict())
    else:
        side = size or max(height, width)
        turn = dataclasses.replace(config.turntable, num_views=num_views, height=side, width=side)
        config = dataclasses.replace(config, turntable=turn)
    views = render_novel_views.run(relit.latent_nerf, chosen, config, out / "views")
    frames = sorted((views / "images").glob("*.png"))
    rate = rate or (24 if cameras is not None else max(1, round(len(frames) / _SECONDS_PER_TURN)))
    write_mp4(out / "film.mp4", (on_white(read_png(frame)) for frame in frames), rate)
    if gif:
        write_gif(out / "film.gif", (on_white(read_png(frame)) for frame in frames), rate)
    return Film(out / "film.mp4", out / "film.gif" if gif else None, frames, sorted((views / "linear").glob("*.exr")))


def write_turntable_gif(relit: RelitObject) -> Path:
    """The turntable of a finished run as a GIF, beside its MP4."""
    frames = relit.frames
    rate = max(1, round(len(frames) / _SECONDS_PER_TURN))
    write_gif(relit.gif, (on_white(read_png(frame)) for frame in frames), rate)
    return relit.gif
