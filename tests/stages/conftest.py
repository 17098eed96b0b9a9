"""Shared by stage tests: a capture of an analytic coloured sphere, as a folder on disk."""

from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.capture import write_capture
from illuminerf.fields.bounds import ball_interval
from illuminerf.scene.cameras import Cameras, sphere_cameras

RADIUS = 0.6


def sphere_cameras_of(num_views: int, size: int = 40, seed: int = 0) -> Cameras:
    return sphere_cameras(num_views, 2.5, 0.7, size, size, np.random.default_rng(seed))


def sphere_image(cameras: Cameras, view: int) -> np.ndarray:
    """Straight sRGB and alpha [h, w, 4]: colour is a smooth function of the place on the sphere."""
    origins, directions = (rays.reshape(-1, 3) for rays in cameras.image_rays(view))
    near, far = ball_interval(origins, directions, RADIUS)
    places = ((origins + near[:, None] * directions) / RADIUS).numpy()
    hit = (far > near).numpy()[:, None]
    colour = np.clip(0.5 + 0.3 * np.sin(2 * places + np.array([0, 1, 2])), 0, 1) * hit
    shape = (cameras.height, cameras.width, 4)
    return np.concatenate([colour, hit], -1).reshape(shape).astype(np.float32)


def write_sphere_capture(folder: Path, num_views: int = 12, size: int = 40) -> Path:
    cameras = sphere_cameras_of(num_views, size)
    images = [sphere_image(cameras, view) for view in range(num_views)]
    names = [f"{view}" for view in range(num_views)]
    write_capture(folder, images, cameras, names, 1.0, np.zeros(3), "masked")
    return folder


@pytest.fixture(scope="session")
def sphere_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """12 views of 40 x 40 pixels of a sphere of radius 0.6."""
    return write_sphere_capture(tmp_path_factory.mktemp("sphere") / "capture")
