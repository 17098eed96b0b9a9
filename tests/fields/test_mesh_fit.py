"""Signed distances of surfaces of which one side is seen: a ball, a box without a bottom, a sheet; and their fit."""

import numpy as np
import pytest
import torch

from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.mesh_fit import MeshDistance, SurfaceRegressionConfig, carved_cells, fit_surface, thickened
from illuminerf.fields.surface import SurfaceConfig, SurfaceField
from illuminerf.scene.cameras import Cameras, sphere_cameras
from illuminerf.scene.surfels import Surfels
from illuminerf.workflow.errors import UserError

RADIUS, SIDE = 0.6, 32
CAMERAS = sphere_cameras(12, 3.0, 0.75, 64, 64, np.random.default_rng(0))


def ball_surfels(count: int = 3000) -> Surfels:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    return Surfels(normals * np.float32(RADIUS), normals, 0.04)


def ball_depths(cameras: Cameras) -> torch.Tensor:
    depths = []
    for view in range(len(cameras)):
        origins, directions = cameras.image_rays(view)
        along = -(origins * directions).sum(-1)
        gap = (origins**2).sum(-1) - along**2
        near = along - (RADIUS**2 - gap).clamp_min(0).sqrt()
        depths.append(torch.where(gap < RADIUS**2, near, torch.inf))
    return torch.stack(depths)


def ball_distance() -> MeshDistance:
    is_seen = carved_cells(CAMERAS, ball_depths(CAMERAS), SIDE)
    return MeshDistance(ball_surfels(), is_seen, np.full(3, -RADIUS), np.full(3, RADIUS))


def test_cells_that_a_camera_sees_through_are_carved() -> None:
    is_seen = carved_cells(CAMERAS, ball_depths(CAMERAS), SIDE)
    axis = (torch.arange(SIDE) + 0.5) * (2 / SIDE) - 1
    radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).norm(dim=-1)
    assert not is_seen[radius < RADIUS - 0.05].any()
    assert is_seen[(radius > RADIUS + 0.05) & (radius < 0.95)].float().mean() > 0.97
    nothing = carved_cells(CAMERAS, torch.full((12, 64, 64), 0.1), SIDE)
    assert not nothing.any()  # the guard: behind a surface right before the cameras nothing is seen


def test_distances_to_a_ball_have_the_right_sign_and_size() -> None:
    points = np.random.default_rng(1).uniform(-0.55, 0.55, (2000, 3))
    truth = np.linalg.norm(points, axis=-1) - RADIUS
    found = ball_distance()(points)
    close = np.abs(truth) < 0.1
    assert np.abs(found - truth)[close].max() < 0.02
    assert np.abs(found - truth).max() < 0.1  # farther off it is known by cells
    assert (np.sign(found) == np.sign(truth))[np.abs(truth) > 0.01].all()


def plane(height: float, up: float, count: int = 2500) -> Surfels:
    generator = np.random.default_rng(2)
    positions = np.column_stack([generator.uniform(-0.5, 0.5, (count, 2)), np.full(count, height)])
    normals = np.tile([0, 0, up], (count, 1))
    return Surfels(positions.astype(np.float32), normals.astype(np.float32), 0.03)


def test_a_sheet_seen_from_both_sides_gets_an_inside() -> None:
    above, below = plane(0, 1), plane(0, -1)
    sheet = Surfels(
        np.concatenate([above.positions, below.positions]), np.concatenate([above.normals, below.normals]), 0.03
    )
    box = (np.full(3, -0.5), np.full(3, 0.5))
    all_seen = torch.ones(SIDE, SIDE, SIDE, dtype=torch.bool)
    heights = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
    points = np.column_stack([np.full((5, 2), 0.2), heights])
    found = MeshDistance(thickened(sheet), all_seen, *box)(points)
    np.testing.assert_allclose(found, np.abs(heights) - 0.03, atol=0.005)
    np.testing.assert_array_equal(thickened(above).positions, above.positions)  # one side alone stays where it is


def test_what_nobody_sees_is_inside_as_far_as_the_box_goes() -> None:
    """The lid of a box, seen from above: below it is solid down to the bottom, which is not there."""
    axis = (np.arange(SIDE) + 0.5) * (2 / SIDE) - 1
    is_seen = torch.from_numpy(np.broadcast_to(axis > 0.3, (SIDE, SIDE, SIDE)).copy())
    low, high = np.array([-0.5, -0.5, -0.3]), np.array([0.5, 0.5, 0.31])
    distance = MeshDistance(plane(0.3, 1), is_seen, low, high)
    found = distance(np.array([[0, 0, 0.35], [0, 0, 0.25], [0, 0, 0.0], [0, 0, -0.6], [0.8, 0, 0]], np.float64))
    assert (np.sign(found) == [1, -1, -1, 1, 1]).all()
    assert found[2] == pytest.approx(-0.3, abs=0.08) and found[3] == pytest.approx(0.3, abs=0.08)


def test_a_field_takes_the_shape_and_the_normals_of_a_ball() -> None:
    grid = HashGridConfig(4, 2, 12, 8, 32)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        surface = SurfaceField(SurfaceConfig(grid, 32, HashGridConfig(3, 2, 11, 8, 16), 16, initial_radius=0.3))
    directions = torch.from_numpy(ball_surfels(500).normals)
    before = surface(directions * RADIUS).signed_distance.abs().mean()
    target = ball_distance()
    tilted = target.seen.normals @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], np.float32)
    config = SurfaceRegressionConfig(num_steps=150, points_per_step=1024, normals=0.5)
    error = fit_surface(surface, target, tilted, config, seed=0)
    with torch.no_grad():
        found, predicted = surface(directions * RADIUS), surface.predicted_normals(directions * RADIUS)
    assert before > 0.25 and error < 0.02 and float(found.signed_distance.abs().mean()) < 0.02
    gradient = torch.nn.functional.normalize(found.gradient, dim=-1)
    assert float((gradient * directions).sum(-1).mean()) > 0.97
    wanted = directions @ torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert float((predicted * wanted).sum(-1).mean()) > 0.9
    assert surface.beta.item() == pytest.approx(1.5e-3, rel=0.01)
    with pytest.raises(UserError):
        SurfaceRegressionConfig(beta=0.0)
