"""Pictures that show where a prediction is wrong."""

import numpy as np

FULL_SCALE = 0.25
"""Absolute error, in sRGB values, that is drawn white."""


def error_map(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """float32 [height, width, 3]: mean absolute error over channels, black (none) through red and yellow to
    white.
    """
    level = np.abs(np.subtract(prediction, truth, dtype=np.float32)).mean(axis=-1) / FULL_SCALE
    return np.clip(np.stack([3 * level, 3 * level - 1, 3 * level - 2], axis=-1), 0, 1).astype(np.float32)


def side_by_side(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """float32 [height, 3 width, 3]: prediction, truth, error map."""
    return np.concatenate([prediction, truth, error_map(prediction, truth)], axis=1).astype(np.float32)
