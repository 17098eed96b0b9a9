"""Camera-frame light maps in our world, on closed forms: a lamp in a known direction."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from illuminerf.data.orb_lights import camera_light, load_light, most_typical, typical_view, world_light, write_light
from illuminerf.data.stanford_orb import novel_views, own_views
from illuminerf.scene.cameras import look_at
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import write_rgb_exr
from illuminerf.workflow.errors import UserError
from tests.data.written_orb import write_orb

POSES = [look_at(np.array(place, float), np.zeros(3)) for place in ([3, 0, 0], [0, -2, 1.0], [-1, 1, -2])]
AXES = {"behind": [0, 0, 1], "front": [0, 0, -1], "right": [1, 0, 0], "left": [-1, 0, 0], "up": [0, 1, 0]}


def camera_lamp(direction: np.ndarray, height: int = 32) -> EnvironmentMap:
    """One bright pixel by the benchmark's own formula: u = (atan2(x, -z) + pi) / 2 pi, v = acos(y) / pi."""
    x, y, z = direction
    u, v = (np.arctan2(x, -z) + np.pi) / (2 * np.pi), np.arccos(np.clip(y, -1, 1)) / np.pi
    image = np.full((height, 2 * height, 3), 1e-3, np.float32)
    image[min(int(v * height), height - 1), int(u * 2 * height) % (2 * height)] = 50
    return EnvironmentMap(image)


def brightest(light: EnvironmentMap) -> np.ndarray:
    return light.directions().reshape(-1, 3)[light.linear_rgb.sum(-1).argmax()]


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", AXES)
def test_a_lamp_beside_the_camera_is_where_it_is_in_the_world(pose: np.ndarray, name: str) -> None:
    direction = np.array(AXES[name], float)
    found = brightest(world_light(camera_lamp(direction), pose))
    rotation = pose[:3, :3]
    np.testing.assert_allclose(found, rotation @ direction, atol=0.15)


def test_other_conventions_put_the_lamp_elsewhere() -> None:
    rotation, direction = POSES[1][:3, :3], np.array([0.6, 0.48, -0.64])
    found = brightest(world_light(camera_lamp(direction), POSES[1]))
    np.testing.assert_allclose(found, rotation @ direction, atol=0.15)
    mirrored, behind = direction * [-1, 1, 1], direction * [1, 1, -1]
    for wrong in (rotation.T @ direction, rotation @ mirrored, rotation @ behind):
        assert np.linalg.norm(found - wrong) > 0.3


def test_what_the_camera_sees_is_in_the_middle_of_its_map() -> None:
    """A lamp in the world where the camera looks."""
    light = EnvironmentMap(np.full((32, 64, 3), 1e-3, np.float32))
    forward = -POSES[0][:3, 2]
    image = light.linear_rgb.copy()
    image[(light.directions() @ forward) > 0.98] = 50
    seen = camera_light(EnvironmentMap(image), POSES[0]).linear_rgb.sum(-1)
    rows, columns = np.nonzero(seen > 50)
    assert abs(rows.mean() - 15.5) < 1 and abs(columns.mean() - 31.5) < 1


def test_to_the_camera_and_back() -> None:
    directions = EnvironmentMap(np.ones((32, 64, 3), np.float32)).directions()
    light = EnvironmentMap((1.5 + directions).astype(np.float32))
    back = world_light(camera_light(light, POSES[2]), POSES[2])
    np.testing.assert_allclose(back.linear_rgb, light.linear_rgb, atol=0.02)
    assert np.abs(world_light(camera_light(light, POSES[2]), POSES[1]).linear_rgb - light.linear_rgb).max() > 0.5


def test_a_turn_about_the_vertical_is_that_of_rotated() -> None:
    directions = EnvironmentMap(np.ones((24, 48, 3), np.float32)).directions()
    light = EnvironmentMap(np.exp(directions).astype(np.float32))
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    np.testing.assert_allclose(light.turned(turn).linear_rgb, light.rotated(0.7).linear_rgb, atol=0.03)
    assert np.abs(light.turned(turn.T).linear_rgb - light.rotated(0.7).linear_rgb).max() > 0.3


def test_turning_keeps_constants_and_the_energy_of_lamps() -> None:
    light = EnvironmentMap(np.full((32, 64, 3), 0.4, np.float32))
    image = light.linear_rgb.copy()
    image[9:12, 20:24] = 200
    lit, errors, errors_of_few_samples = EnvironmentMap(image), [], []
    for seed in range(3):
        turn = Rotation.random(random_state=seed).as_matrix()
        np.testing.assert_allclose(light.turned(turn).linear_rgb, 0.4, rtol=1e-5)
        few = lit.radiance(lit.directions() @ turn.astype(np.float32))[::4, ::4].repeat(4, 0).repeat(4, 1)
        for turned, found in ((lit.turned(turn), errors), (EnvironmentMap(few), errors_of_few_samples)):
            found.append(float(np.abs(turned.mean_radiance() / lit.mean_radiance() - 1).max()))
    assert max(errors) < 0.03 < max(errors_of_few_samples)


def test_values_that_no_light_has_count_as_dark(tmp_path: Path) -> None:
    root = write_orb(tmp_path / "orb")
    view = own_views(root, "cup_scene001")[0]
    image = np.full((8, 16, 3), 2.0, np.float32)
    image[0], image[1, 3] = np.nan, -4
    write_rgb_exr(root / "ground_truth" / "cup_scene001" / "env_map" / "0003.exr", image, half=False)
    light = load_light(root, view)
    assert light.linear_rgb.min() >= 0 and light.linear_rgb.max() <= 2.0001
    assert load_light(root, view, max_height=4).linear_rgb.shape == (4, 8, 3)


def test_the_most_typical_map_is_not_the_odd_one() -> None:
    directions = EnvironmentMap(np.ones((16, 32, 3), np.float32)).directions()
    lights = [EnvironmentMap(np.exp(directions + shift).astype(np.float32)) for shift in (0.0, 0.1, 0.2, 3.0)]
    assert most_typical(lights) == 1
    assert most_typical(lights[::-1]) == 2


def test_every_capture_gets_the_same_map_of_a_target(tmp_path: Path) -> None:
    root = write_orb(tmp_path / "orb")
    views = novel_views(root, "cup_scene001")["cup_scene002"]
    assert typical_view(root, "cup_scene002", views) == typical_view(
        root, "cup_scene002", own_views(root, "cup_scene002")
    )
    with pytest.raises(UserError, match="lacks a view"):
        typical_view(root, "duck_scene001", [*own_views(root, "duck_scene001"), *_renamed(root)])


def _renamed(root: Path) -> list:  # type: ignore[type-arg]
    path = root / "blender_HDR" / "duck_scene003" / "transforms_test.json"
    path.write_text(path.read_text().replace("0011", "0099"))
    return own_views(root, "duck_scene003")


def test_a_light_is_made_once_and_again_where_its_source_has_changed(tmp_path: Path) -> None:
    root = write_orb(tmp_path / "orb")
    view, out = own_views(root, "cup_scene001")[0], tmp_path / "light.exr"
    write_light(root, view, 8, out)
    first, made = out.read_bytes(), out.stat().st_mtime_ns
    write_light(root, view, 8, out)
    assert out.stat().st_mtime_ns == made
    write_light(root, own_views(root, "cup_scene001")[1], 8, out)
    assert out.read_bytes() != first
