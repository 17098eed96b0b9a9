"""A flat plate with a tilted normal map shades as a plate whose normals are tilted, baked and unbaked."""

import numpy as np
import pytest
import trimesh

from illuminerf.cues.materials import Material, Parts
from illuminerf.cues.shading import ShadedScene
from illuminerf.cues.texture_baking import baked
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.workflow.errors import UserError

CAMERA = turntable_cameras(1, 4.0, 0.4, 8, 8, elevation_radians=0.0)
TILT = np.pi / 6


def light_from(direction: str) -> EnvironmentMap:
    """Light from one half of the sphere only: from above, or from +y."""
    radiance = np.full((64, 128, 3), 0.02, np.float32)
    if direction == "z":
        radiance[:32] = 1
    else:  # azimuth falls from +180 degrees at the left edge: +y is left of the middle
        radiance[:, :64] = 1
    return EnvironmentMap(radiance)


def plate(normal: np.ndarray | None, vertex_normal: np.ndarray, is_mirrored: bool = False) -> Parts:
    """A rough square in the plane x = 0 that faces +x, +y to the right and +z up, with one tangent-space normal
    everywhere; it lies on a black box, for what a bent normal reaches below the surface must not be lit."""
    corners = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    if is_mirrored:
        uv[:, 0] = 1 - uv[:, 0]
    mesh = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.tile(np.float32(vertex_normal), (4, 1)))
    color = np.full((4, 4, 3), 0.6, np.float32)
    mapped = None if normal is None else np.tile(np.float32(normal), (4, 4, 1))
    box = trimesh.creation.box((0.5, 2, 2), trimesh.transformations.translation_matrix([-0.2501, 0, 0]))
    below = TriangleMesh(*(np.asarray(a) for a in (box.vertices, box.faces, box.vertex_normals)))
    return [(mesh, Material(color, 1.0, 0.0, uv, normal_map=mapped)), (below, Material((0.0, 0.0, 0.0)))]


def shaded(parts: Parts, light: EnvironmentMap) -> tuple[float, np.ndarray]:
    """Mean radiance in the middle of the plate, and the normal there."""
    scene = ShadedScene(parts, light)
    image = scene.render(CAMERA, 0, light, 1024, 0)
    return float(image[2:6, 2:6, :3].mean()), scene.properties(CAMERA, 0)["normal"][4, 4]


@pytest.mark.parametrize("is_baked", [True, False], ids=["baked", "unbaked"])
@pytest.mark.parametrize("is_mirrored", [False, True], ids=["upright", "mirrored"])
def test_green_is_up(is_baked: bool, is_mirrored: bool) -> None:
    light, tilted = light_from("z"), np.array([np.cos(TILT), 0, np.sin(TILT)])
    wanted, _ = shaded(plate(None, tilted), light)
    flat, _ = shaded(plate(None, np.array([1.0, 0, 0])), light)
    assert abs(wanted - flat) > 0.1 * flat  # the tilt matters
    for sign in (1, -1):
        parts = plate(np.array([0, sign * np.sin(TILT), np.cos(TILT)]), np.array([1.0, 0, 0]), is_mirrored)
        found, normal = shaded(baked(parts) if is_baked else parts, light)
        if sign == 1:
            assert found == pytest.approx(wanted, rel=0.03)
            np.testing.assert_allclose(normal, tilted, atol=0.01)
        else:  # what Direct3D's green-down maps would do
            assert abs(found - wanted) > 0.2 * wanted
            assert normal[2] == pytest.approx(-np.sin(TILT), abs=0.01)


@pytest.mark.parametrize("is_baked", [True, False], ids=["baked", "unbaked"])
@pytest.mark.parametrize("is_mirrored", [False, True], ids=["upright", "mirrored"])
def test_red_is_along_u(is_baked: bool, is_mirrored: bool) -> None:
    light, toward = light_from("y"), -1.0 if is_mirrored else 1.0
    tilted = np.array([np.cos(TILT), toward * np.sin(TILT), 0])
    wanted, _ = shaded(plate(None, tilted), light)
    opposite, _ = shaded(plate(None, tilted * [1, -1, 1]), light)
    parts = plate(np.array([np.sin(TILT), 0, np.cos(TILT)]), np.array([1.0, 0, 0]), is_mirrored)
    found, normal = shaded(baked(parts) if is_baked else parts, light)
    assert found == pytest.approx(wanted, rel=0.03)
    assert abs(found - opposite) > 0.2 * wanted
    np.testing.assert_allclose(normal, tilted, atol=0.01)


def test_normals_stay_on_the_outer_side() -> None:
    """A normal that would point into the surface is bent back to it."""
    grazing = np.array([0.9999, 0, 0.0141])
    (mesh, _), _ = baked(plate(grazing, np.array([1.0, 0, 0])))
    np.testing.assert_allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1, atol=1e-5)
    assert mesh.vertex_normals[:, 0].min() > 0.04 > grazing[2]


@pytest.mark.parametrize("is_baked", [True, False], ids=["baked", "unbaked"])
def test_normals_over_the_horizon_are_laid_onto_it(is_baked: bool) -> None:
    """Seen from above, a normal that is bent far down faces away; turned round it would point into the plate."""
    bent = np.radians(80)
    parts = plate(np.array([0, -np.sin(bent), np.cos(bent)]), np.array([1.0, 0, 0]))
    camera = turntable_cameras(1, 4.0, 0.4, 8, 8, elevation_radians=np.radians(60))
    normal = ShadedScene(baked(parts) if is_baked else parts, light_from("z")).properties(camera, 0)["normal"][4, 4]
    direction = camera.image_rays(0)[1].numpy()[4, 4]
    assert abs(normal @ direction) < 0.01 and normal[0] > 0.5
    assert np.array([np.cos(bent), 0, -np.sin(bent)]) @ direction > 0.1


def test_degenerate_coordinates_leave_the_normal() -> None:
    (mesh, material), _ = plate(np.array([0, np.sin(TILT), np.cos(TILT)]), np.array([1.0, 0, 0]))
    collapsed = Material(material.base_color, 1.0, 0.0, np.zeros((4, 2), np.float32), normal_map=material.normal_map)
    ((found, _),) = baked([(mesh, collapsed)])
    np.testing.assert_allclose(found.vertex_normals, np.tile([1.0, 0, 0], (len(found.vertices), 1)), atol=1e-5)


def test_a_normal_map_needs_the_size_of_the_colours() -> None:
    with pytest.raises(UserError, match="normal map"):
        Material(np.ones((4, 4, 3)), uv=np.zeros((3, 2)), normal_map=np.ones((2, 2, 3)))
