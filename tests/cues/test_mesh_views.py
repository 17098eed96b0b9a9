"""Normals and seen surface of a sphere, and of a sphere inside another one."""

import numpy as np
import pytest

from illuminerf.cues.mesh_views import MeshScene, seen_surfels
from illuminerf.cues.shading import concatenated
from illuminerf.scene.cameras import sphere_cameras, turntable_cameras
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.errors import UserError

CAMERAS = sphere_cameras(6, 3.0, 0.6, 48, 48, np.random.default_rng(0))


def sphere_normals(size: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """True normals of a sphere of radius 0.6 in the first view, and where it is well inside its outline."""
    origins, directions = (rays.double().numpy() for rays in CAMERAS.image_rays(0))
    along = -(origins * directions).sum(-1)
    gap = (origins**2).sum(-1) - along**2
    near = along - np.sqrt(np.maximum(0.36 - gap, 0))
    return (origins + near[..., None] * directions) / 0.6, gap < 0.8 * 0.36


def test_smooth_normals_are_the_vertices_and_flat_ones_the_faces() -> None:
    truth, inside = sphere_normals()
    mesh = sphere_mesh(2, 0.6)
    smooth, coverage = MeshScene(mesh).normals(CAMERAS, 0)
    flat, _ = MeshScene(mesh, is_smooth=False).normals(CAMERAS, 0)
    assert coverage[24, 24] == 1 and coverage[0, 0] == 0 and (smooth[0, 0] == 0).all()
    assert (smooth * truth).sum(-1)[inside].min() > np.cos(np.radians(4))
    assert (flat * truth).sum(-1)[inside].min() < np.cos(np.radians(4))


def test_normals_look_at_the_camera_however_faces_are_wound() -> None:
    truth, inside = sphere_normals()
    mesh = sphere_mesh(3, 0.6)
    turned = TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), -mesh.vertex_normals)
    normals, _ = MeshScene(turned).normals(CAMERAS, 0)
    assert (normals * truth).sum(-1)[inside].min() > np.cos(np.radians(4))


def test_what_is_hidden_inside_is_not_seen() -> None:
    outer, inner = sphere_mesh(3, 0.6), sphere_mesh(3, 0.3)
    seen, _ = seen_surfels(concatenated([outer, inner]), CAMERAS, 0.05, 96)
    radius = np.linalg.norm(seen.positions, axis=-1)
    assert radius.min() > 0.58 and len(seen) > 500
    assert ((seen.positions * seen.normals).sum(-1) > 0.55).all()
    assert seen_surfels(inner, CAMERAS, 0.05, 96)[0].positions.max() < 0.31  # the guard: alone it is


def test_only_the_side_that_a_camera_sees() -> None:
    camera = turntable_cameras(1, 3.0, 0.6, 64, 64, elevation_radians=0.0)
    seen, _ = seen_surfels(sphere_mesh(3, 0.6), camera, 0.05, 64)
    assert seen.positions[:, 0].min() > 0.05
    far = TriangleMesh(sphere_mesh(1).vertices + np.float32([9, 9, 9]), sphere_mesh(1).faces, sphere_mesh(1).vertices)
    with pytest.raises(UserError, match="no camera sees"):
        seen_surfels(far, camera, 0.05, 64)
