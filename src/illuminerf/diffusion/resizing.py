"""Antialiased resizing, as everywhere between a photograph's size and a model's."""

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def resized(images: Float[Tensor, "batch channels height width"], size: int) -> Tensor:
    """Antialiased bilinear resizing to `size` x `size`."""
    if images.shape[-1] == size:
        return images
    return functional.interpolate(images, (size, size), mode="bilinear", antialias=True, align_corners=False)
