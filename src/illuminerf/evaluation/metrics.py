"""PSNR, SSIM and LPIPS of sRGB images in [0, 1], as the relighting benchmarks compute them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

PSNR_OF_EQUAL_IMAGES = 100.0
"""Reported for a mean squared error of zero, whose PSNR is infinite, so that means stay finite."""


@dataclass(frozen=True)
class SsimWindow:
    """The Gaussian window that SSIM's means and variances are taken over."""

    radius: int = 5
    """It is 2 * radius + 1 pixels wide."""
    sigma: float = 1.5
    """In pixels."""
    is_mirrored: bool = False
    """Count every position, with the image mirrored at its border; else only those where the window fits ("valid")."""


ImageMetric = Callable[[np.ndarray, np.ndarray], float]


def psnr(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB over all values of two arrays in [0, 1], at most
    PSNR_OF_EQUAL_IMAGES.
    """
    _check_shapes(prediction, truth)
    error = np.subtract(prediction, truth, dtype=np.float64).ravel()
    mean_squared = float(error @ error) / error.size
    return min(-10 * float(np.log10(mean_squared)), PSNR_OF_EQUAL_IMAGES) if mean_squared > 0 else PSNR_OF_EQUAL_IMAGES


def ssim(prediction: np.ndarray, truth: np.ndarray, window: SsimWindow | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of [height, width, channels] in [0, 1], the mean over
    channels.

    C1 = 0.01^2, C2 = 0.03^2, population variances; by default a Gaussian window of 11 x 11 and sigma 1.5, valid
    positions only.
    """
    window = window or SsimWindow()
    _check_shapes(prediction, truth)
    width = 2 * window.radius + 1
    if min(prediction.shape[:2]) < width:
        raise ValueError(f"SSIM needs {width} x {width} pixels, got {prediction.shape[:2]}")
    channels = range(prediction.shape[-1])
    return float(np.mean([_ssim_of_channel(prediction[..., i], truth[..., i], window) for i in channels]))


def _ssim_of_channel(x: np.ndarray, y: np.ndarray, window: SsimWindow) -> float:
    x, y = x.astype(np.float64), y.astype(np.float64)  # variances are small differences of large numbers
    mean_x, mean_y = _windowed(x, window), _windowed(y, window)
    variances = _windowed(x * x + y * y, window) - mean_x**2 - mean_y**2
    covariance = _windowed(x * y, window) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
    return float(np.mean(luminance * (2 * covariance + 0.03**2) / (variances + 0.03**2)))


def _windowed(image: np.ndarray, window: SsimWindow) -> np.ndarray:
    radius = window.radius
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / window.sigma) ** 2)
    weights /= weights.sum()
    kept = slice(None) if window.is_mirrored else slice(radius, -radius)
    rows = ndimage.correlate1d(image, weights, axis=0, mode="mirror")[kept]
    return ndimage.correlate1d(rows, weights, axis=1, mode="mirror")[:, kept]


def lpips_vgg(device: torch.device) -> ImageMetric | None:
    """LPIPS (Zhang et al. 2018) with VGG features, or None where the optional package or its weights are
    absent.
    """
    try:
        from lpips import LPIPS

        network = LPIPS(net="vgg", verbose=False).to(device).eval()
    except (ImportError, OSError):  # not installed; its weights cannot be fetched
        return None

    def distance(prediction: np.ndarray, truth: np.ndarray) -> float:
        tensors = (
            torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None].to(device)
            for image in (prediction, truth)
        )
        with torch.no_grad():
            return float(network(*tensors, normalize=True))

    return distance


LPIPS_ABSENT = "LPIPS is left out: install it with `pip install illuminerf[lpips]` (it fetches VGG weights once)."


def _check_shapes(prediction: np.ndarray, truth: np.ndarray) -> None:
    if prediction.shape != truth.shape:
        raise ValueError(f"prediction {prediction.shape} and truth {truth.shape} differ in shape")
