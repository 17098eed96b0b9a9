"""Colours of surface points, without a camera: what a mesh is painted with."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from illuminerf.fields.radiance_field import RadianceField
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear

_REACH = 0.03  # in radii of the unit ball


@torch.no_grad()
def surface_colours(
    field: RadianceField,
    positions: np.ndarray,
    viewpoints: np.ndarray,
    num_directions: int,
    latent: Float[Tensor, " latent"] | None = None,
) -> np.ndarray:
    """sRGB colours, float32 [points, 3], of points on the surface.

    A mesh has one colour where the field has one per direction: the mean of the linear radiance towards those
    viewpoints that face the point most squarely, each weighted by the cosine squared. These are also the least likely
    to be hidden, so that the field is asked where photographs taught it something.

    Args:
        field: the fitted field; a few samples per ray suffice, for the rays are short.
        positions: float32 [points, 3] on the surface.
        viewpoints: float [views, 3], places that saw the object.
        num_directions: viewpoints per point.
        latent: latent code; None stands for the zero code.
    """
    device = next(field.parameters()).device
    eyes = torch.from_numpy(np.asarray(viewpoints, np.float32)).to(device)
    points = torch.from_numpy(np.ascontiguousarray(positions, np.float32)).to(device)
    normals = field.shading_normals_at(points)
    towards = functional.normalize(eyes[None] - points[:, None], dim=-1)
    cosines, chosen = (towards * normals[:, None]).sum(-1).topk(min(num_directions, len(eyes)), dim=-1)
    weights = cosines.clamp_min(0.01).square()
    weights = weights / weights.sum(-1, keepdim=True)
    codes = None if latent is None else latent.to(device).expand(len(points), -1)
    mean = torch.zeros_like(points)
    for number in range(chosen.shape[1]):
        backward = towards[torch.arange(len(points), device=device), chosen[:, number]]
        srgb = _short_rays(field, points + _REACH * backward, -backward, codes)
        mean += weights[:, number, None] * linear_from_srgb(srgb)
    return srgb_from_linear(mean).clamp(0, 1).cpu().numpy()


def _short_rays(field: RadianceField, origins: Tensor, directions: Tensor, latents: Tensor | None) -> Tensor:
    """Colours, not premultiplied, of rays that begin just before the surface and end just behind it.

    The field learnt sums along rays. One sample alone, even on the surface, is ten times as far off and speckled.
    """
    near = torch.zeros(len(origins), device=origins.device)
    samples = field.sample(origins, directions, near, near + 2 * _REACH)
    points = field.worth_shading(samples)
    srgb = field.shade(points, field.shading_normals(points), directions, latents)
    return (srgb / samples.weights.sum(-1, keepdim=True).clamp_min(1e-3)).clamp(0, 1)
