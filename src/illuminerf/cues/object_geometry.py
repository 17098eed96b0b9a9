"""Raw parts made fit to be rendered: in the unit sphere, without faces that have no area, with sound normals."""

from dataclasses import dataclass, replace

import numpy as np

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.raw_objects import RawPart

# Where no normals are given, a corner whose face leans more than this (cosine of 37 degrees) from the smooth normal
# keeps its face's: the edges of a box stay sharp, a scanned statue is smooth.
_CREASE_COSINE = 0.8
_MIN_DOUBLE_AREA = 1e-14
_MIN_TOTAL_AREA = 1e-8


@dataclass(frozen=True)
class Bounds:
    """Where an object lies in its file's frame."""

    centre: np.ndarray
    """Of its bounding box."""
    radius: float
    """Of the sphere about the centre that holds it."""


def normalized(name: str, parts: list[RawPart], world_from_file: np.ndarray) -> tuple[list[RawPart], Bounds]:
    """Turn parts by `world_from_file` [3, 3], centre their bounding box and scale them into the unit sphere.

    Also returns where they were.

    All in float64, so that an object far from its origin keeps what precision its file has. Faces without area and
    vertices without faces are dropped, every vertex gets a unit normal.

    Raises:
        BrokenObject: "unreadable" (faces that name absent vertices), "empty", "not finite" or "degenerate".
    """
    for part in parts:
        if len(part.faces) and (part.faces.min() < 0 or part.faces.max() >= len(part.vertices)):
            raise BrokenObject("unreadable", f"{name} has faces that name vertices it does not have")
    parts = [_without_unused(part) for part in parts if len(part.faces)]
    if not parts:
        raise BrokenObject("empty", f"{name} holds no triangles")
    bounds = _bounds(name, parts)
    placed = []
    for part in parts:
        vertices = (part.vertices - bounds.centre) / bounds.radius @ world_from_file.T
        normals = None if part.normals is None else part.normals @ world_from_file.T
        part = _without_flat_faces(replace(part, vertices=vertices, normals=normals))
        if len(part.faces):
            placed.append(part)
    if sum(_double_areas(part).sum() for part in placed) / 2 < _MIN_TOTAL_AREA:
        raise BrokenObject("degenerate", f"{name} has no surface", got="triangles without area")
    return [_with_normals(part) for part in placed], bounds


def merged_by_material(parts: list[RawPart]) -> list[RawPart]:
    """Parts of one material, and with the same arrays, as one: a renderer compiles for each textured shape anew."""
    groups: dict[tuple[int, bool, bool], list[RawPart]] = {}
    for part in parts:
        groups.setdefault((id(part.material), part.uv is None, part.colors is None), []).append(part)
    return [_joined(group) for group in groups.values()]


def _joined(parts: list[RawPart]) -> RawPart:
    if len(parts) == 1:
        return parts[0]
    firsts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    stacked = {
        key: None if getattr(parts[0], key) is None else np.concatenate([getattr(part, key) for part in parts])
        for key in ("vertices", "normals", "uv", "colors")
    }
    faces = np.concatenate([part.faces + first for part, first in zip(parts, firsts, strict=True)])
    return replace(parts[0], faces=faces, color_alpha=min(part.color_alpha for part in parts), **stacked)  # type: ignore[arg-type]


def _bounds(name: str, parts: list[RawPart]) -> Bounds:
    low = np.min([part.vertices.min(0) for part in parts], axis=0)
    high = np.max([part.vertices.max(0) for part in parts], axis=0)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and np.isfinite(high - low).all()):
        raise BrokenObject("not finite", f"{name} has NaN or infinite vertices", fix="repair the mesh")
    centre = low + (high - low) / 2
    # scaled first: the square of 1e-200 would be 0
    size = float((high - low).max())
    if size <= 0:
        raise BrokenObject("degenerate", f"{name} is a single point", got=f"all vertices at {centre}")
    radius = size * max(float(np.linalg.norm((part.vertices - centre) / size, axis=1).max()) for part in parts)
    return Bounds(centre, radius)


def _double_areas(part: RawPart) -> np.ndarray:
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1)


def _without_unused(part: RawPart) -> RawPart:
    """Only vertices that faces name; those of others may be anything, NaN too."""
    is_used = np.zeros(len(part.vertices), bool)
    is_used[part.faces] = True
    if is_used.all():
        return part
    new_index = np.cumsum(is_used) - 1
    kept = {
        key: None if getattr(part, key) is None else getattr(part, key)[is_used]
        for key in ("vertices", "normals", "uv", "colors")
    }
    return replace(part, faces=new_index[part.faces], **kept)  # type: ignore[arg-type]


