"""How far images of one object from neighbouring cameras agree on the colour of the same surface points.

A point of the surface that a pixel of the first view sees is projected into the second view; where the second sees it
too, both colours are compared in sRGB values. What this measures is agreement, not truth: an even grey agrees
perfectly, and blur agrees better than detail. A true image does not reach 0 either, because a relit surface looks
different from two sides (highlights move), the geometry is an estimate, and the second view is read between its
pixels. So figures say something only beside others over the same matches: samples that were drawn for each view alone,
renderings of one 3D appearance, and the photographs.
"""

from dataclasses import dataclass

import numpy as np

from illuminerf.scene.cameras import Cameras
from illuminerf.scene.views import spread_evenly


@dataclass(frozen=True)
class Surface:
    """What one camera sees of the geometry."""

    distance: np.ndarray
    """float [height, width]: from the camera's centre to the surface along the pixel's ray; any value off the object.
    """
    mask: np.ndarray
    """bool [height, width]: where the pixel shows the object and nothing else."""


@dataclass(frozen=True)
class Matches:
    """Points of the surface that both views of a pair see."""

    pixel: np.ndarray
    """int [matches]: row * width + column of the first view."""
    corner: np.ndarray
    """int [matches]: row * width + column of the upper left one of the four pixels of the second view around a point.
    """
    share: np.ndarray
    """float [matches, 4]: weights of those four pixels: upper left, upper right, lower left, lower right."""
    width: int
    """Of the second image, in pixels."""


def neighbours(cameras: Cameras, num_pairs: int, least_radians: float = 0.1) -> list[tuple[int, int]]:
    """At most `num_pairs` views, evenly spread over the list, each with that other view whose direction from the
    origin is closest to its own, but at least `least_radians` away (the farthest where all are closer)."""
    unit = cameras.positions / np.linalg.norm(cameras.positions, axis=1, keepdims=True)
    angle = np.arccos(np.clip(unit @ unit.T, -1, 1))
    np.fill_diagonal(angle, -1)
    pairs = []
    for first in spread_evenly(len(cameras), num_pairs):
        others = np.where(angle[first] < least_radians, np.inf, angle[first])
        second = int(others.argmin()) if np.isfinite(others).any() else int(angle[first].argmax())
        if second != first:  # else there is one view only
            pairs.append((int(first), second))
    return pairs


def match(cameras: Cameras, pair: tuple[int, int], surfaces: tuple[Surface, Surface], tolerance: float) -> Matches:
    """Project the first view's pixels into the second.

    Args:
        cameras: of all views.
        pair: the two views' numbers.
        surfaces: what they see.
        tolerance: a point counts as seen by the second view where its distance to that camera differs from what the
            camera sees there by less than this, in the world's unit.
    """
    first, second = surfaces
    origins, directions = (rays.numpy().reshape(-1, 3).astype(np.float64) for rays in cameras.image_rays(pair[0]))
    pixel = np.flatnonzero(first.mask)
    points = origins[pixel] + first.distance.reshape(-1)[pixel, None] * directions[pixel]
    places, depth = cameras[pair[1]].project(points)
    height, width = second.mask.shape
    column, row = (places[0] - 0.5).T  # centres lie at + 0.5
    left, top = np.floor(column).astype(int), np.floor(row).astype(int)
    inside = (depth[0] > 0) & (left >= 0) & (top >= 0) & (left < width - 1) & (top < height - 1)
    pixel, points, left, top = pixel[inside], points[inside], left[inside], top[inside]
    x, y = column[inside] - left, row[inside] - top
    share = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1)
    matches = Matches(pixel, top * width + left, share, width)
    distance = np.linalg.norm(points - cameras.positions[pair[1]], axis=-1)
    covered = second.mask.reshape(-1)[_around(matches)].all(-1)
    seen = covered & (np.abs(_read(second.distance[..., None], matches)[:, 0] - distance) < tolerance)
    return Matches(pixel[seen], matches.corner[seen], share[seen], width)


def squared_errors(first: np.ndarray, second: np.ndarray, matches: Matches) -> np.ndarray:
    """float64 [matches]: the mean over channels of the squared difference between two images [height, width, 3]."""
    colours = first.reshape(-1, 3)[matches.pixel].astype(np.float64)
    return np.square(colours - _read(second, matches)).mean(-1)


def root_mean(squared: list[np.ndarray]) -> float | None:
    """The root of the mean over all entries; None where there are none."""
    joined = np.concatenate([np.zeros(0), *squared])
    return float(np.sqrt(joined.mean())) if len(joined) else None


def mean_difference(images: np.ndarray, mask: np.ndarray) -> float:
    """Mean absolute difference over all pairs of `images` [images, height, width, ...] inside `mask` [height, width];
    0 for fewer than two images."""
    inside = images[:, mask].astype(np.float64)
    pairs = [(i, j) for i in range(len(inside)) for j in range(i)]
    if not pairs or not mask.any():
        return 0.0
    return float(np.mean([np.abs(inside[i] - inside[j]).mean() for i, j in pairs]))


def _around(matches: Matches) -> np.ndarray:
    """int [matches, 4]: the four pixels around each point."""
    return matches.corner[:, None] + np.array([0, 1, matches.width, matches.width + 1])


def _read(image: np.ndarray, matches: Matches) -> np.ndarray:
    """float64 [matches, channels]: an image [height, width, channels] of the second view, bilinear at the points."""
    values = image.reshape(-1, image.shape[-1])[_around(matches)].astype(np.float64)
    return (values * matches.share[..., None]).sum(1)
