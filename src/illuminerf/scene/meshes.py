"""Triangle meshes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from illuminerf.scene.images import linear_from_srgb, to_uint8
from illuminerf.workflow.atomic import write_bytes
from illuminerf.workflow.errors import UserError

# glTF is y-up: (x, y, z) of our z-up world is written as (x, z, -y)
GLTF_FROM_WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)


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
        """Write binary glTF 2.0, turned to its y-up axes, atomically; normals and colours are kept."""
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
        write_bytes(path, trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True))

    @staticmethod
    def load_glb(path: Path) -> "TriangleMesh":
        """Read a binary glTF as one mesh, turned back to our z-up axes.

        Raises:
            UserError: missing, unreadable or empty.
        """
        if not Path(path).is_file():
            raise UserError(f"{path} is missing", wanted="a .glb mesh")
        try:
            scene = trimesh.load_scene(str(path), file_type="glb", process=False)
            placed = [_placed(scene, node) for node in scene.graph.nodes_geometry]
        except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
            raise UserError(f"{path} is not a readable GLB mesh", got=str(error), fix="export it again") from error
        parts = [part for part in placed if part is not None]
        if not parts:
            raise UserError(f"{path} holds no triangles")
        firsts: np.ndarray = np.cumsum(np.array([0, *(len(vertices) for vertices, _, _ in parts[:-1])]))
        return TriangleMesh(
            np.concatenate([vertices for vertices, _, _ in parts]),
            np.concatenate([faces + first for (_, faces, _), first in zip(parts, firsts, strict=True)]).astype(
                np.int32
            ),
            np.concatenate([normals for _, _, normals in parts]),
        )


def _placed(scene: trimesh.Scene, node: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Vertices, faces and normals of one node in our world, or None where it has no triangles."""
    transform, name = scene.graph[node]
    mesh = scene.geometry[name]
    if not isinstance(mesh, trimesh.Trimesh):
        return None
    normal_transform = np.linalg.inv(transform[:3, :3]).T
    vertices = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
    normals = mesh.vertex_normals @ normal_transform.T
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    turned = [np.ascontiguousarray(array @ GLTF_FROM_WORLD, np.float32) for array in (vertices, normals)]
    return turned[0], np.asarray(mesh.faces, np.int64), turned[1]


def sphere_mesh(subdivisions: int = 4, radius: float = 1.0) -> TriangleMesh:
    """An icosphere about the origin with exact normals."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices = np.asarray(sphere.vertices, np.float32)
    return TriangleMesh(vertices, np.asarray(sphere.faces, np.int32), vertices / np.float32(radius))
