"""Textured objects from GLB files, as parts with metallic-roughness materials in the unit sphere."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from illuminerf.cues.materials import Material
from illuminerf.scene.images import linear_from_srgb
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError

Parts = list[tuple[TriangleMesh, Material]]

# rows are our axes in glTF's y-up ones: (x, y, z) of glTF becomes (x, -z, y)
_WORLD_FROM_GLTF = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)
_LINEAR_FROM_BYTE = linear_from_srgb(np.arange(256, dtype=np.float32) / 255)
_OPAQUE = 250  # of 255; exporters round


def load_object(path: Path, generator: np.random.Generator) -> Parts:
    """Read a GLB object, z-up, centred and scaled into the unit sphere.

    Objects that hold only geometry get a random colour in [0, 1]^3 and a lobe of roughness U[0.02, 0.5] mixed in by
    U[0, 1] (paper, supplement "Training Data Processing"). Deviation: the mix is the metallic of a principled material,
    whose diffuse part has a coat as well; Blender's renderer mixes the paper's two lobes (docs/renderers.md).

    Args:
        path: the .glb file.
        generator: draws the missing material.

    Raises:
        UserError: the object is unreadable, empty, degenerate or (semi-)transparent; the message is the reason.
    """
    try:
        scene = trimesh.load_scene(str(path), file_type="glb", process=False)
        meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OSError) as error:
        raise UserError(f"{path.name} is unreadable", got=f"{type(error).__name__}: {error}") from error
    if not meshes:
        raise UserError(f"{path.name} holds no triangles")
    if any(_is_transparent(mesh) for mesh in meshes):
        raise UserError(f"{path.name} is (semi-)transparent")
    only_geometry = all(_is_bare(mesh) for mesh in meshes)
    parts: Parts = []
    invented = Material(
        tuple(generator.uniform(0, 1, 3)), float(generator.uniform(0.02, 0.5)), float(generator.uniform(0, 1))
    )
    for mesh in meshes:
        parts.append((_triangle_mesh(mesh), invented if only_geometry else _material(mesh)))
    return _in_unit_sphere(path.name, parts)


def varied(parts: Parts, generator: np.random.Generator) -> Parts:
    """The same object of other stuff: roughness and metallic replaced, base colour tinted or replaced, at random.

    Each of the four changes is drawn on its own, so that shape and material stay independent in small collections.
    """
    new_roughness = float(generator.uniform(0.08, 0.95)) if generator.random() < 0.6 else None
    new_metallic = float(generator.random() < 0.5) if generator.random() < 0.4 else None
    tint = generator.uniform(0.3, 1.0, 3) if generator.random() < 0.5 else None
    flat_color = tuple(generator.uniform(0.02, 0.95, 3)) if generator.random() < 0.25 else None
    return [(mesh, _replaced(material, new_roughness, new_metallic, tint, flat_color)) for mesh, material in parts]


def _replaced(
    material: Material,
    roughness: float | None,
    metallic: float | None,
    tint: np.ndarray | None,
    flat_color: tuple[float, float, float] | None,
) -> Material:
    color = np.asarray(material.base_color, np.float32)
    if flat_color is not None:
        color = np.broadcast_to(np.asarray(flat_color, np.float32), color.shape)
    elif tint is not None:
        color = color * tint.astype(np.float32)
    return Material(
        np.ascontiguousarray(color),
        material.roughness if roughness is None else roughness,
        material.metallic if metallic is None else metallic,
        material.uv,
    )


def _pbr(mesh: trimesh.Trimesh) -> Any:
    return getattr(mesh.visual, "material", None)


def _is_transparent(mesh: trimesh.Trimesh) -> bool:
    material = _pbr(mesh)
    if getattr(material, "alphaMode", None) in ("BLEND", "MASK"):
        return True
    factor = getattr(material, "baseColorFactor", None)
    return factor is not None and len(factor) == 4 and int(factor[3]) < _OPAQUE


def _is_bare(mesh: trimesh.Trimesh) -> bool:
    """Whether nothing says what the mesh is made of."""
    if getattr(mesh.visual, "kind", None) == "vertex":
        return False
    material = _pbr(mesh)
    factor = getattr(material, "baseColorFactor", None)
    textures = ("baseColorTexture", "metallicRoughnessTexture")
    is_white = factor is None or bool((np.asarray(factor)[:3] == 255).all())
    return is_white and all(getattr(material, name, None) is None for name in textures)


def _material(mesh: trimesh.Trimesh) -> Material:
    material = _pbr(mesh)
    factor = getattr(material, "baseColorFactor", None)
    color = np.ones(3, np.float32) if factor is None else np.asarray(factor, np.float32)[:3] / 255
    roughness, metallic = (getattr(material, name, None) for name in ("roughnessFactor", "metallicFactor"))
    roughness = 1.0 if roughness is None else float(np.clip(roughness, 0, 1))
    metallic = 1.0 if metallic is None else float(np.clip(metallic, 0, 1))
    visual: Any = mesh.visual
    if getattr(visual, "kind", None) == "vertex":
        vertex_colors = np.asarray(visual.vertex_colors, np.float32)[:, :3] / 255
        return Material(vertex_colors, 0.5, 0.0)
    uv = getattr(visual, "uv", None)
    color_image = getattr(material, "baseColorTexture", None)
    other_image = getattr(material, "metallicRoughnessTexture", None)
    if uv is None or (color_image is None and other_image is None):
        return Material(color, roughness, metallic)
    size = color_image.size if color_image is not None else other_image.size  # type: ignore[union-attr]
    colors = np.broadcast_to(color, (size[1], size[0], 3))
    if color_image is not None:
        colors = colors * _LINEAR_FROM_BYTE[np.asarray(color_image.convert("RGB"))]
    rough_map: np.ndarray | float = roughness
    metal_map: np.ndarray | float = metallic
    if other_image is not None:
        others = np.asarray(other_image.convert("RGB").resize(size), np.float32) / 255
        rough_map, metal_map = roughness * others[..., 1], metallic * others[..., 2]
    return Material(np.clip(colors, 0, 1).astype(np.float32), rough_map, metal_map, np.asarray(uv, np.float32))


def _triangle_mesh(mesh: trimesh.Trimesh) -> TriangleMesh:
    normals = np.nan_to_num(np.asarray(mesh.vertex_normals, np.float64))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # vertices of degenerate triangles only have no normal; any unit vector keeps the shading finite
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), [0.0, 1.0, 0.0])
    return TriangleMesh(
        (np.asarray(mesh.vertices, np.float64) @ _WORLD_FROM_GLTF.T).astype(np.float32),
        np.asarray(mesh.faces, np.int32),
        (normals @ _WORLD_FROM_GLTF.T).astype(np.float32),
    )


def _in_unit_sphere(name: str, parts: Parts) -> Parts:
    used = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh, _ in parts]).astype(np.float64)
    centre = (used.min(0) + used.max(0)) / 2
    radius = np.linalg.norm(used - centre, axis=1).max()
    if not np.isfinite(radius) or radius < 1e-9:
        raise UserError(f"{name} has no extent", got=f"a bounding sphere of radius {radius:.3g}")
    return [
        (TriangleMesh(((mesh.vertices - centre) / radius).astype(np.float32), mesh.faces, mesh.vertex_normals), m)
        for mesh, m in parts
    ]
