"""Triangle meshes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from illuminerf.scene.images import linear_from_srgb, to_uint8
from illuminerf.scene.mesh_claims import check_claims
from illuminerf.workflow.atomic import write_bytes
from illuminerf.workflow.errors import UserError

# glTF is y-up: (x, y, z) of our z-up world is written as (x, z, -y)
GLTF_FROM_WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
UpAxis = Literal["auto", "y", "z"]
_CLAY = PBRMaterial(name="clay", baseColorFactor=[0.6, 0.6, 0.6, 1.0], metallicFactor=0.0, roughnessFactor=1.0)


@dataclass(frozen=True)
class TriangleMesh:
    """A mesh with one shading normal per vertex.

    Attributes:
        vertices: float32 [vertices, 3], world.
        faces: int32 [faces, 3], counter-clockwise seen from outside.
        vertex_normals: float32 [vertices, 3], unit.
        vertex_colors: float32 [vertices, 3] sRGB in [0, 1], or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    vertex_normals: np.ndarray
    vertex_colors: np.ndarray | None = None

    def __post_init__(self) -> None:
        if len(self.vertices) == 0 or len(self.faces) == 0:
            raise UserError("the mesh is empty", got=f"{len(self.vertices)} vertices, {len(self.faces)} faces")
        if not np.isfinite(self.vertices).all() or not np.isfinite(self.vertex_normals).all():
            raise UserError("the mesh has NaN or infinite vertices or normals", fix="repair the mesh")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise UserError("the mesh has faces that name vertices it does not have")

    def save_glb(self, path: Path) -> None:
        """Write binary glTF 2.0, turned to its y-up axes, atomically; normals and colours are kept, and what
        has no colours is grey."""
        colors = None
        if self.vertex_colors is not None:
            colors = to_uint8(linear_from_srgb(self.vertex_colors))  # glTF vertex colours are linear
        mesh = trimesh.Trimesh(
            self.vertices @ GLTF_FROM_WORLD.T,
            self.faces,
            vertex_normals=self.vertex_normals @ GLTF_FROM_WORLD.T,
            vertex_colors=colors,
            process=False,
        )
        if self.vertex_colors is None:  # what has no material is a metal in glTF, and black where nothing surrounds it
            mesh.visual = TextureVisuals(material=_CLAY)
        write_bytes(path, trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True))

    @staticmethod
    def load_glb(path: Path) -> "TriangleMesh":
        """Read a binary glTF as one mesh, turned back to our z-up axes.

        Raises:
            UserError: missing, unreadable or empty.
        """
        return _loaded(path, "glb", GLTF_FROM_WORLD)

    @staticmethod
    def load(path: Path, up_axis: UpAxis = "auto") -> "TriangleMesh":
        """Read a .glb, .gltf, .obj or .ply file as one mesh; normals that it lacks are averaged over faces.

        Args:
            path: the file.
            up_axis: of the file; "y" is turned to our z-up axes. "auto": y for glTF, z for the others.

        Raises:
            UserError: missing, of another kind, unreadable or empty.
        """
        suffix = Path(path).suffix.lower().removeprefix(".")
        if suffix not in ("glb", "gltf", "obj", "ply"):
            raise UserError("not a mesh file", got=str(path), wanted=".glb, .gltf, .obj or .ply")
        is_y_up = up_axis == "y" or (up_axis == "auto" and suffix in ("glb", "gltf"))
        return _loaded(path, suffix, GLTF_FROM_WORLD if is_y_up else np.eye(3, dtype=np.float32))


def _loaded(path: Path, kind: str, file_from_world: np.ndarray) -> TriangleMesh:
    if not Path(path).is_file():
        raise UserError(f"{path} is missing", wanted=f"a .{kind} mesh")
    check_claims(path, kind)
    try:
        scene = trimesh.load_scene(str(path), file_type=kind, process=False, skip_materials=True)
        placed = [_placed(scene, node, file_from_world) for node in scene.graph.nodes_geometry]
    except Exception as error:  # what broken files make of the library, no list foresees
        raise UserError(
            f"{path} is not a readable {kind.upper()} mesh", got=str(error), fix="export it again"
        ) from error
    parts = [part for part in placed if part is not None]
    if not parts:
        raise UserError(f"{path} holds no triangles")
    firsts: np.ndarray = np.cumsum(np.array([0, *(len(vertices) for vertices, _, _ in parts[:-1])]))
    return TriangleMesh(
        np.concatenate([vertices for vertices, _, _ in parts]),
        np.concatenate([faces + first for (_, faces, _), first in zip(parts, firsts, strict=True)]).astype(np.int32),
        np.concatenate([normals for _, _, normals in parts]),
    )


def _placed(
    scene: trimesh.Scene, node: str, file_from_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Vertices, faces and normals of one node in our world, or None where it has no triangles."""
    transform, name = scene.graph[node]
    mesh = scene.geometry[name]
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return None
    normal_transform = np.linalg.inv(transform[:3, :3]).T
    vertices = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
    normals = mesh.vertex_normals @ normal_transform.T
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    turned = [np.ascontiguousarray(array @ file_from_world, np.float32) for array in (vertices, normals)]
    return turned[0], np.asarray(mesh.faces, np.int64), turned[1]


def sphere_mesh(subdivisions: int = 4, radius: float = 1.0) -> TriangleMesh:
    """An icosphere about the origin with exact normals."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices = np.asarray(sphere.vertices, np.float32)
    return TriangleMesh(vertices, np.asarray(sphere.faces, np.int32), vertices / np.float32(radius))
