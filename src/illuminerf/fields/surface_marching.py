"""Where rays meet a finished surface: empty space is skipped, and steps shrink with the distance to the surface.

Training samples all rays alike, with gradients and a fixed number of samples. A finished field can be looked at with
less work: most of a ray is empty, and all that is seen lies within a few beta of its first crossing. Steps there are
as fine as beta itself, however few samples the field was trained with.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from illuminerf.fields.shell import SurfaceShell
from illuminerf.fields.surface import SurfaceField
from illuminerf.fields.volume_rendering import laplace_density

_STRIDE = 0.4  # of the signed distance, which may grow faster than it should
_FINEST_STEP = 0.75  # in units of beta
_GROWTH = 0.5  # steps may be longer by this share per unit of optical depth: less is seen of what they find
_MAX_STEPS = 1000
_OPAQUE = 7.0  # optical depth behind which less than a quarter of a grey level is seen
_LEAST_WEIGHT = 1e-5
_LARGEST_SHARE = 0.03  # of a ray's opacity that one shading point may stand for
_LONGEST_STRETCH = 4.0  # and how much of the ray, in units of beta
_CHUNK = 1 << 13


@dataclass
class RayWeights:
    """Places along rays that are seen, those of all rays in one axis, along each ray in order.

    Attributes:
        ray: which ray each belongs to.
        distance: where on it.
        weight: rendering weight.
    """

    ray: Int[Tensor, " places"]
    distance: Float[Tensor, " places"]
    weight: Float[Tensor, " places"]

    def total(self, num_rays: int, values: Float[Tensor, "places channels"]) -> Float[Tensor, "rays channels"]:
        """Weighted sums along the rays."""
        sums = torch.zeros(num_rays, values.shape[1], device=values.device)
        return sums.index_add(0, self.ray, self.weight[:, None] * values)

    def merged(self, stretch: float) -> "RayWeights":
        """Neighbours on a ray taken together, at their mean distance.

        Args:
            stretch: no more of a ray than this is merged, so that two surfaces stay two.
        """
        if not len(self.ray):
            return self
        ray_starts = _changes(self.ray)
        number = ray_starts.cumsum(0) - 1
        mass = self.weight.double().cumsum(0) - self.weight
        share = (mass - mass[ray_starts][number] + 0.5 * self.weight) / _LARGEST_SHARE
        place = (self.distance - self.distance[ray_starts][number]) / stretch
        starts = ray_starts | _changes(share.long()) | _changes(place.long())
        group, num_groups = starts.cumsum(0) - 1, int(starts.sum())
        weight = torch.zeros(num_groups, device=self.ray.device).index_add(0, group, self.weight)
        moment = torch.zeros_like(weight).index_add(0, group, self.weight * self.distance)
        return RayWeights(self.ray[starts], moment / weight, weight)


def _changes(value: Tensor) -> Tensor:
    first = torch.ones(1, dtype=torch.bool, device=value.device)
    return torch.cat([first, value[1:] != value[:-1]])


@torch.no_grad()
def march(
    surface: SurfaceField,
    shell: SurfaceShell,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    near: Float[Tensor, " rays"],
    far: Float[Tensor, " rays"],
) -> RayWeights:
    """Follow rays through the shell until they are opaque or leave it.

    Args:
        near, far: what `shell.enter` says; near is finite.
    """
    finest = _FINEST_STEP * surface.beta
    ray = torch.arange(len(near), device=near.device)
    at, passed = near, torch.zeros_like(near)
    value = _distance(surface, origins, directions, at)
    parts = [(ray[:0], at[:0], at[:0])]
    for _ in range(_MAX_STEPS):
        if not len(ray):
            break
        step = torch.maximum(value.abs() * _STRIDE, finest * (1 + _GROWTH * passed))
        reached = at + step
        after = _distance(surface, origins, directions, reached)
        depth = surface.depths_along(torch.stack([value, after], -1), torch.stack([at, reached], -1))[:, 0]
        weight = torch.exp(-passed) * -torch.expm1(-depth)
        seen = (weight > _LEAST_WEIGHT).nonzero()[:, 0]
        middle = at + step * middle_of_weight(value, after, depth, surface.beta)
        parts.append((ray[seen], middle[seen], weight[seen]))
        passed = passed + depth
        onward = shell.advance(origins, directions, reached, torch.where(passed < _OPAQUE, far, 0))
        going = onward.isfinite().nonzero()[:, 0]
        jumped = (onward > reached)[going].nonzero()[:, 0]
        ray, origins, directions, far, passed, at, value = (
            state[going] for state in (ray, origins, directions, far, passed, onward, after)
        )
        value[jumped] = _distance(surface, origins[jumped], directions[jumped], at[jumped])
    ray, distance, weight = (torch.cat(part) for part in zip(*parts, strict=True))
    order = ray.argsort(stable=True)
    return RayWeights(ray[order], distance[order], weight[order])


def shading_places(samples: RayWeights, surface: SurfaceField) -> RayWeights:
    """Fewer places that stand for all samples: what is seen of an opaque surface is shaded at a few dozen."""
    return samples.merged(_LONGEST_STRETCH * float(surface.beta.detach()))


def middle_of_weight(
    before: Float[Tensor, "*batch"], after: Float[Tensor, "*batch"], depth: Float[Tensor, "*batch"], beta: Tensor
) -> Float[Tensor, "*batch"]:
    """Where in an interval the mean of its weight lies, 0 to 1, if density times transmittance is exponential there.

    A step towards the surface finds nearly all of its weight at its end.

    Args:
        before, after: signed distances at the ends.
        depth: optical depth of the interval.
    """
    growth = laplace_density(after, beta).log() - laplace_density(before, beta).log() - depth
    curved = growth.abs() > 1e-2
    safe = torch.where(curved, growth, 1.0)
    return torch.where(curved, -1 / torch.expm1(-safe) - 1 / safe, 0.5 + growth / 12)


def _distance(surface: SurfaceField, origins: Tensor, directions: Tensor, at: Tensor) -> Tensor:
    if not len(at):
        return at
    points = origins + at[:, None] * directions
    return torch.cat([surface.signed_distance(chunk) for chunk in points.split(_CHUNK)])
