"""One photograph under a light that turns about the object: a film straight from the relighting diffusion model.

Own addition: the paper shows turning lights through a latent NeRF per frame. A fixed camera needs none, since one
photograph relit in every frame is already consistent with itself; all frames share their noise, so nothing flickers.

cues/<000>.exr     radiance cues of each frame, as `render_radiance_cues` writes them
images/<000>.png   frames, sRGB with straight alpha: the mean of the samples
rotating.mp4, .gif the frames over white, with a mirror ball that shows where the light is
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from illuminerf.cues.renderer import CUE_CHANNELS, CueSampling, MitsubaCueRenderer
from illuminerf.data.capture import load_capture
from illuminerf.diffusion.full_size import Photograph, relight_photographs
from illuminerf.diffusion.pretrained import model_folder, pretrained_model
from illuminerf.diffusion.relighter import Relighter
from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.run_folder import RunFolder
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap, chrome_ball
from illuminerf.scene.images import linear_from_srgb, read_png, srgb_from_linear, write_exr, write_png
from illuminerf.scene.light_preview import viewing_exposure
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.tone import compressed
from illuminerf.scene.video import write_gif, write_mp4
from illuminerf.scene.views import Views
from illuminerf.stages import render_radiance_cues
from illuminerf.stages.relight_views import exposure_for, gloss_of, photograph
from illuminerf.stages.render_radiance_cues import cue_path, placed_light
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.device import derived_seed, resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

STAGE = "rotate_light"
_BALL_SHARE = 5  # the mirror ball is a fifth of the frame's shorter side
_BALL_ROWS = 128  # of the light that it mirrors
_PEAK = 8.0  # radiance that it shows as white


@dataclass(frozen=True)
class Config:
    """Which photograph, and how the light turns."""

    view: int = 0
    """Which photograph is relit, counted from 0."""
    num_frames: int = 48
    """Frames of one turn, counter-clockwise seen from above."""
    frames_per_second: int = 12
    """Of both films."""
    exposure_stops: float = 0.0
    """The light's radiance times 2^stops."""
    sampling: CueSampling = CueSampling(samples_per_pixel=128)
    """Paths and bounces of the cues."""
    num_samples: int = 4
    """Samples whose mean is a frame."""
    num_steps: int = 4
    """Denoising steps."""
    temperature: float = 0.6
    """Factor on the initial noise."""
    seed: int = 0
    """Of the paths and of the samples; the same in every frame."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        counts = (self.num_frames, self.frames_per_second, self.num_samples, self.num_steps)
        if min(counts) < 1 or self.view < 0:
            raise UserError("counts must be at least 1 and the view not negative", got=str(self))


def film(run: RunFolder, out: Path, light: str | None, model: str, config: Config) -> Path:
    """A film of one photograph of a finished run under one of its lights, which makes one turn.

    Args:
        run: the run.
        out: folder of the frames and the film.
        light: one of the run's lights; None where it has only one.
        model: the relighting model: a folder, embedded or dilightnet.
        config: which photograph, how many frames.

    Returns:
        The MP4.

    Raises:
        UserError: no such run, light or photograph, or `out` was made with other settings.
    """
    used = run.light(light).folder / "cues" / "light.exr"
    illumination = run.folder / "illumination"
    given = illumination if illumination.is_dir() else None
    return render(run.folder / "geometry", run.capture, used, model, given, config, out) / "rotating.mp4"


def render(
    geometry: Path, capture: Path, light: Path, model: Path | str, illumination: Path | None, config: Config, out: Path
) -> Path:
    """Relight one photograph of `capture` under all turns of `light`; frames that exist are kept.

    Args:
        geometry: a Geometry artefact of the capture.
        capture: a Capture artefact.
        light: an environment map file, z-up (docs/conventions.md).
        model: a RelightingModel folder, "embedded", or "dilightnet" once downloaded.
        illumination: an Illumination artefact of the same views, or None.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: an input is missing or unusable, there is no such view, or `out` was made with other settings.
    """
    folder = model_folder(model)
    inputs: dict[str, Path | str] = {"geometry": geometry, "capture": capture, "light": light, "model": folder}
    if illumination is not None:
        inputs["illumination"] = illumination
    with open_artefact(out, STAGE, config, inputs) as artefact:
        if artefact.is_done:
            return out
        views = load_capture(capture).views
        if config.view >= len(views):
            raise UserError(f"there is no view {config.view}", wanted=f"0 to {len(views) - 1}")
        placed = placed_light(light, render_radiance_cues.Config(exposure_stops=config.exposure_stops))
        _write_cues(TriangleMesh.load_glb(geometry / "mesh.glb"), views.cameras, placed, config, out)
        shading = None if illumination is None else illumination / "shading" / f"{config.view:03d}.exr"
        _write_frames(views, folder, shading, gloss_of(illumination), config, out)
        x, y = views.cameras.world_from_camera[config.view, :2, 3]
        shown = list(_shown(placed, float(math.atan2(y, x)), config.num_frames, out))
        write_mp4(out / "rotating.mp4", shown, config.frames_per_second)
        write_gif(out / "rotating.gif", shown, config.frames_per_second)
        artefact.finish({"num_frames": config.num_frames})
    return out


def _turn(frame: int, num_frames: int) -> float:
    return 2 * math.pi * frame / num_frames


def _write_cues(mesh: TriangleMesh, cameras: Cameras, placed: EnvironmentMap, config: Config, out: Path) -> None:
    renderer = MitsubaCueRenderer(mesh, placed, config.sampling)
    seed = derived_seed(config.seed, "view", config.view)
    for frame in track(range(config.num_frames), "radiance cues"):
        if not cue_path(out, frame).exists():
            light = placed.rotated(_turn(frame, config.num_frames))
            image = renderer.render(cameras, config.view, light, seed)
            write_exr(cue_path(out, frame), dict(zip((*CUE_CHANNELS, "A"), image, strict=True)))


def _write_frames(views: Views, model: Path, shading: Path | None, gloss: float, config: Config, out: Path) -> None:
    device = resolve_device(config.device)
    network, exposure = pretrained_model(model, device), exposure_for(config.num_frames, out)
    for frame in track(range(config.num_frames), "relight frames"):
        if not _frame_path(out, frame).exists():
            source = photograph(views, config.view, cue_path(out, frame), shading, gloss, device)
            srgb, alpha = _mean_of_samples(network, source, exposure, config), views.alpha[config.view]
            straight = np.clip(srgb / np.maximum(alpha, 1e-3)[..., None], 0, 1)
            write_png(_frame_path(out, frame), np.dstack([straight, alpha]))


def _frame_path(out: Path, frame: int) -> Path:
    return out / "images" / f"{frame:03d}.png"


def _mean_of_samples(
    network: Relighter, source: Photograph, exposure: float, config: Config
) -> Float[np.ndarray, "height width 3"]:
    """Premultiplied sRGB; the mean is taken in linear light."""
    seeds = [derived_seed(config.seed, "relight", config.view, k) for k in range(config.num_samples)]
    samples = relight_photographs(
        network, [source], [seeds], config.num_steps, "ddim", config.temperature, exposure=exposure
    )[0]
    linear = linear_from_srgb(samples.permute(0, 2, 3, 1).cpu().numpy()).mean(0)
    return np.asarray(srgb_from_linear(linear), np.float32)


def _shown(placed: EnvironmentMap, azimuth: float, num_frames: int, out: Path) -> Iterator[np.ndarray]:
    """The frames over white, with a mirror ball seen from the camera's side in the lower left corner."""
    small = placed.resized(min(placed.linear_rgb.shape[0], _BALL_ROWS))
    exposure = viewing_exposure(small.linear_rgb)
    for frame in range(num_frames):
        shown = on_white(read_png(_frame_path(out, frame)))
        size = max(min(shown.shape[:2]) // _BALL_SHARE, 8)
        linear, inside = chrome_ball(small.rotated(_turn(frame, num_frames) - azimuth), size)
        ball = srgb_from_linear(compressed(linear * exposure, _PEAK))
        corner = shown[-size:, :size]
        shown[-size:, :size] = np.where(inside[..., None] > 0, ball, corner)
        yield shown
