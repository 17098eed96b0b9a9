"""Where the object is, from masks and from cameras alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from illuminerf.data.placement import Ball, focus_ball, hull_ball, mask_preview, nearest_point_to_rays, outline_ball
from illuminerf.scene.cameras import Cameras, look_at, sphere_cameras
from illuminerf.workflow.errors import UserError
from tests.data.synthetic_capture import CENTRE, RADIUS, ball_cameras, ball_images

CAMERAS = ball_cameras(24, 60, 60)
MASKS = list(ball_images(CAMERAS)[..., 3] > 127)


def test_the_hull_of_a_ball_is_a_little_larger_than_the_ball() -> None:
    ball = hull_ball(CAMERAS, MASKS)
    assert np.linalg.norm(ball.centre - CENTRE) < 0.1 * RADIUS
    assert RADIUS <= ball.radius < 1.35 * RADIUS


def test_cameras_from_above_only_do_not_stretch_the_ball() -> None:
    """Below the object the hull is a cone without end; the outlines are not fooled."""
    band = (np.radians(20), np.radians(70))
    cameras = sphere_cameras(24, 3.0, 0.7, 60, 60, np.random.default_rng(1), *band)
    masks = []
    for view in range(len(cameras)):
        origins, directions = (rays.numpy() for rays in cameras.image_rays(view))
        along = -(origins * directions).sum(-1)
        masks.append(np.linalg.norm(origins + along[..., None] * directions, axis=-1) < 0.5)
    ball = hull_ball(cameras, masks)
    assert np.linalg.norm(ball.centre) < 0.05
    assert 0.5 <= ball.radius < 0.5 * 1.25
    outlined = outline_ball(cameras, masks)
    assert 0.5 <= outlined.radius < 0.5 * 1.25


def test_one_bad_mask_does_not_carve_the_object_away() -> None:
    masks = [mask.copy() for mask in MASKS]
    masks[3] = np.zeros_like(masks[3])
    masks[3][0, 0] = True
    ball = hull_ball(CAMERAS, masks)
    assert np.linalg.norm(ball.centre - CENTRE) < 0.15 * RADIUS
    assert RADIUS * 0.95 < ball.radius < 1.5 * RADIUS


def test_an_object_beside_the_optical_axes_is_found() -> None:
    off_axis = CAMERAS.transformed(1.0, np.array([0.3, 0.1, 0.0]))  # they look past the ball at CENTRE
    masks = list(ball_images(off_axis)[..., 3] > 127)
    assert np.linalg.norm(hull_ball(off_axis, masks).centre - CENTRE) < 0.1 * RADIUS
    assert np.linalg.norm(focus_ball(off_axis).centre - CENTRE) > 0.2  # guard: the axes alone do not find it


def test_masks_that_do_not_agree_are_an_error() -> None:
    with pytest.raises(UserError, match="masks and poses do not agree"):
        masks = [np.zeros((60, 60), bool) for _ in MASKS]
        for view, mask in enumerate(masks):
            mask[(view * 37) % 55 : (view * 37) % 55 + 3, (view * 23) % 55 : (view * 23) % 55 + 3] = True
        hull_ball(CAMERAS, masks)


@given(
    seed=st.integers(0, 1000),
    scale=st.floats(0.01, 100),
    shift=st.tuples(*[st.floats(-50, 50)] * 3),
)
@settings(max_examples=20, deadline=None)
def test_the_focus_follows_the_world(seed: int, scale: float, shift: tuple[float, float, float]) -> None:
    cameras = sphere_cameras(12, 3.0, 0.7, 40, 50, np.random.default_rng(seed))
    offset = np.array(shift)
    ball = focus_ball(cameras.transformed(scale, offset))
    np.testing.assert_allclose(ball.centre / scale, offset, atol=1e-6)
    np.testing.assert_allclose(ball.radius / scale, 3 * np.sin(np.arctan(np.tan(0.35) * 40 / 50)), rtol=1e-6)


def test_a_stray_camera_does_not_move_the_focus() -> None:
    cameras = sphere_cameras(20, 3.0, 0.7, 40, 40, np.random.default_rng(0))
    poses = cameras.world_from_camera.copy()
    poses[0] = look_at(np.array([3.0, 0, 0]), np.array([3.0, 5.0, 1.0]))
    stray = Cameras(poses, cameras.intrinsics, 40, 40)
    assert np.linalg.norm(focus_ball(stray).centre) < 0.01
    lines = poses[:, :3, 3], -poses[:, :3, 2]
    across = np.eye(3) - lines[1][:, :, None] * lines[1][:, None, :]
    plain = np.linalg.solve(across.sum(0), np.einsum("lij,lj->i", across, lines[0]))
    assert np.linalg.norm(plain) > 0.05  # guard: plain least squares is moved


def test_parallel_and_outward_cameras_are_errors() -> None:
    parallel = np.tile(np.eye(4), (5, 1, 1))
    parallel[:, 0, 3] = np.arange(5)
    intrinsics = np.tile([50.0, 50, 20, 20], (5, 1))
    with pytest.raises(UserError, match="one direction"):
        focus_ball(Cameras(parallel, intrinsics, 40, 40))
    outward = np.stack([look_at(p, 2 * p) for p in np.random.default_rng(0).normal(size=(5, 3))])
    with pytest.raises(UserError, match="look away"):
        focus_ball(Cameras(outward, intrinsics, 40, 40))


def test_nearest_point_of_crossing_lines() -> None:
    directions = np.eye(3)
    point = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(nearest_point_to_rays(point - 4 * directions, directions), point, atol=1e-9)


def test_placement_maps_the_ball_to_the_unit_ball() -> None:
    scale, offset = Ball(np.array([1.0, 2.0, 3.0]), 4.0).placement(0.9)
    surface = np.array([1.0, 2.0, 7.0])
    np.testing.assert_allclose((surface + offset) * scale, [0, 0, 0.9])


def test_previews_keep_every_marked_pixel() -> None:
    mask = np.zeros((801, 1203), bool)
    mask[800, 1202] = mask[0, 0] = mask[400, 7] = True
    small = mask_preview(mask)
    assert max(small.shape) <= 200 and small.sum() == 3 and small[0, 0] and small[-1, -1]
    np.testing.assert_array_equal(mask_preview(mask[:50, :50]), mask[:50, :50])
