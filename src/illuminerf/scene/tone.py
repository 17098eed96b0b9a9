"""One tone curve and its inverse: radiance of any height into [0, 1], and what a picture with such a curve had before.

y = x (1 + x / peak^2) / (1 + x): linear in the dark, 1 at the peak (Reinhard et al. 2002, equation 4). The curve
acts on the largest channel and the others keep their share of it, so that hues stay.
"""

import numpy as np

from illuminerf.workflow.errors import UserError


def compressed(linear_rgb: np.ndarray, peak: float) -> np.ndarray:
    """Radiance [..., 3] from 0 to `peak` brought into [0, 1]; what is above is cut off. A peak of 1 changes nothing."""
    largest = linear_rgb.max(-1, keepdims=True)
    cut = np.minimum(largest, peak)
    toned = cut * (1 + cut / peak**2) / (1 + cut)
    return (linear_rgb * _ratio(toned, largest)).astype(np.float32)


def expanded(linear_rgb: np.ndarray, peak: float) -> np.ndarray:
    """Inverse of `compressed`: values [..., 3] in [0, 1] brought to 0 to `peak`."""
    if not 1 <= peak < np.inf:
        raise UserError("the peak of a light is out of range", got=str(peak), wanted="1 (as it is) or more")
    largest = np.clip(linear_rgb.max(-1, keepdims=True), 0, 1).astype(np.float64)
    # the positive root of x^2 / peak^2 + (1 - y) x - y = 0, without the difference of two nearly equal numbers
    before = 2 * largest / (1 - largest + np.sqrt((1 - largest) ** 2 + 4 * largest / peak**2))
    return (linear_rgb * _ratio(before, largest)).astype(np.float32)


def _ratio(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """1 in the dark, where both curves are straight."""
    return np.where(before > 1e-6, after / np.maximum(before, 1e-6), 1.0)
