"""The Stanford-ORB benchmark's rule for relit images (facts: its public code).

Images are linear. The mask shrinks by a 5 x 5 window and everything outside it is black. One factor per image and
channel, by least squares in linear light, brings the prediction to the truth.

    PSNR-H   both images first times mean(sRGB(truth)) / mean(truth), which makes dark truths count; clipped to [0, 4]
    PSNR-L   clipped to [0, 1], in sRGB
    SSIM     of the images of PSNR-L, with a Gaussian window of 3 x 3 and sigma 1.5, mirrored at the border
    LPIPS    of the images of PSNR-L, coded as sRGB once more

Errors are averaged over the whole image, black surroundings included, and no PSNR is less than that of a mid grey
inside the mask. Means are over the images of a capture, then over captures.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from illuminerf.evaluation.metrics import ImageMetric, SsimWindow, psnr, ssim
from illuminerf.scene.images import srgb_from_linear

RESOLUTION = 512
"""Pixels along each side; the photographs of 2048 x 2048 are averaged down to it."""
MASK_THRESHOLD = 0.5
MAX_HDR = 4.0
WINDOW = SsimWindow(radius=1, sigma=1.5, is_mirrored=True)
_EROSION_SIDE = 5
_GREY = 0.5
_BLACK = 1e-8
_NO_ENERGY = 1e-6


@dataclass(frozen=True)
class OrbScores:
    """Scores of one image."""

    psnr_h: float
    """Of linear values, in dB."""
    psnr_l: float
    """Of sRGB values, in dB."""
    ssim: float
    lpips: float | None = None
    """None where LPIPS is not computed."""


def eroded(mask: np.ndarray) -> np.ndarray:
    """bool [height, width]: `mask` without a margin of two pixels; the border of the image is no margin."""
    return ndimage.binary_erosion(mask, np.ones((_EROSION_SIDE, _EROSION_SIDE), bool), border_value=1)


def score_image(
    prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray, lpips: ImageMetric | None = None
) -> OrbScores:
    """Score one image.

    Args:
        prediction: linear, not negative, [height, width, 3].
        truth: linear [height, width, 3]; what is negative counts as 0.
        mask: the truth's, bool [height, width], some of it left by `eroded`.
        lpips: or None.
    """
    inner = eroded(mask)
    if not inner.any():
        raise ValueError("the mask holds nothing but margin")
    prediction, truth = (
        np.where(inner[..., None], np.maximum(image, 0), 0).astype(np.float64) for image in (prediction, truth)
    )
    factor = _brightening(truth)
    bright = (_fitted(prediction * factor, truth * factor, inner), truth * factor)
    high = [np.clip(image, 0, MAX_HDR) for image in bright]
    low = [srgb_from_linear(np.clip(image, 0, 1)) for image in (_fitted(prediction, truth, inner), truth)]
    return OrbScores(
        _bounded_psnr(high[0], high[1], inner),
        _bounded_psnr(low[0], low[1], inner),
        ssim(low[0], low[1], WINDOW),
        None if lpips is None else lpips(srgb_from_linear(low[0]), srgb_from_linear(low[1])),
    )


def _brightening(truth: np.ndarray) -> float:
    clipped = np.clip(truth, 0, 1)
    mean = float(clipped.mean())
    return float(srgb_from_linear(clipped).mean()) / mean if mean > _BLACK else 1.0


def _fitted(prediction: np.ndarray, truth: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """`prediction` times the factor of each channel; one that is all but black is fitted as if it were white."""
    predicted, wanted = prediction[inner], truth[inner]
    predicted = np.where((predicted**2).sum(0) <= _NO_ENERGY, 1.0, predicted)
    return prediction * ((wanted * predicted).sum(0) / (predicted**2).sum(0))


def _bounded_psnr(prediction: np.ndarray, truth: np.ndarray, inner: np.ndarray) -> float:
    grey = np.broadcast_to(_GREY * inner[..., None], truth.shape)
    return max(psnr(prediction, truth), psnr(grey, truth))
