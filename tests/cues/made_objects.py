"""Small glTF files made by hand, so that every field can be got wrong on purpose."""

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.uint32)
_COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121, "int16": 5122, "int8": 5120}


def png(color: tuple[int, ...], size: int = 4) -> bytes:
    """A PNG of one colour, RGB or RGBA."""
    out = io.BytesIO()
    Image.new("RGBA" if len(color) == 4 else "RGB", (size, size), color).save(out, "PNG")
    return out.getvalue()


class Gltf:
    """A glTF document in the making: `json` may be changed at will before it is written."""

    def __init__(self) -> None:
        self.binary = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def view(self, content: bytes) -> int:
        """Append bytes; the index of their buffer view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)})
        self.binary += content
        return len(self.json["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, **extra: Any) -> int:
        """Append an array [n] or [n, width]; the index of its accessor."""
        kind = "SCALAR" if values.ndim == 1 else {16: "MAT4"}.get(values.shape[1], f"VEC{values.shape[1]}")
        component = _COMPONENTS[str(values.dtype)]
        entry = {"bufferView": self.view(values.tobytes()), "componentType": component, "count": len(values)}
        self.json["accessors"].append({**entry, "type": kind, **extra})
        return len(self.json["accessors"]) - 1

    def mesh(
        self,
        vertices: np.ndarray = TETRAHEDRON,
        faces: np.ndarray = FACES,
        material: dict[str, Any] | None = None,
        primitive: dict[str, Any] | None = None,
        node: dict[str, Any] | None = None,
        **attributes: np.ndarray | int,
    ) -> "Gltf":
        """Append a mesh with its node; attributes by glTF name as arrays or accessor indices."""
        made = {key: value if isinstance(value, int) else self.accessor(value) for key, value in attributes.items()}
        entry: dict[str, Any] = {"attributes": {"POSITION": self.accessor(vertices.astype(np.float32)), **made}}
        entry["indices"] = self.accessor(faces.astype(np.uint32).ravel())
        if material is not None:
            self.json.setdefault("materials", []).append(material)
            entry["material"] = len(self.json["materials"]) - 1
        self.json.setdefault("meshes", []).append({"primitives": [{**entry, **(primitive or {})}]})
        self.json.setdefault("nodes", []).append({"mesh": len(self.json["meshes"]) - 1, **(node or {})})
        return self

    def texture(self, image: bytes | str, **sampler: Any) -> dict[str, int]:
        """Append an image (bytes are embedded, a string is a uri); a reference to its texture."""
        entry = {"uri": image} if isinstance(image, str) else {"bufferView": self.view(image), "mimeType": "image/png"}
        self.json.setdefault("images", []).append(entry)
        texture: dict[str, Any] = {"source": len(self.json["images"]) - 1}
        if sampler:
            self.json.setdefault("samplers", []).append(sampler)
            texture["sampler"] = len(self.json["samplers"]) - 1
        self.json.setdefault("textures", []).append(texture)
        return {"index": len(self.json["textures"]) - 1}

    def glb(self, path: Path) -> Path:
        """Write a .glb."""
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        binary = self.binary + b"\0" * (-len(self.binary) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path

    def gltf(self, path: Path, buffer: str = "data.bin") -> Path:
        """Write a .gltf with its buffer beside it."""
        self.json["buffers"] = [{"byteLength": len(self.binary), "uri": buffer}]
        if not buffer.startswith(("data:", "..", "/")):
            (path.parent / buffer).write_bytes(self.binary)
        path.write_text(json.dumps(self.json))
        return path


UV = np.array([[0, 1], [1, 1], [0, 0], [1, 0]], np.float32)
"""Texture coordinates of the tetrahedron's corners, glTF's top-down v."""
