"""Relighting at the photograph's own size with a model of a fixed, smaller one.

The object is cut out as a square, as in the training renders, brought to the model's size and relit; how the result
becomes an image of the photograph's size is the model's own affair (`Relighter.at_full_size`).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional

from illuminerf.diffusion.cue_coding import code_cues, encode_cues
from illuminerf.diffusion.relighter import Piece, Relighter
from illuminerf.diffusion.resizing import resized
from illuminerf.diffusion.sampling import Sampler, sample_decoded
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear

_MARGIN = 1.04
_LEAST_COVERAGE = 0.05


@dataclass(frozen=True)
class Photograph:
    """One view to relight: float32 tensors at full size.

    Attributes:
        masked_image: [4, height, width], sRGB over black in [0, 1], then alpha.
        linear_cues: [12, height, width], straight linear radiance under the target light.
        linear_shading: [3, height, width], straight diffuse cue under the photograph's own light; zeros: unknown.
    """

    masked_image: Tensor
    linear_cues: Tensor
    linear_shading: Tensor


def straight_cues(
    premultiplied: Float[np.ndarray, "channels height width"], coverage: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "channels height width"]:
    """Divide by the mesh's coverage; where the mesh misses the object, repeat the nearest covered pixel."""
    covered = coverage > _LEAST_COVERAGE
    if not covered.any():
        return np.zeros_like(premultiplied)
    straight = premultiplied / np.maximum(coverage, _LEAST_COVERAGE)
    rows, columns = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return straight[:, rows, columns]


def object_square(alpha: Float[Tensor, "height width"]) -> tuple[int, int, int]:
    """(top, left, side) of a square around the object, a little larger; it may reach over the image's border."""
    rows = (alpha > 0.5).any(1).nonzero()[:, 0].tolist() or [0, alpha.shape[0] - 1]
    columns = (alpha > 0.5).any(0).nonzero()[:, 0].tolist() or [0, alpha.shape[1] - 1]
    side = max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1
    side = min(int(np.ceil(side * _MARGIN)), max(alpha.shape))
    return (rows[0] + rows[-1] + 1 - side) // 2, (columns[0] + columns[-1] + 1 - side) // 2, side


def cut_out(image: Float[Tensor, "channels height width"], square: tuple[int, int, int]) -> Tensor:
    """The square's pixels [channels, side, side]; zeros beyond the border."""
    top, left, side = square
    height, width = image.shape[1:]
    padding = (max(0, -left), max(0, left + side - width), max(0, -top), max(0, top + side - height))
    padded = functional.pad(image, padding)
    top, left = max(0, top), max(0, left)
    return padded[:, top : top + side, left : left + side]


def put_back(
    piece: Float[Tensor, "channels side side"], square: tuple[int, int, int], height: int, width: int
) -> Tensor:
    """Undo `cut_out` over black: [channels, height, width]."""
    top, left, side = square
    image = piece.new_zeros(piece.shape[0], height, width)
    rows = slice(max(0, top), min(height, top + side))
    columns = slice(max(0, left), min(width, left + side))
    image[:, rows, columns] = piece[:, rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    return image


@torch.inference_mode()
def relight_photographs(
    model: Relighter,
    photographs: list[Photograph],
    seeds: list[list[int]],
    num_steps: int = 8,
    sampler: Sampler = "ddim",
    temperature: float = 1.0,
    samples_at_once: int = 0,
    exposure: float = 1.0,
) -> list[Float[Tensor, "samples 3 height width"]]:
    """Draw relit images of each photograph at its own size: sRGB over black in [0, 1].

    Args:
        model: of either kind.
        photographs: with the cues of the target light.
        seeds: per photograph, one per sample.
        num_steps, sampler, temperature: as for `sample_relit`.
        samples_at_once: of each photograph, to save memory; 0: all.
        exposure: the model sees the cues times this factor, and what it says is divided by it in linear light: models
            are at their best where the target light is about as bright as those that they were trained under.
    """
    photographs = [replace(p, linear_cues=p.linear_cues * exposure) for p in photographs]
    size = model.image_size
    squares = [object_square(photograph.masked_image[3]) for photograph in photographs]
    images = [cut_out(p.masked_image, square) for p, square in zip(photographs, squares, strict=True)]
    masked = torch.cat([resized(image[None], size) for image in images])
    pairs = list(zip(photographs, squares, strict=True))
    cues = _brought_to(size, [(p.linear_cues, p.masked_image[3], square) for p, square in pairs], masked)
    shading = _brought_to(size, [(p.linear_shading, p.masked_image[3], square) for p, square in pairs], masked)
    coded = code_cues(cues, masked[:, 3:], model.cue_coding)
    inputs = (t.contiguous(memory_format=torch.channels_last) for t in (masked, coded, encode_cues(shading)))
    condition = model.condition(*inputs)
    decoded = sample_decoded(model, condition, seeds, num_steps, sampler, temperature, samples_at_once)
    pieces = [
        Piece(image, cut_out(p.linear_cues, square), cut_out(p.linear_shading, square))
        for p, image, square in zip(photographs, images, squares, strict=True)
    ]
    results = []
    for index, relit in enumerate(model.at_full_size(decoded, condition, pieces)):
        height, width = photographs[index].masked_image.shape[1:]
        coverage = pieces[index].masked_image[None, 3:]
        if exposure != 1:
            straight = linear_from_srgb(relit / coverage.clamp_min(_LEAST_COVERAGE)) / exposure
            relit = srgb_from_linear(straight) * coverage
        # Over black no value exceeds the coverage.
        relit = torch.minimum(relit.clamp_min(0), coverage)
        results.append(torch.stack([put_back(image, squares[index], height, width) for image in relit]))
    return results


def _brought_to(
    size: int, radiance: list[tuple[Tensor, Tensor, tuple[int, int, int]]], masked: Tensor
) -> Float[Tensor, "batch channels size size"]:
    """Cut (straight radiance, coverage, square) out and average it over what is covered: straight again."""
    covered = torch.cat(
        [resized(cut_out(image * coverage, square)[None], size) for image, coverage, square in radiance]
    )
    alpha = masked[:, 3:]
    return covered / alpha.clamp_min(_LEAST_COVERAGE) * (alpha > _LEAST_COVERAGE)
