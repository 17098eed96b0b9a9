"""Transport against closed forms, colours against what was painted, and the fit's gradient against differences."""

import numpy as np
import pytest

from illuminerf.cues.illumination import LightFit, _Pairs, fit_light, light_loss
from illuminerf.cues.surface_samples import OcclusionTest, SurfacePoints, light_transport, seen_colors, surface_points
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.images import linear_from_srgb
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.scene.views import Views


@pytest.fixture(scope="module")
def sphere() -> TriangleMesh:
    return sphere_mesh(3, 0.5)


def points_on(mesh: TriangleMesh, count: int = 200) -> SurfacePoints:
    return surface_points(mesh, count, 0.05, np.random.default_rng(0))


def test_points_lie_on_the_mesh_and_normals_are_smooth(sphere: TriangleMesh) -> None:
    points = points_on(sphere)
    outward = points.positions / np.linalg.norm(points.positions, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(points.positions, axis=1), 0.5, atol=0.005)
    assert (points.normals * outward).sum(1).min() > 0.99


def test_dents_are_ironed_out(sphere: TriangleMesh) -> None:
    moved = sphere.vertices * np.random.default_rng(0).uniform(0.98, 1.02, (len(sphere.vertices), 1))
    dented = TriangleMesh(moved.astype(np.float32), sphere.faces, sphere.vertex_normals)

    def deviation(radius: float) -> float:
        points = surface_points(dented, 400, radius, np.random.default_rng(0))
        outward = points.positions / np.linalg.norm(points.positions, axis=1, keepdims=True)
        return float(1 - (points.normals * outward).sum(1).mean())

    assert deviation(0.15) < 0.25 * deviation(1e-6)


def test_a_furnace_lights_a_convex_body_fully_and_a_roof_takes_its_share(sphere: TriangleMesh) -> None:
    points = points_on(sphere)
    free = light_transport(points, OcclusionTest(sphere), 24).sum(1)
    np.testing.assert_allclose(free, 1, atol=0.02)
    # a disc of radius 2 at height 1 over the origin takes sin^2(atan 2) = 0.8 of what an upward point there receives
    angle = np.linspace(0, 2 * np.pi, 65)[:-1]
    rim = np.stack([2 * np.cos(angle), 2 * np.sin(angle), np.ones(64)], -1)
    vertices = np.concatenate([[[0, 0, 1]], rim]).astype(np.float32)
    faces = np.array([[0, 1 + i, 1 + (i + 1) % 64] for i in range(64)], np.int32)
    roof = TriangleMesh(vertices, faces, np.tile(np.array([[0, 0, -1]], np.float32), (65, 1)))
    origin = SurfacePoints(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
    assert light_transport(origin, OcclusionTest(roof), 48).sum() == pytest.approx(0.2, abs=0.02)


def test_points_have_the_colours_of_photographs_that_see_them(sphere: TriangleMesh) -> None:
    """+y is painted red, -y blue; a highlight in one photograph does not count, an overexposed point is left out."""
    cameras = turntable_cameras(12, 3.0, 0.5, 48, 48)
    srgb, alpha = np.zeros((12, 48, 48, 3), np.float32), np.zeros((12, 48, 48), np.float32)
    for view in range(12):
        origins, directions = (rays.numpy() for rays in cameras.image_rays(view))
        b = (origins * directions).sum(-1)
        root = b**2 - (origins**2).sum(-1) + 0.25
        y = (origins + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * directions)[..., 1:2]
        alpha[view] = root > 0
        srgb[view] = np.where(y > 0, [0.8, 0.1, 0.1], [0.1, 0.1, 0.6])
    srgb[0] = 0.95
    views, points, occlusion = (
        Views(cameras, srgb * alpha[..., None], alpha),
        points_on(sphere, 400),
        OcclusionTest(sphere),
    )
    colors = seen_colors(points, views, occlusion, 0.25, 2)
    is_seen = np.isfinite(colors).all(1)
    away = np.abs(points.positions[:, 1]) > 0.05
    red = linear_from_srgb(np.array([0.8, 0.1, 0.1], np.float32))
    assert 0.4 < is_seen.mean() < 1
    np.testing.assert_allclose(colors[is_seen & away & (points.positions[:, 1] > 0)].mean(0), red, atol=0.01)
    assert points.positions[is_seen, 2].min() > -0.45  # the bottom is not seen
    bright = seen_colors(points, Views(cameras, np.ones_like(srgb), alpha), occlusion, 0.25, 2)
    assert np.isnan(bright).all()


def test_the_gradient_is_that_of_the_loss() -> None:
    generator = np.random.default_rng(0)
    config = LightFit(map_height=4, smoothness=0.5, evenness=0.2)
    transport = generator.uniform(0.1, 1, (30, 32)).astype(np.float32)
    log_colors = generator.normal(size=(30, 3))
    pairs = _Pairs.drawn(generator.normal(size=(30, 3)) * 0.1, log_colors, config, generator)
    log_light, step = generator.normal(size=(4, 8, 3)), generator.normal(size=(4, 8, 3))

    def loss(amount: float) -> tuple[float, np.ndarray]:
        return light_loss(log_light + amount * step, log_colors, transport, pairs, 0.5, config)

    slope = (loss(1e-3)[0] - loss(-1e-3)[0]) / 2e-3
    assert slope == pytest.approx(float((loss(0.0)[1] * step).sum()), rel=1e-3)
    assert slope != pytest.approx(float((loss(0.0)[1] * np.roll(step, 1, 1)).sum()), rel=0.1)


def test_a_light_from_one_side_is_found_and_channels_are_neutral(sphere: TriangleMesh) -> None:
    points = points_on(sphere, 600)
    transport = light_transport(points, OcclusionTest(sphere), 8)
    radiance = np.full((8, 16, 3), 0.1)
    radiance[1:4, 3:6] = [8.0, 6.0, 4.0]
    shading = transport @ radiance.reshape(-1, 3)
    colors = (shading * np.array([0.5, 0.3, 0.2])).astype(np.float32)
    found = fit_light(points, colors, transport, LightFit(map_height=8), np.random.default_rng(0))
    gap = np.log(found.shading) - np.log(shading)
    assert (gap - gap.mean(0)).std() < 0.1 < (np.log(shading) - np.log(shading).mean(0)).std()
    assert found.explained > 0.95 and found.residual < 0.1
    levels = np.exp(np.log(found.shading).mean(0))
    assert levels.max() / levels.min() == pytest.approx(1, abs=0.01)
    assert np.quantile(found.albedo.mean(-1), 0.95) == pytest.approx(0.85, rel=0.02)
