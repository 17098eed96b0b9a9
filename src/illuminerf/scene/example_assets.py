"""A few objects and lights from formulas, as files: enough to try the training-data factory without any download."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from illuminerf.scene.images import linear_from_srgb, to_uint8
from illuminerf.scene.meshes import GLTF_FROM_WORLD, TriangleMesh, sphere_mesh
from illuminerf.scene.named_lights import NAMED_LIGHTS
from illuminerf.scene.procedural import ProceduralObject, duck_still_life
from illuminerf.workflow.atomic import write_bytes

_STILL_LIFE_NAMES = ("duck", "board", "ball", "cup")


def write_example_assets(folder: Path, resolution: int = 96, light_height: int = 128) -> tuple[Path, Path]:
    """Write `objects/*.glb` and `lights/*.exr` into a folder.

    Objects: a duck, a wooden board, a metal ball and a striped cup with colours per vertex, a torus with textures, and
    a pebble without any material. Lights: studio, evening, lamps, overcast.

    Args:
        folder: created.
        resolution: cells per axis that the shapes are meshed at.
        light_height: rows of the lights.

    Returns:
        The two folders.
    """
    objects, lights = folder / "objects", folder / "lights"
    for name, item in zip(_STILL_LIFE_NAMES, duck_still_life(resolution), strict=True):
        write_bytes(objects / f"{name}.glb", _colored_glb(item))
    write_bytes(objects / "torus.glb", _textured_torus_glb())
    write_bytes(objects / "pebble.glb", _glb(_pebble(), ColorVisuals()))
    for name, light in NAMED_LIGHTS.items():
        light.make(light_height).save(lights / f"{name}.exr")
    return objects, lights


def _colored_glb(item: ProceduralObject) -> bytes:
    """Colours per vertex and one roughness and metalness."""
    assert item.mesh.vertex_colors is not None
    visual = TextureVisuals(
        material=PBRMaterial(
            baseColorFactor=[1.0, 1.0, 1.0, 1.0], roughnessFactor=item.roughness, metallicFactor=item.metallic
        )
    )
    colors = to_uint8(linear_from_srgb(item.mesh.vertex_colors))
    visual.vertex_attributes["color"] = np.concatenate([colors, np.full((len(colors), 1), 255, np.uint8)], -1)
    return _glb(item.mesh, visual)


def _textured_torus_glb(steps: int = 64) -> bytes:
    """Checkers of two colours and two roughnesses, as images."""
    around, across = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * steps + 1), np.linspace(0, 2 * np.pi, steps + 1))
    normals = np.stack([np.cos(across) * np.cos(around), np.cos(across) * np.sin(around), np.sin(across)], -1)
    ring = np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], -1)
    index = np.arange(around.size).reshape(around.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    row, column = np.indices((128, 256))
    is_red = (row // 16 + column // 16) % 2 == 1
    color = np.where(is_red[..., None], [225, 120, 88], [108, 158, 216]).astype(np.uint8)
    packed = np.stack([np.zeros_like(row), np.where(is_red, 64, 153), np.zeros_like(row)], -1).astype(np.uint8)
    visual = TextureVisuals(
        uv=np.stack([around, across], -1).reshape(-1, 2) / (2 * np.pi),
        material=PBRMaterial(
            baseColorTexture=Image.fromarray(color),
            metallicRoughnessTexture=Image.fromarray(packed),
            roughnessFactor=1.0,
            metallicFactor=1.0,
        ),
    )
    flat = [array.reshape(-1, 3).astype(np.float32) for array in (0.62 * ring + 0.34 * normals, normals)]
    return _glb(TriangleMesh(flat[0], faces.astype(np.int32), flat[1]), visual)


def _pebble() -> TriangleMesh:
    sphere = sphere_mesh(5)
    radii = np.array([0.9, 0.7, 0.45], np.float32)
    normals = sphere.vertex_normals / radii
    return TriangleMesh(
        sphere.vertices * radii, sphere.faces, normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    )


def _glb(mesh: TriangleMesh, visual: ColorVisuals | TextureVisuals) -> bytes:
    turned = trimesh.Trimesh(
        mesh.vertices @ GLTF_FROM_WORLD.T,
        mesh.faces,
        vertex_normals=mesh.vertex_normals @ GLTF_FROM_WORLD.T,
        process=False,
    )
    turned.visual = visual
    return bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(turned), include_normals=True))
