"""The level of the mesh, on balls whose size is known."""

import pytest
import torch

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.outlines import least_distance, outline_level
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_pool import RayPool, gather_rays
from tests.fields.sphere_views import sphere_views

_RADIUS = 0.5  # of the ball that a field is without its network
_BETA = 0.03


@pytest.fixture
def field() -> RadianceField:
    torch.manual_seed(0)
    field = RadianceField(FieldConfig.embedded())
    with torch.no_grad():
        field.surface.head.weight.zero_()
        field.surface.log_beta.fill_(torch.tensor(_BETA - 5e-4).log())
    return field


def pool(radius: float) -> RayPool:
    cameras, masks = sphere_views(radius, 4)
    return gather_rays(cameras, masks, OccupiedCells(torch.ones(16, 16, 16, dtype=torch.bool)), least_coverage=0.5)


def level(field: RadianceField, radius: float, has_masks: bool = True) -> float:
    return outline_level(field, pool(radius), has_masks, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("radius", [0.5, 0.54, 0.57])
def test_the_mesh_is_as_large_as_the_masks(field: RadianceField, radius: float) -> None:
    # a pixel is 0.05 wide in these masks; a level is an eighth of beta
    assert level(field, radius) == pytest.approx(radius - _RADIUS, abs=0.012)
    assert level(field, radius + 0.05) > level(field, radius) + 0.02, "larger masks, larger mesh"


def test_a_mesh_is_never_thinner_than_its_zero_level(field: RadianceField) -> None:
    assert level(field, 0.4) == 0


def test_without_masks_what_the_field_shows_as_opaque_counts(field: RadianceField) -> None:
    """A ray that grazes a ball of 0.5 gathers density on a way of some 0.2: it is half opaque outside."""
    found = level(field, 0.9, has_masks=False)
    assert _BETA / 2 < found < 4 * _BETA
    with torch.no_grad():
        field.surface.log_beta.sub_(2.0)
    assert level(field, 0.9, has_masks=False) < found / 2, "a harder surface is opaque closer to its zero level"


def test_least_distance_along_rays(field: RadianceField) -> None:
    rays = pool(0.9)
    index = torch.arange(0, len(rays), 7)
    origins, directions, *_ = rays.rays(index)
    closest = (origins - (origins * directions).sum(-1, keepdim=True) * directions).norm(dim=-1)
    wanted = closest - _RADIUS
    with torch.no_grad():
        torch.testing.assert_close(least_distance(field.surface, rays, index), wanted, rtol=0, atol=2e-3)
        # the guard: the middle of each ray is not as close
        middles = origins + 0.5 * (rays.near + rays.far)[index, None] * directions * 0.9
        assert (field.surface.signed_distance(middles) - wanted).abs().max() > 0.01
