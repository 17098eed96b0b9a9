"""Materials + light + cameras -> NovelViews: fitted materials, path traced under another light.

images/<000>.png  straight sRGB and alpha, clipped at 1
linear/<000>.exr  linear radiance, premultiplied, and A
cameras.json      the views
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from illuminerf.cues.fitted_materials import load_materials
from illuminerf.cues.shading import ShadedScene
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear, write_exr, write_png
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.device import derived_seed
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import step_progress

STAGE = "render_materials"


@dataclass(frozen=True)
class Config:
    """How fitted materials are path traced."""

    samples_per_pixel: int = 64
    """Paths per pixel."""
    max_light_height: int = 512
    """Rows; larger lights are averaged down, so that small lamps keep their energy."""
    device: str = "auto"
    """auto, cpu or cuda."""
    seed: int = 0
    """Each view's seed is derived from it."""

    def __post_init__(self) -> None:
        if min(self.samples_per_pixel, self.max_light_height) < 1:
            raise UserError("renderings need at least one sample per pixel and one row of light", got=str(self))


def run(materials: Path, cameras_path: Path, light: Path, config: Config, out: Path) -> Path:
    """Render the object of a Materials artefact under `light`; views that exist are kept.

    Args:
        materials: a Materials artefact (see `fit_materials`).
        cameras_path: a cameras.json in the capture's unit-ball world.
        light: an environment map file, z-up (docs/conventions.md).
        config: the settings.
        out: the NovelViews artefact's folder.

    Raises:
        UserError: an input is missing or unusable, or `out` was made with other settings.
    """
    inputs: dict[str, Path | str] = {"materials": materials, "cameras": cameras_path, "light": light}
    with open_artefact(out, STAGE, config, inputs) as artefact:
        if artefact.is_done:
            return out
        mesh, material = load_materials(materials)
        cameras = Cameras.from_dict(read_json(cameras_path))
        radiance = EnvironmentMap.load(light)
        radiance = radiance.resized(min(radiance.linear_rgb.shape[0], config.max_light_height))
        scene = ShadedScene([(mesh, material)], radiance, config.device)
        missing = [view for view in range(len(cameras)) if not all(path.exists() for path in _paths(out, view))]
        with step_progress("render materials", len(cameras), len(cameras) - len(missing)) as progress:
            for view in missing:
                seed = derived_seed(config.seed, "view", view)
                _write(out, view, scene.render(cameras, view, radiance, config.samples_per_pixel, seed))
                progress.advance()
        write_json(out / "cameras.json", cameras.to_dict())
        artefact.finish({"num_views": len(cameras)})
    return out


def _paths(out: Path, view: int) -> tuple[Path, Path]:
    """Image and linear image of a view."""
    return out / "images" / f"{view:03d}.png", out / "linear" / f"{view:03d}.exr"


def _write(out: Path, view: int, image: np.ndarray) -> None:
    png, exr = _paths(out, view)
    alpha = np.clip(image[..., 3:], 0, 1)
    straight = np.where(alpha > 1e-3, image[..., :3] / np.maximum(alpha, 1e-3), 0)
    write_png(png, np.concatenate([np.clip(srgb_from_linear(straight), 0, 1), alpha], -1))
    write_exr(exr, {name: image[..., index] for index, name in enumerate("RGBA")})
