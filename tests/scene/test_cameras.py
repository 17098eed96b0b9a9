import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from illuminerf.scene.cameras import Cameras, look_at, sphere_cameras, turntable_cameras
from illuminerf.workflow.errors import UserError


def cameras(num_views: int = 5, height: int = 24, width: int = 32) -> Cameras:
    return sphere_cameras(num_views, 3.0, 0.8, height, width, np.random.default_rng(0))


def test_the_central_ray_points_at_the_target() -> None:
    batch = cameras()
    centre = torch.tensor([[16.0, 12.0]]).expand(5, 2)
    origins, directions = batch.rays(torch.arange(5), centre)
    torch.testing.assert_close(directions, -origins / 3.0, atol=1e-5, rtol=0)


def test_axes_are_opengl_in_a_z_up_world() -> None:
    batch = turntable_cameras(4, 2.0, 0.8, 10, 10, elevation_radians=0.0)  # view 0 sits on +x and looks along -x
    _, directions = batch.image_rays(0)
    assert directions[0, 5, 2] > directions[9, 5, 2], "the top row must look up"
    assert directions[5, 9, 1] > directions[5, 0, 1], "from +x, the right of the picture is +y"
    np.testing.assert_allclose(batch.positions[1], [0, 2, 0], atol=1e-12)  # counter-clockwise from above


@given(st.integers(0, 4), st.floats(1, 31), st.floats(1, 23), st.floats(0.5, 5))
def test_project_inverts_rays(view: int, x: float, y: float, distance: float) -> None:
    batch = cameras()
    origins, directions = batch.rays(torch.tensor([view]), torch.tensor([[x, y]]))
    point = (origins + distance * directions).numpy().astype(np.float64)
    image_points, depth = batch.project(point)
    np.testing.assert_allclose(image_points[view, 0], [x, y], atol=1e-3)
    assert depth[view, 0] > 0


def test_resizing_keeps_the_field_of_view() -> None:
    batch = cameras()
    small = batch.resized(12, 16)
    first, second = batch.rays(torch.tensor([1]), torch.tensor([[8.0, 6.0]])), None
    second = small.rays(torch.tensor([1]), torch.tensor([[4.0, 3.0]]))
    torch.testing.assert_close(first[1], second[1])


def test_transforming_moves_centres_only() -> None:
    moved = cameras().transformed(0.5, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(moved.positions, (cameras().positions + [1, 0, 0]) * 0.5)
    np.testing.assert_array_equal(moved.world_from_camera[:, :3, :3], cameras().world_from_camera[:, :3, :3])


def test_json_round_trip_is_exact() -> None:
    again = Cameras.from_dict(cameras().to_dict())
    np.testing.assert_array_equal(again.world_from_camera, cameras().world_from_camera)
    np.testing.assert_array_equal(again.intrinsics, cameras().intrinsics)


def test_look_straight_down_is_still_a_rotation() -> None:
    pose = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("damage", ["nan", "scaled", "mirrored"])
def test_poses_that_are_not_rigid_are_refused(damage: str) -> None:
    poses = cameras().world_from_camera.copy()
    if damage == "nan":
        poses[3, 0, 0] = np.nan
    elif damage == "scaled":
        poses[3, :3, :3] *= 1.01
    else:
        poses[3, :3, 0] *= -1
    with pytest.raises(UserError, match="camera 3"):
        Cameras(poses, cameras().intrinsics, 24, 32)


def test_the_rigidity_tolerance_lets_rounding_pass() -> None:
    poses = cameras().world_from_camera.astype(np.float32).astype(np.float64)
    assert len(Cameras(poses, cameras().intrinsics, 24, 32)) == 5
