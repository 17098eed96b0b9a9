"""The surface: a signed distance with its normals, and the predicted normals."""

import functools
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from illuminerf.fields import surface_kernel
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.hash_grid import HashGrid, HashGridConfig
from illuminerf.fields.volume_rendering import optical_depth
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say

_SHARPNESS = 100.0


@dataclass(frozen=True)
class SurfaceConfig:
    """Signed distance and predicted normals."""

    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(10, 2, 16, 16, 512))
    """Hash grid of the signed distance."""
    hidden_width: int = 64
    """Width of its one hidden layer."""
    normal_grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(8, 2, 15, 32, 512))
    """Hash grid that is used for predicted normals only (supplement A.1)."""
    normal_hidden_width: int = 32
    """Width of the hidden layer of the predicted normals."""
    initial_radius: float = 0.5
    """The signed distance starts as a sphere of this radius."""
    initial_beta: float = 0.03
    """First value of VolSDF's beta, which is learned."""
    has_normal_grid: bool = True
    """False: predicted normals come from the signed distance's own features, as in UniSDF before the supplement's
    change, for comparison."""

    def __post_init__(self) -> None:
        if not 0 < self.initial_radius < 1 or self.initial_beta <= 0:
            raise UserError("initial radius must be in (0, 1) and beta above 0", got=str(self))


class SurfacePoint(NamedTuple):
    """What the surface is at given positions."""

    signed_distance: Float[Tensor, " points"]
    gradient: Float[Tensor, "points 3"]


class SurfaceField(nn.Module):
    """Signed distance |x| - radius + MLP(hash(x)), positive outside, with its analytic gradient."""

    def __init__(self, config: SurfaceConfig) -> None:
        super().__init__()
        self.config = config
        self.grid = HashGrid(config.grid)
        self.hidden = nn.Linear(config.grid.width, config.hidden_width)
        self.head = nn.Linear(config.hidden_width, 1)
        nn.init.zeros_(self.head.bias)
        self.log_beta = nn.Parameter(torch.tensor(float(config.initial_beta)).log())
        self.normal_grid = HashGrid(config.normal_grid) if config.has_normal_grid else None
        self.normal_mlp = nn.Sequential(
            nn.Linear(
                (config.normal_grid if config.has_normal_grid else config.grid).width, config.normal_hidden_width
            ),
            nn.ReLU(),
            nn.Linear(config.normal_hidden_width, 3),
        )

    @property
    def num_normal_levels(self) -> int:
        """Levels of the hash grid that predicted normals come from."""
        return (self.normal_grid or self.grid).config.num_levels

    @property
    def beta(self) -> Float[Tensor, ""]:
        """VolSDF's beta, at least 5e-4 so that float32 optical depths stay finite."""
        return self.log_beta.exp() + 5e-4

    def forward(
        self, positions: Float[Tensor, "points 3"], level_weights: Float[Tensor, " levels"] | None = None
    ) -> SurfacePoint:
        """Signed distance and its gradient."""
        kernels = self._kernels(positions)
        if kernels is not None:
            distance, gradient = kernels.FusedSurface.apply(*self._kernel_inputs(positions, level_weights))
        else:
            distance, gradient = self.residual(*self.grid.with_jacobian(positions, level_weights))
        distance = distance + self.head.bias - self.config.initial_radius
        radius = positions.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        return SurfacePoint(distance + radius[..., 0], gradient + positions / radius)

    def residual(
        self, features: Float[Tensor, "points width"], jacobian: Float[Tensor, "points width 3"]
    ) -> SurfacePoint:
        """What is added to the initial sphere, less the last layer's bias, from what the hash grid gives.

        With the grid's own twin this is the readable twin of `FusedSurface`. The gradient of the small MLP is written
        out (softplus' is the sigmoid) and chained with the Jacobian of the hash grid; both are ordinary differentiable
        functions of the parameters.
        """
        hidden, slope = _SoftplusWithSlope.apply(self.hidden(features))
        by_feature = (slope * self.head.weight) @ self.hidden.weight
        gradient = torch.einsum("nf,nfi->ni", by_feature, jacobian)
        return SurfacePoint((hidden @ self.head.weight.T)[..., 0], gradient)

    def signed_distance(
        self, positions: Float[Tensor, "points 3"], level_weights: Float[Tensor, " levels"] | None = None
    ) -> Float[Tensor, " points"]:
        """Signed distance alone, which is cheaper, most of all where no gradients are recorded."""
        kernels = None if torch.is_grad_enabled() else self._kernels(positions)
        if kernels is not None:
            distance = kernels.distance_alone(*self._kernel_inputs(positions, level_weights))
        else:
            hidden = functional.softplus(self.hidden(self.grid(positions, level_weights)), beta=_SHARPNESS)
            distance = functional.linear(hidden, self.head.weight)[..., 0]
        return distance + self.head.bias + positions.norm(dim=-1) - self.config.initial_radius

    def _kernels(self, positions: Tensor) -> Any:
        """The module whose `FusedSurface` takes these positions, or None; then the readable twin does."""
        if positions.dtype != torch.float32 or not len(positions):
            return None
        if not positions.is_cuda:
            return surface_kernel
        if not self.grid.runs_in_triton(positions):
            return None
        grid = self.config.grid
        return _gpu_kernels(positions.device, grid.num_levels, grid.num_features, self.config.hidden_width)

    def _kernel_inputs(self, positions: Tensor, level_weights: Tensor | None) -> tuple[Any, ...]:
        table, levels = self.grid.table, level_weights
        if levels is None:
            levels = table.new_ones(self.config.grid.num_levels)
        layers = (self.hidden.weight, self.hidden.bias, self.head.weight)
        return (table, *layers, positions, self.grid.layout, levels)

    def predicted_normals(
        self, positions: Float[Tensor, "points 3"], level_weights: Float[Tensor, " levels"] | None = None
    ) -> Float[Tensor, "points 3"]:
        """Unit normals from their own hash grid; they point away from the origin before training."""
        raw = self.normal_mlp((self.normal_grid or self.grid)(positions, level_weights))
        return functional.normalize(raw + positions, dim=-1, eps=1e-6)

    def depths_along(
        self, signed_distance: Float[Tensor, "rays edges"], edges: Float[Tensor, "rays edges"]
    ) -> Float[Tensor, "rays samples"]:
        """Optical depths of the intervals of rays, from the signed distance at their ends.

        Ends, not middles with a slope: beside a surface the slope of a wide interval would foretell a crossing that
        never comes, and opaque specks with it.
        """
        widths = (edges[:, 1:] - edges[:, :-1]).clamp_min(1e-7)
        before, after = signed_distance[:, :-1], signed_distance[:, 1:]
        return optical_depth(0.5 * (before + after), (after - before) / widths, widths, self.beta)


