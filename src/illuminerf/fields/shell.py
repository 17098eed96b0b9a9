"""The cells that a fitted surface can be seen in, fine ones, and how rays get from one to the next."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit, prange
from scipy import ndimage
from torch import Tensor

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.surface import SurfaceField

_REACH = 10.0  # in units of beta: a ray along the surface at this distance gathers less than a grey level
_CELL = 3.0  # cells are at most so many betas wide
_FINEST = 128  # finer ones save less than they cost
_CHUNK = 1 << 15
_NUDGE = np.float32(1e-3)  # in cells: positions land behind a boundary, not on it
_PARALLEL = np.float32(1e-9)  # slopes below it never leave a cell


class SurfaceShell:
    """A cubic grid over [-1, 1]^3 with, in every cell, how far it is to the next occupied one.

    Args:
        cells: what is not occupied counts as empty.
    """

    def __init__(self, cells: OccupiedCells) -> None:
        occupied = cells.cells.cpu().numpy()
        self.side = len(occupied)
        self.clearance = _clearance(occupied).to(cells.cells.device).view(-1)
        where = np.argwhere(occupied)
        low, high = (where.min(0), where.max(0) + 1) if len(where) else (np.zeros(3), np.zeros(3))
        self._low, self._high = (
            torch.tensor(corner * (2 / self.side) - 1, dtype=torch.float32, device=cells.cells.device)
            for corner in (low, high)
        )

    def enter(
        self, origins: Float[Tensor, "rays 3"], directions: Float[Tensor, "rays 3"]
    ) -> tuple[Float[Tensor, " rays"], Float[Tensor, " rays"]]:
        """Where rays first are in an occupied cell, and where they leave the box of all of them; near = infinity
        where they miss."""
        inverse = 1 / torch.where(directions.abs() < float(_PARALLEL), float(_PARALLEL), directions)
        ends = torch.stack([(self._low - origins) * inverse, (self._high - origins) * inverse])
        near = ends.amin(0).amax(-1).clamp_min(0) + float(_NUDGE) * 2 / self.side
        far = ends.amax(0).amin(-1)
        return self.advance(origins, directions, near, far), far

    def advance(
        self,
        origins: Float[Tensor, "rays 3"],
        directions: Float[Tensor, "rays 3"],
        distance: Float[Tensor, " rays"],
        far: Float[Tensor, " rays"],
    ) -> Float[Tensor, " rays"]:
        """The first distance at or after `distance` in an occupied cell; infinity where there is none before `far`.

        No cell is missed: around a cell of clearance c the cube of 2c - 1 cells per side is empty, and the ray goes on
        where it leaves that cube (Amanatides and Woo's traversal, in larger steps).
        """
        if origins.is_cuda:
            return self._advance(origins, directions, distance, far)
        result = torch.empty_like(distance)
        rays = (part.contiguous().numpy() for part in (origins, directions, distance, far))
        _advance_kernel(self.clearance.numpy(), np.float32(self.side), *rays, result.numpy())
        return result

    def _advance(self, origins: Tensor, directions: Tensor, distance: Tensor, far: Tensor) -> Tensor:
        """The kernel's twin."""
        half = self.side / 2
        result = torch.where(distance < far, distance, torch.inf)
        moving = (distance < far).nonzero()[:, 0]
        scaled, slope = origins[moving] * half + half, directions[moving] * half
        at, limit = distance[moving], far[moving]
        while len(moving):
            place = scaled + at[:, None] * slope
            cell = place.long().clamp(0, self.side - 1)
            x, y, z = cell.unbind(-1)
            clearance = self.clearance[(x * self.side + y) * self.side + z].to(place.dtype)
            ahead = torch.where(slope > 0, clearance[:, None], 1 - clearance[:, None])
            is_along = slope.abs() < float(_PARALLEL)
            steps = torch.where(is_along, torch.inf, (cell + ahead - place) / torch.where(is_along, 1, slope))
            at = torch.where(clearance > 0, at + steps.amin(-1).clamp_min(0) + float(_NUDGE) / half, at)
            result[moving] = torch.where(at < limit, at, torch.inf)
            go_on = ((clearance > 0) & (at < limit)).nonzero()[:, 0]
            moving, scaled, slope, at, limit = (part[go_on] for part in (moving, scaled, slope, at, limit))
        return result


@njit(parallel=True, cache=True)
@no_type_check
def _advance_kernel(clearance, side, origins, directions, distance, far, result):
    half, last, zero = side / np.float32(2), int(side) - 1, np.float32(0)
    for ray in prange(len(distance)):
        at = distance[ray]
        result[ray] = np.inf
        while at < far[ray]:
            index = 0
            for axis in range(3):
                place = origins[ray, axis] * half + half + at * directions[ray, axis] * half
                index = index * (last + 1) + min(max(int(place), 0), last)
            free = np.float32(clearance[index])
            if free == zero:
                result[ray] = at
                break
            step = np.float32(np.inf)
            for axis in range(3):
                slope = directions[ray, axis] * half
                if abs(slope) >= _PARALLEL:
                    place = origins[ray, axis] * half + half + at * slope
                    cell = np.float32(min(max(int(place), 0), last))
                    end = cell + free if slope > zero else cell + np.float32(1) - free
                    step = min(step, (end - place) / slope)
            at += max(step, zero) + _NUDGE / half


def _clearance(occupied: np.ndarray) -> Tensor:
    """Chessboard distance in cells to the next occupied one, at most 255."""
    if not occupied.any():
        return torch.full(occupied.shape, 255, dtype=torch.uint8)
    distance = ndimage.distance_transform_cdt(~occupied, "chessboard")
    return torch.from_numpy(np.minimum(distance, 255).astype(np.uint8))


@torch.no_grad()
def surface_shell(surface: SurfaceField, cells: OccupiedCells) -> SurfaceShell:
    """Cells of about the width of the soft surface, inside `cells`, that hold something of it or lie behind it."""
    beta = float(surface.beta)
    side, kept = cells.cells.shape[0], cells.cells.nonzero()
    while side < _FINEST and 2 / side > _CELL * beta:
        side *= 2
        corners = torch.tensor([[c & 1, (c >> 1) & 1, c >> 2] for c in range(8)], device=kept.device)
        kept = (2 * kept[:, None] + corners).reshape(-1, 3)
        # twice half a cell's diagonal: the distance may grow faster than it should
        reach = _REACH * beta + 2 * 1.75 / side
        centres = ((chunk + 0.5) * (2 / side) - 1 for chunk in kept.split(_CHUNK))
        kept = kept[torch.cat([surface.signed_distance(chunk) for chunk in centres]) < reach]
    fine = torch.zeros(side, side, side, dtype=torch.bool, device=kept.device)
    fine[tuple(kept.T)] = True
    return SurfaceShell(OccupiedCells(fine))
