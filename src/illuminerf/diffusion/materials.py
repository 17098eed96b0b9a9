"""Metallic-roughness materials as multiples of the radiance cues.

A surface of base colour a, metallicity m and roughness r reflects about
    (1 - m) a * diffuse cue + (m a + 0.04 (1 - m)) * specular cue at r,
the latter interpolated between the cues' roughness; beyond the roughest it fades to the diffuse cue.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from illuminerf.diffusion.cue_coding import GAMMA

DIELECTRIC_REFLECTANCE = 0.04
_KNOTS = (0.05, 0.13, 0.34, 0.8)  # the cues' roughness, and where a lobe is as good as diffuse


def lobe_shares(roughness: Float[Tensor, "*batch 1 height width"]) -> Float[Tensor, "*batch 4 height width"]:
    """How much of a white lobe of some roughness each cue makes up; in the order of the cues, sums to 1."""
    remaining, shares = torch.ones_like(roughness), []
    for low, high in zip(_KNOTS[:-1], _KNOTS[1:], strict=True):
        onward = ((roughness - low) / (high - low)).clamp(0, 1)
        shares.append(remaining * (1 - onward))
        remaining = remaining * onward
    return torch.cat([remaining, *shares], -3)


def lobe_weights(surface: Float[Tensor, "*batch 5 height width"]) -> Float[Tensor, "*batch 4 3 height width"]:
    """Linear factors on the four cues of a surface (linear base colour, metallicity, roughness)."""
    albedo, metallic, roughness = surface.split([3, 1, 1], -3)
    specular = metallic * albedo + (1 - metallic) * DIELECTRIC_REFLECTANCE
    shares = lobe_shares(roughness).unsqueeze(-3)
    weights = shares * specular.unsqueeze(-4)
    diffuse = ((1 - metallic) * albedo).unsqueeze(-4)
    return torch.cat([weights[..., :1, :, :, :] + diffuse, weights[..., 1:, :, :, :]], -4)


def composited(
    surface: Float[Tensor, "*batch 5 height width"], linear_cues: Float[Tensor, "*batch 12 height width"]
) -> Float[Tensor, "*batch 3 height width"]:
    """The surface under the light of the cues; linear."""
    return (lobe_weights(surface) * linear_cues.unflatten(-3, (4, 3))).sum(-4)


def true_texture(surface: Float[Tensor, "batch 5 height width"]) -> Float[Tensor, "batch 12 height width"]:
    """What ConvNet 2 should say of a surface: its factors on the cues, coded as the cues are (embedded model)."""
    return lobe_weights(surface).flatten(1, 2) ** (1 / GAMMA)
