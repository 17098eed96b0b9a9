"""Drawn lights: shift, flip and scale do what their record says, and conserve what they should."""

import numpy as np
import pytest

from illuminerf.cues.training_lights import LightVariation, draw_light
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.workflow.errors import UserError


def mean_radiance(light: EnvironmentMap) -> float:
    return float(light.mean_radiance().mean())


@pytest.fixture
def light() -> EnvironmentMap:
    return EnvironmentMap(np.random.default_rng(0).random((16, 32, 3)).astype(np.float32), "noise")


def test_mean_radiance_weights_by_solid_angle() -> None:
    upper = np.zeros((64, 128, 3), np.float32)
    upper[:16] = 1  # elevations over 45 degrees: (1 - cos 45) / 2 of the sphere
    assert mean_radiance(EnvironmentMap(upper)) == pytest.approx((1 - np.sqrt(0.5)) / 2, abs=1e-6)
    assert upper.mean() != pytest.approx((1 - np.sqrt(0.5)) / 2, abs=1e-2)


@pytest.mark.parametrize(("exposure", "wanted"), [(-6.0, 0.25), (6.0, 1.5)])
def test_brightness_comes_into_range(light: EnvironmentMap, exposure: float, wanted: float) -> None:
    drawn, draw = draw_light(light.exposed(exposure), np.random.default_rng(1), LightVariation())
    assert mean_radiance(drawn) == pytest.approx(wanted, rel=1e-4)
    assert draw.scale != 1


def test_usable_lights_keep_their_brightness(light: EnvironmentMap) -> None:
    drawn, draw = draw_light(light, np.random.default_rng(1), LightVariation(flip_probability=0.0))
    assert draw.scale == 1 and not draw.is_flipped
    assert mean_radiance(drawn) == pytest.approx(mean_radiance(light), rel=1e-5)


def test_the_record_tells_how_to_make_the_light_again(light: EnvironmentMap) -> None:
    for seed in range(6):
        drawn, draw = draw_light(light, np.random.default_rng(seed), LightVariation(shuffle_probability=0.8))
        again = light.rotated(draw.rotation_radians).linear_rgb[..., draw.permutation] * draw.scale
        np.testing.assert_allclose(drawn.linear_rgb, again[::-1] if draw.is_flipped else again, rtol=1e-5)
        # whole columns only: the very values, in another order
        np.testing.assert_allclose(
            np.sort(drawn.linear_rgb, None), np.sort(light.linear_rgb * draw.scale, None), rtol=1e-5
        )


def test_a_flip_turns_the_light_upside_down() -> None:
    image = np.ones((16, 32, 3), np.float32)
    image[:4] = 3
    drawn, draw = draw_light(EnvironmentMap(image), np.random.default_rng(0), LightVariation(flip_probability=1.0))
    assert draw.is_flipped
    assert drawn.radiance(np.array([[0.0, 0.0, -1.0]]))[0, 0] > 2 * drawn.radiance(np.array([[0.0, 0.0, 1.0]]))[0, 0]


def test_shuffled_colours_are_each_order_alike(light: EnvironmentMap) -> None:
    orders = [
        draw_light(light, np.random.default_rng(seed), LightVariation(shuffle_probability=1.0))[1].permutation
        for seed in range(120)
    ]
    assert {orders.count(order) > 5 for order in set(orders)} == {True} and len(set(orders)) == 6
    plain = LightVariation(shifts=False, flip_probability=0.0, shuffle_probability=0.0)
    drawn, draw = draw_light(light, np.random.default_rng(0), plain)
    assert draw.permutation == (0, 1, 2) and draw.rotation_radians == 0
    np.testing.assert_array_equal(drawn.linear_rgb, light.linear_rgb)


def test_wrong_settings_are_explained() -> None:
    with pytest.raises(UserError, match="got 1.5 and 0.5; wanted values in"):
        LightVariation(flip_probability=1.5)
    with pytest.raises(UserError, match="got 2 to 1.5; wanted 0 < lowest"):
        LightVariation(lowest_mean_radiance=2.0)
