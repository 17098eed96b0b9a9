"""Triangles of a glTF scene: nodes walked, primitives unpacked, every instance placed by its node's transform.

Skinned meshes stand in their rest pose; morph targets and animations are left out.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.cues.gltf_document import GltfDocument
from illuminerf.cues.gltf_materials import GltfMaterials
from illuminerf.cues.raw_objects import RawPart, ReadingLimits

_POINTS_AND_LINES, _TRIANGLES, _STRIP, _FAN = (0, 1, 2, 3), 4, 5, 6
_MAX_NODES = 200_000

Placed = tuple[dict[str, Any], np.ndarray]
"""A node and its world_from_node [4, 4]."""


def read_gltf(path: Path, limits: ReadingLimits) -> list[RawPart]:
    """All triangles of a .glb or .gltf file, one part per primitive and instance, in glTF's y-up axes.

    Raises:
        BrokenObject: it cannot be read.
    """
    document = GltfDocument(path, limits)
    nodes = list(_placed_nodes(document))
    limits.check_faces(path.name, sum(_claimed_faces(document, node) for node, _ in nodes))
    materials = GltfMaterials(document)
    world_from_node = {id(node): transform for node, transform in nodes}
    parts = []
    for node, transform in nodes:
        if "mesh" not in node:
            continue
        skin = _skin_matrices(document, node, world_from_node)
        for primitive in _primitives(document, node["mesh"]):
            part = _part(document, primitive, materials)
            if part is not None:
                posed = None if skin is None else _posed(document, primitive, part, skin)
                parts.append(_transformed(part, transform) if posed is None else posed)
    return parts


def _placed_nodes(document: GltfDocument) -> Iterator[Placed]:
    """Nodes of the default scene (without scenes: all that are nobody's child), parents first."""
    scenes = document.items("scenes")
    if scenes:
        roots = document.item("scenes", document.json.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in document.items("nodes") for child in node.get("children", [])}
        roots = [index for index in range(len(document.items("nodes"))) if index not in children]
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    num_seen = 0
    while stack:
        index, world_from_parent = stack.pop()
        num_seen += 1
        if num_seen > max(len(document.items("nodes")), 1) or num_seen > _MAX_NODES:
            raise document.broken("nodes that are their own ancestors, or too many")
        node = document.item("nodes", index)
        with np.errstate(all="ignore"):  # what is not finite is found in the vertices
            transform = world_from_parent @ _local(document, node)
        yield node, transform
        stack += [(child, transform) for child in reversed(node.get("children", []))]


def _local(document: GltfDocument, node: dict[str, Any]) -> np.ndarray:
    """parent_from_node [4, 4], float64."""
    try:
        if "matrix" in node:
            return np.array(node["matrix"], np.float64).reshape(4, 4).T  # column by column in the file
        x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64) / max(
            float(np.linalg.norm(node.get("rotation", [0, 0, 0, 1]))), 1e-30
        )
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        local = np.eye(4)
        local[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), np.float64).reshape(3)
        local[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64).reshape(3)
        return local
    except (ValueError, TypeError) as error:
        raise document.broken(f"a node whose transform is not one: {error}") from error


def _primitives(document: GltfDocument, mesh: Any) -> list[dict[str, Any]]:
    found = document.item("meshes", mesh).get("primitives", [])
    if not isinstance(found, list) or not all(
        isinstance(p, dict) and isinstance(p.get("attributes"), dict) for p in found
    ):
        raise document.broken("a mesh without primitives")
    return found


