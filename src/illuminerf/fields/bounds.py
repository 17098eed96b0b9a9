"""Where the object can be: the unit ball, and inside it the cells that no mask rules out."""

from collections.abc import Iterable
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit, prange
from scipy import ndimage
from torch import Tensor

from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.errors import UserError


def ball_interval(
    origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"], radius: float = 1.0
) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"]]:
    """Distances at which unit-direction rays enter and leave the ball about the origin (far <= near: they miss)."""
    along = -(origins * directions).sum(-1)
    closest = origins + along[:, None] * directions
    half = (radius**2 - (closest * closest).sum(-1)).clamp_min(0).sqrt()
    return (along - half).clamp_min(0), along + half


class OccupiedCells:
    """A cubic grid over [-1, 1]^3 whose false cells are known to be empty.

    Args:
        cells: bool [side, side, side], indexed x, y, z.
    """

    def __init__(self, cells: Bool[Tensor, "side side side"]) -> None:
        self.cells = cells

    def contains(self, positions: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Whether positions lie in occupied cells."""
        side = self.cells.shape[0]
        x, y, z = (positions * (side / 2) + side / 2).long().clamp(0, side - 1).unbind(-1)
        return self.cells.view(-1)[(x * side + y) * side + z]

    def clip(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]
    ) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"]]:
        """Near and far ends of the stretch of each ray that meets occupied cells; far = near = 0 where none does."""
        near, far = ball_interval(origins, directions)
        steps = int(1.5 * self.cells.shape[0])
        if origins.is_cuda:
            first, last = self._march(origins, directions, near, far, steps)
        else:
            first, last = torch.empty(len(near), dtype=torch.long), torch.empty(len(near), dtype=torch.long)
            rays = (origins.contiguous().numpy(), directions.contiguous().numpy(), near.numpy(), far.numpy())
            _march_kernel(self.cells.numpy(), *rays, steps, first.numpy(), last.numpy())
        width = (far - near) / steps
        # one step of margin at both ends: cells are tested at points
        clipped_near = near + width * (first - 1).clamp_min(0)
        clipped_far = near + width * (last + 2).clamp_max(steps)
        any_hit = last >= 0
        return clipped_near * any_hit, clipped_far * any_hit

    def _march(
        self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, steps: int
    ) -> tuple[Tensor, Tensor]:
        """First and last of `steps` points along each ray in an occupied cell (last = -1: none). The kernel's twin."""
        centres = torch.arange(steps, device=origins.device) + 0.5
        distances = near[:, None] + ((far - near) / steps)[:, None] * centres
        hit = self.contains(origins[:, None] + distances[..., None] * directions[:, None])
        hit &= (far > near)[:, None]
        last = steps - 1 - hit.flip(-1).int().argmax(-1)
        return hit.int().argmax(-1), torch.where(hit.any(-1), last, -1)

    def dilated(self, cells: int) -> "OccupiedCells":
        """Grown by a number of cells in every direction."""
        grown = ndimage.binary_dilation(
            self.cells.cpu().numpy(), ndimage.generate_binary_structure(3, 3), iterations=cells
        )
        return OccupiedCells(torch.from_numpy(grown).to(self.cells.device))


@njit(inline="always")
@no_type_check
def _occupied(cells, origin, direction, distance):
    side = cells.shape[0]
    half = np.float32(side / 2)
    x = int((origin[0] + distance * direction[0]) * half + half)
    y = int((origin[1] + distance * direction[1]) * half + half)
    z = int((origin[2] + distance * direction[2]) * half + half)
    return cells[min(max(x, 0), side - 1), min(max(y, 0), side - 1), min(max(z, 0), side - 1)]


@njit(parallel=True, cache=True)
@no_type_check
def _march_kernel(cells, origins, directions, near, far, steps, first, last):
    for ray in prange(len(near)):
        first[ray], last[ray] = 0, -1
        if far[ray] <= near[ray]:
            continue
        width = (far[ray] - near[ray]) / np.float32(steps)
        for step in range(steps):
            distance = near[ray] + width * np.float32(step + 0.5)
            if _occupied(cells, origins[ray], directions[ray], distance):
                first[ray] = last[ray] = step
                break
        if last[ray] < 0:
            continue
        for step in range(steps - 1, first[ray], -1):
            distance = near[ray] + width * np.float32(step + 0.5)
            if _occupied(cells, origins[ray], directions[ray], distance):
                last[ray] = step
                break


def visual_hull(cameras: Cameras, alpha: Iterable[np.ndarray], side: int) -> Bool[Tensor, "side side side"]:
    """Cells of the ball that some pixel with alpha > 0.5 sees in every view whose image they fall into.

    Args:
        alpha: float32 [height, width] per view.

    Raises:
        UserError: nothing is left, because masks and cameras do not fit together.
    """
    axis = ((np.arange(side) + 0.5) * (2 / side) - 1).astype(np.float32)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    inside = (points**2).sum(-1) < 1
    # a voxel may cover several pixels, so a mask counts as far as half a voxel reaches
    for view, coverage in enumerate(alpha):
        candidates = np.flatnonzero(inside)
        image_points, depth = cameras[view].project(points[candidates])
        nearest = max(float(depth[0].min(initial=1e6)), 0.1)
        reach = 0.87 * (2 / side) * cameras.intrinsics[view, 0] / nearest + 1
        mask = coverage > 0.5
        grown = ndimage.distance_transform_edt(~mask) <= reach
        column, row = np.floor(image_points[0]).astype(int).T
        seen = (column >= 0) & (column < cameras.width) & (row >= 0) & (row < cameras.height) & (depth[0] > 0)
        keep = np.ones(len(candidates), bool)
        keep[seen] = grown[row[seen], column[seen]]
        inside[candidates] = keep
    if not inside.any():
        raise UserError(
            "no point in the unit ball is inside all masks",
            fix="check that cameras follow the OpenGL convention and that the capture's scale and offset fit",
        )
    return torch.from_numpy(inside.reshape(side, side, side))


def signed_distance_of_cells(cells: Bool[Tensor, "side side side"]) -> Float[Tensor, "side side side"]:
    """Approximate signed distance (positive outside, world units) at the cells' centres."""
    occupied = cells.cpu().numpy()
    spacing = 2 / occupied.shape[0]
    outside = ndimage.distance_transform_edt(~occupied)
    inside = ndimage.distance_transform_edt(occupied)
    distance = ndimage.gaussian_filter((outside - inside).astype(np.float32), 1.0) * spacing
    return torch.from_numpy(distance)
