"""PLY meshes, ascii and binary, with normals, colours and texture coordinates where they have any.

Colours are sRGB coded, as scanners and MeshLab write them: bytes, or numbers in [0, 1].
"""

import re
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.raw_objects import ImageFile, RawMaterial, RawPart, ReadingLimits, file_beside
from illuminerf.scene.images import linear_from_srgb

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_MAX_HEADER = 2**16
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count_kind: str | None = None
    """Set for lists."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]


_Columns = dict[str, np.ndarray]
"""A property's values by name: [rows], or for lists the flat values; `name#` holds a list's counts [rows]."""


def read_ply(path: Path, limits: ReadingLimits) -> list[RawPart]:
    """The triangles of a PLY file; polygons are cut into fans.

    Raises:
        BrokenObject: it cannot be read; a point cloud is "empty".
    """
    limits.check_file(path)
    content = path.read_bytes()
    byte_order, elements, texture, start = _header(path.name, content)
    by_name = {element.name: element for element in elements}
    if "tristrips" in by_name:
        raise _broken(path.name, "triangle strips, which are not supported")
    if not by_name.get("face") or not by_name["face"].count:
        raise BrokenObject("empty", f"{path.name} holds no triangles", got="a point cloud")
    limits.check_faces(path.name, by_name["face"].count)
    _check_claims(path.name, elements, len(content) - start, is_ascii=not byte_order)
    if byte_order:
        columns = _read_binary(path.name, elements, content, start, byte_order)
    else:
        columns = _read_ascii(path.name, elements, content[start:])
    return [_part(path, columns["vertex"], columns["face"], texture, limits)]


def _broken(name: str, got: str) -> BrokenObject:
    return BrokenObject("unreadable", f"{name} is unreadable", got=got)


def _header(name: str, content: bytes) -> tuple[str, list[_Element], str | None, int]:
    """Byte order ("<", ">" or "" for ascii), elements, texture file, and where the data starts."""
    end = re.search(rb"end_header[ \t]*(\r\n|\n|\r)", content[:_MAX_HEADER])
    if not content.startswith(b"ply") or end is None:
        raise _broken(name, "no PLY header")
    order, texture = "?", None
    elements: list[tuple[str, int, list[_Property]]] = []
    for line in re.split(r"\r\n|\n|\r", content[: end.start()].decode("latin-1")):
        match line.split():
            case ["format", kind, *_]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(kind, "?")
            case ["comment", "TextureFile", *words]:
                texture = " ".join(words)
            case ["element", element, count] if count.isdigit():
                elements.append((element, int(count), []))
            case ["property", "list", count_kind, kind, prop] if {kind, count_kind} <= set(_TYPES) and elements:
                elements[-1][2].append(_Property(prop, _TYPES[kind], _TYPES[count_kind]))
            case ["property", kind, prop] if kind in _TYPES and elements:
                elements[-1][2].append(_Property(prop, _TYPES[kind]))
            case ["element" | "property", *_]:
                raise _broken(name, f"the header line {line[:60]!r}")
    if order == "?":
        raise _broken(name, "an unknown PLY format")
    if "vertex" not in {element for element, _, _ in elements}:
        raise BrokenObject("empty", f"{name} holds no vertices")
    return order, [_Element(element, count, tuple(props)) for element, count, props in elements], texture, end.end()


def _check_claims(name: str, elements: list[_Element], num_bytes: int, is_ascii: bool) -> None:
    """The rows that the header claims must fit into the bytes there are."""
    least = 0
    for element in elements:
        kinds = [prop.count_kind or prop.kind for prop in element.properties]
        least += element.count * (2 * len(kinds) - 1 if is_ascii else sum(np.dtype(kind).itemsize for kind in kinds))
    if least > num_bytes:
        counts = ", ".join(f"{element.count:,} {element.name}" for element in elements)
        raise _broken(name, f"{num_bytes:,} bytes for {counts}: the file is cut off")


def _read_binary(name: str, elements: list[_Element], content: bytes, offset: int, order: str) -> dict[str, _Columns]:
    found = {}
    for element in elements:
        uniform = _uniform_row(element, content, offset, order)
        if uniform is not None:
            rows = np.frombuffer(content, uniform, element.count, offset)
            found[element.name] = _columns_of_rows(element, rows)
            offset += rows.nbytes
        else:
            found[element.name], offset = _read_lists(name, element, content, offset, order)
    return found


def _uniform_row(element: _Element, content: bytes, offset: int, order: str) -> np.dtype | None:
    """The type of a row if all lists are as long as in the first row (all triangles, say), else None."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int, ...]]] = []
    position = offset
    for prop in element.properties:
        if prop.count_kind:
            kind = np.dtype(order + prop.count_kind)
            if position + kind.itemsize > len(content) or not element.count:
                return None
            length = int(np.frombuffer(content, kind, 1, position)[0])
            if not 0 <= length <= 64:
                return None
            fields += [(f"{prop.name}#", order + prop.count_kind), (prop.name, order + prop.kind, (length,))]
            position += kind.itemsize + length * np.dtype(prop.kind).itemsize
        else:
            fields.append((prop.name, order + prop.kind))
            position += np.dtype(prop.kind).itemsize
    dtype = np.dtype(fields)
    if offset + dtype.itemsize * element.count > len(content):
        return None
    rows = np.frombuffer(content, dtype, element.count, offset)
    lists = [f"{prop.name}#" for prop in element.properties if prop.count_kind]
    return dtype if all((rows[key] == rows[key][0]).all() for key in lists) else None


