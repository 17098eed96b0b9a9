"""Which way is up, and how far two sets of the same cameras are apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from illuminerf.data.world_alignment import (
    Similarity,
    angles_degrees,
    levelled,
    pose_errors,
    similarity_between,
    up_axis,
)
from illuminerf.scene.cameras import sphere_cameras
from illuminerf.workflow.errors import UserError

CAMERAS = sphere_cameras(20, 3.0, 0.7, 40, 40, np.random.default_rng(0), 0.0, 1.3)
TURN = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()
MOVED = Similarity(2.5, TURN, np.array([1.0, -4.0, 0.5]))


def test_a_similarity_is_found_again() -> None:
    points = np.random.default_rng(1).normal(size=(30, 3))
    found = similarity_between(points, MOVED.points(points))
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(found.translation, MOVED.translation, atol=1e-12)


def test_a_mirrored_world_is_matched_by_a_turn_only() -> None:
    points = np.random.default_rng(1).normal(size=(30, 3))
    found = similarity_between(points, points * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert np.abs(found.points(points) - points * [1, 1, -1]).max() > 0.5


def test_points_in_a_line_are_refused() -> None:
    line = np.arange(5)[:, None] * np.array([1.0, 2.0, 3.0])
    with pytest.raises(UserError, match="aligned"):
        similarity_between(line, line)


def test_angles_are_exact_from_tiny_to_half_a_turn() -> None:
    degrees = np.array([1e-6, 0.5, 90.0, 179.9])
    turned = Rotation.from_rotvec(np.radians(degrees)[:, None] * np.array([0.6, 0.0, 0.8])).as_matrix()
    np.testing.assert_allclose(angles_degrees(turned @ TURN, np.tile(TURN, (4, 1, 1))), degrees, rtol=1e-6)


def test_errors_of_poses_do_not_depend_on_the_world_and_show_what_was_done() -> None:
    true = CAMERAS.world_from_camera
    rotation, position = pose_errors(MOVED.poses(true), true)
    assert rotation.max() < 1e-5 and position.max() < 1e-9
    wrong = true.copy()
    wrong[3, :3, :3] = Rotation.from_euler("z", 2.0, degrees=True).as_matrix() @ wrong[3, :3, :3]
    wrong[7, :3, 3] += [0, 0, 0.03]  # a hundredth of the distance
    rotation, position = pose_errors(MOVED.poses(wrong), true)
    assert rotation[3] == pytest.approx(2.0, abs=0.1) and np.delete(rotation, 3).max() < 0.2
    assert position[7] == pytest.approx(0.01, abs=0.002) and np.delete(position, 7).max() < 0.004


def test_up_is_found_in_any_world_although_no_camera_looks_level() -> None:
    found = up_axis(MOVED.poses(CAMERAS.world_from_camera))
    np.testing.assert_allclose(found, TURN @ [0, 0, 1], atol=1e-6)
    mean = MOVED.poses(CAMERAS.world_from_camera)[:, :3, 1].mean(0)
    uneven = MOVED.poses(CAMERAS.world_from_camera[CAMERAS.positions[:, 0] > 0])[:, :3, 1].mean(0)
    assert (mean / np.linalg.norm(mean)) @ found > 0  # the same side
    assert (uneven / np.linalg.norm(uneven)) @ found < 0.95  # the mean of up axes alone would be off by far


def test_a_few_photographs_on_their_side_do_not_matter() -> None:
    poses = CAMERAS.world_from_camera.copy()
    for view in (2, 9, 14):
        poses[view, :3, :3] = poses[view, :3, :3] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    assert up_axis(poses) @ [0, 0, 1] > np.cos(np.radians(0.5))
    squares = np.linalg.eigh(np.einsum("vi,vj->ij", poses[:, :3, 0], poses[:, :3, 0]))[1][:, 0]
    assert abs(squares[2]) < np.cos(np.radians(1))  # least squares would be turned


def test_cameras_that_look_one_way_keep_their_own_up() -> None:
    poses = np.tile(CAMERAS.world_from_camera[:1], (5, 1, 1))
    np.testing.assert_allclose(up_axis(poses), poses[0, :3, 1], atol=1e-9)


def test_the_levelled_world_is_z_up_and_seen_from_the_front() -> None:
    cameras = sphere_cameras(8, 3.0, 0.7, 40, 40, np.random.default_rng(3))
    moved = MOVED.poses(cameras.world_from_camera)
    from illuminerf.scene.cameras import Cameras

    world = levelled(Cameras(moved, cameras.intrinsics, 40, 40), TURN @ [0, 0, 1], MOVED.translation)
    poses = world.poses(moved)
    assert poses[0, 0, 3] == pytest.approx(0, abs=1e-9) and poses[0, 1, 3] < 0
    np.testing.assert_allclose(poses[:, 2, 3], 2.5 * cameras.positions[:, 2], atol=1e-9)
    np.testing.assert_allclose(poses[:, 2, 0], 0, atol=1e-9)  # level
