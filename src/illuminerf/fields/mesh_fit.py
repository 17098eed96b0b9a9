"""A field for a mesh that was brought: its signed distance by regression, then its appearance from the photographs.

The mesh need not be closed, nor its faces wound one way. Close to the surface that cameras see, the sign of a distance
is that of the side from which it is seen; elsewhere, what no camera can see is inside, as far as the mesh's box goes.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from illuminerf.fields import losses
from illuminerf.fields.bounds import signed_distance_of_cells
from illuminerf.fields.proposal_sampling import interlevel_loss
from illuminerf.fields.radiance_field import RadianceField
from illuminerf.fields.ray_pool import RayPool
from illuminerf.fields.step_draws import StepDraws
from illuminerf.fields.surface import SurfaceField
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.surfels import Surfels
from illuminerf.workflow.device import numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import step_progress

_NEAR_CELLS = 2.0
_OPPOSITE_COSINE = -0.5


@dataclass(frozen=True)
class SurfaceRegressionConfig:
    """How a signed distance is fitted to that of a mesh."""

    num_steps: int = 400
    """Steps of Adam."""
    points_per_step: int = 8192
    """Half of them close to the surface, the others anywhere in the unit ball."""
    learning_rate: float = 5e-3
    """First learning rate; it falls to a tenth, logarithmically."""
    close: float = 0.02
    """Standard deviation of the distance of close points, in radii of the unit ball; a third of them lie ten times
    closer."""
    normals: float = 0.05
    """Weight of 1 - cos between gradient and normal, and between predicted and smooth normal, at close points."""
    eikonal: float = 0.01
    """Weight of (|gradient| - 1)^2 anywhere."""
    beta: float = 1e-3
    """VolSDF's beta of the fitted field: how sharp its surface is."""

    def __post_init__(self) -> None:
        if min(self.num_steps, self.points_per_step) < 1 or min(self.learning_rate, self.close, self.beta) <= 0:
            raise UserError("steps, points, learning rate and distances must be positive", got=str(self))


