"""The fused surface kernel in float32 against its readable twin in float64: values, first and second derivative."""

import copy
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from torch import Tensor

from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.surface import SurfaceConfig, SurfaceField
from illuminerf.fields.surface_kernel import softplus_with_slope

ROOT = Path(__file__).parents[2]
# the first level is dense, the others are hashed
_CONFIG = SurfaceConfig(HashGridConfig(4, 2, 10, 4, 48), 24, HashGridConfig(3, 2, 10, 4, 16), 8)
_LEVELS = torch.tensor([1.0, 1.0, 0.6, 0.0])


def _surface(num_features: int = 2) -> SurfaceField:
    torch.manual_seed(0)
    surface = SurfaceField(SurfaceConfig(HashGridConfig(4, num_features, 10, 4, 48), 24, _CONFIG.normal_grid, 8))
    with torch.no_grad():
        surface.grid.table.copy_(torch.randn_like(surface.grid.table) * 0.1)
        surface.hidden.bias.mul_(0.1)
    return surface


def _positions(count: int = 300) -> Tensor:
    """Inside, on the faces of cells, on the box and outside it."""
    positions = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 2.2 - 1.1
    positions[:20] = (positions[:20] * 2).round() / 2
    return positions


def _losses(distance: Tensor, gradient: Tensor, positions: Tensor) -> dict[str, Tensor]:
    waves = torch.sin(7 * positions.sum(-1))
    return {
        "distance": (distance * waves).mean(),
        "eikonal": ((gradient.norm(dim=-1) - 1) ** 2).mean(),
        "both": ((gradient * waves[:, None]).sum(-1) * distance).mean(),
    }


def _parameters(surface: SurfaceField) -> list[Tensor]:
    return [surface.grid.table, surface.hidden.weight, surface.hidden.bias, surface.head.weight]


@pytest.mark.parametrize("levels", [None, _LEVELS])
@pytest.mark.parametrize("num_features", [1, 2, 4])
def test_values_and_derivatives_are_the_twins(num_features: int, levels: Tensor | None) -> None:
    surface, positions = _surface(num_features), _positions()
    twin = copy.deepcopy(surface).double()
    ours, exact = surface(positions, levels), twin(positions.double(), levels)
    torch.testing.assert_close(ours.signed_distance.double(), exact.signed_distance, rtol=0, atol=2e-6)
    torch.testing.assert_close(ours.gradient.double(), exact.gradient, rtol=1e-4, atol=1e-4)
    found, wanted = (_losses(*point, place) for point, place in ((ours, positions), (exact, positions.double())))
    for name in wanted:
        mine = torch.autograd.grad(found[name], _parameters(surface), retain_graph=True)
        theirs = torch.autograd.grad(wanted[name], _parameters(twin), retain_graph=True)
        for one, other in zip(mine, theirs, strict=True):
            scale = float(other.abs().max())
            assert scale > 0
            assert float((one - other).abs().max()) < 2e-3 * scale, name


@pytest.mark.parametrize("levels", [None, _LEVELS])
def test_the_distance_alone_is_the_same(levels: Tensor | None) -> None:
    surface, positions = _surface(), _positions()
    with torch.no_grad():
        exact = copy.deepcopy(surface).double().signed_distance(positions.double(), levels)
        alone = surface.signed_distance(positions, levels)
        other = surface.signed_distance(positions, _LEVELS if levels is None else None)
    torch.testing.assert_close(alone.double(), exact, rtol=0, atol=2e-6)
    # the guard: other weights of the levels are told apart
    assert float((other.double() - exact).abs().max()) > 2e-4
    # with gradients it is differentiable
    assert surface.signed_distance(positions, levels).requires_grad and not alone.requires_grad


def test_without_the_curvature_of_the_softplus_the_gradient_is_another_one() -> None:
    surface, positions = _surface().double(), _positions().double()
    features, jacobian = surface.grid.with_jacobian(positions)
    slope = torch.sigmoid(100 * surface.hidden(features))
    found = []
    for each in (slope, slope.detach()):
        gradient = torch.einsum("nf,nfi->ni", (each * surface.head.weight) @ surface.hidden.weight, jacobian)
        loss = ((gradient.norm(dim=-1) - 1) ** 2).mean()
        found.append(torch.autograd.grad(loss, surface.grid.table, retain_graph=True)[0])
        if each is slope:
            torch.testing.assert_close(gradient, surface.residual(features, jacobian).gradient)
    assert float((found[0] - found[1]).abs().max()) > 0.02 * float(found[0].abs().max())


