"""Principled materials and a light as unknowns, and how badly they explain photographs.

What the paper compares with: inverse rendering, which takes photographs apart into shape, material and light. Here the
shape is given. Values per vertex are sums over grids of several resolutions, so that what few photographs show is
filled in from around, and roughness and metalness, of which photographs tell little, have coarse grids only.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor, nn

from illuminerf.cues.differentiable_shading import DifferentiableShading
from illuminerf.cues.materials import Material
from illuminerf.cues.surface_samples import CLIPPED_SRGB
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import Views
from illuminerf.workflow.device import derived_seed
from illuminerf.workflow.errors import UserError

_SMOOTHEST = 0.08  # smaller roughness is a mirror: all noise at a few paths
_OPAQUE = 0.98
_DARKEST = 0.02  # linear; errors of darker pixels do not count more
_CHROMA_STIFFNESS = 4.0  # colour of light varies less than its brightness


@dataclass(frozen=True)
class MaterialFit:
    """How materials and light are fitted to photographs."""

    map_height: int = 16
    """Rows of the light; it has twice as many columns."""
    color_sides: tuple[int, ...] = (8, 16, 32, 64, 128, 256)
    """Cells along each side of the ball's box, of the grids that base colour is a sum over."""
    surface_sides: tuple[int, ...] = (2, 4, 8, 16)
    """The same of roughness and metallic."""
    max_depth: int = 3
    """Longest path in edges: 2 is direct light with shadows, 3 is one bounce."""
    samples_per_ray: int = 4
    """Paths for the value of a pixel, and as many for its gradient."""
    first_roughness: float = 0.5
    """Where the fit starts, and what it is drawn to."""
    first_metallic: float = 0.05
    """The same of metallic."""
    robustness: float = 0.15
    """Error, in sRGB values, from which on it counts linearly and no longer squared."""
    light_smoothness: float = 0.003
    """Weight of the squared differences of log radiance between neighbouring texels."""
    color_detail: float = 0.003
    """Weight of the squared values of the grids of base colour, times their side over the coarsest one's."""
    surface_change: float = 0.001
    """Weight of the squared changes of roughness and metallic, in logits."""
    device: str = "auto"
    """Of the path tracer: auto, cpu or cuda."""

    def __post_init__(self) -> None:
        if not 4 <= self.map_height <= 256 or self.max_depth < 2 or self.samples_per_ray < 1:
            raise UserError("the fit of materials needs a light, paths and samples", got=str(self))
        if not self.color_sides or not self.surface_sides or min(*self.color_sides, *self.surface_sides) < 1:
            raise UserError("the fit of materials needs grids", wanted="sides of 1 or more")
        if not all(0 < value < 1 for value in (self.first_metallic, self.first_roughness - _SMOOTHEST)):
            raise UserError("the fit of materials starts outside (0, 1)", got=str(self))
        weights = (self.light_smoothness, self.color_detail, self.surface_change)
        if min(weights) < 0 or not self.robustness > 0:
            raise UserError("weights of the fit of materials must not be negative", got=str(self))


