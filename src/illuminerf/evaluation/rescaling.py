"""Per-channel scales that take out what single-light capture cannot know: the product of albedo and light.

Both rules return one factor per channel; they differ in what outliers can do to it.
"""

from collections.abc import Iterable

import numpy as np

EPSILON = 1e-6
"""Predictions are clipped from below to this before they divide, as in the TensoIR scorer."""


MaskedPixels = Iterable[tuple[np.ndarray, np.ndarray]]
"""Per view (truth, prediction), each [pixels, 3] in sRGB: the pixels inside the view's mask."""


def median_ratio(views: MaskedPixels) -> np.ndarray:
    """float64 [3]: the median over all pixels of truth / clip(prediction, EPSILON, 1), per channel.

    One float64 per masked pixel and channel is kept: 8-bit values make exact quotients, and
    the cut to 8 bits afterwards shows a factor's last bits. Without any pixel the factors are
    1.
    """
    ratios = [np.divide(truth, np.clip(prediction, EPSILON, 1), dtype=np.float64) for truth, prediction in views]
    if not sum(len(ratio) for ratio in ratios):
        return np.ones(3)
    return np.array([np.median(np.concatenate([ratio[:, i] for ratio in ratios])) for i in range(3)], np.float64)


def least_squares_scale(views: MaskedPixels) -> np.ndarray:
    """float64 [3]: s = sum(truth * prediction) / sum(prediction^2) per channel, over all given pixels.

    A channel that is predicted black everywhere gets 1.
    """
    mixed, squared = np.zeros(3), np.zeros(3)
    for truth, prediction in views:
        mixed += np.sum(np.multiply(truth, prediction, dtype=np.float64), axis=0)
        squared += np.sum(np.square(prediction, dtype=np.float64), axis=0)
    return np.where(squared > 0, mixed / np.where(squared > 0, squared, 1), 1.0)


def rescaled_inside(prediction: np.ndarray, mask: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """`prediction` [height, width, 3] with clip(prediction * scale, 0, 1) cut to 8 bits inside `mask`.

    The cut truncates, as a cast to uint8 does; outside the mask nothing changes.
    """
    inside = np.floor(np.clip(prediction[mask] * scale, 0, 1) * 255) / 255
    out = prediction.copy()
    out[mask] = inside
    return out
