"""Shaded objects: energy, colours and properties against what the materials say."""

import numpy as np
import pytest

from illuminerf.cues.materials import Material
from illuminerf.cues.shading import ShadedScene, concatenated, render_shaded
from illuminerf.scene.cameras import Cameras, turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import linear_from_srgb
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.errors import UserError

WHITE = EnvironmentMap(np.ones((16, 32, 3), np.float32))
ONE_VIEW: Cameras = turntable_cameras(1, 3.0, 0.7, 32, 32)


def moved(mesh: TriangleMesh, x: float, y: float, scale: float = 0.4) -> TriangleMesh:
    vertices = (mesh.vertices * scale + [x, y, 0]).astype(np.float32)
    return TriangleMesh(vertices, mesh.faces, mesh.vertex_normals)


def quad(color: np.ndarray) -> tuple[TriangleMesh, Material]:
    """A square in the plane x = 0 that faces +x, its picture upright with +y to the right."""
    corners = [[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    mesh = TriangleMesh(
        np.array(corners, np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.tile(np.float32([1, 0, 0]), (4, 1)),
    )
    size = color.shape[:2]
    return mesh, Material(color, np.full(size, 0.25, np.float32), np.zeros(size, np.float32), uv)


def test_two_materials_keep_their_properties() -> None:
    """From +x, +y is on the right: a rough red ball left, a smooth metallic blue one right."""
    ball = sphere_mesh(3)
    red, blue = Material((0.8, 0.1, 0.05), 0.9, 0.0), Material((0.1, 0.2, 0.7), 0.2, 1.0)
    scene = ShadedScene([(moved(ball, 0, -0.5), red), (moved(ball, 0, 0.5), blue)], WHITE)
    camera = turntable_cameras(1, 3.0, 0.7, 32, 32, elevation_radians=0.0)
    found = scene.properties(camera, 0)
    left, right = (16, 8), (16, 24)
    np.testing.assert_allclose(found["base_color"][left], red.base_color, atol=1e-3)
    np.testing.assert_allclose(found["base_color"][right], blue.base_color, atol=1e-3)
    assert found["roughness"][left] == pytest.approx(0.9, abs=1e-3)
    assert found["metallic"][right] == pytest.approx(1.0, abs=1e-3)
    assert found["coverage"][left] == 1 and found["coverage"][0, 0] == 0
    assert found["normal"][left] @ [1, 0, 0] > 0.95
    np.testing.assert_allclose(np.linalg.norm(found["normal"][found["coverage"] > 0], axis=-1), 1, atol=1e-4)


def test_rough_dielectric_in_a_furnace_shows_its_colour() -> None:
    views = render_shaded([(sphere_mesh(3), Material((0.6, 0.3, 0.1), 1.0, 0.0))], ONE_VIEW, WHITE, 64)
    centre = linear_from_srgb(views.srgb[0, 12:20, 12:20]).mean((0, 1))
    # about 4% of the light is reflected at the surface on top
    np.testing.assert_allclose(centre, [0.6, 0.3, 0.1], atol=0.07)
    assert centre[0] > 1.5 * centre[1] > 3 * centre[2]
    assert views.alpha[0, 16, 16] == 1 and views.alpha[0, 0, 0] == 0 and (views.srgb[0, 0, 0] == 0).all()


def test_shaded_views_are_deterministic() -> None:
    parts = [(sphere_mesh(2), Material())]
    first, second = (render_shaded(parts, ONE_VIEW, WHITE, 4, seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.srgb, second.srgb)
    assert (render_shaded(parts, ONE_VIEW, WHITE, 4, seed=6).srgb != first.srgb).any()


def test_textures_stand_upright() -> None:
    color = np.full((8, 8, 3), 0.05, np.float32)
    color[:4, :4] = [0.9, 0.0, 0.0]  # red in the picture's upper left
    scene = ShadedScene([quad(color)], WHITE)
    camera = turntable_cameras(1, 4.0, 0.5, 32, 32, elevation_radians=0.0)
    found = scene.properties(camera, 0)["base_color"][..., 0]
    assert found[8, 8] > 0.8
    assert max(found[8, 24], found[24, 8], found[24, 24]) < 0.1
    assert scene.properties(camera, 0)["roughness"][8, 8] == pytest.approx(0.25, abs=1e-3)


def test_concatenated_keeps_every_triangle() -> None:
    first, second = sphere_mesh(1), moved(sphere_mesh(0), 2, 0)
    both = concatenated([first, second])
    assert len(both.faces) == len(first.faces) + len(second.faces)
    np.testing.assert_array_equal(both.vertices[both.faces[len(first.faces) :]], second.vertices[second.faces])


def test_materials_are_checked() -> None:
    with pytest.raises(UserError, match="base_color"):
        Material((1.5, 0.0, 0.0))
    with pytest.raises(UserError, match="roughness"):
        Material(roughness=-0.1)
    with pytest.raises(UserError, match="uv"):
        Material(np.ones((2, 2, 3), np.float32))
