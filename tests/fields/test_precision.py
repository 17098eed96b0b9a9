"""bfloat16 in the radiance fields' layers: close to float32, and nowhere else."""

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_loss, level_weights
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.fields.radiance_field import RadianceField
from illuminerf.workflow.config import from_json, to_json
from tests.fields.test_appearance import _FIELD, _pool


def _field() -> RadianceField:
    torch.manual_seed(0)
    return RadianceField(dataclasses.replace(_FIELD, num_samples=4))


def _loss(field: RadianceField) -> Tensor:
    pool = _pool(40)
    target, alpha = torch.full((40, 3), 0.5), torch.ones(40)
    generator = torch.Generator().manual_seed(1)
    index = torch.arange(40)
    config = GeometryLossConfig(first_levels=2)
    levels = level_weights(field, config, torch.tensor(1.0))
    return geometry_loss(field, config, pool, target, alpha, index, levels, generator)[0]


def _by_precision(ask: Callable[[RadianceField], Tensor]) -> tuple[Tensor, Tensor]:
    field = _field()
    full = ask(field)
    with field.computing_in("bfloat16"):
        half = ask(field)
    assert torch.equal(ask(field), full), "outside it is float32 again"
    return full.detach(), half.detach()


def _colours(field: RadianceField) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    positions, directions = torch.rand(2, 50, 3, generator=generator) - 0.5
    normals = torch.nn.functional.normalize(directions + 0.1, dim=-1)
    return field.appearance(positions, directions, normals, torch.ones(50, 4))


def test_colours_are_close_and_of_float32() -> None:
    full, half = _by_precision(_colours)
    assert half.dtype == torch.float32
    assert 0 < float((half - full).abs().max()) < 0.01
    # the guard: other directions are further off than that
    field = _field()
    with torch.no_grad():
        field.appearance.camera_radiance[0].weight.mul_(1.3)
    assert float((_colours(field) - full).detach().abs().max()) > 0.01
    # ... and the sums along rays have more digits than bfloat16's eight bits
    assert float((half[:, :6] - half[:, :6].bfloat16().float()).abs().max()) > 1e-5


def test_losses_and_gradients_are_close() -> None:
    full, half = _by_precision(_loss)
    assert half.dtype == torch.float32 and 0 < abs(float(half / full) - 1) < 0.01
    gradients = []
    for precision in ("float32", "bfloat16"):
        field = _field()
        with field.computing_in(precision):  # type: ignore[arg-type]
            _loss(field).backward()
        gradients.append(field.appearance.grid.table.grad)
        assert gradients[-1].dtype == torch.float32
    error = float((gradients[1] - gradients[0]).norm() / gradients[0].norm())
    assert 0 < error < 0.1


def test_signed_distances_and_predicted_normals_keep_all_digits() -> None:
    positions = torch.rand(50, 3, generator=torch.Generator().manual_seed(3)) - 0.5

    def surface(field: RadianceField) -> Tensor:
        point = field.surface(positions)
        normals = field.surface.predicted_normals(positions)
        return torch.cat([point.signed_distance[:, None], point.gradient, normals], -1)

    full, half = _by_precision(surface)
    assert torch.equal(full, half)


def test_precision_is_part_of_the_config() -> None:
    config = OptimiserConfig(precision="bfloat16")
    assert from_json(OptimiserConfig, to_json(config)) == config != OptimiserConfig()
