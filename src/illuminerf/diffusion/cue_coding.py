"""How radiance cues enter the networks, and how products of texture and cues become an image again.

Cues are radiance without an upper bound; networks want values of order one. A power law keeps products products:
(albedo * cue)^(1/g) = albedo^(1/g) * cue^(1/g), so ConvNet 2's elementwise multiplication can express shading exactly.
"""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

from illuminerf.scene.images import srgb_from_linear

CueCoding = Literal["power", "srgb8"]
GAMMA = 2.2
MAX_RADIANCE = 16.0


def code_cues(
    linear_cues: Float[Tensor, "*batch 12 height width"],
    alpha: Float[Tensor, "*batch 1 height width"],
    coding: CueCoding,
) -> Float[Tensor, "*batch 12 height width"]:
    """Straight linear radiance as a model wants it: by `encode_cues`, or as DiLightNet's hints.

    The latter are pictures: sRGB, clipped at 1, of 256 levels, and only then multiplied by alpha.
    """
    if coding == "power":
        return encode_cues(linear_cues)
    return (srgb_from_linear(linear_cues.clamp(0.0, 1.0)) * 255).round() / 255 * alpha


def encode_cues(
    linear_cues: Float[Tensor, "*batch channels height width"],
) -> Float[Tensor, "*batch channels height width"]:
    """Straight linear radiance to power-coded values in [0, 3.53]: min(x, 16)^(1/2.2).

    Deviation: the paper does not say how it codes cues; DiLightNet feeds 8-bit sRGB, clipped at 1.
    """
    return linear_cues.clamp(0.0, MAX_RADIANCE) ** (1 / GAMMA)


def decode_cues(coded_cues: Tensor) -> Tensor:
    """Inverse of `encode_cues`."""
    return coded_cues.clamp_min(0.0) ** GAMMA


def composited_srgb(
    products: Float[Tensor, "batch 12 height width"],
) -> Float[Tensor, "batch 3 height width"]:
    """Add the four lobes' products in linear light: straight sRGB [batch, 3, height, width], unclipped above 1."""
    linear = decode_cues(products).unflatten(1, (4, 3)).sum(1)
    return srgb_from_linear(linear)
