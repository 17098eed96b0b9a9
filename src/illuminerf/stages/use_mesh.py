"""Capture + a mesh that was brought -> Geometry: what `estimate_geometry` makes, from someone else's surface.

mesh.glb                the mesh in the capture's unit ball, which cues are rendered from
field.safetensors, ...  a radiance field whose signed distance and predicted normals are those of the mesh, with the
                        photographs' appearance on it: what later stages render through
normals/<000>.png       predicted normals in some views

The mesh lies in the world of the caller's cameras. It need not be closed; `fields.mesh_fit` says how inside is told
from outside.
"""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from illuminerf.cues.mesh_views import MeshScene, seen_surfels
from illuminerf.data.capture import Capture, load_capture
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.image_rendering import observed_cells, render_image
from illuminerf.fields.mesh_fit import (
    MeshDistance,
    SurfaceRegressionConfig,
    appearance_loss,
    carved_cells,
    fit_surface,
    thickened,
)
from illuminerf.fields.optimisation import OptimiserConfig, fit
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_pool import gather_rays
from illuminerf.fields.shell import surface_shell
from illuminerf.fields.storage import StoredField, save_field
from illuminerf.fields.surface import surface_cells
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import write_png
from illuminerf.scene.meshes import TriangleMesh, UpAxis
from illuminerf.scene.views import Views, spread_evenly
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.device import derived_seed, resolve_device, torch_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_VIEWS_CHECKED = 8


@dataclass(frozen=True)
class Config:
    """How a mesh becomes a geometry; the defaults are the embedded preset."""

    radiance_field: FieldConfig = field(
        default_factory=lambda: replace(FieldConfig.embedded(), radiance_normals="predicted")
    )
    """Sizes of the radiance field; those of later stages. Its predicted normals follow the mesh's smooth ones."""
    regression: SurfaceRegressionConfig = field(default_factory=SurfaceRegressionConfig)
    """Fit of signed distance and normals to the mesh."""
    optimiser: OptimiserConfig = field(default_factory=lambda: OptimiserConfig(num_steps=500))
    """Fit of appearance and proposal to the photographs, on that surface."""
    up_axis: UpAxis = "auto"
    """Which axis of the file points up; "auto": y for glTF, whose definition it is, z for OBJ and PLY."""
    spacing: float = 0.005
    """Between the points on the mesh that distances are taken from, in radii of the unit ball."""
    ray_size: int = 256
    """Rays along the longer side of every photograph that find what of the mesh is seen."""
    occupancy_side: int = 64
    """Cells per axis of the grid that says where the object is."""
    least_overlap: float = 0.5
    """Of the mesh's outlines with the photographs' masks (intersection over union); with less it is refused."""
    num_previews: int = 3
    """Normal maps to write."""
    seed: int = 0
    """Seed of weights, batches and jitter."""
    device: str = "auto"
    """auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if not 0 < self.spacing < 0.2 or self.ray_size < 16 or not 8 <= self.occupancy_side <= 512:
            raise UserError("spacing, rays or cells are out of range", got=str(self))
        if not 0 <= self.least_overlap <= 1 or self.num_previews < 0:
            raise UserError("the overlap must be a share, the previews not negative", got=str(self))


def run(mesh_file: Path, capture_path: Path, config: Config, out: Path) -> Path:
    """Take the mesh of a file for the geometry of a capture.

    Args:
        mesh_file: .glb, .gltf, .obj or .ply, in the world of the caller's cameras.
        capture_path: a Capture artefact.
        config: the settings.
        out: the Geometry artefact's folder.

    Raises:
        UserError: the mesh is unreadable or does not lie where the photographs show the object.
    """
    inputs: dict[str, Path | str] = {"mesh": mesh_file, "capture": capture_path}
    with open_artefact(out, "use_mesh", config, inputs) as artefact:
        if artefact.is_done:
            return out
        start = time.monotonic()
        device, capture = resolve_device(config.device), load_capture(capture_path)
        views = capture.views
        mesh = in_unit_ball(TriangleMesh.load(mesh_file, config.up_axis), capture)
        overlap = _checked_overlap(mesh, capture, config)
        target, normals = _seen_from(mesh, views.cameras, config)
        radiance_field = _new_field(config, device)
        error = fit_surface(radiance_field.surface, target, normals, config.regression, config.seed)
        near_surface = surface_cells(radiance_field.surface, _ball_cells(config.occupancy_side, device))
        _fit_appearance(radiance_field, near_surface, views, config, out / "checkpoint.safetensors")
        cells = observed_cells(radiance_field, near_surface, views.cameras)
        save_field(out, StoredField(radiance_field, cells))
        mesh.save_glb(out / "mesh.glb")
        for number in range(min(config.num_previews, len(views))):
            _save_preview(radiance_field, cells, views.cameras, number * len(views) // config.num_previews, out)
        (out / "checkpoint.safetensors").unlink(missing_ok=True)
        metrics = {"fit_seconds": round(time.monotonic() - start, 2), "num_faces": len(mesh.faces)}
        artefact.finish(metrics | {"mask_overlap": overlap, "distance_error": error})
    return out


def in_unit_ball(mesh: TriangleMesh, capture: Capture) -> TriangleMesh:
    """A mesh of the caller's world in the capture's unit ball.

    Raises:
        UserError: it reaches out of the ball.
    """
    vertices = ((mesh.vertices.astype(np.float64) + capture.offset) * capture.scale).astype(np.float32)
    reach = float(np.linalg.norm(vertices[np.unique(mesh.faces)], axis=-1).max())
    if reach >= 1:
        raise UserError(
            "the mesh reaches beyond the object's place",
            got=f"{reach:.2f} times the radius of the capture's ball",
            wanted="less than 1",
            fix="give the mesh in the world of the capture's cameras, without surroundings; or import the capture with "
            "a smaller --object-radius",
        )
    return TriangleMesh(vertices, mesh.faces, mesh.vertex_normals)


def _checked_overlap(mesh: TriangleMesh, capture: Capture, config: Config) -> float:
    """Intersection over union of the mesh's outlines and the masks; 1 where the capture has no masks."""
    if capture.background != "masked":
        return 1.0
    views, scene = capture.views, MeshScene(mesh, device=config.device)
    both = either = 0
    for view in spread_evenly(len(views), _VIEWS_CHECKED):
        drawn, mask = scene.normals(views.cameras, view)[1] > 0.5, views.alpha[view] > 0.5
        both, either = both + int((drawn & mask).sum()), either + int((drawn | mask).sum())
    overlap = both / max(either, 1)
    if overlap < config.least_overlap:
        raise UserError(
            "the mesh does not lie where the photographs show the object",
            got=f"outlines that share {overlap:.0%} of their area with the masks",
            wanted=f"{config.least_overlap:.0%} or more",
            fix="give the mesh in the world of the capture's cameras; if it lies on its side, set up_axis",
        )
    return float(overlap)


