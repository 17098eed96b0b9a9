"""The embedded model's "VAE": blockwise cosine transform, orthonormal, so that nothing has to be learnt.

An image is cut into blocks; of each block's DCT-II the lowest `keep` x `keep` coefficients per colour are the latent.
keep == block is lossless; keep == block / 2 is the ideal half-resolution image, at a quarter of the channels.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from illuminerf.workflow.device import full_precision
from illuminerf.workflow.processes import sum_over_processes


@dataclass(frozen=True)
class PatchLatentConfig:
    """The block transform."""

    block: int = 8
    """Pixels per side of a block; the latent is smaller by this factor, 8 as in Stable Diffusion."""
    keep: int = 4
    """Lowest frequencies kept per axis."""

    def __post_init__(self) -> None:
        if not 1 <= self.keep <= self.block:
            raise ValueError("keep is between 1 and block")

    @property
    def channels(self) -> int:
        """Latent channels: 3 * keep^2."""
        return 3 * self.keep**2


class PatchLatents(nn.Module):
    """Images [batch, 3, height, width] to latents [batch, 3 keep^2, height / block, width / block] and back."""

    basis: Tensor
    scale: Tensor

    def __init__(self, config: PatchLatentConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("basis", _dct_filters(config.block, config.keep), persistent=False)
        self.register_buffer("scale", torch.ones(config.channels))

    def encode(self, image: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch channels rows columns"]:
        """Transform and divide by the measured spread of each coefficient."""
        return self.coefficients(image) / self.scale[:, None, None]

    def coefficients(self, image: Float[Tensor, "batch 3 height width"]) -> Tensor:
        """The transform alone."""
        with full_precision(image.device):
            return functional.conv2d(image.float(), self.basis, stride=self.config.block)

    def decode(self, latent: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch 3 height width"]:
        """Undo `encode`; frequencies that were not kept are zero."""
        coefficients = latent * self.scale[:, None, None]
        with full_precision(latent.device):
            return functional.conv_transpose2d(coefficients.float(), self.basis, stride=self.config.block)

    @torch.no_grad()
    def measure(self, image: Float[Tensor, "batch 3 height width"], covered: Tensor, momentum: float) -> None:
        """Move `scale` towards the root mean square of the coefficients over `covered` [batch, 1, rows, columns], of
        all processes' images."""
        sums = (self.coefficients(image).square() * covered).sum((0, 2, 3))
        sums = sum_over_processes(torch.cat([sums, covered.sum()[None]]))
        squares = sums[:-1] / sums[-1].clamp_min(1.0)
        self.scale.copy_(((1 - momentum) * self.scale.square() + momentum * squares).clamp_min(1e-6).sqrt())


def _dct_filters(block: int, keep: int) -> Float[Tensor, "channels 3 block block"]:
    positions = torch.arange(block, dtype=torch.float64) + 0.5
    rows = torch.stack([torch.cos(math.pi * k * positions / block) for k in range(keep)])
    rows *= math.sqrt(2 / block)
    rows[0] /= math.sqrt(2)
    planes = torch.einsum("ij,kl->ikjl", rows, rows).reshape(keep**2, block, block)
    filters = torch.zeros(3, keep**2, 3, block, block, dtype=torch.float64)
    for colour in range(3):
        filters[colour, :, colour] = planes
    return filters.flatten(0, 1).float()
