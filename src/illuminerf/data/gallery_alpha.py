"""What is object in frames that only show it on white."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

WHITE = 247
"""Of 255; the encoder leaves white at 249 or more."""
_SMALLEST_HOLE_UNDER_ONE_LIGHT = 4e-5
_SMALLEST_HOLE = 2
"""Pixels, where several lights agree that they look through."""
_SMALLEST_PART = 6e-5
"""Share of the image; compression leaves specks beside the outline."""


def object_mask(frames: Sequence[np.ndarray]) -> np.ndarray:
    """bool [height, width] from uint8 frames [height, width, 3] of one view, one per light.

    White that touches the border of the image is background. White that the object encloses is background too, but
    under a single light only where it is larger than a highlight.
    """
    white = np.all([frame.min(-1) >= WHITE for frame in frames], axis=0)
    labels, count = ndimage.label(white)
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    least = _SMALLEST_HOLE if len(frames) > 1 else _SMALLEST_HOLE_UNDER_ONE_LIGHT * white.size
    is_background = areas >= least
    for side in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        is_background[side] = True
    is_background[0] = False
    mask = ~is_background[labels]
    parts, count = ndimage.label(mask)
    is_large = np.bincount(parts.ravel(), minlength=count + 1) >= _SMALLEST_PART * white.size
    return mask & is_large[parts]


def straight_on_white(frame: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """float32 [height, width, 4]: straight sRGB that shows `frame` [height, width, 3] on white, and alpha."""
    covered = alpha[..., None]
    straight = np.where(covered > 0, (frame - (1 - covered)) / np.maximum(covered, 1e-3), frame)
    return np.concatenate([np.clip(straight, 0, 1), covered], -1).astype(np.float32)
