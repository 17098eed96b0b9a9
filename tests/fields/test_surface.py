"""The surface's analytic gradient, and an analytic sphere through density and weights."""

import torch
from torch.nn import functional

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.hash_grid import HashGridConfig, interpolate
from illuminerf.fields.surface import SurfaceConfig, SurfaceField, surface_cells
from illuminerf.fields.volume_rendering import rendering_weights

_CONFIG = SurfaceConfig(HashGridConfig(4, 2, 10, 4, 32), 16, HashGridConfig(3, 2, 10, 4, 16), 8)


def _surface(bumpy: bool) -> SurfaceField:
    torch.manual_seed(0)
    surface = SurfaceField(_CONFIG)
    with torch.no_grad():
        if bumpy:
            surface.grid.table.copy_(torch.randn_like(surface.grid.table) * 0.05)
        else:
            surface.head.weight.zero_()
    return surface.double()


def _positions() -> torch.Tensor:
    return torch.rand(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 1.6 - 0.8


def test_gradient_is_that_of_autograd_through_positions() -> None:
    surface = _surface(bumpy=True)
    positions = _positions().requires_grad_()
    grid = surface.grid
    features, _ = interpolate(positions, grid.table, grid._resolutions, grid._sizes, grid._offsets)
    hidden = functional.softplus(surface.hidden(features), beta=100, threshold=1000)
    distance = surface.head(hidden)[:, 0] + positions.norm(dim=-1) - 0.5
    (wanted,) = torch.autograd.grad(distance.sum(), positions, create_graph=True)
    point = surface(positions.detach())
    torch.testing.assert_close(point.signed_distance, distance)
    torch.testing.assert_close(point.gradient, wanted)
    torch.testing.assert_close(surface.signed_distance(positions.detach()), distance)
    # and so are the gradients of an eikonal loss to all parameters: the second-order terms
    parameters = [grid.table, surface.hidden.weight, surface.hidden.bias, surface.head.weight]
    ours = torch.autograd.grad(((point.gradient.norm(dim=-1) - 1) ** 2).mean(), parameters)
    double_backward = torch.autograd.grad(((wanted.norm(dim=-1) - 1) ** 2).mean(), parameters)
    for mine, twin in zip(ours, double_backward, strict=True):
        assert float(twin.abs().max()) > 0
        torch.testing.assert_close(mine, twin, rtol=1e-6, atol=1e-9)


def test_before_training_it_is_a_sphere_with_outward_normals() -> None:
    surface, positions = _surface(bumpy=False), _positions()
    point = surface(positions)
    torch.testing.assert_close(point.signed_distance, positions.norm(dim=-1) - 0.5)
    torch.testing.assert_close(point.gradient, functional.normalize(positions, dim=-1))
    assert float(surface.predicted_normals(positions).detach().norm(dim=-1).sub(1).abs().max()) < 1e-9


def test_weights_peak_where_the_ray_meets_the_sphere() -> None:
    surface = _surface(bumpy=False)
    with torch.no_grad():
        surface.log_beta.fill_(-6.0)
    directions = torch.tensor([[0.0, 0, 1]], dtype=torch.float64)
    edges = torch.linspace(1, 3, 81, dtype=torch.float64)[None]
    middles = 0.5 * (edges[0, 1:] + edges[0, :-1])
    ends = torch.tensor([[0.0, 0, -2]], dtype=torch.float64) + edges[0, :, None] * directions
    weights = rendering_weights(surface.depths_along(surface(ends).signed_distance[None], edges))[0].detach()
    assert abs(float(weights.sum()) - 1) < 1e-3
    # the expected depth is the distance to the sphere, to a few beta and not to the width of an interval
    assert abs(float((weights * middles).sum()) - 1.5) < 0.02
    beside = surface(ends + torch.tensor([0.55, 0, 0], dtype=torch.float64)).signed_distance[None]
    assert float(surface.depths_along(beside, edges).detach().sum()) < 1e-3
    # three wide intervals past the sphere do not see it either
    few = edges[:, ::27]
    assert float(surface.depths_along(beside[:, ::27], few).detach().sum()) < 1e-3


def test_surface_cells_keep_the_shell_and_the_inside() -> None:
    surface = _surface(bumpy=False).float()
    with torch.no_grad():
        surface.log_beta.fill_(-6.0)
    cells = surface_cells(surface, OccupiedCells(torch.ones(32, 32, 32, dtype=torch.bool)))
    inside = torch.tensor([[0.0, 0, 0], [0.49, 0, 0], [0.0, -0.51, 0]])
    assert bool(cells.contains(inside).all())
    assert not bool(cells.contains(torch.tensor([[0.7, 0, 0], [0.5, 0.5, 0.5]])).any())
