"""What the balls and the sky show, against closed forms."""

from pathlib import Path

import numpy as np
import pytest

from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.light_preview import from_above, light_preview, matte_ball
from illuminerf.scene.named_lights import find_light

SIZE = 64


def cosine_light(axis: int, sign: float, height: int = 64) -> EnvironmentMap:
    """Radiance max(sign * direction[axis], 0)."""
    directions = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32)).directions()
    return EnvironmentMap(np.repeat(np.maximum(sign * directions[..., axis : axis + 1], 0), 3, -1))


def test_a_matte_ball_in_a_white_furnace_is_white() -> None:
    ball, alpha = matte_ball(EnvironmentMap(np.full((32, 64, 3), 0.7, np.float32)), SIZE)
    np.testing.assert_allclose(ball[alpha > 0], 0.7, rtol=4e-3)
    assert alpha.mean() == pytest.approx(np.pi / 4, abs=0.01) and not ball[alpha == 0].any()


def test_a_matte_ball_under_a_cosine_light_has_its_closed_form() -> None:
    """Facing the light, radiance is the integral of cos^2 over the hemisphere over pi: 2/3."""
    ball, _ = matte_ball(cosine_light(0, 1.0), SIZE)
    middle = ball[SIZE // 2, SIZE // 2, 0]
    assert middle == pytest.approx(2 / 3, abs=0.01)
    behind, _ = matte_ball(cosine_light(0, -1.0), SIZE)
    assert behind[SIZE // 2, SIZE // 2, 0] < 0.01, "the other side must fail"


@pytest.mark.parametrize(("axis", "sign", "place"), [(1, 1.0, (32, 57)), (1, -1.0, (32, 6)), (2, 1.0, (6, 32))])
def test_a_matte_ball_is_bright_where_its_labels_say(axis: int, sign: float, place: tuple[int, int]) -> None:
    ball, _ = matte_ball(cosine_light(axis, sign), SIZE)
    opposite = ball[SIZE - 1 - place[0], SIZE - 1 - place[1], 0]
    assert ball[place][0] > 0.5 > 5 * opposite


@pytest.mark.parametrize(("axis", "sign", "place"), [(0, 1.0, (32, 62)), (1, 1.0, (1, 32)), (0, -1.0, (32, 1))])
def test_the_sky_from_above_has_x_at_the_right_and_y_up(axis: int, sign: float, place: tuple[int, int]) -> None:
    sky, alpha = from_above(cosine_light(axis, sign), SIZE)
    assert alpha[place] == 1 and sky[place][0] > 0.95
    assert sky[SIZE - 1 - place[0], SIZE - 1 - place[1], 0] < 0.05


def test_a_positive_turn_goes_counter_clockwise_there() -> None:
    turned, _ = from_above(cosine_light(0, 1.0).rotated(np.pi / 2), SIZE)
    assert turned[1, 32, 0] > 0.95 > 0.05 > turned[62, 32, 0]


def test_a_sheet_shows_the_light() -> None:
    evening, studio = light_preview(find_light(Path("evening"))), light_preview(find_light(Path("studio")))
    assert evening.shape == studio.shape and evening.dtype == np.uint8
    assert np.abs(evening.astype(int) - studio).mean() > 10
    sun = evening[44 : 44 + 384, 44 : 44 + 768].reshape(-1, 3)
    assert sun.max(0)[0] > 240 and np.median(sun, 0).max() < 180, "the sun stands out"
