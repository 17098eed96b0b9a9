"""Cameras of training items: the object fills the picture, or the focal length is the paper's."""

import numpy as np
import pytest

from illuminerf.cues.training_cameras import CameraSphere, draw_camera
from illuminerf.workflow.errors import UserError

THIN = np.array([[0, 0, 1.0], [0, 0, -1.0], [0.1, 0, 0]])


def test_the_object_fills_the_picture() -> None:
    for seed in range(10):
        camera = draw_camera(CameraSphere(), 64, THIN, np.random.default_rng(seed))
        points, depth = camera.project(THIN)
        reach = np.abs(points[0] / 32 - 1).max()
        assert (depth > 0).all() and reach == pytest.approx(1 / CameraSphere().margin, abs=1e-6)


def test_the_papers_cameras_have_one_focal_length_and_see_the_unit_sphere() -> None:
    sphere = np.random.default_rng(0).normal(size=(2000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    heights = []
    for seed in range(40):
        camera = draw_camera(CameraSphere.paper(), 512, THIN, np.random.default_rng(seed))
        assert camera.intrinsics[0, 0] == 512
        points, _ = camera.project(sphere)
        assert points.min() > 0 and points.max() < 512
        heights.append(camera.positions()[0, 2] if callable(camera.positions) else camera.positions[0, 2])
    assert min(heights) < -1 and max(heights) > 1


def test_wrong_settings_are_explained() -> None:
    with pytest.raises(UserError, match="distances"):
        CameraSphere(min_distance=0.5)
    with pytest.raises(UserError, match="focal length"):
        CameraSphere(focal_length=-1.0)
    with pytest.raises(UserError, match="elevation"):
        CameraSphere(min_elevation_radians=2.0)