def _seen_from(mesh: TriangleMesh, cameras: Cameras, config: Config) -> tuple[MeshDistance, np.ndarray]:
    """The mesh's signed distance, and smooth normals at its points."""
    seen, smooth = seen_surfels(mesh, cameras, config.spacing, config.ray_size, config.device)
    scene = MeshScene(mesh, is_smooth=False, device=config.device)
    factor = config.ray_size / max(cameras.height, cameras.width)
    small = cameras.resized(max(1, round(cameras.height * factor)), max(1, round(cameras.width * factor)))
    depths = np.stack([scene.depths(small, view) for view in track(range(len(small)), "find depths")])
    is_seen = carved_cells(small, torch.from_numpy(depths), config.occupancy_side)
    corners = mesh.vertices[np.unique(mesh.faces)]
    return MeshDistance(thickened(seen), is_seen, corners.min(0), corners.max(0)), smooth


def _ball_cells(side: int, device: torch.device) -> OccupiedCells:
    axis = (torch.arange(side, device=device) + 0.5) * (2 / side) - 1
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    return OccupiedCells(x**2 + y**2 + z**2 < 1)


def _new_field(config: Config, device: torch.device) -> RadianceField:
    """Seeded weights, the same on every device."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, "weights"))
        return RadianceField(config.radiance_field).to(device)


class _OnSurface(nn.Module):
    """What is fitted to photographs where the surface is given."""

    def __init__(self, radiance_field: RadianceField) -> None:
        super().__init__()
        self.appearance, self.proposal = radiance_field.appearance, radiance_field.proposal


def _fit_appearance(
    radiance_field: RadianceField, cells: OccupiedCells, views: Views, config: Config, checkpoint: Path
) -> None:
    device = cells.cells.device
    pool = gather_rays(views.cameras, views.alphas(), cells, device)
    srgb = pool.values(views.premultiplied())
    radiance_field.surface.requires_grad_(False)

    def step_loss(step: int) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        generator = torch_generator(config.seed, "appearance", step, device=device)
        index = pool.draw(config.optimiser.rays_per_step, generator)
        return appearance_loss(radiance_field, pool, srgb, index, generator)

    with radiance_field.computing_in(config.optimiser.precision):
        fit(_OnSurface(radiance_field), config.optimiser, step_loss, checkpoint, "fit appearance")


def _save_preview(radiance_field: RadianceField, cells: OccupiedCells, cameras: Cameras, view: int, out: Path) -> None:
    image = render_image(radiance_field, surface_shell(radiance_field.surface, cells), cameras, view)
    shown = np.clip(image.normals * 0.5 + 0.5 * image.alpha[..., None], 0, 1)
    write_png(out / "normals" / f"{view:03d}.png", np.dstack([shown, image.alpha]))
