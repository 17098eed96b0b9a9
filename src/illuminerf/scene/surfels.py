"""Surface elements: points on a surface that stand for small discs, to measure distances to it.

With discs instead of points the spacing of the points does not count as distance: a flat surface is at distance 0 of
itself however thinly it is sampled.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

_TILTED = np.array([0.48, 0.64, 0.6], np.float32)  # no face of a box is parallel to it


@dataclass(frozen=True)
class Surfels:
    """Discs on a surface.

    Attributes:
        positions: float32 [surfels, 3], their centres.
        normals: float32 [surfels, 3], unit.
        radius: of every disc, in world units; about the spacing of the points, so that they leave no gaps.
    """

    positions: np.ndarray
    normals: np.ndarray
    radius: float

    def __len__(self) -> int:
        return len(self.positions)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.positions)

    def neighbours(self, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances to the `count` nearest centres, and their index: [points, count] each."""
        distance, index = self._tree.query(points, k=range(1, count + 1))
        return np.asarray(distance), np.asarray(index)

    def nearest(self, points: np.ndarray, within: float = np.inf) -> np.ndarray:
        """Index [points] of the disc with the nearest centre; -1 where none is `within` reach, which is found fast."""
        distance, index = self._tree.query(points, distance_upper_bound=within)
        return np.where(np.isfinite(distance), index, -1)

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distance [points] to the disc with the nearest centre; infinite where there are no discs."""
        if not len(self):
            return np.full(len(points), np.inf)
        return np.abs(self.signed_distances(points, self.nearest(points)))

    def signed_distances(self, points: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Distance [points] of each point to the disc that `index` [points] names, negative behind it."""
        offset = points.astype(np.float64) - self.positions[index]
        across = (offset * self.normals[index]).sum(-1)
        along = np.linalg.norm(offset - across[:, None] * self.normals[index], axis=-1)
        return np.copysign(np.hypot(across, np.maximum(along - self.radius, 0)), across)


def thinned(positions: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """Index of the first of the points [points, 3] in every cell of a cubic grid, in order; a thin sheet, whose two
    sides share their cells, keeps both."""
    side = normals @ _TILTED > 0
    cells = np.column_stack([np.floor(positions / spacing).astype(np.int64), side])
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])