def _without_flat_faces(part: RawPart) -> RawPart:
    # also as the renderer will see them, in single precision
    single = replace(part, vertices=part.vertices.astype(np.float32).astype(np.float64))
    has_area = np.minimum(_double_areas(part), _double_areas(single)) > _MIN_DOUBLE_AREA
    return part if has_area.all() else _without_unused(replace(part, faces=part.faces[has_area]))


def _with_normals(part: RawPart) -> RawPart:
    """Unit normals for all vertices; faces turned to the side of the normals that the file gives."""
    corners = part.vertices[part.faces]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = crossed / np.linalg.norm(crossed, axis=-1, keepdims=True)
    given = _sound(part.normals, flat)
    if given is None:
        return _with_computed_normals(part, corners, flat)
    is_missing = (given == 0).all(1)
    if is_missing.any():
        given = np.where(is_missing[:, None], _smooth(part, corners, flat), given)
    # Exporters mirror without turning the winding, or write normals for one side of a sheet: the normals are trusted,
    # since they are what is shaded.
    looks_back = np.einsum("fi,fi->f", flat, given[part.faces].sum(1)) < 0
    faces = np.where(looks_back[:, None], part.faces[:, ::-1], part.faces)
    return replace(part, normals=given, faces=faces)


def _sound(normals: np.ndarray | None, flat: np.ndarray) -> np.ndarray | None:
    """Unit normals, 0 where the file's are unusable; None where they say nothing about the shape."""
    if normals is None:
        return None
    with np.errstate(all="ignore"):
        finite = np.nan_to_num(normals, nan=0.0, posinf=0.0, neginf=0.0)
        length = np.linalg.norm(finite, axis=1, keepdims=True)
        unit = np.where(length > 1e-20, finite / np.maximum(length, 1e-20), 0.0)
    # some exporters write one and the same normal everywhere
    is_constant = np.abs(unit - unit[0]).max() < 1e-4
    if is_constant and np.abs(np.abs(flat @ unit[0]) - 1).max() > 0.1:
        return None
    return unit


def _smooth(part: RawPart, corners: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Normals [V, 3] weighted by the faces' angles at the vertex, so that it does not matter how a polygon was cut;
    equal at equal positions even where a seam of the texture splits vertices."""
    place = _places(part.vertices)
    num_places = int(place.max()) + 1
    summed = np.zeros((num_places, 3))
    for corner in range(3):
        to_next, to_last = (corners[:, (corner + step) % 3] - corners[:, corner] for step in (1, 2))
        across = np.linalg.norm(np.cross(to_next, to_last), axis=-1)
        angle = np.arctan2(across, np.einsum("fi,fi->f", to_next, to_last))
        where = place[part.faces[:, corner]]
        for axis in range(3):
            summed[:, axis] += np.bincount(where, angle * flat[:, axis], num_places)
    summed = summed[place]
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    # two sides of a thin sheet cancel out; any of the faces will do there
    any_face = np.zeros_like(summed)
    any_face[part.faces.ravel()] = np.repeat(flat, 3, axis=0)
    return np.where(length > 1e-6, summed / np.maximum(length, 1e-6), any_face)


def _places(vertices: np.ndarray) -> np.ndarray:
    """A number per vertex [V], the same for those at the same position."""
    bits = (vertices.astype(np.float32) + np.float32(0)).view(np.uint32).astype(np.uint64)
    # mixed into 64 bits: sorting numbers is ten times faster than sorting rows
    mixed = np.zeros(len(vertices), np.uint64)
    for axis in range(3):
        mixed = (mixed ^ bits[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return np.unique(mixed, return_inverse=True)[1]


def _with_computed_normals(part: RawPart, corners: np.ndarray, flat: np.ndarray) -> RawPart:
    """Smooth normals, but sharp creases: corners there get vertices of their own."""
    smooth = _smooth(part, corners, flat)
    is_sharp = np.einsum("fci,fi->fc", smooth[part.faces], flat) < _CREASE_COSINE
    faces = part.faces.copy()
    source = part.faces[is_sharp]
    faces[is_sharp] = len(part.vertices) + np.arange(len(source))
    stacked = {
        key: None if getattr(part, key) is None else np.concatenate([getattr(part, key), getattr(part, key)[source]])
        for key in ("vertices", "uv", "colors")
    }
    normals = np.concatenate([smooth, np.broadcast_to(flat[:, None], (*is_sharp.shape, 3))[is_sharp]])
    return _without_unused(replace(part, faces=faces, normals=normals, **stacked))  # type: ignore[arg-type]
