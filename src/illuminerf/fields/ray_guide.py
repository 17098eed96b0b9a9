"""Which rays to look at again: those where the error is."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from illuminerf.fields.ray_pool import RayPool
from illuminerf.workflow.processes import ALONE, Team

_TILE = 8  # pixels
_NEW_SHARE = 0.5  # of what a step finds, in a tile's running error


class RayGuide:
    """Tiles of pixels with a running mean of their rays' errors, to draw rays from in proportion to it.

    Deviation: the paper draws rays evenly. Most pixels of an object are right after a few hundred steps; edges, holes
    and thin parts are few and stay wrong, and a short fit sees them too seldom.

    Attributes:
        errors: of every tile that has rays; 1, which is more than any error, where none was seen yet.
    """

    def __init__(self, pool: RayPool) -> None:
        width, height = pool.cameras.width, pool.cameras.height
        columns, rows = -(-width // _TILE), -(-height // _TILE)
        pixel = pool.pixel.long()
        key = (pool.view.long() * rows + pixel // width // _TILE) * columns + pixel % width // _TILE
        keys, self._tile, self._count = torch.unique(key, return_inverse=True, return_counts=True)
        self._tile = self._tile.int()
        self._order = torch.argsort(self._tile, stable=True).int()
        self._first = self._count.cumsum(0) - self._count
        self.errors = torch.ones(len(keys), device=key.device)

    def draw(self, num_rays: int, generator: torch.Generator) -> Int[Tensor, " batch"]:
        """Random rays of the pool: a tile in proportion to its rays' errors together, then one of its rays."""
        device = self.errors.device
        share = (self.errors.clamp_min(1e-6) * self._count).double().cumsum(0)
        at = torch.rand(num_rays, generator=generator, device=device, dtype=torch.float64) * share[-1]
        tile = torch.searchsorted(share, at, right=True).clamp_max(len(share) - 1)
        within = torch.rand(num_rays, generator=generator, device=device, dtype=torch.float64) * self._count[tile]
        return self._order[self._first[tile] + within.long().minimum(self._count[tile] - 1)].long()

    def update(
        self,
        index: Int[Tensor, " batch"],
        error: Float[Tensor, " own"],
        team: Team = ALONE,
        is_void: Float[Tensor, ""] | None = None,
    ) -> None:
        """Take in the errors of a step's rays.

        Args:
            index: rays of the pool, all processes' together.
            error: of this process's own share of them, 0 to 1.
            is_void: 1: nothing is taken in, since the step will be done again.
        """
        whole = torch.zeros(len(index), device=error.device)
        whole[team.own(len(index))] = error.detach()
        whole = team.sum(whole)
        tile = self._tile[index].long()
        total = torch.zeros_like(self.errors).index_add_(0, tile, whole)
        count = torch.zeros_like(self.errors).index_add_(0, tile, torch.ones_like(whole))
        mixed = (1 - _NEW_SHARE) * self.errors + _NEW_SHARE * total / count.clamp_min(1)
        seen = count > 0 if is_void is None else (count > 0) & (is_void == 0)
        self.errors.copy_(torch.where(seen, mixed, self.errors))
