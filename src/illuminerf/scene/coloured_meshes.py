"""Meshes with a finished look: unlit glTF with a colour per vertex or a texture, PLY with a colour per vertex.

A relit object has its light in its colours already. KHR_materials_unlit tells viewers to show them as they are; there
are no normals, for the same reason. Colours of vertices are linear in glTF, textures sRGB.

Vertex colours are the sturdier of the two. A viewer that smooths edges by several samples per pixel asks for colours a
little outside of triangles smaller than a pixel: between vertices that is a neighbour's colour, in an atlas anything.
"""

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from illuminerf.scene.images import linear_from_srgb, to_uint8
from illuminerf.scene.meshes import GLTF_FROM_WORLD, TriangleMesh
from illuminerf.scene.triangle_atlas import TriangleAtlas
from illuminerf.workflow.atomic import write_bytes

_UNSIGNED_SHORT, _UNSIGNED_INT, _FLOAT = 5123, 5125, 5126
_LINEAR, _CLAMP_TO_EDGE = 9729, 33071
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


def save_textured_glb(path: Path, mesh: TriangleMesh, atlas: TriangleAtlas, srgb: np.ndarray) -> None:
    """Write binary glTF 2.0, turned to its y-up axes, atomically.

    Args:
        path: the .glb.
        mesh: the triangles.
        atlas: where each triangle's colours are.
        srgb: the texture, float [height, width, 3] in [0, 1].
    """
    corner = mesh.faces.reshape(-1)
    positions = (mesh.vertices[corner] @ GLTF_FROM_WORLD.T).astype("<f4")
    picture = io.BytesIO()
    Image.fromarray(to_uint8(srgb)).save(picture, "PNG", optimize=True)
    uvs = atlas.corners().reshape(-1, 2).astype("<f4")
    parts = [positions.tobytes(), uvs.tobytes(), picture.getvalue()]
    write_bytes(path, _glb(_textured(positions), parts))


def save_coloured_glb(path: Path, mesh: TriangleMesh) -> None:
    """Write binary glTF 2.0, turned to its y-up axes, with the mesh's vertex colours, unlit, atomically."""
    assert mesh.vertex_colors is not None, "a mesh without colours"
    positions = (mesh.vertices @ GLTF_FROM_WORLD.T).astype("<f4")
    colours = np.full((len(positions), 4), 65535, "<u2")  # 16 bits, because linear 8 bits are coarse in the dark
    colours[:, :3] = np.round(linear_from_srgb(np.clip(mesh.vertex_colors, 0, 1)) * 65535)
    corners = mesh.faces.astype("<u4")
    document = _unlit({"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0})
    document["accessors"] = [
        _place(positions),
        {"bufferView": 1, "type": "VEC4", "componentType": _UNSIGNED_SHORT, "normalized": True, "count": len(colours)},
        {"bufferView": 2, "type": "SCALAR", "componentType": _UNSIGNED_INT, "count": corners.size},
    ]
    write_bytes(path, _glb(document, [positions.tobytes(), colours.tobytes(), corners.tobytes()]))


def save_coloured_ply(path: Path, mesh: TriangleMesh) -> None:
    """Write binary PLY, z-up as our world, with normals and the mesh's vertex colours as 8-bit sRGB, atomically."""
    assert mesh.vertex_colors is not None, "a mesh without colours"
    kinds = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    kinds += [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.zeros(len(mesh.vertices), kinds)
    colours = to_uint8(mesh.vertex_colors)
    for names, values in (("xyz", mesh.vertices), (("nx", "ny", "nz"), mesh.vertex_normals)):
        for axis, name in enumerate(names):
            vertices[name] = values[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    words = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {words[kind]} {name}" for name, kind in kinds]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    write_bytes(path, "\n".join(header).encode() + vertices.tobytes() + faces.tobytes())


def _unlit(primitive: dict[str, Any]) -> dict[str, Any]:
    """The JSON of one unlit mesh, without its accessors; `_glb` adds places in the binary part."""
    surface = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"name": "relit", "extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": surface}
    return {
        "asset": {"version": "2.0", "generator": "Open IllumiNeRF"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "relit"}],
        "meshes": [{"name": "relit", "primitives": [primitive]}],
        "materials": [material],
    }


def _place(positions: np.ndarray) -> dict[str, Any]:
    """The accessor of positions, which must state their extent."""
    extent = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    return {"bufferView": 0, "type": "VEC3", "componentType": _FLOAT, "count": len(positions), **extent}


def _textured(positions: np.ndarray) -> dict[str, Any]:
    """The JSON of one unlit, textured mesh without indices. No mipmaps: cells of the atlas that lie side by side need
    not do so on the object."""
    document = _unlit({"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0})
    document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    document["textures"] = [{"source": 0, "sampler": 0}]
    document["images"] = [{"bufferView": 2, "mimeType": "image/png", "name": "relit"}]
    document["samplers"] = [
        {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP_TO_EDGE, "wrapT": _CLAMP_TO_EDGE}
    ]
    uvs = {"bufferView": 1, "type": "VEC2", "componentType": _FLOAT, "count": len(positions)}
    document["accessors"] = [_place(positions), uvs]
    return document


def _glb(document: dict[str, Any], parts: list[bytes]) -> bytes:
    """Container of one JSON and one binary chunk; every part starts at a multiple of four bytes."""
    primitive = document["meshes"][0]["primitives"][0]
    target = {document["accessors"][i]["bufferView"]: _ARRAY_BUFFER for i in primitive["attributes"].values()}
    if "indices" in primitive:
        target[document["accessors"][primitive["indices"]]["bufferView"]] = _ELEMENT_ARRAY_BUFFER
    views, binary = [], b""
    for number, part in enumerate(parts):
        use = {"target": target[number]} if number in target else {}
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part), **use})
        binary += part + b"\0" * (-len(part) % 4)
    document = {**document, "bufferViews": views, "buffers": [{"byteLength": len(binary)}]}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
