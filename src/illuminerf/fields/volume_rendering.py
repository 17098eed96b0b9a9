"""From signed distance to density, from density to weights (Yariv et al. 2021, VolSDF)."""

import torch
from jaxtyping import Float
from torch import Tensor


def laplace_density(signed_distance: Float[Tensor, "*batch"], beta: Float[Tensor, ""]) -> Float[Tensor, "*batch"]:
    """VolSDF equation 2: (1 / beta) times the Laplace CDF of minus the signed distance. Per unit length.

    Args:
        signed_distance: positive outside.
        beta: scale of the Laplace distribution, in world units.
    """
    tail = 0.5 * torch.exp(-signed_distance.abs() / beta)
    return torch.where(signed_distance > 0, tail, 1 - tail) / beta


def optical_depth(
    signed_distance: Float[Tensor, "*batch"],
    slope: Float[Tensor, "*batch"],
    widths: Float[Tensor, "*batch"],
    beta: Float[Tensor, ""],
) -> Float[Tensor, "*batch"]:
    """Integral of `laplace_density` over an interval in which the signed distance is linear.

    Deviation: UniSDF takes density times width. Once beta is smaller than an interval that depends on where the
    midpoint fell; the integral does not, so that a few samples per ray are enough.

    Args:
        signed_distance: at the middle of the interval.
        slope: its derivative along the ray.
        widths: lengths of the intervals.
    """
    change = slope * widths
    steep = change.abs() > 0.1 * beta
    safe = torch.where(steep, change, torch.ones_like(change))
    ahead = _laplace_integral(-signed_distance + safe / 2, beta)
    behind = _laplace_integral(-signed_distance - safe / 2, beta)
    integral = (ahead - behind) / safe * widths / beta
    return torch.where(steep, integral, laplace_density(signed_distance, beta) * widths)


def _laplace_integral(value: Tensor, beta: Tensor) -> Tensor:
    """Antiderivative of the Laplace CDF."""
    return value.clamp_min(0) + 0.5 * beta * torch.exp(-value.abs() / beta)


def rendering_weights(depths: Float[Tensor, "*rays samples"]) -> Float[Tensor, "*rays samples"]:
    """Weights of the samples from their optical depths: transmittance up to each times its own opacity."""
    before = torch.cumsum(depths, -1) - depths
    return torch.exp(-before) * -torch.expm1(-depths)


def composite_samples(
    weights: Float[Tensor, "rays samples"], values: Float[Tensor, "rays samples channels"]
) -> Float[Tensor, "rays channels"]:
    """Weighted sum along each ray (over black)."""
    return (weights[..., None] * values).sum(-2)
