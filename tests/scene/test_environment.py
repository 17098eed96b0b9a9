from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from illuminerf.scene.environment import EnvironmentMap, chrome_ball
from illuminerf.scene.images import write_rgb_exr
from illuminerf.workflow.errors import UserError


def random_light(height: int = 16) -> EnvironmentMap:
    image = np.random.default_rng(0).uniform(0, 2, (height, 2 * height, 3)).astype(np.float32)
    return EnvironmentMap(image)


def lamp(azimuth: float, elevation: float, height: int = 32) -> EnvironmentMap:
    """One bright pixel in the given direction."""
    image = np.full((height, 2 * height, 3), 1e-3, np.float32)
    row = int((np.pi / 2 - elevation) / np.pi * height)
    column = int((np.pi - azimuth) / (2 * np.pi) * 2 * height)
    image[row, column] = 100
    return EnvironmentMap(image)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


def brightest(light: EnvironmentMap) -> np.ndarray:
    flat = light.linear_rgb.sum(-1).argmax()
    return light.directions().reshape(-1, 3)[flat]


def test_look_up_at_pixel_centres_gives_the_pixels() -> None:
    light = random_light()
    np.testing.assert_allclose(light.radiance(light.directions()), light.linear_rgb, atol=2e-5)


def test_axes_as_documented() -> None:
    light = random_light()
    np.testing.assert_allclose(light.directions()[0, 0, 2], 1, atol=0.01)  # first row is up
    middle = light.directions()[8, 15:17].mean(0)
    np.testing.assert_allclose(middle, [1, 0, 0], atol=0.15)  # the middle of the map is +x
    assert light.directions()[8, 8, 1] > 0.9  # a quarter from the left is +y


@pytest.mark.parametrize("turn", [0.5, np.pi / 2, -2.0])
def test_rotation_turns_counter_clockwise_from_above(turn: float) -> None:
    turned = brightest(lamp(0.3, 0.4).rotated(turn))
    np.testing.assert_allclose(turned, direction(0.3 + turn, 0.4), atol=0.15)
    assert np.linalg.norm(turned - direction(0.3 - turn, 0.4)) > 0.3, "the other sense must fail"


def test_a_full_turn_changes_nothing() -> None:
    np.testing.assert_allclose(random_light().rotated(2 * np.pi).linear_rgb, random_light().linear_rgb, atol=1e-5)


def test_solid_angles_cover_the_sphere_and_a_constant_light_has_its_mean() -> None:
    light = EnvironmentMap(np.full((16, 32, 3), 0.7, np.float32))
    assert light.solid_angles().sum() * 32 == pytest.approx(4 * np.pi)
    np.testing.assert_allclose(light.mean_radiance(), 0.7, rtol=1e-6)


def test_resizing_keeps_the_energy_of_lamps() -> None:
    before, after = lamp(0.3, 0.0), lamp(0.3, 0.0).resized(8)
    assert after.linear_rgb.mean() == pytest.approx(before.linear_rgb.mean(), rel=1e-5)


def test_chrome_ball_mirrors_what_is_behind_the_camera_in_its_middle() -> None:
    ball, alpha = chrome_ball(lamp(0.0, 0.02), 65)
    assert ball[32, 32].max() > 1
    assert alpha[0, 0] == 0
    right, _ = chrome_ball(lamp(np.pi / 2, 0.02), 65)
    assert right[32, 33:].max() > 1 > right[32, :32].max(), "a lamp at +y shows on the right, seen from +x"


def test_files_round_trip(tmp_path: Path) -> None:
    random_light().save(tmp_path / "light.exr")
    np.testing.assert_array_equal(EnvironmentMap.load(tmp_path / "light.exr").linear_rgb, random_light().linear_rgb)


def test_ldr_is_decoded_with_a_warning(tmp_path: Path) -> None:
    Image.fromarray(np.full((8, 16, 3), 188, np.uint8)).save(tmp_path / "light.png")
    with pytest.warns(UserWarning, match="low dynamic range"):
        light = EnvironmentMap.load(tmp_path / "light.png")
    np.testing.assert_allclose(light.linear_rgb, 0.5, atol=0.01)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda image: image[:, :-1], "not an equirectangular"),
        (lambda image: np.where(image > 1.9, np.nan, image), "NaN"),
        (lambda image: np.where(image > 1.9, np.inf, image), "infinite"),
        (lambda image: np.where(image > 1.9, -1.0, image), "negative"),
        (lambda image: image * 0, "all black"),
    ],
)
def test_impossible_lights_are_refused(tmp_path: Path, damage, message: str) -> None:  # type: ignore[no-untyped-def]
    image = damage(random_light().linear_rgb).astype(np.float32)
    if np.isfinite(image).all():
        write_rgb_exr(tmp_path / "light.exr", image, half=False)
        with pytest.raises(UserError, match=message):
            EnvironmentMap.load(tmp_path / "light.exr")
    with pytest.raises(UserError, match=message):
        EnvironmentMap(image)


def test_a_resampling_filters_undershoot_is_clipped(tmp_path: Path) -> None:
    image = random_light().linear_rgb.copy()
    image[3, 3] = -0.01
    write_rgb_exr(tmp_path / "light.exr", image, half=False)
    assert EnvironmentMap.load(tmp_path / "light.exr").linear_rgb.min() == 0


@pytest.mark.parametrize("name", ["absent.exr", "notes.txt", "broken.exr", "broken.hdr", "broken.png"])
def test_unreadable_lights_are_refused(tmp_path: Path, name: str) -> None:
    if not name.startswith("absent"):
        (tmp_path / name).write_bytes(b"\x76\x2f\x31\x01 this is no picture")
    with pytest.raises(UserError, match="Fix|wanted"):
        EnvironmentMap.load(tmp_path / name)


@pytest.mark.parametrize("height", [4, 10, 16, 24, 37])
def test_any_height_keeps_the_energy(height: int) -> None:
    light = random_light(16)
    resized = light.resized(height)
    assert resized.linear_rgb.shape == (height, 2 * height, 3)
    np.testing.assert_allclose(resized.linear_rgb.mean((0, 1)), light.linear_rgb.mean((0, 1)), rtol=1e-5)
    assert abs(light.linear_rgb[::3].mean() - light.linear_rgb.mean()) > 1e-4  # mere sampling would not


def test_doubling_repeats_every_pixel() -> None:
    light = random_light(16)
    np.testing.assert_allclose(light.resized(32).linear_rgb, light.linear_rgb.repeat(2, 0).repeat(2, 1), rtol=1e-6)
