"""Textures moved onto the vertices of a finer mesh, so that every object is one shape with one kind of material.

A path tracer that compiles its kernels compiles anew for each number of textured shapes: 10 to 30 s for an object that
renders in 3. After baking, all objects share one kernel.

Normal maps become the vertex normals of the finer mesh. Radiance cues are not concerned: they are rendered from the
mesh's own vertex normals, which is what estimated geometry can give at inference; the targets and the G-buffer's
normals have the detail.

Deviation: the paper renders textures as they are. Baking blurs what is finer than `max_edge`, about two pixels of a
training image; lettering stays legible.
"""

import numpy as np
from PIL import Image

from illuminerf.cues.materials import Material, Parts
from illuminerf.scene.meshes import TriangleMesh

_MAX_ROUNDS = 40
_COARSER = 1.2
_TINT_EDGE = 0.02
_TINT_FACES = 100_000
# cosine to the face's own normal below which a mapped normal is bent back, so that no light comes from behind
_MIN_FACING = 0.05


def baked(parts: Parts, max_edge: float = 0.03, max_faces: int = 40_000) -> Parts:
    """Replace textured parts by finely split ones with per-vertex values.

    Args:
        parts: meshes with materials, in the unit sphere.
        max_edge: longest edge of textured faces after splitting, world units; about two pixels.
        max_faces: edges are let grow until about this many faces come out, or no face is split.
    """
    textured = [mesh.vertices[mesh.faces] for mesh, material in parts if material.is_textured]
    if not textured:
        return parts
    max_edge = affordable_edge(np.concatenate(textured), max_edge, max_faces)
    return [
        _baked_part(mesh, material, max_edge) if material.is_textured else (mesh, material) for mesh, material in parts
    ]


def baked_with_tint(mesh: TriangleMesh, material: Material, tint: np.ndarray) -> tuple[TriangleMesh, Material]:
    """A textured part whose base colour is also multiplied by `tint` [V, 3] per vertex, as a finer mesh in the unit
    sphere with per-vertex values."""
    max_edge = affordable_edge(mesh.vertices[mesh.faces], _TINT_EDGE, _TINT_FACES)
    return _baked_part(mesh, material, max_edge, tint)


def affordable_edge(corners: np.ndarray, max_edge: float, max_faces: int) -> float:
    """`max_edge`, enlarged until about `max_faces` come out or no face is split."""
    while _predicted_faces(corners, max_edge) > max(max_faces, 1.2 * len(corners)):
        max_edge *= _COARSER
    return max_edge


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


def _baked_part(
    mesh: TriangleMesh, material: Material, max_edge: float, tint: np.ndarray | None = None
) -> tuple[TriangleMesh, Material]:
    assert material.uv is not None
    tint = np.ones((len(mesh.vertices), 3), np.float32) if tint is None else tint
    corners = np.concatenate([mesh.vertices, mesh.vertex_normals, material.uv, tint], -1)[mesh.faces]
    if material.normal_map is not None:
        # constant over a face, so splitting hands them on exactly
        frames = _face_frames(mesh, material.uv)
        corners = np.concatenate([corners, np.repeat(frames[:, None], 3, axis=1)], -1)
    texels_per_edge = _texels_per_unit(mesh, material) * max_edge / 2
    split = split_to_edge(corners.astype(np.float32), max_edge)
    flat = split.reshape(-1, split.shape[-1])
    normals = flat[:, 3:6] / np.maximum(np.linalg.norm(flat[:, 3:6], axis=-1, keepdims=True), 1e-8)
    if material.normal_map is not None:
        mapped = _sampled(material.normal_map, flat[:, 6:8], texels_per_edge)
        normals = _mapped_normals(normals, mapped, flat[:, 11:14], flat[:, 14:15], flat[:, 15:18])
    faces = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
    color, roughness, metallic = (_sampled(image, flat[:, 6:8], texels_per_edge) for image in material.images())
    values = Material(
        np.clip(color * flat[:, 8:11], 0, 1), np.clip(roughness[:, 0], 0, 1), np.clip(metallic[:, 0], 0, 1)
    )
    return TriangleMesh(np.ascontiguousarray(flat[:, :3]), faces, normals.astype(np.float32)), values


def is_uv_mirrored(mesh: TriangleMesh, uv: np.ndarray) -> np.ndarray:
    """Faces [F] on which the picture appears mirrored, so that +v runs along -(normal x tangent)."""
    return _face_frames(mesh, uv)[:, 3] < 0


def _face_frames(mesh: TriangleMesh, uv: np.ndarray) -> np.ndarray:
    """Per face [F, 7]: unit direction of +u on the surface (0 where the coordinates are degenerate), +1 or -1 as the
    picture is upright or mirrored, unit geometric normal."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    ua, ub, uc = (uv[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    (p, q), (s, t) = (b - a, c - a), (ub - ua, uc - ua)
    determinant = s[:, 0] * t[:, 1] - t[:, 0] * s[:, 1]
    tangent = p * t[:, 1:] - q * s[:, 1:]
    tangent *= np.sign(determinant)[:, None]
    length = np.linalg.norm(tangent, axis=-1, keepdims=True)
    tangent = np.where(length > 1e-30, tangent / np.maximum(length, 1e-30), 0)
    normal = np.cross(p, q)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    return np.concatenate([tangent, np.where(determinant < 0, -1.0, 1.0)[:, None], normal], -1)


def _mapped_normals(
    normals: np.ndarray, mapped: np.ndarray, tangents: np.ndarray, handedness: np.ndarray, flat: np.ndarray
) -> np.ndarray:
    """World-space normals of tangent-space ones.

    Args:
        normals: interpolated unit normals [n, 3].
        mapped: tangent-space normals [n, 3], of any length.
        tangents: direction of +u [n, 3], 0 where there is none: the normal stays there.
        handedness: +1 or -1 [n, 1], see `_face_frames`.
        flat: the face's own unit normals [n, 3].
    """
    tangents = tangents - normals * (normals * tangents).sum(-1, keepdims=True)
    length = np.linalg.norm(tangents, axis=-1, keepdims=True)
    tangents = tangents / np.maximum(length, 1e-8)
    bitangents = handedness * np.cross(normals, tangents)
    bent = tangents * mapped[:, :1] + bitangents * mapped[:, 1:2] + normals * mapped[:, 2:]
    bent = np.where(length > 1e-4, bent, normals)
    bent /= np.maximum(np.linalg.norm(bent, axis=-1, keepdims=True), 1e-8)
    outward = np.where((normals * flat).sum(-1, keepdims=True) < 0, -flat, flat)
    bent += outward * np.maximum(_MIN_FACING - (bent * outward).sum(-1, keepdims=True), 0)
    return bent / np.maximum(np.linalg.norm(bent, axis=-1, keepdims=True), 1e-8)


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
