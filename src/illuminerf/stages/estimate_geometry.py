"""Capture -> Geometry: a signed distance field fitted to the images, and its mesh with smooth normals.

On several GPUs (or, through gloo, several CPU processes), which share the rays of every step and the folder:

    torchrun --nproc-per-node 8 -m illuminerf estimate-geometry CAPTURE --out GEOMETRY
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from illuminerf.data.capture import load_capture
from illuminerf.fields.bounds import OccupiedCells, visual_hull
from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_steps, start_from_cells
from illuminerf.fields.image_rendering import observed_cells, render_image
from illuminerf.fields.meshing import MeshNormals, extract_mesh
from illuminerf.fields.optimisation import OptimiserConfig, fit
from illuminerf.fields.outlines import outline_level
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_guide import RayGuide
from illuminerf.fields.ray_pool import gather_rays
from illuminerf.fields.shell import SurfaceShell, surface_shell
from illuminerf.fields.storage import StoredField, save_field
from illuminerf.fields.surface import surface_cells
from illuminerf.scene.images import write_png
from illuminerf.scene.views import Views, spread_evenly
from illuminerf.workflow.device import derived_seed, torch_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import Team, join, open_together
from illuminerf.workflow.progress import say

_OUTLINE_VIEWS = 12


@dataclass(frozen=True)
class Config:
    """Geometry estimation (supplement A.1); the defaults are the embedded preset."""

    radiance_field: FieldConfig = field(default_factory=FieldConfig.embedded)
    """Sizes of the radiance field."""
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    """Steps, rays, learning rates."""
    losses: GeometryLossConfig = field(default_factory=GeometryLossConfig)
    """Loss weights."""
    occupancy_side: int = 64
    """Cells per axis of the grid that says where the object can be."""
    mesh_resolution: int = 160
    """Points per axis of marching cubes, over the object's box."""
    outlines_set_level: bool = True
    """The mesh is taken where its outlines are those of the photographs (see `outline_level`). False: at zero, as in
    UniSDF, for comparison."""
    mesh_normals: MeshNormals = "averaged"
    """Smooth normals of the mesh: the surface's own, averaged, or the predicted ones, as in the paper."""
    min_component_share: float = 0.01
    """Mesh components below this share of the largest one's area are dropped."""
    num_held_out_views: int = 2
    """Views kept from the fit, spread evenly, to measure PSNR on; none where fewer than 10 views exist."""
    num_previews: int = 3
    """Normal maps to write."""
    seed: int = 0
    """Seed of weights, batches and jitter."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if not 8 <= self.occupancy_side <= 512 or not 16 <= self.mesh_resolution <= 2048:
            raise UserError(
                "grid sizes are out of range",
                got=f"occupancy {self.occupancy_side}, mesh {self.mesh_resolution}",
                wanted="8 to 512 and 16 to 2048",
            )
        if not 0 <= self.min_component_share < 1 or min(self.num_held_out_views, self.num_previews) < 0:
            raise UserError("shares and counts must not be negative", got=str(self))

    @classmethod
    def paper(cls) -> "Config":
        """The paper's settings: about an hour on one large GPU."""
        return cls(
            radiance_field=FieldConfig.paper(),
            optimiser=OptimiserConfig.paper(),
            losses=GeometryLossConfig(first_levels=4, coarse_to_fine_share=0.25),
            occupancy_side=128,
            mesh_resolution=512,
            num_held_out_views=0,
        )


