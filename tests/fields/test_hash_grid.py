"""The numba kernel against the readable twin, first and (through the Jacobian) second derivative."""

import pytest
import torch

from illuminerf.fields.hash_grid import HashGrid, HashGridConfig, coarse_to_fine_weights, interpolate
from illuminerf.fields.hash_grid_kernel import KernelInterpolation
from illuminerf.workflow.errors import UserError

# the last levels are hashed, the first are dense
_SMALL = HashGridConfig(num_levels=4, num_features=2, log2_entries=7, coarsest=3, finest=24)


def _double_grid(config: HashGridConfig = _SMALL) -> HashGrid:
    grid = HashGrid(config, torch.Generator().manual_seed(1)).double()
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=torch.Generator().manual_seed(2)))
    return grid


def _positions(count: int = 50) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 1.9 - 0.95


def _twin(grid: HashGrid, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return interpolate(positions, grid.table, grid._resolutions, grid._sizes, grid._offsets, True)


@pytest.mark.parametrize("num_features", [1, 2, 4])
def test_kernel_equals_twin_in_value_and_in_gradient(num_features: int) -> None:
    grid = _double_grid(HashGridConfig(4, num_features, 7, 3, 24))
    positions = _positions()
    outputs = []
    for features, jacobian in (grid.with_jacobian(positions), _twin(grid, positions)):
        mixed = (features**3).sum() + (jacobian**2 * torch.linspace(0, 1, 3)).sum()
        outputs.append((features, jacobian, *torch.autograd.grad(mixed, grid.table)))
    for ours, twin in zip(*outputs, strict=True):
        torch.testing.assert_close(ours, twin, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(grid(positions), outputs[1][0], rtol=1e-10, atol=1e-10)


def test_features_alone_send_the_same_gradient_to_the_table() -> None:
    grid, positions = _double_grid(), _positions()
    (ours,) = torch.autograd.grad((grid(positions) ** 2).sum(), grid.table)
    (twin,) = torch.autograd.grad((_twin(grid, positions)[0] ** 2).sum(), grid.table)
    torch.testing.assert_close(ours, twin, rtol=1e-10, atol=1e-10)


def test_gradcheck_of_the_kernel() -> None:
    grid, positions = _double_grid(), _positions(6)
    table = grid.table.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda t: KernelInterpolation.apply(t, positions, grid.layout, True), (table,))


def test_jacobian_is_the_derivative_of_the_features() -> None:
    grid = _double_grid()
    positions = _positions().requires_grad_()
    features, _ = _twin(grid, positions)
    _, jacobian = grid.with_jacobian(positions.detach())
    for column in range(features.shape[1]):
        (row,) = torch.autograd.grad(features[:, column].sum(), positions, retain_graph=True)
        torch.testing.assert_close(jacobian[:, column], row, rtol=1e-9, atol=1e-9)


def test_loss_on_normals_equals_double_backward() -> None:
    """An eikonal loss by forward mode against autograd through positions, gradient to the table included."""
    grid, weights = _double_grid(), torch.linspace(-1, 1, 8, dtype=torch.float64)
    positions = _positions().requires_grad_()
    features, _ = _twin(grid, positions)
    (slope,) = torch.autograd.grad((features.tanh() @ weights).sum(), positions, create_graph=True)
    (wanted,) = torch.autograd.grad(((slope.norm(dim=-1) - 1) ** 2).mean(), grid.table)

    features, jacobian = grid.with_jacobian(positions.detach())
    slope = torch.einsum("nf,nfi->ni", (1 - features.tanh() ** 2) * weights, jacobian)
    (ours,) = torch.autograd.grad(((slope.norm(dim=-1) - 1) ** 2).mean(), grid.table)
    torch.testing.assert_close(ours, wanted, rtol=1e-8, atol=1e-10)
    # the guard: without the term through tanh'' the gradient is another one
    frozen = (1 - features.tanh() ** 2).detach() * weights
    slope = torch.einsum("nf,nfi->ni", frozen, grid.with_jacobian(positions.detach())[1])
    (without,) = torch.autograd.grad(((slope.norm(dim=-1) - 1) ** 2).mean(), grid.table)
    assert (without - wanted).abs().max() > 1e-3 * wanted.abs().max()


def test_grid_reproduces_a_linear_function() -> None:
    grid = _double_grid(HashGridConfig(1, 1, 12, 8, 8))
    axis = torch.arange(9) / 4 - 1
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    with torch.no_grad():
        grid.table.copy_((2 * x - y + 0.5 * z).reshape(-1, 1))
    positions = _positions()
    features, jacobian = grid.with_jacobian(positions)
    slope = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    torch.testing.assert_close(features[:, 0], positions @ slope)
    torch.testing.assert_close(jacobian[:, 0], slope.expand(50, 3))


def test_positions_outside_are_clamped() -> None:
    grid = _double_grid()
    outside = torch.tensor([[1.5, 0.2, -3.0], [1.0, 0.2, -1.0]], dtype=torch.float64)
    features = grid(outside)
    torch.testing.assert_close(features[0], features[1])


def test_no_positions() -> None:
    features, jacobian = HashGrid(_SMALL).with_jacobian(torch.zeros(0, 3))
    assert features.shape == (0, 8) and jacobian.shape == (0, 8, 3)


def test_levels_fade_in_one_after_the_other() -> None:
    assert coarse_to_fine_weights(4, torch.tensor(0.0), 2).tolist() == [1, 1, 0, 0]
    assert coarse_to_fine_weights(4, torch.tensor(0.25), 2).tolist() == [1, 1, 0.5, 0]
    assert coarse_to_fine_weights(4, torch.tensor(3.0), 2).tolist() == [1, 1, 1, 1]


def test_off_levels_do_not_count() -> None:
    grid, positions = _double_grid(), _positions()
    levels = torch.tensor([1.0, 1.0, 0.0, 0.0])
    features, jacobian = grid.with_jacobian(positions, levels)
    assert features[:, 4:].abs().max() == 0 and jacobian[:, 4:].abs().max() == 0
    assert features[:, :4].abs().min(0).values.max() > 0


@pytest.mark.parametrize("wrong", [{"num_levels": 0}, {"log2_entries": 40}, {"coarsest": 64, "finest": 32}])
def test_wrong_sizes_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(UserError):
        HashGridConfig(**wrong)
