"""Textures moved onto the vertices of a finer mesh, so that every object is one shape with one kind of material.

A path tracer that compiles its kernels compiles anew for each number of textured shapes: 10 to 30 s for an object that
renders in 3. After baking, all objects share one kernel.

Deviation: the paper renders textures as they are. Baking blurs what is finer than `max_edge`, about two pixels of a
training image; lettering stays legible.
"""

import numpy as np
from PIL import Image

from illuminerf.cues.materials import Material
from illuminerf.scene.meshes import TriangleMesh

_MAX_ROUNDS = 40
_COARSER = 1.2


def baked(
    parts: list[tuple[TriangleMesh, Material]], max_edge: float = 0.03, max_faces: int = 40_000
) -> list[tuple[TriangleMesh, Material]]:
    """Replace textured parts by finely split ones with per-vertex values.

    Args:
        parts: meshes with materials, in the unit sphere.
        max_edge: longest edge of textured faces after splitting, world units; about two pixels.
        max_faces: edges are let grow until about this many faces come out, or no face is split.
    """
    textured = [mesh.vertices[mesh.faces] for mesh, material in parts if material.is_textured]
    if not textured:
        return parts
    corners = np.concatenate(textured)
    num_whole = len(corners)
    while _predicted_faces(corners, max_edge) > max(max_faces, 1.2 * num_whole):
        max_edge *= _COARSER
    return [
        _baked_part(mesh, material, max_edge) if material.is_textured else (mesh, material) for mesh, material in parts
    ]


def split_to_edge(corners: np.ndarray, max_edge: float) -> np.ndarray:
    """Halve triangles across their longest edge until no edge is longer than `max_edge`.

    Args:
        corners: [faces, 3, channels]; the first three channels are the position, the rest is interpolated along.
        max_edge: in units of the position.

    Returns:
        [more faces, 3, channels]; T-junctions stay flat, since nothing is displaced.
    """
    done = []
    for _ in range(_MAX_ROUNDS):
        lengths = _edge_lengths(corners)
        is_long = lengths.max(1) > max_edge
        done.append(corners[~is_long])
        corners = corners[is_long]
        if not len(corners):
            break
        # turn each triangle so that its longest edge is a-b
        first = lengths[is_long].argmax(1)
        order = (first[:, None] + np.arange(3)) % 3
        turned = np.take_along_axis(corners, order[..., None], 1)
        a, b, c = turned[:, 0], turned[:, 1], turned[:, 2]
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate([*done, corners])


def _edge_lengths(corners: np.ndarray) -> np.ndarray:
    """Lengths of the edges that start at each corner [faces, 3]."""
    return np.linalg.norm(corners[:, [1, 2, 0], :3] - corners[:, :, :3], axis=-1)


def _predicted_faces(corners: np.ndarray, max_edge: float) -> float:
    """Roughly how many faces `split_to_edge` makes: by area, but slivers by length."""
    a, b, c = corners[:, 0, :3], corners[:, 1, :3], corners[:, 2, :3]
    by_area = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2 / (0.12 * max_edge**2)
    by_length = _edge_lengths(corners).max(1) / max_edge
    return float(np.maximum(np.maximum(by_area, by_length), 1).sum())


def _area(mesh: TriangleMesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum() / 2)


def _baked_part(mesh: TriangleMesh, material: Material, max_edge: float) -> tuple[TriangleMesh, Material]:
    assert material.uv is not None
    corners = np.concatenate([mesh.vertices, mesh.vertex_normals, material.uv], -1)[mesh.faces]
    texels_per_unit = _texels_per_unit(mesh, material)
    split = split_to_edge(corners.astype(np.float32), max_edge)
    flat = split.reshape(-1, split.shape[-1])
    normals = flat[:, 3:6] / np.maximum(np.linalg.norm(flat[:, 3:6], axis=-1, keepdims=True), 1e-8)
    faces = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
    color, roughness, metallic = (
        _sampled(image, flat[:, 6:8], texels_per_unit * max_edge / 2) for image in material.images()
    )
    values = Material(np.clip(color, 0, 1), np.clip(roughness[:, 0], 0, 1), np.clip(metallic[:, 0], 0, 1))
    return TriangleMesh(np.ascontiguousarray(flat[:, :3]), faces, normals.astype(np.float32)), values


def _texels_per_unit(mesh: TriangleMesh, material: Material) -> float:
    """How many texels lie along one unit of length on the surface, on average."""
    assert material.uv is not None
    height, width = np.asarray(material.base_color).shape[:2]
    a, b, c = (material.uv[mesh.faces[:, i]] for i in range(3))
    u, v = b - a, c - a
    uv_area = float(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2)
    return float(np.sqrt(max(uv_area * width * height, 1e-12) / max(_area(mesh), 1e-12)))


def _sampled(image: np.ndarray, uv: np.ndarray, footprint: float) -> np.ndarray:
    """Bilinear, repeating samples [n, channels] of an image averaged over `footprint` texels first."""
    factor = int(np.clip(footprint, 1, min(image.shape[:2])))
    channels = [image[..., i] for i in range(image.shape[-1])]
    if factor > 1:
        channels = [np.asarray(Image.fromarray(np.ascontiguousarray(c)).reduce(factor)) for c in channels]
    small = np.stack(channels, -1)
    height, width = small.shape[:2]
    # where the factor does not divide the size, the last texel averages fewer
    x = uv[:, 0] * (image.shape[1] / factor) - 0.5
    y = (1 - uv[:, 1]) * (image.shape[0] / factor) - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    tx, ty = (x - x0)[:, None], (y - y0)[:, None]
    texel = lambda row, column: small[row % height, column % width]  # noqa: E731
    top = texel(y0, x0) * (1 - tx) + texel(y0, x0 + 1) * tx
    bottom = texel(y0 + 1, x0) * (1 - tx) + texel(y0 + 1, x0 + 1) * tx
    return (top * (1 - ty) + bottom * ty).astype(np.float32)