def _columns_of_rows(element: _Element, rows: np.ndarray) -> _Columns:
    columns = {}
    for prop in element.properties:
        columns[prop.name] = rows[prop.name].reshape(-1).astype(prop.kind)
        if prop.count_kind:
            columns[f"{prop.name}#"] = rows[f"{prop.name}#"].astype(np.int64)
    return columns


def _read_lists(name: str, element: _Element, content: bytes, offset: int, order: str) -> tuple[_Columns, int]:
    """Row by row, for lists of several lengths; slow (about 2 seconds for a million rows)."""
    codes = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
    values: dict[str, list[float]] = {prop.name: [] for prop in element.properties}
    counts: dict[str, list[int]] = {prop.name: [] for prop in element.properties if prop.count_kind}
    try:
        for _ in range(element.count):
            for prop in element.properties:
                length = 1
                if prop.count_kind:
                    code = order + codes[prop.count_kind]
                    (length,) = struct.unpack_from(code, content, offset)
                    offset += struct.calcsize(code)
                    counts[prop.name].append(length)
                code = f"{order}{length}{codes[prop.kind]}"
                values[prop.name] += struct.unpack_from(code, content, offset)
                offset += struct.calcsize(code)
    except struct.error as error:
        raise _broken(name, "lists that are longer than the file") from error
    columns = {prop.name: np.array(values[prop.name], prop.kind) for prop in element.properties}
    return columns | {f"{key}#": np.array(count, np.int64) for key, count in counts.items()}, offset


def _read_ascii(name: str, elements: list[_Element], text: bytes) -> dict[str, _Columns]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # stops at what is no number; then too few are found
        numbers = np.fromstring(text, np.float64, sep=" ")
    found, position = {}, 0
    for element in elements:
        rows, position = _ascii_rows(name, element, numbers, position)
        found[element.name] = rows
    return found


def _ascii_rows(name: str, element: _Element, numbers: np.ndarray, position: int) -> tuple[_Columns, int]:
    values: dict[str, list[np.ndarray]] = {prop.name: [] for prop in element.properties}
    counts: dict[str, list[int]] = {prop.name: [] for prop in element.properties if prop.count_kind}
    lists = [prop for prop in element.properties if prop.count_kind]
    if len(lists) == len(element.properties) == 1 and element.count and position < len(numbers):
        width = int(np.nan_to_num(numbers[position])) + 1
        block = numbers[position : position + width * element.count]
        if width > 1 and len(block) == width * element.count and (block[::width] == width - 1).all():
            rows = block.reshape(-1, width)
            key = lists[0].name
            return {key: rows[:, 1:].ravel(), f"{key}#": rows[:, 0].astype(np.int64)}, position + len(block)
    if not lists:
        width = len(element.properties)
        block = numbers[position : position + width * element.count]
        if len(block) < width * element.count:
            raise _broken(name, f"{len(block):,} numbers for {element.count:,} {element.name}")
        rows = block.reshape(-1, width)
        return {prop.name: rows[:, i] for i, prop in enumerate(element.properties)}, position + len(block)
    for _ in range(element.count):
        for prop in element.properties:
            length = 1
            if prop.count_kind:
                length = int(numbers[position]) if position < len(numbers) and numbers[position] >= 0 else 2**62
                position += 1
                counts[prop.name].append(length)
            if position + length > len(numbers):
                raise _broken(name, f"too few numbers for {element.count:,} {element.name}")
            values[prop.name].append(numbers[position : position + length])
            position += length
    columns = {key: np.concatenate([*found, np.zeros(0)]) for key, found in values.items()}
    return columns | {f"{key}#": np.array(count, np.int64) for key, count in counts.items()}, position


