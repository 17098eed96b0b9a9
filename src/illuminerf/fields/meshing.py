"""From the signed distance to a triangle mesh with smooth normals."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes
from torch.nn import functional

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.surface import SurfaceField
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError

_CHUNK = 1 << 17
_NORMALS_REACH = 0.02  # in world units, how far normals are averaged over the surface
MeshNormals = Literal["averaged", "predicted"]


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
    normals: MeshNormals = "averaged",
) -> TriangleMesh:
    """Marching cubes, with vertex normals that vary smoothly: highlights in the radiance cues follow them.

    Deviation: the paper takes the predicted normals (supplement A.2). In fits of some thousand steps these are off by
    more than the surface itself; instead its own, the gradients of the signed distance, are averaged over neighbours.

    Args:
        surface: the fitted surface.
        cells: the distance is evaluated in these cells only; elsewhere it counts as outside.
        resolution: points per axis over the box of the occupied cells.
        min_component_share: connected components smaller than this share of the largest one's area are dropped.
        observed: components without a vertex in these cells are dropped too.
        level: the signed distance that counts as the surface (see `outline_level`).
        normals: "predicted" for comparison.

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
    chunks, faces = positions.split(_CHUNK), faces.astype(np.int32)
    if normals == "predicted":
        chosen = torch.cat([surface.predicted_normals(chunk) for chunk in chunks]).cpu().numpy()
    else:
        gradients = torch.cat([functional.normalize(surface(chunk).gradient, dim=-1, eps=1e-6) for chunk in chunks])
        chosen = averaged_normals(gradients.cpu().numpy(), faces, round((_NORMALS_REACH / spacing) ** 2))
    return TriangleMesh(positions.cpu().numpy(), faces, chosen)


def averaged_normals(
    normals: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], passes: int
) -> Float[np.ndarray, "vertices 3"]:
    """Unit normals, each replaced by the mean of itself and its neighbours, so many times.

    Passes reach as far as their number's square root times the length of an edge.
    """
    first, second = (np.concatenate([faces[:, i] for i in order]) for order in ((0, 1, 2), (1, 2, 0)))
    each = np.arange(len(normals))
    rows, columns = np.concatenate([first, second, each]), np.concatenate([second, first, each])
    near = coo_matrix((np.ones(len(rows), np.float32), (rows, columns)), shape=(len(normals),) * 2).tocsr()
    near.data[:] = 1  # an edge of two faces was added up
    for _ in range(passes):
        mean = near @ normals
        length = np.linalg.norm(mean, axis=-1, keepdims=True)
        # where neighbours cancel out, as on a sheet's rim, the normal stays
        normals = np.where(length > 1e-3, mean / np.maximum(length, 1e-9), normals)
    return normals.astype(np.float32)


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