class MeshDistance:
    """The signed distance of a surface of which cameras see one side, positive outside.

    Args:
        seen: the part of the surface that cameras see, normals towards them, sheets `thickened`.
        is_seen: bool [side, side, side] over [-1, 1]^3, whether some camera sees a cell's centre before any surface.
        low, high: the mesh's bounding box, [3].
    """

    def __init__(
        self, seen: Surfels, is_seen: Bool[Tensor, "side side side"], low: np.ndarray, high: np.ndarray
    ) -> None:
        self.seen = seen
        side = is_seen.shape[0]
        axis = (np.arange(side) + 0.5) * (2 / side) - 1
        in_box = [(axis > low[i]) & (axis < high[i]) for i in range(3)]
        inside = ~is_seen.numpy() & in_box[0][:, None, None] & in_box[1][:, None] & in_box[2]
        self._far = signed_distance_of_cells(torch.from_numpy(inside)).numpy()
        self._near = _NEAR_CELLS * 2 / side

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Signed distances [points] at points [points, 3] of the unit ball."""
        side = len(self._far)
        cell = np.clip(((points + 1) * (side / 2)).astype(np.int64), 0, side - 1)
        distance = self._far[tuple(cell.T)].astype(np.float32)
        index = self.seen.nearest(points, within=self._near + self.seen.radius)
        near = self.seen.signed_distances(points, index)
        is_near = (index >= 0) & (np.abs(near) < self._near)
        distance[is_near] = near[is_near]
        return distance


def thickened(seen: Surfels) -> Surfels:
    """Sheets that are seen from both sides get room between them: their discs move towards the cameras by one radius.
    Other discs stay."""
    if not len(seen):
        return seen
    reach = 2 * seen.radius
    count = min(16, len(seen))
    distance, index = seen.neighbours(seen.positions, count)
    opposite = (seen.normals[:, None] * seen.normals[index]).sum(-1) < _OPPOSITE_COSINE
    is_sheet = (opposite & (distance < reach)).any(-1)
    moved = seen.positions + np.float32(seen.radius) * seen.normals * is_sheet[:, None]
    return Surfels(moved.astype(np.float32), seen.normals, seen.radius)


def carved_cells(
    cameras: Cameras, depths: Float[Tensor, "views rows columns"], side: int
) -> Bool[Tensor, "side side side"]:
    """Cells of [-1, 1]^3 whose centre some camera sees before it sees the surface.

    Args:
        cameras: who looks.
        depths: distance from each camera to the surface along rays through the pixels of an image of any size;
            infinite where there is none.
        side: cells per axis.
    """
    axis = ((np.arange(side) + 0.5) * (2 / side) - 1).astype(np.float32)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    unseen = np.arange(len(points))
    rows, columns = depths.shape[1:]
    for view in range(len(cameras)):
        pixels, depth = (values[0] for values in cameras[view].project(points[unseen]))
        column = np.floor(pixels[:, 0] * (columns / cameras.width)).astype(np.int64)
        row = np.floor(pixels[:, 1] * (rows / cameras.height)).astype(np.int64)
        inside = (depth > 0) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        distance = np.linalg.norm(points[unseen] - cameras.positions[view], axis=-1)
        surface = depths[view].numpy()[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        unseen = unseen[~(inside & (distance < surface))]
    is_seen = np.ones(len(points), bool)
    is_seen[unseen] = False
    return torch.from_numpy(is_seen.reshape(side, side, side))


def fit_surface(
    surface: SurfaceField, target: MeshDistance, smooth_normals: np.ndarray, config: SurfaceRegressionConfig, seed: int
) -> float:
    """Regress signed distance and predicted normals; returns the mean error of the distance close to the surface at the
    end.

    Args:
        smooth_normals: float32 [surfels, 3], what predicted normals shall be at the surfels of `target.seen`.
    """
    device = surface.log_beta.device
    with torch.no_grad():
        surface.log_beta.copy_(torch.tensor(config.beta).log())
    parameters = [p for p in surface.parameters() if p is not surface.log_beta]
    optimiser = torch.optim.Adam(parameters, lr=config.learning_rate, betas=(0.9, 0.99), eps=1e-15, fused=True)
    error = 0.0
    with step_progress("fit mesh", config.num_steps) as progress:
        for step in range(config.num_steps):
            for group in optimiser.param_groups:
                group["lr"] = config.learning_rate * 0.1 ** (step / config.num_steps)
            batch = _draw(target, smooth_normals, config, numpy_generator(seed, "mesh", step))
            loss, error = _regression_loss(surface, config, *(torch.from_numpy(array).to(device) for array in batch))
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            progress.advance(1, error=error)
    for parameter in parameters:
        parameter.grad = None
    return error


def _draw(
    target: MeshDistance, smooth_normals: np.ndarray, config: SurfaceRegressionConfig, generator: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Close points with their surfels' flat and smooth normals, then points anywhere; and all signed distances."""
    seen, num_close = target.seen, config.points_per_step // 2
    chosen = generator.integers(len(seen), size=num_close)
    scale = np.where(np.arange(num_close) % 3 == 0, 0.1, 1.0)[:, None] * config.close
    close = seen.positions[chosen] + scale * generator.normal(size=(num_close, 3))
    anywhere = generator.normal(size=(config.points_per_step - num_close, 3))
    anywhere /= np.linalg.norm(anywhere, axis=-1, keepdims=True)
    anywhere *= generator.random((len(anywhere), 1)) ** (1 / 3)
    points = np.concatenate([close, anywhere]).astype(np.float32)
    owner = seen.nearest(close)
    return points, target(points), seen.normals[owner], smooth_normals[owner]


def _regression_loss(
    surface: SurfaceField,
    config: SurfaceRegressionConfig,
    points: Float[Tensor, "points 3"],
    distances: Float[Tensor, " points"],
    flat: Float[Tensor, "close 3"],
    smooth: Float[Tensor, "close 3"],
) -> tuple[Tensor, float]:
    found, num_close = surface(points), len(flat)
    error = (found.signed_distance - distances).abs()
    # a distance of one radius matters less than whether the surface is where it should be
    weight = 1 / (1 + distances.abs() / config.close)
    gradient = functional.normalize(found.gradient[:num_close], dim=-1, eps=1e-6)
    is_close = distances[:num_close].abs() < config.close
    bent = (1 - (gradient * flat).sum(-1)) * is_close
    predicted = surface.predicted_normals(points[:num_close])
    total = (weight * error).mean() / config.close + config.eikonal * losses.eikonal_loss(found.gradient)
    total = total + config.normals * (bent.mean() + (1 - (predicted * smooth).sum(-1)).mean())
    return total, float(error[:num_close].detach().mean())


def appearance_loss(
    field: RadianceField,
    pool: RayPool,
    target_srgb: Float[Tensor, "pool 3"],
    index: Int[Tensor, " batch"],
    generator: torch.Generator,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Colours of rays, and the proposal that finds the surface: what is left to fit where the surface is known."""
    origins, directions, near, far = pool.rays(index)
    samples = field.sample(origins, directions, near, far, StepDraws(generator, len(index)))
    points = field.worth_shading(samples)
    srgb = field.shade(points, field.shading_normals(points), directions)
    total = losses.robust_colour_loss(srgb, target_srgb[index])
    total = total + interlevel_loss(samples.edges, samples.weights, samples.proposal_edges, samples.proposal_weights)
    return total, {"psnr": losses.psnr(losses.colour_loss(srgb.detach(), target_srgb[index]))}