def run(capture_path: Path, config: Config, out: Path) -> Path:
    """Fit the geometry of a capture; see the module's docstring."""
    team, device = join(config.device)
    with open_together(team, out, "estimate_geometry", config, {"capture": capture_path}) as artefact:
        if artefact.is_done:
            return out
        start = time.monotonic()
        capture = load_capture(capture_path)
        views, has_masks = capture.views, capture.background == "masked"
        fitted, held_out = _split(len(views), config.num_held_out_views)
        hull = _bounds(views, has_masks, config.occupancy_side, device)
        radiance_field = new_field(config.radiance_field, config.seed, device)
        _fit(radiance_field, hull, views, fitted, has_masks, config, out / "checkpoint.safetensors", team)
        if not team.is_first:
            return out
        fit_seconds = time.monotonic() - start

        near_surface = surface_cells(radiance_field.surface, hull)
        cells = observed_cells(radiance_field, near_surface, views.cameras)
        save_field(out, StoredField(radiance_field, cells))
        # unobserved parts of observed components stay: they close the mesh against light from behind
        level = 0.0
        if config.outlines_set_level and bool(near_surface.cells.any()):
            level = _level(radiance_field, near_surface, views, fitted, has_masks, config.seed)
        mesh = extract_mesh(
            radiance_field.surface,
            near_surface,
            config.mesh_resolution,
            config.min_component_share,
            cells,
            level,
            config.mesh_normals,
        )
        mesh.save_glb(out / "mesh.glb")
        shell = surface_shell(radiance_field.surface, cells)
        _save_previews(radiance_field, shell, views, config.num_previews, out / "normals")
        scores = [_psnr(radiance_field, shell, views, view) for view in held_out]
        metrics = {"fit_seconds": round(fit_seconds, 2), "beta": float(radiance_field.surface.beta.detach())}
        metrics |= {"mesh_level": level, "num_faces": len(mesh.faces)}
        if scores:
            metrics["held_out_psnr"] = float(np.mean(scores))
            say(f"geometry: held-out views reach {np.mean(scores):.2f} dB PSNR")
        (out / "checkpoint.safetensors").unlink(missing_ok=True)
        artefact.finish(metrics)
    return out


def new_field(config: FieldConfig, seed: int, device: torch.device) -> RadianceField:
    """A radiance field with seeded weights, the same on every device."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(seed, "weights"))
        return RadianceField(config).to(device)


def _fit(
    radiance_field: RadianceField,
    hull: OccupiedCells,
    views: Views,
    fitted: list[int],
    has_masks: bool,
    config: Config,
    checkpoint: Path,
    team: Team,
) -> None:
    device = hull.cells.device
    pool = gather_rays(views.cameras[fitted], views.alphas(fitted), hull, device)
    srgb = pool.values(views.premultiplied(fitted))
    alpha = pool.values(views.alphas(fitted)) if has_masks else None
    guide = RayGuide(pool) if config.losses.guided_share else None

    steps = geometry_steps(radiance_field, config.losses, config.optimiser, pool, srgb, alpha, guide, config.seed, team)

    def start() -> None:
        if config.losses.starts_from_hull:
            start_from_cells(radiance_field, hull, config.losses.first_levels, config.seed)

    with radiance_field.computing_in(config.optimiser.precision):
        fit(
            radiance_field,
            config.optimiser,
            steps,
            checkpoint,
            "fit geometry",
            start,
            team,
            {} if guide is None else {"ray_errors": guide.errors},
        )


def _bounds(views: Views, has_masks: bool, side: int, device: torch.device) -> OccupiedCells:
    if not has_masks:
        return OccupiedCells(torch.ones(side, side, side, dtype=torch.bool, device=device))
    return OccupiedCells(visual_hull(views.cameras, views.alphas(), side).to(device)).dilated(1)


def _level(
    radiance_field: RadianceField,
    near_surface: OccupiedCells,
    views: Views,
    fitted: list[int],
    has_masks: bool,
    seed: int,
) -> float:
    chosen = [fitted[i] for i in spread_evenly(len(fitted), _OUTLINE_VIEWS)]
    device = near_surface.cells.device
    pool = gather_rays(views.cameras[chosen], views.alphas(chosen), near_surface, device, 0.5)
    return outline_level(radiance_field, pool, has_masks, torch_generator(seed, "outlines", device=device))


def _split(num_views: int, num_held_out: int) -> tuple[list[int], list[int]]:
    """Views to fit and views held out."""
    if num_views < 10 or not num_held_out:
        return list(range(num_views)), []
    held_out = [int((i + 0.5) * num_views / num_held_out) for i in range(num_held_out)]
    return [view for view in range(num_views) if view not in held_out], held_out


def _save_previews(
    radiance_field: RadianceField, shell: SurfaceShell, views: Views, num_previews: int, folder: Path
) -> None:
    for number in range(min(num_previews, len(views))):
        view = number * len(views) // num_previews
        image = render_image(radiance_field, shell, views.cameras, view)
        shown = np.clip(image.normals * 0.5 + 0.5 * image.alpha[..., None], 0, 1)
        write_png(folder / f"{view:03d}.png", np.dstack([shown, image.alpha]))


def _psnr(radiance_field: RadianceField, shell: SurfaceShell, views: Views, view: int) -> float:
    """PSNR over the whole image, premultiplied on black."""
    image = render_image(radiance_field, shell, views.cameras, view)
    target = views.srgb[view] * views.alpha[view][..., None]
    return float(-10 * np.log10(max(np.mean((np.clip(image.srgb, 0, 1) - target) ** 2), 1e-12)))
