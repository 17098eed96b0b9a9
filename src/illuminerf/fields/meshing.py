"""From the signed distance to a triangle mesh with predicted normals."""

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.surface import SurfaceField
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError

_CHUNK = 1 << 17


class EmptySurface(UserError):
    """The fit ended without a surface."""


@torch.no_grad()
def extract_mesh(
    surface: SurfaceField,
    cells: OccupiedCells,
    resolution: int,
    min_component_share: float = 0.01,
    observed: OccupiedCells | None = None,
    level: float = 0.0,
) -> TriangleMesh:
    """Marching cubes, with predicted normals as vertex normals.

    Args:
        surface: the fitted surface.
        cells: the distance is evaluated in these cells only; elsewhere it counts as outside.
        resolution: points per axis over the box of the occupied cells.
        min_component_share: connected components smaller than this share of the largest one's area are dropped.
        observed: components without a vertex in these cells are dropped too.
        level: the signed distance that counts as the surface (see `outline_level`).

    Raises:
        EmptySurface: the distance does not cross the level.
    """
    side = cells.cells.shape[0]
    device = cells.cells.device
    occupied = cells.cells.nonzero()
    if not len(occupied):
        raise _empty()
    low = (occupied.min(0).values - 1).cpu().numpy() * (2 / side) - 1
    high = (occupied.max(0).values + 2).cpu().numpy() * (2 / side) - 1
    spacing = float((high - low).max()) / (resolution - 1)
    axes = [torch.arange(low[i], high[i] + spacing, spacing, device=device, dtype=torch.float32) for i in range(3)]
    shape = tuple(len(axis) for axis in axes)
    distance = torch.full((shape[0] * shape[1] * shape[2],), level + spacing, device=device)
    for chunk in torch.arange(len(distance), device=device).split(_CHUNK):
        index = (chunk // (shape[1] * shape[2]), chunk // shape[2] % shape[1], chunk % shape[2])
        positions = torch.stack([axis[i] for axis, i in zip(axes, index, strict=True)], -1)
        inside = cells.contains(positions) & (positions.norm(dim=-1) < 1)
        distance[chunk[inside]] = surface.signed_distance(positions[inside])
    volume = distance.view(shape).cpu().numpy()
    if volume.min() >= level or volume.max() <= level:
        raise _empty()
    # inside is below outside, and faces come out counter-clockwise seen from outside (held by a test)
    vertices, faces, _, _ = marching_cubes(volume, level, spacing=(spacing,) * 3, gradient_direction="descent")
    vertices = vertices + low
    if observed is not None:
        is_seen = observed.contains(torch.from_numpy(vertices.astype(np.float32)).to(device)).cpu().numpy()
        vertices, faces = _large_components(vertices, faces, min_component_share, is_seen)
    else:
        vertices, faces = _large_components(vertices, faces, min_component_share)
    positions = torch.from_numpy(vertices.astype(np.float32)).to(device)
    normals = torch.cat([surface.predicted_normals(chunk) for chunk in positions.split(_CHUNK)])
    return TriangleMesh(positions.cpu().numpy(), faces.astype(np.int32), normals.cpu().numpy())


def _empty() -> EmptySurface:
    return EmptySurface(
        "the fitted surface is empty: its signed distance has no zero crossing",
        fix="check masks and cameras, or fit for more steps",
    )


def _large_components(
    vertices: np.ndarray, faces: np.ndarray, min_share: float, is_seen: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Drop components that no camera saw or whose area is below a share of the largest one's, and unused vertices."""
    first = np.concatenate([faces[:, 0], faces[:, 1]])
    second = np.concatenate([faces[:, 1], faces[:, 2]])
    links = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(len(vertices),) * 2)
    count, label = connected_components(links, directed=False)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    area_of = np.bincount(label[faces[:, 0]], area, minlength=count)
    if is_seen is not None and is_seen.any():
        area_of *= np.bincount(label, is_seen, minlength=count) > 0
    faces = faces[area_of[label[faces[:, 0]]] >= min_share * area_of.max()]
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)
