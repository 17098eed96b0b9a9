"""Directions, AffineGLO, the blend of the two radiance fields, and the cached rendering against the direct one."""

import math

import numpy as np
import torch
from torch.nn import functional

from illuminerf.fields.appearance import AffineGLO, AppearanceConfig, AppearanceField, blend_radiance
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.directions import encode_directions, encoded_width, reflect
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.proposal_sampling import ProposalConfig
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_pool import RayPool
from illuminerf.fields.shading_cache import cache_shading, latent_loss, steps_on_surface
from illuminerf.fields.surface import SurfaceConfig
from illuminerf.scene.cameras import turntable_cameras

_GRID = HashGridConfig(3, 2, 8, 4, 16)
_FIELD = FieldConfig(
    SurfaceConfig(_GRID, 8, _GRID, 8, initial_beta=0.01),
    AppearanceConfig(_GRID, 8, 8, 1, 2, 4, 8),
    ProposalConfig(_GRID, 8),
    num_proposal_samples=16,
    num_samples=8,
    min_weight=0.0,
)


def _directions(count: int, seed: int = 0) -> torch.Tensor:
    return functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)


def test_encoding_is_sine_and_cosine_of_octaves() -> None:
    directions = _directions(7)
    encoded = encode_directions(directions, 3)
    assert encoded.shape == (7, encoded_width(3))
    parts = [directions]
    for octave in range(3):
        parts += [(2**octave * directions).sin(), (2**octave * directions).cos()]
    torch.testing.assert_close(encoded, torch.cat(parts, -1), rtol=1e-5, atol=1e-5)


def test_reflection_is_an_involution_that_flips_the_normal_part() -> None:
    directions, normals = _directions(20, 1), _directions(20, 2)
    mirrored = reflect(directions, normals)
    torch.testing.assert_close(reflect(mirrored, normals), directions)
    torch.testing.assert_close((mirrored * normals).sum(-1), -(directions * normals).sum(-1))
    torch.testing.assert_close(mirrored.norm(dim=-1), torch.ones(20))


def test_the_zero_code_leaves_the_bottleneck_as_it_is() -> None:
    glo = AffineGLO(4, 16, 8)
    bottleneck = torch.randn(5, 8, generator=torch.Generator().manual_seed(0))
    assert torch.equal(glo(bottleneck, torch.zeros(5, 4)), bottleneck)
    assert not torch.allclose(glo(bottleneck, torch.ones(5, 4)), bottleneck, atol=1e-3)


def test_zero_code_and_no_code_render_the_same() -> None:
    torch.manual_seed(0)
    field = AppearanceField(_FIELD.appearance)
    inputs = (0.5 * _directions(6), _directions(6, 1), _directions(6, 2))
    assert torch.equal(field(*inputs), field(*inputs, torch.zeros(6, 4)))


def test_blend_is_per_ray() -> None:
    rendered = torch.tensor([[1.0, 1, 1, 0, 0, 0, 0.0], [1.0, 1, 1, 0, 0, 0, math.log(3)]])
    torch.testing.assert_close(blend_radiance(rendered)[:, 0], torch.tensor([0.5, 0.25]))


def _pool(count: int) -> RayPool:
    cameras = turntable_cameras(2, 2.5, 0.6, 16, 16)
    pixel = torch.arange(16 * 6, 16 * 6 + count)
    return RayPool(
        torch.ones(count, dtype=torch.long),
        pixel,
        torch.full((count,), 1.6),
        torch.full((count,), 3.4),
        count,
        cameras,
    )