def _claimed_faces(document: GltfDocument, node: dict[str, Any]) -> int:
    """Triangles of a node by what its accessors claim; nothing is read."""
    total = 0
    for primitive in _primitives(document, node["mesh"]) if "mesh" in node else []:
        if primitive.get("mode", _TRIANGLES) in _POINTS_AND_LINES or "POSITION" not in primitive["attributes"]:
            continue
        corners = document.count(primitive.get("indices", primitive["attributes"]["POSITION"]))
        total += corners // 3 if primitive.get("mode", _TRIANGLES) == _TRIANGLES else max(corners - 2, 0)
        if document.count(primitive["attributes"]["POSITION"]) > 3 * document.limits.max_faces:
            document.limits.check_faces(document.path.name, document.count(primitive["attributes"]["POSITION"]) // 3)
    return total


def _part(document: GltfDocument, primitive: dict[str, Any], materials: GltfMaterials) -> RawPart | None:
    attributes, mode = primitive["attributes"], primitive.get("mode", _TRIANGLES)
    for name in primitive.get("extensions", {}):
        if name == "KHR_draco_mesh_compression":
            raise document.broken(f"the extension {name}, which is not supported")
    if mode in _POINTS_AND_LINES or "POSITION" not in attributes:
        return None
    vertices = document.array(attributes["POSITION"], 3).astype(np.float64)
    num_vertices = len(vertices)
    indices = document.array(primitive["indices"], 1) if "indices" in primitive else np.arange(num_vertices)
    faces = _triangles(document, indices.astype(np.int64), mode)
    if not len(faces):
        return None
    if faces.max() >= num_vertices:
        raise document.broken(f"faces that name vertex {faces.max()} of {num_vertices}")
    colors, color_alpha = _vertex_colors(document, attributes, num_vertices)
    material, uv_of = materials.material(primitive.get("material"))
    uv_set = f"TEXCOORD_{uv_of.uv_set}"
    uv = document.array(attributes[uv_set], 2).astype(np.float64) if uv_set in attributes else None
    normals = document.array(attributes["NORMAL"], 3).astype(np.float64) if "NORMAL" in attributes else None
    for name, array in (("texture coordinates", uv), ("normals", normals)):
        if array is not None and len(array) != num_vertices:
            raise document.broken(f"{len(array)} {name} for {num_vertices} vertices")
    return RawPart(vertices, faces, normals, None if uv is None else uv_of.bottom_up(uv), colors, color_alpha, material)


def _triangles(document: GltfDocument, indices: np.ndarray, mode: Any) -> np.ndarray:
    """Faces [F, 3] of a list, strip or fan; what is left over at the end is dropped, as the standard says."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if mode not in (_STRIP, _FAN):
        raise document.broken(f"a primitive of mode {mode!r}")
    if len(indices) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _FAN:
        return np.stack([indices[1:-1], indices[2:], np.broadcast_to(indices[0], len(indices) - 2)], -1)
    faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], -1)
    faces[1::2] = faces[1::2, [1, 0, 2]]  # every other one would turn its back
    return faces


def _vertex_colors(document: GltfDocument, attributes: dict[str, Any], wanted: int) -> tuple[np.ndarray | None, float]:
    """COLOR_0, linear [V, 3], and its least alpha."""
    if "COLOR_0" not in attributes:
        return None, 1.0
    width = 3 if document.item("accessors", attributes["COLOR_0"]).get("type") == "VEC3" else 4
    colors = document.array(attributes["COLOR_0"], width)
    if len(colors) != wanted:
        raise document.broken(f"{len(colors)} colours for {wanted} vertices")
    if np.issubdtype(colors.dtype, np.integer):  # some exporters forget `normalized`
        colors = colors.astype(np.float64) / np.iinfo(colors.dtype).max
    colors = np.clip(np.nan_to_num(colors), 0, 1).astype(np.float32)
    return colors[:, :3], 1.0 if width == 3 or not wanted else float(colors[:, 3].min())


def _transformed(part: RawPart, transform: np.ndarray) -> RawPart:
    """The part in the world; a mirroring transform turns the faces round so that they still face outward."""
    linear = transform[:3, :3]
    with np.errstate(all="ignore"):  # overflow becomes infinite and is found later
        vertices = part.vertices @ linear.T + transform[:3, 3]
        # normals go with the cofactor matrix, which unlike the inverse exists for flattening transforms too
        size = np.abs(linear).max()
        unit = linear / size if size > 0 and np.isfinite(size) else np.eye(3)
        cofactor = np.stack(
            [np.cross(unit[:, 1], unit[:, 2]), np.cross(unit[:, 2], unit[:, 0]), np.cross(unit[:, 0], unit[:, 1])], -1
        )
        is_mirrored = np.linalg.det(unit) < 0
    normals = None if part.normals is None else part.normals @ (-cofactor if is_mirrored else cofactor).T
    faces = part.faces[:, ::-1] if is_mirrored else part.faces
    return RawPart(vertices, faces, normals, part.uv, part.colors, part.color_alpha, part.material)


def _skin_matrices(
    document: GltfDocument, node: dict[str, Any], world_from_node: dict[int, np.ndarray]
) -> np.ndarray | None:
    """world_from_bind [joints, 4, 4] of a skinned node, whose own transform then does not count; else None."""
    if "skin" not in node:
        return None
    skin = document.item("skins", node["skin"])
    joints = [document.item("nodes", joint) for joint in skin.get("joints", [])]
    if not joints or any(id(joint) not in world_from_node for joint in joints):
        return None
    placed = np.stack([world_from_node[id(joint)] for joint in joints])
    if "inverseBindMatrices" not in skin:
        return placed
    inverse = document.array(skin["inverseBindMatrices"], 16).reshape(-1, 4, 4).transpose(0, 2, 1)
    return placed @ inverse[: len(placed)] if len(inverse) >= len(placed) else None


def _posed(document: GltfDocument, primitive: dict[str, Any], part: RawPart, skin: np.ndarray) -> RawPart | None:
    """The part bent by linear blend skinning into the pose of the nodes, or None where it has no weights."""
    attributes, num_vertices = primitive["attributes"], len(part.vertices)
    if "JOINTS_0" not in attributes or "WEIGHTS_0" not in attributes:
        return None
    joints = document.array(attributes["JOINTS_0"], 4).astype(np.int64)
    weights = document.array(attributes["WEIGHTS_0"], 4).astype(np.float64)
    if len(joints) != num_vertices or len(weights) != num_vertices or joints.min() < 0 or joints.max() >= len(skin):
        raise document.broken("a skin that names absent joints")
    total = weights.sum(1, keepdims=True)
    weights = np.where(total > 0, weights / np.maximum(total, 1e-12), [1.0, 0, 0, 0])
    vertices, normals = np.zeros_like(part.vertices), np.zeros_like(part.vertices)
    for slot in range(4):
        # one slot at a time: all four would take 512 bytes a vertex
        matrices = skin[joints[:, slot]] * weights[:, slot, None, None]
        vertices += np.einsum("vij,vj->vi", matrices[:, :3, :3], part.vertices) + matrices[:, :3, 3]
        if part.normals is not None:
            normals += np.einsum("vij,vj->vi", matrices[:, :3, :3], part.normals)
    is_mirrored = bool(np.linalg.det(skin[joints[0, 0]][:3, :3]) < 0)
    faces = part.faces[:, ::-1] if is_mirrored else part.faces
    found = None if part.normals is None else normals
    return RawPart(vertices, faces, found, part.uv, part.colors, part.color_alpha, part.material)
