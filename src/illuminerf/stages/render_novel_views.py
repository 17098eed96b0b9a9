"""LatentNerf + cameras -> NovelViews: images from new sides under the target light."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from illuminerf.fields.image_rendering import RenderedImage, render_image, render_image_as_trained
from illuminerf.fields.shell import surface_shell
from illuminerf.fields.storage import StoredField, load_field
from illuminerf.scene.cameras import Cameras, turntable_cameras
from illuminerf.scene.images import linear_from_srgb, write_exr, write_png
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.device import resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_LEAST_SAMPLES = 32  # with the 16 that a fit makes do with, outlines have light specks
_TRAINED_CHUNK = 8192  # samples as in training take far more memory per ray


@dataclass(frozen=True)
class TurntableConfig:
    """Cameras on a circle around the object, used where no camera file is given."""

    num_views: int = 48
    """Frames of one turn."""
    radius: float = 3.0
    """Distance to the centre, in radii of the unit ball."""
    fov_radians: float = 0.7
    """Horizontal field of view."""
    elevation_radians: float = 0.5
    """Height above the horizon."""
    height: int = 200
    """Image height in pixels."""
    width: int = 200
    """Image width in pixels."""


@dataclass(frozen=True)
class Config:
    """How novel views are rendered."""

    turntable: TurntableConfig = field(default_factory=TurntableConfig)
    """Cameras where no camera file is given."""
    latent_index: int | None = None
    """Which training image's latent code to render; None is the zero code, as in the paper's results."""
    num_samples: int | None = None
    """Samples per ray, placed as in training; None takes those of training, and 32 where they were fewer."""
    marches: bool = False
    """Follow each ray through the surface in steps as fine as beta instead. Closer to the integral that the field
    stands for; it then also shows what no photograph constrains, such as the underside of what stands on a table."""
    rays_per_chunk: int = 1 << 17
    """Rays at a time, which bounds memory."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if self.rays_per_chunk < 1 or (self.num_samples is not None and self.num_samples < 2):
            raise UserError("rays per chunk and samples per ray must be positive", got=str(self))
        if self.marches and self.num_samples is not None:
            raise UserError("steps of a march are not counted", got=str(self), fix="leave out num_samples or marches")


def run(latent_nerf_path: Path, cameras_path: Path | None, config: Config, out: Path) -> Path:
    """Render a fitted field: a latent NeRF under its target light, or a geometry's own appearance (the input light).

    Args:
        latent_nerf_path: a LatentNerf or a Geometry artefact.
        cameras_path: a cameras.json (or a folder with one) in the capture's unit-ball world; None for the turntable.
        config: the settings.
        out: the NovelViews artefact: images/<view>.png (straight sRGB, alpha), linear/<view>.exr (linear radiance
            premultiplied, A), cameras.json.

    Raises:
        UserError: the field or the cameras cannot be read, or there is no such latent code.
    """
    if cameras_path is not None and cameras_path.is_dir():
        cameras_path = cameras_path / "cameras.json"
    inputs: dict[str, Path | str] = {
        "field": latent_nerf_path,
        "cameras": "turntable" if cameras_path is None else cameras_path,
    }
    with open_artefact(out, "render_novel_views", config, inputs) as artefact:
        if artefact.is_done:
            return out
        stored = load_field(latent_nerf_path, resolve_device(config.device))
        render = _renderer(stored, config)
        latent = _latent(stored, config.latent_index)
        cameras = _cameras(cameras_path, config.turntable)
        for view in track(range(len(cameras)), "render novel views"):
            if not all(path.exists() for path in _paths(out, view)):
                _write_view(render(cameras, view, latent), view, out)
        write_json(out / "cameras.json", cameras.to_dict())
        artefact.finish({"num_views": len(cameras)})
    return out


def _paths(out: Path, view: int) -> tuple[Path, Path]:
    """Image and linear image of a view."""
    return out / "images" / f"{view:03d}.png", out / "linear" / f"{view:03d}.exr"


def _renderer(stored: StoredField, config: Config) -> Callable[[Cameras, int, torch.Tensor | None], RenderedImage]:
    chunk = config.rays_per_chunk
    if config.marches:
        shell = surface_shell(stored.field.surface, stored.cells)
        return partial(render_image, stored.field, shell, chunk=chunk)
    trained = stored.field.config
    num_samples = config.num_samples or max(trained.num_samples, _LEAST_SAMPLES)
    # what is left out must not grow with the number of samples
    least = trained.min_weight * min(trained.num_samples / num_samples, 1)
    stored.field.config = replace(trained, num_samples=num_samples, min_weight=least)
    return partial(render_image_as_trained, stored.field, stored.cells, chunk=min(chunk, _TRAINED_CHUNK))


def _write_view(image: RenderedImage, view: int, out: Path) -> None:
    alpha = image.alpha[..., None]
    straight = np.clip(np.where(alpha > 1e-3, image.srgb / np.maximum(alpha, 1e-3), 0), 0, 1)
    png, exr = _paths(out, view)
    write_png(png, np.concatenate([straight, alpha], -1))
    linear = linear_from_srgb(straight.astype(np.float32)) * alpha
    write_exr(exr, {name: linear[..., i] for i, name in enumerate("RGB")} | {"A": image.alpha})


def _latent(stored: StoredField, index: int | None) -> torch.Tensor | None:
    if index is None:
        return None
    count = 0 if stored.latents is None else len(stored.latents)
    if stored.latents is None or not 0 <= index < count:
        raise UserError(f"there is no latent code {index}", wanted=f"0 to {count - 1}" if count else "none")
    return stored.latents[index]


def _cameras(path: Path | None, turntable: TurntableConfig) -> Cameras:
    if path is not None:
        return Cameras.from_dict(read_json(path))
    return turntable_cameras(
        turntable.num_views,
        turntable.radius,
        turntable.fov_radians,
        turntable.height,
        turntable.width,
        turntable.elevation_radians,
    )
