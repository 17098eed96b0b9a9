"""Transport against closed forms, colours against what was painted, and the fit's gradient against differences."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from illuminerf.cues.illumination import FittedLight, LightFit, Pairs, fit_light, light_loss
from illuminerf.cues.surface_samples import (
    RayCaster,
    SurfacePoints,
    interreflection,
    light_transport,
    seen_colors,
    surface_points,
)
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
    free = light_transport(points, RayCaster(sphere), 24).sum(1)
    np.testing.assert_allclose(free, 1, atol=0.02)
    # a disc of radius 2 at height 1 over the origin takes sin^2(atan 2) = 0.8 of what an upward point there receives
    angle = np.linspace(0, 2 * np.pi, 65)[:-1]
    rim = np.stack([2 * np.cos(angle), 2 * np.sin(angle), np.ones(64)], -1)
    vertices = np.concatenate([[[0, 0, 1]], rim]).astype(np.float32)
    faces = np.array([[0, 1 + i, 1 + (i + 1) % 64] for i in range(64)], np.int32)
    roof = TriangleMesh(vertices, faces, np.tile(np.array([[0, 0, -1]], np.float32), (65, 1)))
    origin = SurfacePoints(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
    assert light_transport(origin, RayCaster(roof), 48).sum() == pytest.approx(0.2, abs=0.02)


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
    views, points, caster = (
        Views(cameras, srgb * alpha[..., None], alpha),
        points_on(sphere, 400),
        RayCaster(sphere),
    )
    colors = seen_colors(points, views, caster, 0.25, 2)
    is_seen = np.isfinite(colors).all(1)
    away = np.abs(points.positions[:, 1]) > 0.05
    red = linear_from_srgb(np.array([0.8, 0.1, 0.1], np.float32))
    assert 0.4 < is_seen.mean() < 1
    np.testing.assert_allclose(colors[is_seen & away & (points.positions[:, 1] > 0)].mean(0), red, atol=0.01)
    assert points.positions[is_seen, 2].min() > -0.45  # the bottom is not seen
    bright = seen_colors(points, Views(cameras, np.ones_like(srgb), alpha), caster, 0.25, 2)
    assert np.isnan(bright).all()


def test_the_gradient_is_that_of_the_loss() -> None:
    generator = np.random.default_rng(0)
    config = LightFit(map_height=4, smoothness=0.5, evenness=0.2)
    transport = generator.uniform(0.1, 1, (30, 32)).astype(np.float32)
    log_colors = generator.normal(size=(30, 3))
    pairs = Pairs.drawn(generator.normal(size=(30, 3)) * 0.1, log_colors, config, generator)
    log_light, step = generator.normal(size=(4, 8, 3)), generator.normal(size=(4, 8, 3))

    def loss(amount: float) -> tuple[float, np.ndarray]:
        return light_loss(log_light + amount * step, log_colors, transport, pairs, 0.5, config)

    slope = (loss(1e-3)[0] - loss(-1e-3)[0]) / 2e-3
    assert slope == pytest.approx(float((loss(0.0)[1] * step).sum()), rel=1e-3)
    assert slope != pytest.approx(float((loss(0.0)[1] * np.roll(step, 1, 1)).sum()), rel=0.1)


def test_a_light_from_one_side_is_found_and_channels_are_neutral(sphere: TriangleMesh) -> None:
    points = points_on(sphere, 600)
    transport = light_transport(points, RayCaster(sphere), 8)
    radiance = np.full((8, 16, 3), 0.1)
    radiance[1:4, 3:6] = [8.0, 6.0, 4.0]
    shading = transport @ radiance.reshape(-1, 3)

    def fitted(paint: float) -> FittedLight:
        colors = (paint * shading * np.array([1, 0.8, 0.6])).astype(np.float32)
        return fit_light(
            points, colors, transport, csr_matrix((600, 600)), LightFit(map_height=8), np.random.default_rng(0)
        )

    found = fitted(0.5)
    gap = np.log(found.shading) - np.log(shading)
    assert (gap - gap.mean(0)).std() < 0.1 < (np.log(shading) - np.log(shading).mean(0)).std()
    assert found.explained > 0.95 and found.residual < 0.1
    levels = np.exp(np.log(found.shading).mean(0))
    assert levels.max() / levels.min() == pytest.approx(1, abs=0.01)
    assert np.quantile(found.albedo.mean(-1), 0.95) == pytest.approx(0.65, rel=0.02)
    # what is hardly lit by any standard is dark itself
    assert np.quantile(fitted(0.02).albedo.mean(-1), 0.95) < 0.2


def test_light_from_other_points_is_left_out_of_paint() -> None:
    """A white floor beside a red wall: near the wall it is red, and the fit must not take that for paint."""
    corners = [[[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[1, -1, 0], [1, 1, 0], [1, 1, 1], [1, -1, 1]]]
    mesh = TriangleMesh(
        np.array(corners, np.float32).reshape(-1, 3),
        np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]], np.int32),
        np.repeat(np.array([[0, 0, 1], [-1, 0, 0]], np.float32), 4, 0),
    )
    points, caster = surface_points(mesh, 400, 0.01, np.random.default_rng(0)), RayCaster(mesh)
    bounces = interreflection(points, caster, 256, np.random.default_rng(0))
    is_wall = points.normals[:, 0] < -0.5
    sums = np.asarray(bounces.sum(1)).ravel()
    nearest = np.argsort(np.where(is_wall, np.inf, 1 - points.positions[:, 0]))[: (~is_wall).sum()]
    assert sums[nearest[:20]].mean() > 2 * sums[nearest[-100:]].mean() > 0  # the wall looms less from afar
    transport = light_transport(points, caster, 8)
    paint = np.where(is_wall[:, None], [0.8, 0.1, 0.1], [0.8, 0.8, 0.8])
    colors = paint * transport.sum(1)[:, None]
    for _ in range(20):
        colors = paint * (transport.sum(1)[:, None] + bounces @ colors)

    def spread(used: csr_matrix) -> float:
        found = fit_light(
            points, colors.astype(np.float32), transport, used, LightFit(map_height=8), np.random.default_rng(0)
        )
        return float(np.log(found.albedo[~is_wall]).std(0).mean())

    assert spread(bounces) < 0.5 * spread(csr_matrix((400, 400)))
