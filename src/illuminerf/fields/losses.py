"""The losses of geometry estimation.

Sums over samples take the samples of all rays in one axis (those of negligible weight may be left out) and are
divided by the number of rays: a mean over rays of a sum over each ray's samples.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def colour_loss(srgb: Float[Tensor, "rays 3"], target_srgb: Float[Tensor, "rays 3"]) -> Float[Tensor, ""]:
    """Squared error (equation 7 of the paper), premultiplied sRGB, mean over rays and channels."""
    return ((srgb - target_srgb) ** 2).mean()


def robust_colour_loss(srgb: Float[Tensor, "rays 3"], target_srgb: Float[Tensor, "rays 3"]) -> Float[Tensor, ""]:
    """Charbonnier distance sqrt(error^2 + 0.001^2) in premultiplied sRGB, mean over rays and channels."""
    return torch.sqrt((srgb - target_srgb) ** 2 + 1e-6).mean()


def eikonal_loss(gradient: Float[Tensor, "points 3"]) -> Float[Tensor, ""]:
    """Mean over points of (|gradient| - 1)^2."""
    return ((gradient.norm(dim=-1) - 1) ** 2).mean()


def mask_loss(depth: Float[Tensor, " rays"], alpha: Float[Tensor, " rays"]) -> Float[Tensor, ""]:
    """Opacity 1 - exp(-depth) against coverage, mean over rays.

    Binary cross entropy with its background term -log(1 - opacity) = depth replaced by log(1 + depth). Written in the
    optical depth, because an opaque ray's opacity has no gradient left and matter before the background would stay;
    with the logarithm, so that a few very dense rays do not drown all others.

    Args:
        depth: optical depth of the whole ray.
        alpha: coverage of its pixel.
    """
    outside = torch.log1p(depth)
    inside = -torch.log(-torch.expm1(-depth.clamp_min(1e-3)))
    return ((1 - alpha) * outside + alpha * inside).mean()


def orientation_loss(
    weights: Float[Tensor, " samples"],
    normals: Float[Tensor, "samples 3"],
    directions: Float[Tensor, "samples 3"],
    num_rays: int,
) -> Float[Tensor, ""]:
    """Ref-NeRF, equation 11: visible samples must not face away, sum of w max(n . d, 0)^2."""
    facing_away = (normals * directions).sum(-1).clamp_min(0)
    return (weights * facing_away**2).sum() / num_rays


def predicted_normal_loss(
    weights: Float[Tensor, " samples"],
    density_normals: Float[Tensor, "samples 3"],
    predicted_normals: Float[Tensor, "samples 3"],
    num_rays: int,
    lambdas: tuple[float, float, float] = (1e-3, 1e-3, 1e-2),
) -> Float[Tensor, ""]:
    """The asymmetric loss of the supplement (equation for L_p, after NeRF-Casting).

    Three times the same value, each with the gradient to one party: lambda_1 to the weights, lambda_2 to the density
    normals, lambda_3 to the predicted normals.
    """
    n, n_predicted = density_normals, predicted_normals
    to_weights = weights * _squared_distance(n.detach(), n_predicted.detach())
    to_density = weights.detach() * _squared_distance(n, n_predicted.detach())
    to_predicted = weights.detach() * _squared_distance(n.detach(), n_predicted)
    total = lambdas[0] * to_weights + lambdas[1] * to_density + lambdas[2] * to_predicted
    return total.sum() / num_rays


def normal_smoothness_loss(
    weights: Float[Tensor, " samples"],
    predicted_normals: Float[Tensor, "samples 3"],
    perturbed_normals: Float[Tensor, "samples 3"],
    num_rays: int,
) -> Float[Tensor, ""]:
    """The supplement's L_s without its lambda_4: predicted normals at x and at x + epsilon agree.

    Args:
        perturbed_normals: predicted normals at the positions plus Gaussian noise (sigma 0.01).
    """
    return (weights * _squared_distance(perturbed_normals, predicted_normals)).sum() / num_rays


def psnr(mean_squared_error: Tensor) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB of values in [0, 1], float64."""
    return -10 * torch.log10(mean_squared_error.double().clamp_min(1e-12))


def _squared_distance(first: Tensor, second: Tensor) -> Tensor:
    return ((first - second) ** 2).sum(-1)
