"""OpenCV's radial-tangential lens distortion and its removal.

A point (x, y) = (X/Z, Y/Z) in the image plane (y down) is seen at
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y,        r^2 = x^2 + y^2
(OpenCV documentation, "Camera Calibration and 3D Reconstruction").
"""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage


def distorted(points: np.ndarray, coefficients: Sequence[float]) -> np.ndarray:
    """float64 [*points, 2]: where the lens shows the ideal image-plane `points` [*points, 2]; k1, k2, p1,
    p2, k3.
    """
    k1, k2, p1, p2, k3 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def undistorted_image(
    image: np.ndarray,
    intrinsics: Sequence[float],
    coefficients: Sequence[float],
) -> np.ndarray:
    """The image a pinhole with the same `intrinsics` (fx, fy, cx, cy in pixels) would have taken.

    `image` is float32 [height, width, channels], linear and premultiplied; so is the result, of the same
    shape, sampled bilinearly. What the lens did not see is zero in every channel, alpha included.
    """
    if not any(coefficients):
        return image
    height, width, _ = image.shape
    fx, fy, cx, cy = intrinsics
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    ideal = np.stack([(columns - cx) / fx, (rows - cy) / fy], axis=-1)
    seen = distorted(ideal, coefficients)
    source_columns = seen[..., 0] * fx + cx
    source_rows = seen[..., 1] * fy + cy
    inside = (source_columns >= 0) & (source_columns <= width) & (source_rows >= 0) & (source_rows <= height)
    coordinates = np.stack([source_rows, source_columns]) - 0.5
    channels = [
        ndimage.map_coordinates(image[..., channel], coordinates, order=1, mode="nearest") * inside
        for channel in range(image.shape[-1])
    ]
    return np.stack(channels, axis=-1).astype(np.float32)
