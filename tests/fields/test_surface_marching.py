"""Marched images against images of many samples, and the traversal of empty cells against points along rays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from illuminerf.fields.appearance import AppearanceConfig
from illuminerf.fields.bounds import OccupiedCells, ball_interval
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.image_rendering import RenderedImage, render_image, render_image_as_trained
from illuminerf.fields.proposal_sampling import ProposalConfig
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.shell import SurfaceShell, surface_shell
from illuminerf.fields.surface import SurfaceConfig
from illuminerf.fields.surface_marching import RayWeights, march, middle_of_weight
from illuminerf.fields.volume_rendering import laplace_density
from illuminerf.scene.cameras import Cameras, turntable_cameras

_GRID = HashGridConfig(4, 2, 12, 4, 32)
_CONFIG = FieldConfig(
    SurfaceConfig(_GRID, 16, _GRID, 8, initial_beta=6e-3),
    AppearanceConfig(_GRID, 8, 16, 1, 1, 4, 8),
    ProposalConfig(_GRID, 8),
    num_proposal_samples=32,
    num_samples=24,
    radiance_normals="predicted",
)
_CELLS = OccupiedCells(torch.ones(16, 16, 16, dtype=torch.bool))
_GREY_LEVEL = 1 / 255


@pytest.fixture(scope="module")
def field() -> RadianceField:
    """A dented, coloured ball."""
    torch.manual_seed(0)
    field = RadianceField(_CONFIG)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for grid, size in ((field.surface.grid, 0.1), (field.surface.normal_grid, 0.3), (field.appearance.grid, 1.0)):
            grid.table.copy_(torch.randn(grid.table.shape, generator=generator) * size)
    return field


@pytest.fixture(scope="module")
def camera() -> Cameras:
    return turntable_cameras(1, 2.5, 0.6, 32, 40)


@pytest.fixture(scope="module")
def shell(field: RadianceField) -> SurfaceShell:
    return surface_shell(field.surface, _CELLS)


@pytest.fixture(scope="module")
def many_samples(field: RadianceField, camera: Cameras) -> RenderedImage:
    """The slow image with samples enough, none of them left out."""
    return _as_trained(field, camera, num_samples=400, min_weight=0.0)


def _as_trained(field: RadianceField, camera: Cameras, **changes: float) -> RenderedImage:
    field.config = replace(_CONFIG, num_proposal_samples=64, **changes)
    try:
        return render_image_as_trained(field, _CELLS, camera, 0)
    finally:
        field.config = _CONFIG


def _errors(one: RenderedImage, other: RenderedImage) -> dict[str, float]:
    return {name: float(np.abs(value - getattr(other, name)).max()) for name, value in vars(one).items()}


def test_a_marched_image_is_that_of_many_samples(
    field: RadianceField, shell: SurfaceShell, camera: Cameras, many_samples: RenderedImage
) -> None:
    errors = _errors(render_image(field, shell, camera, 0), many_samples)
    assert all(error < _GREY_LEVEL for error in errors.values()), errors


def test_a_shell_that_lacks_cells_is_seen(
    field: RadianceField, shell: SurfaceShell, camera: Cameras, many_samples: RenderedImage
) -> None:
    occupied = (shell.clearance == 0).view(shell.side, shell.side, shell.side).clone()
    # a hole through the object, as wide as a pixel
    centres = (occupied.nonzero() + 0.5) * (2 / shell.side) - 1
    axis = functional.normalize(torch.from_numpy(camera.positions[0]).float(), dim=0)
    occupied[tuple(occupied.nonzero()[(centres - (centres @ axis)[:, None] * axis).norm(dim=-1) < 0.04].T)] = False
    errors = _errors(render_image(field, SurfaceShell(OccupiedCells(occupied)), camera, 0), many_samples)
    assert all(error > 2 * _GREY_LEVEL for error in errors.values()), errors


def test_density_normals_are_used_where_the_field_wants_them(
    field: RadianceField, shell: SurfaceShell, camera: Cameras
) -> None:
    camera = camera.resized(16, 20)
    predicted = render_image(field, shell, camera, 0)
    field.config = replace(_CONFIG, radiance_normals="density")
    try:
        marched = render_image(field, shell, camera, 0)
    finally:
        field.config = _CONFIG
    reference = _as_trained(field, camera, num_samples=400, min_weight=0.0, radiance_normals="density")
    errors, others = _errors(marched, reference), _errors(predicted, reference)
    assert errors["srgb"] < _GREY_LEVEL and errors["srgb"] < 0.3 * others["srgb"]
    # gradients turn within the soft shell, of which a march takes in one place
    assert errors["normals"] < 0.05 and errors["normals"] < 0.3 * others["normals"]


def test_no_cell_is_missed_and_none_is_met_too_early() -> None:
    generator = torch.Generator().manual_seed(0)
    cells = OccupiedCells(torch.rand(24, 24, 24, generator=generator) < 0.004)
    origins = 2.5 * functional.normalize(torch.randn(500, 3, generator=generator), dim=-1)
    directions = functional.normalize(torch.rand(500, 3, generator=generator) - 0.5 - origins, dim=-1)
    directions[:3], origins[0] = torch.eye(3), torch.tensor([-3.0, 0.03, 0.03])
    near, far = SurfaceShell(cells).enter(origins, directions)
    distances = torch.arange(0.5, 4.5, 2e-3)
    points = origins[:, None] + distances[:, None] * directions[:, None]
    inside = cells.contains(points) & (points.abs().amax(-1) < 1)
    first = torch.where(inside.any(-1), distances[inside.int().argmax(-1)], torch.inf)
    found = first.isfinite()
    assert 0.1 < float(found.float().mean()) < 0.9
    assert bool((near <= first + 1e-3).all())
    met = near.isfinite()
    assert bool(cells.contains(origins[met] + (near[met, None] + 1e-5) * directions[met]).all())
    assert int((met & ~found).sum()) <= 5  # corners that points 0.002 apart step over
    assert bool((near[met] < far[met]).all())
    twin = SurfaceShell(cells)._advance(origins, directions, ball_interval(origins, directions)[0] - 0.5, far)
    kernel = SurfaceShell(cells).advance(origins, directions, ball_interval(origins, directions)[0] - 0.5, far)
    torch.testing.assert_close(kernel, twin, rtol=0, atol=1e-4)
    # the guard: clearances that are too large miss cells
    wrong = SurfaceShell(cells)
    wrong.clearance = torch.where(wrong.clearance > 1, wrong.clearance + 1, wrong.clearance)
    assert float((wrong.enter(origins, directions)[0] > first + 1e-3).float().mean()) > 0.02


def test_rays_go_on_behind_a_gap() -> None:
    occupied = torch.zeros(16, 16, 16, dtype=torch.bool)
    occupied[3, 8, 8] = occupied[12, 8, 8] = True
    shell = SurfaceShell(OccupiedCells(occupied))
    origins, directions = torch.tensor([[-2.0, 0.06, 0.06]]), torch.tensor([[1.0, 0, 0]])
    near, far = shell.enter(origins, directions)
    assert float(near) == pytest.approx(2 - 1 + 3 / 8, abs=1e-3)
    again = shell.advance(origins, directions, near + 0.13, far)
    assert float(again) == pytest.approx(2 - 1 + 12 / 8, abs=1e-3)
    assert bool(shell.advance(origins, directions, again + 0.13, far).isinf().all())


def test_an_empty_shell_is_an_empty_image(field: RadianceField, camera: Cameras) -> None:
    shell = SurfaceShell(OccupiedCells(torch.zeros(8, 8, 8, dtype=torch.bool)))
    image = render_image(field, shell, camera, 0)
    assert not any(value.any() for value in vars(image).values())


def test_weights_of_a_ray_through_a_sphere() -> None:
    torch.manual_seed(0)
    field = RadianceField(_CONFIG)
    with torch.no_grad():
        field.surface.head.weight.zero_()
    beta = float(field.surface.beta.detach())
    beside = torch.tensor([0.0, 0.3, 0.5 + 3 * beta, 0.5 + 6 * beta])
    origins = torch.stack([torch.full((4,), -2.0), beside, torch.zeros(4)], -1)
    directions = torch.tensor([[1.0, 0, 0]]).expand(4, 3)
    shell = surface_shell(field.surface, _CELLS)
    samples = march(field.surface, shell, origins, directions, *shell.enter(origins, directions))
    alpha, depth = samples.total(4, torch.stack([torch.ones_like(samples.distance), samples.distance], -1)).unbind(-1)
    # the integral itself, in fine steps
    step = 1e-4
    along = torch.arange(1, 3, step, dtype=torch.float64)
    points = origins.double()[:, None] + along[:, None] * directions.double()[:, None]
    density = laplace_density(points.norm(dim=-1) - 0.5, torch.tensor(beta, dtype=torch.float64))
    weights = torch.exp(-step * (density.cumsum(-1) - density)) * -torch.expm1(-step * density)
    torch.testing.assert_close(alpha.double(), weights.sum(-1), rtol=0, atol=2e-3)
    torch.testing.assert_close(depth.double(), (weights * along).sum(-1), rtol=0, atol=_GREY_LEVEL)
    assert float(alpha[0]) > 0.998 and 0.3 < float(alpha[2]) < 0.97 and 0.01 < float(alpha[3]) < 0.2
    hit, _ = ball_interval(origins[:1], directions[:1], 0.5)
    assert abs(float(depth[0]) - float(hit)) < beta


def test_where_the_weight_of_an_interval_lies() -> None:
    beta, start, end = 0.01, 0.05, 0.004
    share = torch.linspace(0, 1, 20001, dtype=torch.float64)
    density = laplace_density(start + (end - start) * share, torch.tensor(beta, dtype=torch.float64))
    width = start - end
    passed = torch.cumsum(density, 0) * width / len(share)
    weight = density * torch.exp(-passed)
    wanted = float((weight * share).sum() / weight.sum())
    ends = torch.tensor([start]), torch.tensor([end])
    found = float(middle_of_weight(*ends, passed[-1:].float(), torch.tensor(beta)))
    assert wanted > 0.7 and found == pytest.approx(wanted, abs=0.02)
    even = torch.tensor([-0.3])
    assert float(middle_of_weight(even, even, torch.tensor([1e-4]), torch.tensor(beta))) == pytest.approx(0.5, abs=1e-3)


def test_merging_keeps_mass_and_mean_and_never_joins_surfaces() -> None:
    ray = torch.tensor([0] * 6 + [2] * 4)
    distance = torch.tensor([1.0, 1.01, 1.02, 1.03, 1.04, 2.0, 3.0, 3.01, 3.02, 3.03])
    weight = torch.tensor([0.002, 0.003, 0.004, 0.5, 0.3, 0.1, 0.005, 0.005, 0.005, 0.005])
    merged = RayWeights(ray, distance, weight).merged(0.1)
    assert merged.ray.tolist() == [0, 0, 0, 0, 2]
    values = torch.stack([distance, torch.ones_like(distance)], -1)
    moments = torch.stack([merged.distance, torch.ones_like(merged.distance)], -1)
    torch.testing.assert_close(merged.total(3, moments), RayWeights(ray, distance, weight).total(3, values))
    assert len(RayWeights(ray[:0], distance[:0], weight[:0]).merged(0.1).ray) == 0