def _part(path: Path, vertex: _Columns, face: _Columns, texture: str | None, limits: ReadingLimits) -> RawPart:
    if not {"x", "y", "z"} <= set(vertex):
        raise _broken(path.name, "vertices without x, y, z")
    indices = next((key for key in ("vertex_indices", "vertex_index") if f"{key}#" in face), None)
    if indices is None:
        raise BrokenObject("empty", f"{path.name} holds no triangles", got="faces without vertices")
    positions = np.stack([vertex[axis] for axis in "xyz"], -1).astype(np.float64)
    corners, polygons = face[indices].astype(np.int64), face[f"{indices}#"]
    slots = fan_slots(polygons)
    limits.check_faces(path.name, len(slots))
    faces = corners[slots]
    if len(faces) and (faces.min() < 0 or faces.max() >= len(positions)):
        raise _broken(path.name, f"faces that name vertices outside 0 to {len(positions) - 1}")
    normals = None
    if {"nx", "ny", "nz"} <= set(vertex):
        normals = np.stack([vertex[axis] for axis in ("nx", "ny", "nz")], -1).astype(np.float64)
    colors, alpha = _colors(vertex)
    uv = next((np.stack([vertex[u], vertex[v]], -1) for u, v in _UV_NAMES if u in vertex and v in vertex), None)
    if texture is not None and "texcoord#" in face and (face["texcoord#"] == 2 * polygons).all():
        # a coordinate per corner: every corner becomes a vertex
        uv, flat = face["texcoord"].reshape(-1, 2)[slots].reshape(-1, 2), faces.ravel()
        positions, faces = positions[flat], np.arange(len(flat)).reshape(-1, 3)
        normals, colors = (None if array is None else array[flat] for array in (normals, colors))
    material = None
    if texture is not None and uv is not None:
        file = file_beside(path, texture)
        limits.check_file(file)
        material = RawMaterial(color_image=ImageFile(file.name, file.read_bytes()))
    return RawPart(positions, faces, normals, None if uv is None else uv.astype(np.float64), colors, alpha, material)


def fan_slots(polygons: np.ndarray) -> np.ndarray:
    """Triangles [T, 3] of polygons of so many corners each [P], as positions in the flat list of corners."""
    firsts = np.cumsum(polygons) - polygons
    triangles = np.maximum(polygons - 2, 0)
    owner = np.repeat(np.arange(len(polygons)), triangles)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = firsts[owner]
    return np.stack([first, first + within + 1, first + within + 2], -1)


def _colors(vertex: _Columns) -> tuple[np.ndarray | None, float]:
    names = ("red", "green", "blue") if "red" in vertex else ("diffuse_red", "diffuse_green", "diffuse_blue")
    if not set(names) <= set(vertex):
        return None, 1.0
    coded = np.stack([vertex[name] for name in names], -1).astype(np.float32)
    alpha = vertex.get("alpha", np.full(1, 255.0)).astype(np.float32)
    # bytes by what they hold: ascii files have no types left, and 0..1 in bytes would be black anyway
    scale = 255.0 if coded.max(initial=0) > 1 else 1.0
    opaque = float(alpha.min(initial=255.0)) / (255.0 if alpha.max(initial=0) > 1 else 1.0)
    is_unset = alpha.max(initial=0) == 0
    colors = linear_from_srgb(np.clip(np.nan_to_num(coded) / np.float32(scale), 0, 1))
    return colors.astype(np.float32), 1.0 if is_unset else opaque
