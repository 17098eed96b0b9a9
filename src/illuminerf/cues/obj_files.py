"""Wavefront OBJ meshes: polygons with positions, normals, texture coordinates and vertex colours, by material.

Text is taken in line by line; only arrays of machine numbers are kept, about 60 bytes a corner.
"""

from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.mtl_files import read_mtl
from illuminerf.cues.ply_files import fan_slots
from illuminerf.cues.raw_objects import RawMaterial, RawPart, ReadingLimits, file_beside
from illuminerf.scene.images import linear_from_srgb

_ABSENT = np.iinfo(np.int64).min
_NO_MATERIAL = -1


@dataclass
class _Text:
    """What the lines of a file say, as they come."""

    positions: array = field(default_factory=lambda: array("d"))
    colors: array = field(default_factory=lambda: array("d"))
    uv: array = field(default_factory=lambda: array("d"))
    normals: array = field(default_factory=lambda: array("d"))
    corners: array = field(default_factory=lambda: array("q"))
    """Position, uv and normal of every corner, counted from 0; `_ABSENT` where it has none."""
    polygons: array = field(default_factory=lambda: array("q"))
    """Corners of each polygon."""
    owners: array = field(default_factory=lambda: array("q"))
    """Material of each polygon, an index into `materials`."""
    materials: dict[str, int] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)


def read_obj(path: Path, limits: ReadingLimits) -> list[RawPart]:
    """The triangles of an OBJ file, one part per material; polygons are cut into fans.

    Raises:
        BrokenObject: it cannot be read, or a material library or texture is missing.
    """
    limits.check_file(path)
    text = _scanned(path, limits)
    if not len(text.polygons):
        if len(text.positions):
            raise BrokenObject("empty", f"{path.name} holds no triangles", got="vertices without faces")
        raise BrokenObject("empty", f"{path.name} holds no vertices")
    materials: dict[str, RawMaterial] = {}
    for library in text.libraries:
        materials |= read_mtl(path, file_beside(path, library), limits)
    corners = np.frombuffer(text.corners, np.int64).reshape(-1, 3)
    polygons, owners = np.frombuffer(text.polygons, np.int64), np.frombuffer(text.owners, np.int64)
    slots = fan_slots(polygons)
    owner = np.repeat(owners, np.maximum(polygons - 2, 0))
    names = {index: name for name, index in text.materials.items()}
    parts = []
    for material in np.unique(owner):
        # a name that no library has is no material
        raw = materials.get(names[int(material)]) if material != _NO_MATERIAL else None
        parts.append(_part(path.name, text, corners[slots[owner == material].ravel()], raw))
    return parts


def _scanned(path: Path, limits: ReadingLimits) -> _Text:
    text = _Text()
    current, num_faces, lines = _NO_MATERIAL, 0, {b"v": text.positions, b"vt": text.uv, b"vn": text.normals}
    try:
        with open(path, "rb") as file:
            for line in file:
                while line.rstrip().endswith(b"\\"):  # goes on in the next line
                    more = next(file, b"")
                    line = line.rstrip()[:-1] + b" " + more
                words = line.split()
                if not words:
                    continue
                keyword = words[0]
                if keyword in lines:
                    width = 2 if keyword == b"vt" else 3
                    numbers = [float(word) for word in words[1:]]
                    if keyword == b"vt" and len(numbers) == 1:
                        numbers.append(0.0)
                    lines[keyword].extend(_exactly(numbers, width))
                    if keyword == b"v" and len(numbers) >= 6:
                        text.colors.extend(numbers[-3:])
                elif keyword == b"f":
                    _add_polygon(text, words[1:], current)
                    num_faces += max(len(words) - 3, 0)
                    limits.check_faces(path.name, num_faces)
                elif keyword == b"usemtl":
                    current = _material_index(text, line.split(None, 1)[1:])
                elif keyword == b"mtllib":
                    text.libraries.append(line.split(None, 1)[1].strip().decode("utf-8", "replace"))
    except (ValueError, IndexError) as error:
        raise BrokenObject("unreadable", f"{path.name} is unreadable", got=str(error)) from error
    return text


def _exactly(numbers: list[float], width: int) -> list[float]:
    if len(numbers) < width:
        raise ValueError(f"{len(numbers)} numbers where {width} are needed")
    return numbers[:width]


def _material_index(text: _Text, names: list[bytes]) -> int:
    if not names:
        return _NO_MATERIAL
    name = names[0].strip().decode("utf-8", "replace")
    return text.materials.setdefault(name, len(text.materials))


def _add_polygon(text: _Text, words: list[bytes], material: int) -> None:
    """Append a face's corners; negative numbers count back from what has been read so far."""
    limits = (len(text.positions) // 3, len(text.uv) // 2, len(text.normals) // 3)
    for word in words:
        parts = word.split(b"/")
        for slot in range(3):
            if slot < len(parts) and parts[slot]:
                number = int(parts[slot])
                text.corners.append(number - 1 if number > 0 else limits[slot] + number)
            else:
                text.corners.append(_ABSENT)
    text.polygons.append(len(words))
    text.owners.append(material)


def _part(name: str, text: _Text, corners: np.ndarray, material: RawMaterial | None) -> RawPart:
    """One material's triangles; every different (position, uv, normal) becomes a vertex.

    Args:
        name: of the file.
        text: what was read.
        corners: [3 T, 3], three in a row for each triangle.
        material: or None.
    """
    tables = [np.frombuffer(values, np.float64).reshape(-1, width)
              for values, width in ((text.positions, 3), (text.uv, 2), (text.normals, 3))]  # fmt: skip
    has = [bool((corners[:, slot] != _ABSENT).all()) for slot in range(3)]
    for slot, table in enumerate(tables):
        used = corners[:, slot]
        if has[slot] and (used.min() < 0 or used.max() >= len(table)):
            what = ("vertices", "texture coordinates", "normals")[slot]
            raise BrokenObject("unreadable", f"{name} has faces that name {what} it does not have")
    if not has[0]:
        raise BrokenObject("unreadable", f"{name} has faces without vertices")
    # one number per combination, to sort numbers instead of rows
    key = corners[:, 0]
    for slot in (1, 2):
        if has[slot]:
            _, key = np.unique(key, return_inverse=True)
            key = key * np.int64(len(tables[slot])) + corners[:, slot]
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    chosen = corners[first]
    colors = None
    if len(text.colors) == len(text.positions):
        coded = np.frombuffer(text.colors, np.float64).reshape(-1, 3)[chosen[:, 0]]
        coded = coded / 255 if coded.max(initial=0) > 1 else coded
        colors = linear_from_srgb(np.clip(np.nan_to_num(coded), 0, 1)).astype(np.float32)
    return RawPart(
        tables[0][chosen[:, 0]],
        inverse.reshape(-1, 3),
        tables[2][chosen[:, 2]] if has[2] else None,
        tables[1][chosen[:, 1]] if has[1] else None,
        colors,
        1.0,
        material,
    )
