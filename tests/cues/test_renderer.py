"""Cues against closed forms: furnaces, mirrors, lamps on one side, shifted principal points."""

import numpy as np
import pytest

from illuminerf.cues.renderer import CUE_CHANNELS, CueSampling, MitsubaCueRenderer, render_cues
from illuminerf.scene.cameras import Cameras, look_at
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.errors import UserError

SIZE = 32


def camera(position: tuple[float, float, float], size: int = SIZE, focal: float = 1.2, **shift: float) -> Cameras:
    intrinsics = np.array([[focal * size, focal * size, size / 2 + shift.get("x", 0), size / 2 + shift.get("y", 0)]])
    return Cameras(look_at(np.array(position), np.zeros(3))[None], intrinsics, size, size)


def constant_light(value: float = 1.0, height: int = 16) -> EnvironmentMap:
    return EnvironmentMap(np.full((height, 2 * height, 3), value, np.float32))


def lamp(direction: tuple[float, float, float], height: int = 64, width_radians: float = 0.3) -> EnvironmentMap:
    """A disc of radiance 50 about a direction, on a dim ground."""
    rows, columns = np.mgrid[0:height, 0 : 2 * height] + 0.5
    elevation = np.pi / 2 - rows / height * np.pi
    azimuth = np.pi - columns / (2 * height) * 2 * np.pi
    axes = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    inside = np.stack(axes, -1) @ (np.array(direction) / np.linalg.norm(direction)) > np.cos(width_radians)
    return EnvironmentMap(np.where(inside, 50.0, 0.01).astype(np.float32)[..., None].repeat(3, -1))


def cues(mesh: TriangleMesh, cameras: Cameras, light: EnvironmentMap, spp: int = 16, seed: int = 0) -> np.ndarray:
    return next(render_cues(mesh, cameras, light, CueSampling(spp), seed))


@pytest.fixture(scope="module")
def sphere() -> TriangleMesh:
    return sphere_mesh(4)


def brightest(image: np.ndarray) -> tuple[float, float]:
    """Energy-weighted centre (x, y) of what is brighter than half the maximum."""
    weights = np.where(image > image.max() / 2, image, 0)
    rows, columns = np.mgrid[0 : image.shape[0], 0 : image.shape[1]] + 0.5
    return float((weights * columns).sum() / weights.sum()), float((weights * rows).sum() / weights.sum())


def test_rows_of_the_light_lie_where_the_conventions_say() -> None:
    """A plate that faces up under a bright cap of 45 degrees: the irradiance over pi is sin^2 45 = 1 / 2."""
    plate = TriangleMesh(
        np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.tile(np.array([[0, 0, 1]], np.float32), (4, 1)),
    )
    above = camera((0.01, 0, 3), focal=2.0)

    def brightness(lit_rows: float) -> float:
        rows = np.zeros((32, 64, 3), np.float32)
        rows[:8] = 1
        rows[8] = lit_rows
        return float(cues(plate, above, EnvironmentMap(rows), spp=256)[0].mean())

    assert brightness(0.0) == pytest.approx(0.5, rel=0.01)
    assert brightness(0.5) > 0.5 * 1.02  # half a row more is seen


def test_white_furnace(sphere: TriangleMesh) -> None:
    image = cues(sphere, camera((3, 0, 0)), constant_light(0.7), spp=64)
    inside = image[12] == 1
    assert inside.sum() > 300
    diffuse = image[:3, inside]
    assert abs(diffuse.mean() - 0.7) < 0.003
    for first in (3, 6, 9):
        lobe = image[first : first + 3, inside]
        assert 0.96 * 0.7 < lobe.mean() < 1.005 * 0.7  # single scattering loses a little at grazing angles
    assert (image[:, :2, :2] == 0).all()  # the background stays empty