class FittedMaterials(nn.Module):
    """Base colour, roughness and metallic of vertices, and the light: what is optimised.

    Args:
        mesh: the object in the unit ball.
        light: where the fit starts; of `config.map_height` rows.
        config: the settings.
    """

    def __init__(self, mesh: TriangleMesh, light: EnvironmentMap, config: MaterialFit) -> None:
        super().__init__()
        self._config = config
        self._color = [_Interpolation(mesh.vertices, side) for side in config.color_sides]
        self._surface = [_Interpolation(mesh.vertices, side) for side in config.surface_sides]
        self.color_grids = nn.ParameterList(torch.zeros(grid.num_values, 3) for grid in self._color)
        self.surface_grids = nn.ParameterList(torch.zeros(grid.num_values, 2) for grid in self._surface)
        start = np.maximum(light.resized(config.map_height).linear_rgb, 1e-3 * light.linear_rgb.mean())
        self.log_light = nn.Parameter(torch.from_numpy(np.log(start)))

    def values(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Base colour [vertices, 3], roughness [vertices], metallic [vertices] and the light's radiance."""
        color, surface = _summed(self._color, self.color_grids), _summed(self._surface, self.surface_grids)
        config = self._config
        rough = (config.first_roughness - _SMOOTHEST) / (1 - _SMOOTHEST)
        first = torch.logit(torch.tensor([rough, config.first_metallic]))
        roughness, metallic = torch.sigmoid(surface + first).unbind(-1)
        return torch.sigmoid(color), _SMOOTHEST + (1 - _SMOOTHEST) * roughness, metallic, self.log_light.exp()

    def prior(self) -> Tensor:
        """Smooth light, materials no more detailed than photographs ask for."""
        config = self._config
        finer = [side / config.color_sides[0] for side in config.color_sides]
        color = sum(f * values.square().mean() for f, values in zip(finer, self.color_grids, strict=True))
        surface = sum(values.square().mean() for values in self.surface_grids)
        return (
            config.light_smoothness * _unevenness(self.log_light)
            + config.color_detail * color
            + config.surface_change * surface
        )

    def material(self) -> Material:
        """What was found, for `cues.shading`."""
        with torch.no_grad():
            color, roughness, metallic, _ = (value.numpy() for value in self.values())
        return Material(color, roughness, metallic)

    def light(self) -> EnvironmentMap:
        """What was found."""
        return EnvironmentMap(self.log_light.detach().exp().numpy().copy(), "fitted")


class Photographs:
    """Pixels of photographs that lie on the object, to draw batches from.

    Raises:
        UserError: there are none.
    """

    def __init__(self, views: Views) -> None:
        self._views = views
        size = views.alpha.shape[1] * views.alpha.shape[2]
        covered = [np.flatnonzero(alpha > _OPAQUE) + view * size for view, alpha in enumerate(views.alpha)]
        self._index = np.concatenate(covered)
        if len(self._index) == 0:
            raise UserError("no pixel of the photographs lies on the object", fix="check the masks of the capture")

    def drawn(self, count: int, generator: torch.Generator) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Rays through random points of `count` random pixels, origins and directions [count, 3], and sRGB colours."""
        chosen = self._index[torch.randint(len(self._index), (count,), generator=generator).numpy()]
        place = np.unravel_index(chosen, self._views.alpha.shape)
        view, row, column = map(torch.from_numpy, place)
        points = torch.stack([column, row], -1) + torch.rand(count, 2, generator=generator)
        return self._views.cameras.rays(view, points), torch.from_numpy(self._views.srgb[place])


def photometric_loss(
    found: FittedMaterials,
    shading: DifferentiableShading,
    rays: tuple[Tensor, Tensor],
    srgb: Tensor,
    config: MaterialFit,
    seed: int,
) -> tuple[Tensor, float]:
    """How far the rendering of rays is from the photographs' colours [rays, 3], and its PSNR, noise included.

    The error is that of linear radiance, weighted by the slope of sRGB at the photograph's value: the mean of a noisy
    rendering is linear, that of its sRGB values is too dark.
    """
    radiance, hit = shading.radiance(*found.values(), rays, config.samples_per_ray, derived_seed(seed, "paths"))
    wanted = linear_from_srgb(srgb)
    slope = 0.43 * (wanted + _DARKEST) ** -0.58
    error = (radiance - wanted) * slope
    # what a photograph shows as white may be any brighter
    error = torch.where((srgb > CLIPPED_SRGB) & (error > 0), 0.0, error) * hit[:, None]
    weight = (1 + (error.detach() / config.robustness).square()).rsqrt()
    count = hit.sum().clamp_min(1) * 3
    with torch.no_grad():
        squared = (srgb_from_linear(radiance.clamp(0, 1)) - srgb).square() * hit[:, None]
        psnr = float(-10 * torch.log10(squared.sum() / count + 1e-10))
    return (weight * error.square()).sum() / count, psnr


class _Interpolation:
    """Trilinear interpolation at fixed points between the values of a grid over [-1, 1]^3, of which only the corners of
    cells that hold a point exist."""

    def __init__(self, points: np.ndarray, side: int) -> None:
        at = (np.clip(points.astype(np.float64), -1, 1) + 1) / 2 * side
        low = np.minimum(at.astype(np.int64), side - 1)
        share = at - low
        corners, weights = [], []
        for offset in np.ndindex(2, 2, 2):
            corner = low + np.array(offset)
            corners.append((corner[:, 0] * (side + 1) + corner[:, 1]) * (side + 1) + corner[:, 2])
            weights.append(np.where(np.array(offset), share, 1 - share).prod(-1))
        used, columns = np.unique(np.stack(corners, -1), return_inverse=True)
        self.num_values = len(used)
        rows = np.repeat(np.arange(len(points)), 8)
        entries = np.stack(weights, -1).astype(np.float32).ravel()
        self.matrix = csr_matrix((entries, (rows, columns.ravel())), shape=(len(points), len(used)))
        self.transposed = self.matrix.T.tocsr()

    def __call__(self, values: Tensor) -> Tensor:
        return _Interpolated.apply(values, self)


def _summed(grids: Sequence[_Interpolation], values: Iterable[Tensor]) -> Tensor:
    return torch.stack([grid(value) for grid, value in zip(grids, values, strict=True)]).sum(0)


class _Interpolated(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, grid: _Interpolation) -> Tensor:
        ctx.grid = grid
        return torch.from_numpy(grid.matrix @ values.detach().numpy())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.grid.transposed @ gradient.numpy()), None


def _unevenness(log_light: Tensor) -> Tensor:
    """Mean squared difference between neighbouring texels, and of every texel's colour from grey."""
    grey = log_light.mean(-1, keepdim=True)
    chroma = log_light - grey
    side, down = log_light - log_light.roll(1, 1), log_light.diff(dim=0)
    return side.square().mean() + down.square().mean() + _CHROMA_STIFFNESS * chroma.square().mean()