def test_cached_colours_are_the_rendered_ones() -> None:
    torch.manual_seed(0)
    field, pool = RadianceField(_FIELD), _pool(40)
    index = torch.arange(40)
    cache = cache_shading(field, pool, num_kept=8)
    origins, directions, near, far = pool.rays(index)
    samples = field.sample(origins, directions, near, far)
    points = field.worth_shading(samples)
    normals = field.shading_normals(points)
    latents = torch.randn(40, 4, generator=torch.Generator().manual_seed(0))
    direct = field.shade(points, normals, directions, latents)
    assert float(direct.detach().max()) > 0.1
    torch.testing.assert_close(cache.render(field, index, latents), direct, rtol=1e-4, atol=1e-5)
    # the guard: fewer kept samples are another image, yet of the same opacity
    fewer = cache_shading(field, pool, num_kept=1)
    assert not torch.allclose(fewer.render(field, index, latents), direct, atol=1e-4)
    torch.testing.assert_close(fewer.weights.sum(-1), cache.weights.sum(-1))


def test_a_step_within_a_pixel_stays_on_the_surface_and_in_the_pixel() -> None:
    pool = _pool(40)
    index = torch.arange(40)
    origins, directions, _, _ = pool.rays(index)
    generator = torch.Generator().manual_seed(0)
    normals = functional.normalize(-directions + 0.8 * torch.randn(40, 3, generator=generator), dim=-1)
    facing = -(directions * normals).sum(-1)
    assert float(facing.min()) < 0.3 < float(facing.median()) < 0.9, "slanted ones, and a few beyond the bound"
    points, within = origins + 2.5 * directions, torch.rand(40, 2, generator=generator) - 0.5
    side = 2.5 / float(pool.cameras.intrinsics[0, 0])
    moved = points + steps_on_surface(within * side, directions, normals)
    bounded = facing > 0.3
    assert float(((moved - points) * normals).sum(-1)[bounded].abs().max()) < 1e-6
    assert float(((moved - points) * normals).sum(-1)[~bounded].abs().max()) > 1e-4
    camera = pool.cameras[[1]]
    (before, _), (after, _) = (camera.project(each.numpy()) for each in (points, moved))
    steps = np.linalg.norm(after[0] - before[0], axis=-1)
    np.testing.assert_allclose(steps, within.norm(dim=-1).numpy(), rtol=0.1, atol=1e-3)
    assert np.abs(steps - 2 * within.norm(dim=-1).numpy()).max() > 0.3, "the guard: of twice the length"


def test_colours_within_a_pixel_are_others_and_those_in_its_middle_the_same() -> None:
    torch.manual_seed(0)
    field, pool = RadianceField(_FIELD), _pool(40)
    index = torch.arange(40)
    cache = cache_shading(field, pool, num_kept=4)
    middle = cache.render(field, index)
    torch.testing.assert_close(cache.render(field, index, within_pixels=torch.zeros(40, 2)), middle)
    corner = cache.render(field, index, within_pixels=torch.full((40, 2), 0.5))
    assert 1e-5 < float((corner - middle).detach().abs().max()) < 0.2
    assert 0.5 < float((cache.pixel_sides * pool.cameras.intrinsics[0, 0]).mean()) / 2.0 < 1.5


def test_latent_fit_reaches_appearance_and_latents_but_not_the_geometry() -> None:
    torch.manual_seed(0)
    field, pool = RadianceField(_FIELD), _pool(40)
    cache = cache_shading(field, pool, num_kept=4)
    latents = torch.full((40, 4), 0.1, requires_grad=True)
    loss, _ = latent_loss(field, cache, torch.arange(40), torch.full((40, 3), 0.5), latents, 1e-4)
    loss.backward()
    assert float(latents.grad.abs().sum()) > 0
    assert float(field.appearance.grid.table.grad.abs().sum()) > 0
    assert all(p.grad is None for p in [*field.surface.parameters(), *field.proposal.parameters()])


def test_rays_through_empty_space_are_black_and_finite() -> None:
    field, pool = RadianceField(_FIELD), _pool(3)
    origins, directions, near, far = pool.rays(torch.arange(3))
    samples = field.sample(origins + torch.tensor([0.0, 0, 0.9]), directions, near, far)
    points = field.worth_shading(samples)
    colour = field.shade(points, points.density_normals, directions)
    assert float(colour.detach().abs().max()) < 1e-3
    assert not bool(OccupiedCells(torch.zeros(8, 8, 8, dtype=torch.bool)).clip(origins, directions)[1].any())
