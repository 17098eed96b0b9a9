"""Surfaces of known distance: concentric spheres, a moved box, a floater."""

import numpy as np
import pytest

from illuminerf.evaluation.geometry_scores import (
    angles_degrees,
    area_surfels,
    box_diagonal,
    floater_share,
    intersection_over_union,
    surface_distances,
)
from illuminerf.evaluation.geometry_sheet import SurfaceView, contact_sheet, covered_by_both
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.scene.surfels import Surfels, thinned


def sphere_surfels(radius: float, count: int = 4000, turn: float = 0.0) -> Surfels:
    """Evenly spread over a sphere, turned about its axis."""
    z = (np.arange(count) + 0.5) / count * 2 - 1
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5)) + turn
    ring = np.sqrt(1 - z**2)
    normals = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], -1).astype(np.float32)
    return Surfels(normals * np.float32(radius), normals, float(np.sqrt(4 * np.pi / count)) * radius)


def test_concentric_spheres_are_apart_by_the_difference_of_their_radii() -> None:
    truth = sphere_surfels(0.5)
    found = surface_distances(sphere_surfels(0.51, turn=1), truth, size=1.0)
    assert found.chamfer == pytest.approx(1.0, abs=0.02)
    assert found.accuracy == pytest.approx(1.0, abs=0.05) and found.completeness == pytest.approx(1.0, abs=0.05)
    assert found.f_score(0.5) == 0 and found.f_score(1.5) == 1


def test_another_sampling_of_the_same_surface_is_no_distance() -> None:
    """Discs, not points: points alone would be 0.8 percent apart."""
    truth, again = sphere_surfels(0.5), sphere_surfels(0.5, turn=1)
    assert surface_distances(again, truth, size=1.0).chamfer < 0.03
    points = Surfels(truth.positions, truth.normals, radius=0.0)
    assert surface_distances(again, points, size=1.0).accuracy > 0.3


def test_both_directions_count() -> None:
    """Half of the sphere: all of it is there, half of what is there is missing."""
    truth = sphere_surfels(0.5)
    upper = truth.positions[:, 2] > 0
    half = Surfels(truth.positions[upper], truth.normals[upper], truth.radius)
    found = surface_distances(half, truth, size=1.0)
    assert found.accuracy == 0 and found.completeness > 5
    assert found.f_score(0.5) == pytest.approx(2 * 0.5 / 1.5, abs=0.03)


def test_angles_are_exact_for_small_and_for_large_ones() -> None:
    turn = np.radians([0.0, 1e-3, 30.0, 90.0, 180.0])
    turned = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    np.testing.assert_allclose(angles_degrees(np.array([1.0, 0, 0]), turned), [0, 1e-3, 30, 90, 180], atol=1e-9)


def test_floaters_are_what_comes_near_nothing() -> None:
    ball, far = sphere_mesh(2, 0.5), sphere_mesh(2, 0.05)
    moved = far.vertices + np.float32([0.8, 0, 0])
    both = TriangleMesh(
        np.concatenate([ball.vertices, moved]),
        np.concatenate([ball.faces, far.faces + len(ball.vertices)]).astype(np.int32),
        np.concatenate([ball.vertex_normals, far.vertex_normals]),
    )
    truth = area_surfels(ball, 5000, np.random.default_rng(0))
    assert floater_share(both, truth, 0.02) == pytest.approx(0.01 / 1.01, rel=0.01)
    assert floater_share(both, truth, 0.5) == 0 and floater_share(ball, truth, 0.02) == 0


def test_points_of_an_area_are_on_it_and_even() -> None:
    points = area_surfels(sphere_mesh(3, 0.5), 4000, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(points.positions, axis=-1), 0.5, atol=0.005)
    assert np.abs(points.positions.mean(0)).max() < 0.02
    assert ((points.positions * points.normals).sum(-1) > 0.48).all()


def test_thinning_keeps_one_point_per_cell_and_both_sides_of_a_sheet() -> None:
    points = np.random.default_rng(0).random((500, 3)).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (500, 1))
    kept = thinned(points, up, 0.25)
    assert len(kept) == 64 and kept[0] == 0 and (np.diff(kept) > 0).all()
    both = thinned(np.concatenate([points, points]), np.concatenate([up, -up]), 0.25)
    assert len(both) == 128


def test_masks_and_sizes() -> None:
    first, second = np.array([True, True, False]), np.array([False, True, True])
    assert intersection_over_union(first, second) == pytest.approx(1 / 3)
    assert intersection_over_union(first & False, first & False) == 1
    assert box_diagonal(sphere_mesh(4, 0.5)) == pytest.approx(3**0.5, rel=1e-3)


def test_the_sheet_shows_where_normals_and_masks_differ() -> None:
    up = np.zeros((8, 24, 3), np.float32)
    up[..., 2] = 1
    turned = up.copy()
    turned[:, 12:] = [0, np.sin(np.radians(30)), np.cos(np.radians(30))]
    covered = np.ones((8, 24), np.float32)
    half = covered.copy()
    half[:4] = 0
    photograph = np.ones((8, 24, 4), np.float32)
    view = SurfaceView(photograph, photograph, up, covered, turned, half)
    assert covered_by_both(view).sum() == 4 * 24
    error = contact_sheet([view])[16:, -24:]
    np.testing.assert_allclose(error[:4], np.broadcast_to([0, 0.7, 0.7], (4, 24, 3)))  # of one surface only
    assert error[4:, :12].max() < 0.01 and error[4:, 12:].min() > 0.95
