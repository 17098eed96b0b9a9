"""Gloss that photographs show is measured from how colours change with the eye."""

import numpy as np
import pytest

from illuminerf.cues.gloss import GlossFit, estimated_gloss, lobe_slope
from illuminerf.cues.materials import Material
from illuminerf.cues.renderer import CueSampling
from illuminerf.cues.shading import render_shaded
from illuminerf.cues.surface_samples import RayCaster, surface_points
from illuminerf.scene.cameras import spiral_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.procedural import duck_still_life
from illuminerf.workflow.errors import UserError


def made(slope: float, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours, diffuse cues and lobes [8 views, 500 points, 3] of painted points; a third are not seen."""
    shape = (8, 500, 3)
    diffuse = np.broadcast_to(generator.uniform(0.2, 1.0, shape[1:]), shape) * generator.uniform(0.99, 1.01, shape)
    lobe = generator.exponential(1.0, shape)
    colours = generator.uniform(0.05, 0.8, shape[1:]) * diffuse + slope * lobe
    colours[generator.random(shape[:2]) < 1 / 3] = np.nan
    return colours, diffuse, lobe


@pytest.mark.parametrize("slope", [0.0, 0.04, 0.3])
def test_the_slope_is_exact_whatever_the_paint(slope: float) -> None:
    colours, diffuse, lobe = made(slope, np.random.default_rng(0))
    assert lobe_slope(colours, diffuse, lobe) == pytest.approx(slope, abs=1e-9)
    # a lobe of other views says something else
    assert abs(lobe_slope(colours, diffuse, lobe[::-1]) - slope) > 0.1 * slope


def test_highlights_in_the_wrong_place_hardly_count() -> None:
    generator = np.random.default_rng(1)
    colours, diffuse, lobe = made(0.04, generator)
    spoilt = generator.random(colours.shape[:2]) < 0.05
    colours[spoilt] += 2.0
    assert lobe_slope(colours, diffuse, lobe) == pytest.approx(0.04, abs=0.004)
    left = np.where(np.isfinite(colours), colours - np.nanmean(colours, 0), 0)
    plain = (left * (lobe - lobe.mean(0))).sum() / np.square(lobe - lobe.mean(0)).sum()
    assert abs(plain - 0.04) > 0.004  # least squares would have believed them


def test_a_varnished_duck_shows_gloss_and_a_matt_one_does_not() -> None:
    mesh, light = duck_still_life(40)[0].mesh, lamp()
    cameras = spiral_cameras(10, 3.0, 0.5, 48, 48, np.radians(-10), np.radians(70))
    points = surface_points(mesh, 1500, 0.05, np.random.default_rng(0))
    found = []
    for roughness in (0.34, 1.0):
        views = render_shaded([(mesh, Material((0.4, 0.3, 0.2), roughness))], cameras, light, 64)
        gloss = estimated_gloss(mesh, points, RayCaster(mesh), views, light, CueSampling(32), GlossFit(num_views=10), 0)
        assert gloss is not None
        found.append(gloss)
    assert found[0] > 0.5 and found[1] < 0.4 * found[0]


def test_where_too_little_is_seen_nothing_is_said() -> None:
    mesh, light = duck_still_life(40)[0].mesh, lamp()
    cameras = spiral_cameras(2, 3.0, 0.5, 24, 24, np.radians(-10), np.radians(70))
    views = render_shaded([(mesh, Material())], cameras, light, 4)
    points = surface_points(mesh, 300, 0.05, np.random.default_rng(0))
    assert estimated_gloss(mesh, points, RayCaster(mesh), views, light, CueSampling(4), GlossFit(), 0) is None
    with pytest.raises(UserError, match="gloss"):
        GlossFit(num_views=3, least_views=4)


def lamp(height: int = 16) -> EnvironmentMap:
    """A lamp at one side above a dim room."""
    directions = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32)).directions()
    lobe = np.exp(20 * (directions @ np.array([0.64, -0.48, 0.6]) - 1))[..., None]
    return EnvironmentMap((0.15 + 4 * lobe * np.ones(3)).astype(np.float32))