@functools.cache
def _gpu_kernels(device: torch.device, num_levels: int, num_features: int, num_hidden: int) -> Any:
    """`surface_triton`, or None where it cannot run; then the hash grid's kernels and torch do."""
    from illuminerf.fields import surface_triton

    reason = surface_triton.why_not(device, num_levels, num_features, num_hidden)
    if not reason:
        return surface_triton
    say(f"the surface runs slower than it could on {device}, without its own kernels: {reason}")
    return None


class _SoftplusWithSlope(torch.autograd.Function):
    """Softplus of sharpness 100 and its derivative, which share one exponential and one backward pass."""

    @staticmethod
    def forward(ctx, value: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[no-untyped-def]
        tail = value.abs().mul_(-_SHARPNESS).exp_()
        slope = torch.reciprocal(tail + 1)
        slope = torch.where(value > 0, slope, tail * slope)
        ctx.save_for_backward(slope)
        return value.clamp_min(0).add_(tail.log1p_(), alpha=1 / _SHARPNESS), slope

    @staticmethod
    def backward(ctx, value_grad: Tensor, slope_grad: Tensor) -> Tensor:  # type: ignore[no-untyped-def]
        (slope,) = ctx.saved_tensors
        curvature = (slope * slope).sub_(slope).mul_(-_SHARPNESS)
        return curvature.mul_(slope_grad).addcmul_(slope, value_grad)


@torch.no_grad()
def surface_cells(surface: SurfaceField, cells: OccupiedCells) -> OccupiedCells:
    """Those of the given cells that the fitted surface or its soft shell can touch."""
    side = cells.cells.shape[0]
    index = cells.cells.nonzero()
    distance = torch.cat([surface.signed_distance((chunk + 0.5) * (2 / side) - 1) for chunk in index.split(1 << 17)])
    # half a cell's diagonal, and as far as the density is worth anything
    reach = 1.75 / side + 6 * float(surface.beta)
    kept = torch.zeros_like(cells.cells)
    kept[tuple(index[distance < reach].T)] = True
    return OccupiedCells(kept)