def _elsewhere(tensor: Tensor, offset: int) -> Tensor:
    """The same numbers at another place in memory."""
    buffer = tensor.new_empty(tensor.numel() + 64)
    return buffer[offset : offset + tensor.numel()].view(tensor.shape).copy_(tensor)


def test_result_does_not_depend_on_where_arrays_lie() -> None:
    """Loops that ran as vectors for some addresses only would round in two ways."""
    surface, positions = _surface(), _positions(1000)
    generator = torch.Generator().manual_seed(2)
    incoming = torch.randn(1000, generator=generator), torch.randn(1000, 3, generator=generator)
    found = []
    for offset in range(0, 60, 3):
        kept = [torch.empty(1000 + 100 * offset) for _ in range(offset % 7)]  # so that temporary arrays move too
        places, weights = _elsewhere(positions, offset), _elsewhere(torch.ones(4), offset)
        point = surface(places, weights)
        grads = [_elsewhere(each, offset) for each in incoming]
        gradients = torch.autograd.grad(point, _parameters(surface), grads)
        features = surface.grid(places)
        of_table = torch.autograd.grad(features, surface.grid.table, _elsewhere(torch.ones_like(features), offset))
        found.append([*point, *gradients, features, *of_table])
        del kept
    for other in found[1:]:
        assert all(torch.equal(one, another) for one, another in zip(found[0], other, strict=True))


@pytest.mark.parametrize("count", [1, 15, 64, 65, 300])
def test_a_point_does_not_depend_on_the_others(count: int) -> None:
    surface, positions = _surface(), _positions()
    together = surface(positions, _LEVELS)
    apart = [surface(part, _LEVELS) for part in positions.split(count)]
    assert torch.equal(together.signed_distance, torch.cat([part.signed_distance for part in apart]))
    assert torch.equal(together.gradient, torch.cat([part.gradient for part in apart]))
    assert torch.equal(surface.grid(positions), torch.cat([surface.grid(part) for part in positions.split(count)]))


def _digest() -> str:
    """Of the surface's values and all gradients at some positions."""
    surface, positions = _surface(), _positions(1000)
    point = surface(positions)
    gradients = torch.autograd.grad(sum(_losses(*point, positions).values()), _parameters(surface))  # type: ignore[arg-type]
    parts = (part.detach().numpy().tobytes() for part in (*point, *gradients))
    return f"{numba.get_num_threads()} {hashlib.sha256(b''.join(parts)).hexdigest()}"


def test_result_does_not_depend_on_threads() -> None:
    script = "import illuminerf; from tests.fields.test_surface_kernel import _digest; print(_digest())"
    digests = {}
    for told, threads in (("OMP_NUM_THREADS", 1), ("NUMBA_NUM_THREADS", 2)):
        kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
        environment = kept | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", told: str(threads)}
        done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
        assert not done.returncode, done.stderr
        count, digests[told] = done.stdout.split()
        assert int(count) == threads
    assert len(set(digests.values())) == 1


def test_polynomials_stand_for_exponential_and_logarithm() -> None:
    values = np.concatenate([np.linspace(-2, 2, 4001), np.linspace(-0.01, 0.01, 2001), [-1e20, 1e20, 0.0]])
    softplus, slope = np.empty_like(values), np.empty_like(values)
    for i, value in enumerate(values):
        softplus[i], slope[i] = softplus_with_slope(np.float32(value))
    exact = np.float32(values).astype(np.float64)
    tail = np.exp(-np.minimum(np.abs(exact) * 100, 700))
    np.testing.assert_allclose(softplus, np.maximum(exact, 0) + np.log1p(tail) / 100, rtol=3e-7, atol=2e-8)
    np.testing.assert_allclose(slope, np.where(exact > 0, 1, tail) / (1 + tail), rtol=0, atol=1e-6)
    # the guard: a series one term shorter is told apart
    z = tail / (2 + tail)
    short = 2 * (z + z**3 / 3 + z**5 / 5)
    assert np.abs(np.maximum(exact, 0) + short / 100 - softplus).max() > 1e-6
