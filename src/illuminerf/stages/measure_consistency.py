"""Capture + RelitViews + LatentNerf -> Consistency: do relit images of neighbouring views agree on the object?

consistency.json    samples, renderings, photographs: root mean square differences in sRGB values (None: no point is
                    seen twice), over the same points; codes_alpha, codes_colour: what latent codes change (None: the
                    field has none); matches, pairs, angle_radians (mean between the views of a pair).

See `evaluation/consistency.py` for what these figures say and what not.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.data.capture import load_capture
from illuminerf.evaluation.consistency import (
    Surface,
    match,
    mean_difference,
    neighbours,
    root_mean,
    squared_errors,
)
from illuminerf.fields.image_rendering import RenderedImage, render_image
from illuminerf.fields.shell import SurfaceShell, surface_shell
from illuminerf.fields.storage import StoredField, load_field
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import read_png
from illuminerf.scene.views import Views, spread_evenly
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.device import resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_COVERED = 0.95  # from this opacity a pixel shows the object alone


@dataclass(frozen=True)
class Config:
    """What is compared."""

    num_pairs: int = 10
    """Pairs of neighbouring views; up to twice as many are rendered."""
    tolerance: float = 0.02
    """Depth test, in radii of the unit ball."""
    num_codes: int = 4
    """Latent codes that are compared with each other, evenly spread over the training images."""
    num_code_views: int = 2
    """Views in which they are rendered."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if min(self.num_pairs, self.num_codes, self.num_code_views) < 1 or not self.tolerance > 0:
            raise UserError("pairs, codes, views and tolerance must be positive", got=str(self))


def run(capture: Path, relit: Path, latent_nerf: Path, config: Config, out: Path) -> Path:
    """Compare relit samples, renderings of the latent NeRF with the zero code, and photographs, each among themselves.

    Args:
        capture: a Capture artefact.
        relit: a folder with samples of every one of its views, samples/<view>_<sample>.png.
        latent_nerf: a LatentNerf artefact; its frozen geometry says which pixels see the same point.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: an input is missing, or samples do not fit the capture.
    """
    inputs: dict[str, Path | str] = {"capture": capture, "relit": relit, "latent_nerf": latent_nerf}
    with open_artefact(out, "measure_consistency", config, inputs) as artefact:
        if artefact.is_done:
            return out
        views = load_capture(capture).views
        stored = load_field(latent_nerf, resolve_device(config.device))
        shell = surface_shell(stored.field.surface, stored.cells)
        pairs = neighbours(views.cameras, config.num_pairs)
        shown = sorted({view for pair in pairs for view in pair})
        rendered = {v: render_image(stored.field, shell, views.cameras, v) for v in track(shown, "compare views")}
        measured = _agreement(views, relit, rendered, pairs, config.tolerance)
        measured |= _codes(stored, shell, views.cameras, shown[: config.num_code_views], config.num_codes)
        write_json(out / "consistency.json", measured)
        artefact.finish(measured)
    return out


def _agreement(
    views: Views, relit: Path, rendered: dict[int, RenderedImage], pairs: list[tuple[int, int]], tolerance: float
) -> dict[str, Any]:
    surfaces = {view: _surface(image, views.alpha[view]) for view, image in rendered.items()}
    samples = {view: _samples(relit, view, views.alpha[view]) for view in rendered}
    smooth = {view: _straight(image.srgb, image.alpha) for view, image in rendered.items()}
    errors: dict[str, list[np.ndarray]] = {"samples": [], "renderings": [], "photographs": []}
    num_matches, angles = 0, []
    for first, second in pairs:
        matches = match(views.cameras, (first, second), (surfaces[first], surfaces[second]), tolerance)
        num_matches += len(matches.pixel)
        errors["samples"] += [
            squared_errors(one, other, matches) for one, other in zip(samples[first], samples[second], strict=True)
        ]
        errors["renderings"].append(squared_errors(smooth[first], smooth[second], matches))
        errors["photographs"].append(squared_errors(views.srgb[first], views.srgb[second], matches))
        one, other = (p / np.linalg.norm(p) for p in views.cameras.positions[[first, second]])
        angles.append(float(np.arccos(np.clip(one @ other, -1, 1))))
    summary: dict[str, Any] = {name: root_mean(squared) for name, squared in errors.items()}
    angle = float(np.mean(angles)) if angles else None
    return summary | {"matches": num_matches, "pairs": len(pairs), "angle_radians": angle}


def _codes(
    stored: StoredField, shell: SurfaceShell, cameras: Cameras, shown: list[int], num_codes: int
) -> dict[str, float | None]:
    """What the choice of a code changes; geometry is frozen, so that alpha shall not."""
    if stored.latents is None or not shown:
        return {"codes_alpha": None, "codes_colour": None}
    count = len(stored.latents)
    chosen = spread_evenly(count, num_codes)
    alphas, colours = [], []
    for view in shown:
        images = [render_image(stored.field, shell, cameras, view, stored.latents[index]) for index in chosen]
        mask = images[0].alpha > _COVERED
        alphas.append(mean_difference(np.stack([image.alpha for image in images]), np.ones_like(mask)))
        colours.append(mean_difference(np.stack([image.srgb for image in images]), mask))
    return {"codes_alpha": float(np.mean(alphas)), "codes_colour": float(np.mean(colours))}


def _surface(image: RenderedImage, alpha: np.ndarray) -> Surface:
    """Where mask and geometry agree that there is nothing but the object."""
    distance = image.depth / np.maximum(image.alpha, 1e-3)
    return Surface(distance, (image.alpha > _COVERED) & (alpha > _COVERED))


def _samples(relit: Path, view: int, alpha: np.ndarray) -> list[np.ndarray]:
    """Straight sRGB of all samples of a view."""
    paths = sorted((relit / "samples").glob(f"{view:03d}_*.png"))
    if not paths:
        raise UserError(f"{relit} has no sample of view {view}", wanted=f"samples/{view:03d}_00.png")
    images = [read_png(path)[..., :3] for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image.shape[:2] != alpha.shape:
            raise UserError(
                f"{path} has another size than the capture", got=str(image.shape[:2]), wanted=str(alpha.shape)
            )
    return [_straight(image, alpha) for image in images]


def _straight(srgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return srgb / np.maximum(alpha, 1e-3)[..., None]
