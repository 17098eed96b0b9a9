"""Reprojection between views: closed cases on a textured sphere and plane that a formula renders."""

import numpy as np
import pytest

from illuminerf.evaluation.consistency import (
    Surface,
    match,
    mean_difference,
    neighbours,
    root_mean,
    squared_errors,
)
from illuminerf.fields.bounds import ball_interval
from illuminerf.scene.cameras import Cameras, turntable_cameras

SIZE = 96
RADIUS = 0.6
BOUND = 0.01


def texture(points: np.ndarray) -> np.ndarray:
    return 0.5 + 0.4 * np.sin(6 * points + np.array([0, 1, 2]))


def sphere_view(cameras: Cameras, view: int) -> tuple[Surface, np.ndarray]:
    origins, directions = (rays.reshape(-1, 3) for rays in cameras.image_rays(view))
    near, far = ball_interval(origins, directions, RADIUS)
    hit, shape = (far > near).numpy(), (cameras.height, cameras.width)
    points = (origins + near[:, None] * directions).numpy()
    image = np.where(hit[:, None], texture(points), 0).reshape(*shape, 3)
    return Surface(near.numpy().reshape(shape), hit.reshape(shape)), image


def plane_view(cameras: Cameras, view: int) -> tuple[Surface, np.ndarray]:
    """The plane z = 0, seen from above."""
    origins, directions = (rays.numpy() for rays in cameras.image_rays(view))
    distance = -origins[..., 2] / directions[..., 2]
    points = origins + distance[..., None] * directions
    return Surface(distance, np.linalg.norm(points, axis=-1) < 0.8), texture(points)


@pytest.fixture(params=[sphere_view, plane_view])
def pair(request: pytest.FixtureRequest) -> tuple[Cameras, tuple[Surface, Surface], tuple[np.ndarray, np.ndarray]]:
    cameras = turntable_cameras(20, 2.5, 0.7, SIZE, SIZE, 0.9)
    (first, one), (second, other) = (request.param(cameras, view) for view in (0, 1))
    return cameras, (first, second), (one, other)


def test_the_same_texture_agrees_and_a_shifted_one_does_not(
    pair: tuple[Cameras, tuple[Surface, Surface], tuple[np.ndarray, np.ndarray]],
) -> None:
    cameras, surfaces, (one, other) = pair
    matches = match(cameras, (0, 1), surfaces, 0.02)
    assert len(matches.pixel) > 0.6 * surfaces[0].mask.sum()
    exact = root_mean([squared_errors(one, other, matches)])
    shifted = root_mean([squared_errors(one, np.roll(other, 3, axis=1), matches)])
    assert exact is not None and shifted is not None
    assert exact < BOUND < 3 * BOUND < shifted


def test_a_constant_offset_is_measured_as_it_is(
    pair: tuple[Cameras, tuple[Surface, Surface], tuple[np.ndarray, np.ndarray]],
) -> None:
    cameras, surfaces, _ = pair
    matches = match(cameras, (0, 1), surfaces, 0.02)
    grey = np.full((SIZE, SIZE, 3), 0.5)
    assert root_mean([squared_errors(grey, grey + 0.1, matches)]) == pytest.approx(0.1)


def test_what_the_second_view_does_not_see_is_left_out() -> None:
    cameras = turntable_cameras(4, 2.5, 0.7, SIZE, SIZE, 0.0)  # a quarter turn apart: half of the visible cap is hidden
    surfaces = [sphere_view(cameras, view)[0] for view in range(3)]
    quarter = match(cameras, (0, 1), (surfaces[0], surfaces[1]), 0.02)
    columns = quarter.pixel % SIZE
    share = len(quarter.pixel) / surfaces[0].mask.sum()
    assert 0.15 < share < 0.5 and columns.min() > 0.45 * SIZE
    assert not len(match(cameras, (0, 2), (surfaces[0], surfaces[2]), 0.02).pixel)  # from behind
    careless = match(cameras, (0, 2), (surfaces[0], surfaces[2]), 10.0)
    assert len(careless.pixel) > 1000  # the depth test is what leaves them out


def test_nothing_seen_twice_is_no_figure() -> None:
    assert root_mean([]) is None and root_mean([np.zeros(0)]) is None


def test_neighbours_are_the_next_views_that_are_not_too_close() -> None:
    cameras = turntable_cameras(20, 2.5, 0.7, 8, 8)  # 0.27 apart on the sphere
    for first, second in neighbours(cameras, 20):
        assert (first - second) % 20 in (1, 19)
    for first, second in neighbours(cameras, 20, 0.3):
        assert (first - second) % 20 in (2, 18)
    assert len(neighbours(cameras, 5)) == 5
    assert neighbours(cameras[[0, 1, 2]], 5, 2.0) == [(0, 2), (1, 0), (2, 0)]  # all closer: the farthest
    assert neighbours(cameras[[0, 0]], 5) == [(0, 1), (1, 0)]
    assert not neighbours(cameras[[0]], 5)


def test_mean_difference_is_over_pairs_and_the_mask() -> None:
    images = np.zeros((3, 2, 2))
    images[1], images[2] = 0.1, 0.4
    images[:, 0, 0] = 7 * np.arange(3)
    mask = np.ones((2, 2), bool)
    mask[0, 0] = False
    assert mean_difference(images, mask) == pytest.approx((0.1 + 0.4 + 0.3) / 3)
    assert mean_difference(images[:1], mask) == 0
