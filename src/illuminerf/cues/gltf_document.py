"""The container of glTF 2.0: JSON, buffers, accessors and images of .glb and .gltf files, with every claim checked.

Nothing is allocated by a count that the file's own bytes do not back.
"""

import base64
import binascii
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np

from illuminerf.cues.broken_object import BrokenObject
from illuminerf.cues.raw_objects import ImageFile, ReadingLimits, file_beside

_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_DTYPES: dict[Any, Any] = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# required extensions that change nothing we read, or that `gltf_scenes` understands
_KNOWN_EXTENSIONS = {
    "KHR_lights_punctual",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "EXT_texture_webp",
    "KHR_animation_pointer",
    "KHR_node_visibility",
    "KHR_xmp_json_ld",
}


class GltfDocument:
    """One glTF file; external buffers and images are read when they are asked for.

    Args:
        path: a .glb or .gltf file.
        limits: what is too large.

    Raises:
        BrokenObject: "unreadable", "too large" or "missing texture".
    """

    def __init__(self, path: Path, limits: ReadingLimits) -> None:
        limits.check_file(path)
        self.path, self.limits = path, limits
        content = path.read_bytes()
        # the suffix is no proof: both kinds are told apart by their first bytes
        self.json, self._binary = self._split_glb(content) if content[:4] == b"glTF" else (self._parsed(content), None)
        self._buffers: dict[int, bytes] = {}
        self._images: dict[int, ImageFile] = {}
        self._check_version_and_extensions()

    def broken(self, got: str) -> BrokenObject:
        """An "unreadable" error about this file."""
        return BrokenObject("unreadable", f"{self.path.name} is unreadable", got=got)

    def items(self, kind: str) -> list[dict[str, Any]]:
        """The top-level list `kind` of the JSON, [] where absent."""
        found = self.json.get(kind, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise self.broken(f"'{kind}' that is not a list of objects")
        return found

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """One entry of the top-level list `kind`."""
        items = self.items(kind)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(items):
            raise self.broken(f"a reference to entry {index!r} of {len(items)} {kind}")
        return items[index]

    def count(self, accessor: Any) -> int:
        """How many elements an accessor claims, without reading it."""
        count = self.item("accessors", accessor).get("count")
        if isinstance(count, bool) or not isinstance(count, int) or count < 0:
            raise self.broken(f"an accessor of {count!r} elements")
        return count

    def array(self, accessor: Any, width: int) -> np.ndarray:
        """The elements of an accessor [count, width] (or [count] for width 1): float64 where they are floats or
        normalised integers, else integers."""
        entry, count = self.item("accessors", accessor), self.count(accessor)
        dtype = _DTYPES.get(entry.get("componentType"))
        if dtype is None or _WIDTHS.get(entry.get("type", "")) != width:
            raise self.broken(
                f"an accessor of {entry.get('type')} of {entry.get('componentType')}, not of {width} numbers"
            )
        if "bufferView" in entry:
            values = self._strided(entry["bufferView"], entry.get("byteOffset", 0), count, np.dtype(dtype), width)
        else:  # zeros by definition; only the limit on faces stands against a huge claim
            if count > 3 * self.limits.max_faces:
                raise BrokenObject(
                    "too large", f"{self.path.name} is too large", got=f"{count:,} vertices without data"
                )
            values = np.zeros((count, width), dtype)
        if "sparse" in entry:
            values = self._with_sparse(values, entry["sparse"], np.dtype(dtype), width)
        if np.issubdtype(dtype, np.floating):
            values = values.astype(np.float64)
        elif entry.get("normalized"):
            values = np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1)
        return values[:, 0] if width == 1 else values

    def image(self, index: Any) -> ImageFile:
        """The undecoded image `index`."""
        entry = self.item("images", index)
        if index not in self._images:
            name = f"image {index} of {self.path.name}"
            if "bufferView" in entry:
                content = bytes(self._view(entry["bufferView"])[0])
            else:
                content, name = self._fetched(entry.get("uri")), f"{name} ({str(entry.get('uri'))[:40]})"
            self._images[index] = ImageFile(name, content)
        return self._images[index]

    def _split_glb(self, content: bytes) -> tuple[dict[str, Any], bytes | None]:
        if len(content) < 20:
            raise self.broken("a cut-off header")
        _, version, length = struct.unpack_from("<4sII", content)
        if version != 2:
            raise self.broken(f"glTF version {version}")
        if length > len(content):
            raise self.broken(f"{len(content):,} of {length:,} bytes: the file is cut off")
        chunks: dict[int, bytes] = {}
        offset = 12
        while offset + 8 <= length:
            size, kind = struct.unpack_from("<II", content, offset)
            if offset + 8 + size > len(content):
                raise self.broken("a chunk that is longer than the file")
            chunks.setdefault(kind, content[offset + 8 : offset + 8 + size])
            offset += 8 + size + (-size) % 4
        if _JSON_CHUNK not in chunks:
            raise self.broken("no JSON chunk")
        return self._parsed(chunks[_JSON_CHUNK]), chunks.get(_BINARY_CHUNK)

    def _parsed(self, content: bytes) -> dict[str, Any]:
        try:
            parsed = json.loads(content.rstrip(b"\0 ").decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise self.broken(f"JSON that does not parse: {error}") from error
        if not isinstance(parsed, dict):
            raise self.broken("JSON that is not an object")
        return parsed

    def _check_version_and_extensions(self) -> None:
        asset = self.json.get("asset")
        version = str(asset.get("version", "")) if isinstance(asset, dict) else ""
        if not version.startswith("2."):
            raise self.broken(f"glTF version {version or 'unknown'}")
        required = self.json.get("extensionsRequired", [])
        for name in required if isinstance(required, list) else []:
            if name not in _KNOWN_EXTENSIONS and not str(name).startswith("KHR_materials_"):
                raise self.broken(f"the required extension {name}, which is not supported")

    def _fetched(self, uri: Any) -> bytes:
        if not isinstance(uri, str):
            raise self.broken("a buffer or image without data")
        if uri.startswith("data:"):
            header, _, data = uri.partition(",")
            try:
                return base64.b64decode(data, validate=False) if header.endswith(";base64") else unquote_to_bytes(data)
            except (binascii.Error, ValueError) as error:
                raise self.broken("a data URI that does not decode") from error
        if "://" in uri:
            raise self.broken(f"data on the network: {uri[:60]}")
        file = file_beside(self.path, unquote_to_bytes(uri).decode("utf-8", "replace"))
        self.limits.check_file(file)
        return file.read_bytes()

    def _buffer(self, index: Any) -> bytes:
        entry = self.item("buffers", index)
        if index not in self._buffers:
            if "uri" not in entry and (index != 0 or self._binary is None):
                raise self.broken(f"buffer {index} without data")
            self._buffers[index] = self._fetched(entry["uri"]) if "uri" in entry else self._binary or b""
        return self._buffers[index]

    def _view(self, index: Any) -> tuple[memoryview, int]:
        """The bytes of a buffer view and its stride (0: tightly packed)."""
        view = self.item("bufferViews", index)
        if "EXT_meshopt_compression" in _extensions(view):
            raise self.broken("the extension EXT_meshopt_compression, which is not supported")
        buffer = self._buffer(view.get("buffer"))
        start, size, stride = (view.get(key, 0) for key in ("byteOffset", "byteLength", "byteStride"))
        if not all(isinstance(n, int) and n >= 0 for n in (start, size, stride)) or start + size > len(buffer):
            raise self.broken(f"a buffer view up to byte {start}+{size} of a buffer of {len(buffer):,}")
        return memoryview(buffer)[start : start + size], stride

    def _strided(self, view: Any, offset: Any, count: int, dtype: np.dtype, width: int) -> np.ndarray:
        content, stride = self._view(view)
        element = dtype.itemsize * width
        stride = stride or element
        if (
            not isinstance(offset, int)
            or offset < 0
            or (count and offset + (count - 1) * stride + element > len(content))
        ):
            raise self.broken(f"an accessor that claims {count:,} elements where {len(content):,} bytes are")
        if not count:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, content, offset, (stride, dtype.itemsize))

    def _with_sparse(self, values: np.ndarray, sparse: Any, dtype: np.dtype, width: int) -> np.ndarray:
        try:
            count, indices, replaced = sparse["count"], sparse["indices"], sparse["values"]
            index_dtype = np.dtype(_DTYPES[indices["componentType"]])
            rows = self._strided(indices["bufferView"], indices.get("byteOffset", 0), count, index_dtype, 1)[:, 0]
            new = self._strided(replaced["bufferView"], replaced.get("byteOffset", 0), count, dtype, width)
        except (KeyError, TypeError) as error:
            raise self.broken("a broken sparse accessor") from error
        if len(rows) and rows.max() >= len(values):
            raise self.broken("a sparse accessor that names absent elements")
        values = values.copy()
        values[rows] = new
        return values


def _extensions(entry: dict[str, Any]) -> dict[str, Any]:
    found = entry.get("extensions", {})
    return found if isinstance(found, dict) else {}
