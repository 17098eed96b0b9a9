"""Shared by stage tests: a capture of an analytic coloured sphere, as a folder on disk."""

from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.capture import write_capture
from illuminerf.fields.appearance import AppearanceConfig
from illuminerf.fields.bounds import ball_interval
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.fields.proposal_sampling import ProposalConfig
from illuminerf.fields.radiance_field import FieldConfig
from illuminerf.fields.surface import SurfaceConfig
from illuminerf.scene.cameras import Cameras, sphere_cameras
from illuminerf.stages import estimate_geometry

RADIUS = 0.6
_GRID = HashGridConfig(5, 2, 12, 8, 48)
TINY_GEOMETRY = estimate_geometry.Config(
    radiance_field=FieldConfig(
        SurfaceConfig(_GRID, 32, HashGridConfig(4, 2, 11, 8, 32), 16, initial_beta=0.01),
        AppearanceConfig(_GRID, 8, 32, 1, 2, 4, 16),
        ProposalConfig(HashGridConfig(3, 2, 10, 8, 24), 8),
        num_proposal_samples=16,
        num_samples=10,
    ),
    optimiser=OptimiserConfig(num_steps=120, rays_per_step=128, warmup_steps=10),
    occupancy_side=32,
    mesh_resolution=32,
    num_held_out_views=0,
    num_previews=0,
    device="cpu",
)


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


@pytest.fixture(scope="session")
def sphere_geometry(sphere_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short fit to it."""
    return estimate_geometry.run(sphere_capture, TINY_GEOMETRY, tmp_path_factory.mktemp("fit") / "geometry")
