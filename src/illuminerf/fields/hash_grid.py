"""Multi-resolution hash grid (Mueller et al. 2022) with its spatial Jacobian.

Features and Jacobian are both linear in the table, so a signed distance built on them has normals in forward mode,
and losses on those normals train with ordinary first-order autograd: no double backward through positions.
`interpolate` is the readable version and runs everywhere. `HashGrid` uses its fast twins: on a CPU the one in numba; on
a GPU, for float32 tables, the one in Triton, which PyTorch brings along there.
"""

import functools
import importlib.util
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from illuminerf.fields.hash_grid_kernel import KernelInterpolation, kernel_layout
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say

_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashGridConfig:
    """Sizes of one hash grid over the box [-1, 1]^3."""

    num_levels: int = 10
    """Number of resolutions, spaced geometrically."""
    num_features: int = 2
    """Features per entry and level."""
    log2_entries: int = 16
    """Entries per level are at most 2 to this power; coarse levels that fit are stored densely."""
    coarsest: int = 16
    """Cells per axis of the first level."""
    finest: int = 512
    """Cells per axis of the last level."""

    def __post_init__(self) -> None:
        if self.num_levels < 1 or self.num_features < 1 or not 4 <= self.log2_entries <= 24:
            raise UserError("a hash grid needs levels, features and 2^4 to 2^24 entries", got=str(self))
        if not 1 <= self.coarsest <= self.finest:
            raise UserError(
                "hash grid resolutions must grow", got=f"{self.coarsest} to {self.finest}", wanted="1 <= coarsest"
            )

    def resolutions(self) -> list[int]:
        """Cells per axis of each level."""
        if self.num_levels == 1:
            return [self.coarsest]
        ratio = (self.finest / self.coarsest) ** (1 / (self.num_levels - 1))
        return [round(self.coarsest * ratio**level) for level in range(self.num_levels)]

    @property
    def width(self) -> int:
        """Length of a feature vector."""
        return self.num_levels * self.num_features


class HashGrid(nn.Module):
    """A table of features with trilinear interpolation.

    Positions are [points, 3]; outside the box [-1, 1]^3 they are clamped to it. Positions get no gradient.
    """

    def __init__(self, config: HashGridConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        self._resolutions = config.resolutions()
        limit = 2**config.log2_entries
        self._sizes = [min((r + 1) ** 3, limit) for r in self._resolutions]
        self._offsets = [sum(self._sizes[:level]) for level in range(config.num_levels)]
        self.layout = kernel_layout(self._resolutions, self._sizes, self._offsets)
        table = torch.rand(sum(self._sizes), config.num_features, generator=generator)
        self.table = nn.Parameter((table * 2 - 1) * 1e-4)

    def forward(
        self, positions: Float[Tensor, "points 3"], level_weights: Float[Tensor, " levels"] | None = None
    ) -> Float[Tensor, "points width"]:
        """Features, each level times its weight (coarse to fine)."""
        features, _ = self._interpolated(positions, with_jacobian=False)
        return features if level_weights is None else features * self._columns(level_weights)

    def with_jacobian(
        self, positions: Float[Tensor, "points 3"], level_weights: Float[Tensor, " levels"] | None = None
    ) -> tuple[Float[Tensor, "points width"], Float[Tensor, "points width 3"]]:
        """Features and their derivatives with respect to the position."""
        features, jacobian = self._interpolated(positions, with_jacobian=True)
        if level_weights is None:
            return features, jacobian
        columns = self._columns(level_weights)
        return features * columns, jacobian * columns[:, None]

    def runs_in_triton(self, positions: Float[Tensor, "points 3"]) -> bool:
        """Whether kernels in Triton take these positions: on a GPU that has them, for a table in float32."""
        return positions.is_cuda and self.table.dtype == torch.float32 and _gpu_kernel(positions.device) is not None

    def _interpolated(self, positions: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor]:
        kernel: Any = KernelInterpolation
        if positions.is_cuda:
            kernel = _gpu_kernel(positions.device) if self.table.dtype == torch.float32 else None
        if kernel is None or not len(positions):
            levels = (self._resolutions, self._sizes, self._offsets)
            return interpolate(positions, self.table, *levels, with_jacobian=with_jacobian)
        return kernel.apply(self.table, positions, self.layout, with_jacobian)

    def _columns(self, level_weights: Tensor) -> Tensor:
        return level_weights.to(self.table)[:, None].expand(-1, self.config.num_features).reshape(-1)


@functools.cache
def _gpu_kernel(device: torch.device) -> Any:
    """`TritonInterpolation`, or None where it cannot run; then the readable twin does."""
    if importlib.util.find_spec("triton") is None:
        reason = "there is no triton (pip install triton)"
    else:
        from illuminerf.fields.hash_grid_triton import TritonInterpolation, why_not

        reason = why_not(device)
        if not reason:
            return TritonInterpolation
    say(f"hash grids run many times slower than they could on {device}, without their kernels: {reason}")
    return None


def interpolate(
    positions: Float[Tensor, "points 3"],
    table: Float[Tensor, "entries features"],
    resolutions: list[int],
    sizes: list[int],
    offsets: list[int],
    with_jacobian: bool = False,
) -> tuple[Float[Tensor, "points width"], Float[Tensor, "..."]]:
    """Readable twin of the kernel: features [points, levels * features] and Jacobian [points, .., 3] (or empty).

    Differentiable in the table and, almost everywhere, in the positions.
    """
    features, jacobians = [], []
    corners = torch.tensor([[c & 1, (c >> 1) & 1, c >> 2] for c in range(8)], device=positions.device)
    for resolution, size, offset in zip(resolutions, sizes, offsets, strict=True):
        half = resolution / 2
        scaled = (positions.to(table.dtype) * half + half).clamp(0, resolution)
        cell = scaled.detach().long().clamp_max(resolution - 1)
        inside = (scaled - cell)[:, None]
        axis_weights = torch.where(corners.bool(), inside, 1 - inside)
        values = table[offset + _entries(cell[:, None] + corners, resolution, size)]
        features.append((axis_weights.prod(-1, keepdim=True) * values).sum(1))
        if with_jacobian:
            wx, wy, wz = axis_weights.unbind(-1)
            slopes = torch.stack([wy * wz, wx * wz, wx * wy], -1) * (corners * 2 - 1) * half
            jacobians.append(torch.einsum("nci,ncf->nfi", slopes, values))
    jacobian = torch.cat(jacobians, 1) if with_jacobian else table.new_empty(0)
    return torch.cat(features, -1), jacobian


def _entries(corner: Tensor, resolution: int, size: int) -> Tensor:
    x, y, z = corner.unbind(-1)
    side = resolution + 1
    if side**3 <= size:
        return x + side * (y + side * z)
    return (x * _PRIMES[0] ^ y * _PRIMES[1] ^ z * _PRIMES[2]) & (size - 1)


def coarse_to_fine_weights(num_levels: int, progress: Float[Tensor, ""], first_levels: int) -> Float[Tensor, " levels"]:
    """Weight of each level as training goes: `first_levels` are on at progress 0, all at progress 1 and after.

    Args:
        progress: share of the coarse-to-fine phase that is over.
    """
    active = first_levels + progress.clamp(0, 1) * (num_levels - first_levels)
    return (active - torch.arange(num_levels, device=progress.device, dtype=torch.float32)).clamp(0, 1)
