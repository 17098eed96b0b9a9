"""How far an estimated surface is from the true one: normals, distances, floaters."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.surfels import Surfels

FULL_SCALE_DEGREES = 30.0
"""Error of a normal that error maps draw white."""


def angles_degrees(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles [...] between unit vectors [..., 3], in degrees; exact for small ones too."""
    first, second = first.astype(np.float64), second.astype(np.float64)
    return np.degrees(2 * np.arctan2(np.linalg.norm(first - second, axis=-1), np.linalg.norm(first + second, axis=-1)))


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances between an estimated surface and the true one, in percent of the object's size.

    Attributes:
        to_truth: float64 [points of the estimate]: small where what was estimated is there.
        to_estimate: float64 [points of the truth]: small where what is there was estimated.
    """

    to_truth: np.ndarray
    to_estimate: np.ndarray

    @property
    def accuracy(self) -> float:
        """Mean distance from the estimate to the truth."""
        return float(self.to_truth.mean())

    @property
    def completeness(self) -> float:
        """Mean distance from the truth to the estimate."""
        return float(self.to_estimate.mean())

    @property
    def chamfer(self) -> float:
        """Mean of both directions."""
        return (self.accuracy + self.completeness) / 2

    def f_score(self, percent: float) -> float:
        """Harmonic mean of the shares of both surfaces that are closer than `percent` to the other (Knapitsch et al.
        2017), in [0, 1]."""
        precision, recall = float((self.to_truth < percent).mean()), float((self.to_estimate < percent).mean())
        return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def surface_distances(estimate: Surfels, truth: Surfels, size: float) -> SurfaceDistances:
    """Both directions, in percent of `size`, between evenly sampled surfaces."""
    to_truth, to_estimate = truth.distances(estimate.positions), estimate.distances(truth.positions)
    return SurfaceDistances(100 * to_truth / size, 100 * to_estimate / size)


def box_diagonal(mesh: TriangleMesh) -> float:
    """Diagonal of a mesh's axis-aligned bounding box: the size that distances are measured by."""
    corners = mesh.vertices[np.unique(mesh.faces)]
    return float(np.linalg.norm(corners.max(0) - corners.min(0)))


def intersection_over_union(first: np.ndarray, second: np.ndarray) -> float:
    """Of two boolean arrays; 1 where both are empty."""
    union = np.count_nonzero(first | second)
    return float(np.count_nonzero(first & second) / union) if union else 1.0


def floater_share(mesh: TriangleMesh, truth: Surfels, reach: float) -> float:
    """Share of the area of `mesh` in connected components that come nowhere closer than `reach` to the truth."""
    first = np.concatenate([mesh.faces[:, 0], mesh.faces[:, 1]])
    second = np.concatenate([mesh.faces[:, 1], mesh.faces[:, 2]])
    num_vertices = len(mesh.vertices)
    links = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(num_vertices, num_vertices))
    count, label = connected_components(links, directed=False)
    component = label[mesh.faces[:, 0]]
    area = np.bincount(component, face_areas(mesh), minlength=count)
    closest = np.full(count, np.inf)
    np.minimum.at(closest, label, truth.distances(mesh.vertices))
    total = area.sum()
    return float(area[closest > reach].sum() / total) if total else 0.0


def face_areas(mesh: TriangleMesh) -> np.ndarray:
    """float64 [faces]."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)


def area_surfels(mesh: TriangleMesh, count: int, generator: np.random.Generator) -> Surfels:
    """Points drawn evenly from all of a mesh, the hidden parts included."""
    area = face_areas(mesh)
    face = generator.choice(len(area), count, p=area / area.sum())
    a, b, c = (mesh.vertices[mesh.faces[face, i]].astype(np.float64) for i in range(3))
    u, v = np.sqrt(generator.random(count))[:, None], generator.random(count)[:, None]
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-20)
    positions = (1 - u) * a + u * (1 - v) * b + u * v * c
    return Surfels(positions.astype(np.float32), normals.astype(np.float32), float(np.sqrt(area.sum() / count)))