def test_diffuse_cue_has_interreflections() -> None:
    """In a furnace a concave white body is as bright as a convex one, but only if all bounces count."""
    sphere = sphere_mesh(3)
    inside_out = TriangleMesh(
        sphere.vertices, sphere.faces[sphere.vertices[sphere.faces].mean(1)[:, 0] < 0], -sphere.vertices
    )
    view = camera((3, 0, 0), focal=4.0)
    bright = cues(inside_out, view, constant_light(), spp=64)
    sampling = CueSampling(64, diffuse_depth=2)
    dark = next(render_cues(inside_out, view, constant_light(), sampling, 0))
    middle = (slice(0, 3), slice(12, 20), slice(12, 20))
    assert bright[middle].mean() > 0.9
    assert dark[middle].mean() < 0.75


@pytest.mark.parametrize("axis", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
def test_the_lit_side_faces_the_lamp(sphere: TriangleMesh, axis: tuple[float, float, float]) -> None:
    """Seen from +x with +z up, +y is on the right."""
    x, y = brightest(cues(sphere, camera((3, 0, 0)), lamp(axis))[0])
    right, up = x - SIZE / 2, SIZE / 2 - y
    assert np.dot([right, up], [axis[1], axis[2]]) > 4
    assert abs(np.dot([right, up], [axis[2], axis[1]])) < 1.5


def test_the_chrome_ball_reflects_where_the_mirror_law_says(sphere: TriangleMesh) -> None:
    view = camera((0, -3, 0), size=64)
    direction = np.array([0.6, -0.5, 0.7])
    x, y = brightest(cues(sphere, view, lamp(tuple(direction), width_radians=0.12), spp=64)[3])
    origins, directions = (rays.numpy().astype(np.float64) for rays in view.image_rays(0))
    b = (origins * directions).sum(-1)
    root = b**2 - ((origins**2).sum(-1) - 1)
    normals = origins + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * directions
    mirrored = directions - 2 * (directions * normals).sum(-1, keepdims=True) * normals
    agreement = np.where(root > 0, mirrored @ (direction / np.linalg.norm(direction)), -1)
    row, column = np.unravel_index(agreement.argmax(), agreement.shape)
    assert abs(x - column - 0.5) < 1 and abs(y - row - 0.5) < 1
    assert abs(x - (64 - column - 0.5)) > 8  # a mirrored light would be seen elsewhere


def test_turning_light_and_camera_together_changes_nothing(sphere: TriangleMesh) -> None:
    light, turn = lamp((0.2, 1, 0.4)), np.pi / 2
    first = cues(sphere, camera((3, 0, 0)), light, spp=64)
    turned = cues(sphere, camera((0, 3, 0)), light.rotated(turn), spp=64)
    wrong = cues(sphere, camera((0, 3, 0)), light.rotated(-turn), spp=64)
    scale = first[:3].max()
    assert np.abs(first[:3] - turned[:3]).mean() < 0.01 * scale
    assert np.abs(first[:3] - wrong[:3]).mean() > 0.05 * scale


def test_exposure_is_linear(sphere: TriangleMesh) -> None:
    light = lamp((1, 1, 1))
    np.testing.assert_allclose(
        cues(sphere, camera((3, 0, 0)), light.exposed(1.0))[:12],
        2 * cues(sphere, camera((3, 0, 0)), light)[:12],
        rtol=1e-4,
    )


@pytest.mark.parametrize(("x", "y"), [(5.0, 0.0), (0.0, -4.0), (-3.0, 6.0)])
def test_principal_point_moves_the_picture(sphere: TriangleMesh, x: float, y: float) -> None:
    """The projected centre of a far, narrow ball is the principal point."""
    mesh = TriangleMesh(sphere.vertices * np.float32(0.3), sphere.faces, sphere.vertex_normals)
    alpha = cues(mesh, camera((6, 0, 0), x=x, y=y, focal=3.0), constant_light())[12]
    rows, columns = np.mgrid[0:SIZE, 0:SIZE] + 0.5
    assert abs((alpha * columns).sum() / alpha.sum() - (SIZE / 2 + x)) < 0.1
    assert abs((alpha * rows).sum() / alpha.sum() - (SIZE / 2 + y)) < 0.1


def test_coverage_matches_the_cameras_own_rays(sphere: TriangleMesh) -> None:
    """Also with pixels that are not square."""
    view = camera((2.0, 1.5, 1.0))
    view = Cameras(view.world_from_camera, view.intrinsics * [1.0, 0.8, 1.0, 0.9], SIZE, SIZE)
    alpha = cues(sphere, view, constant_light(), spp=64)[12]
    origins, directions = (rays.numpy() for rays in view.image_rays(0))
    b = (origins * directions).sum(-1)
    hit = b**2 - ((origins**2).sum(-1) - 1) > 0
    disagree = (alpha > 0.5) != hit
    assert hit.sum() > 300
    assert disagree.sum() <= 0.04 * hit.sum()


def test_views_are_deterministic_and_independent(sphere: TriangleMesh) -> None:
    views = Cameras(
        np.stack([look_at(np.array(p), np.zeros(3)) for p in ((3.0, 0, 0), (0, 3.0, 1.0))]),
        np.tile([[40.0, 40, 16, 16]], (2, 1)),
        SIZE,
        SIZE,
    )
    light, sampling = lamp((1, 0, 1)), CueSampling(4)
    both = list(render_cues(sphere, views, light, sampling, 7))
    second = next(render_cues(sphere, views, light, sampling, 7, views=[1]))
    np.testing.assert_array_equal(both[1], second)
    other_seed = next(render_cues(sphere, views, light, sampling, 8, views=[1]))
    assert (other_seed != second).any()


def test_exchanging_the_light_equals_building_anew(sphere: TriangleMesh) -> None:
    first, second = lamp((1, 0, 1)), lamp((0, 1, -1))
    renderer = MitsubaCueRenderer(sphere, first, CueSampling(4))
    view = camera((3, 0, 0))
    before = renderer.render(view, 0, first, 3)
    exchanged = renderer.render(view, 0, second, 3)
    fresh = MitsubaCueRenderer(sphere, second, CueSampling(4)).render(view, 0, second, 3)
    np.testing.assert_array_equal(exchanged, fresh)
    assert np.abs(before - fresh).max() > 0.1
    with pytest.raises(UserError, match="one resolution"):
        renderer.render(view, 0, constant_light(height=8), 3)


def test_diffuse_is_flat_and_specular_is_smooth() -> None:
    """The hybrid of the supplement: 20 faces show in the diffuse cue only."""
    mesh = sphere_mesh(0)
    image = cues(mesh, camera((3, 0.3, 0.4), size=64), lamp((1, 0.5, 1), width_radians=1.0), spp=64)
    inside = image[12] == 1
    levels_diffuse = len(np.unique(np.round(image[0][inside] / image[0].max(), 1)))
    levels_rough = len(np.unique(np.round(image[9][inside] / image[9].max(), 1)))
    assert levels_diffuse < levels_rough


def test_the_diffuse_cue_alone_is_that_of_the_stack(sphere: TriangleMesh) -> None:
    view, light, sampling = camera((3, 0, 0)), lamp((1, 0, 1)), CueSampling(4)
    alone = next(render_cues(sphere, view, light, sampling, 7, only_diffuse=True))
    stack = next(render_cues(sphere, view, light, sampling, 7))
    np.testing.assert_array_equal(alone, stack[[0, 1, 2, 12]])


def test_channels_and_settings() -> None:
    assert len(CUE_CHANNELS) == 12 and CUE_CHANNELS[3] == "ggx_005.R"
    with pytest.raises(UserError, match="samples_per_pixel"):
        CueSampling(0)
    with pytest.raises(UserError, match="too short"):
        CueSampling(4, specular_depth=1)
