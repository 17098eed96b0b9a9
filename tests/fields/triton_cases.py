"""What the Triton kernels are asked in their test; run as a script, it answers by Triton's interpreter.

Whether kernels are interpreted is settled when Triton is imported, so the answers come from a process of their own:

    TRITON_INTERPRET=1 python triton_cases.py ANSWERS.safetensors
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import torch
from safetensors.torch import save_file
from torch import Tensor

from illuminerf.fields.hash_grid import HashGrid, HashGridConfig
from illuminerf.fields.surface import SurfaceConfig, SurfaceField

Interpolate = Callable[[HashGrid, Tensor, bool], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Case:
    """A grid of a dense level of 4^3 cells and a hashed one of 32^3, and where it is asked."""

    num_features: int
    positions: Tensor
    dtype: torch.dtype = torch.float64

    def grid(self, dtype: torch.dtype) -> HashGrid:
        grid = HashGrid(HashGridConfig(2, self.num_features, 7, 4, 32)).to(dtype)
        numbers = torch.randn(grid.table.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float32)
        with torch.no_grad():
            grid.table.copy_(numbers)
        return grid


def _inside(count: int) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(count)) * 1.9 - 0.95


# multiples of 1/16 lie on borders of both levels' cells, and are what they are in float32
_BORDERS = (torch.randint(-16, 17, (14, 3), generator=torch.Generator().manual_seed(5)) / 16).float()
_OUTSIDE = torch.tensor([[1.5, 0.2, -3.0], [-1.0, 1.0, 1.0], [1.0, -1.0, 2.0]])
CASES = {
    "one point, one feature": Case(1, _inside(1)),
    "three features, odd borders": Case(3, torch.cat([_inside(20), _BORDERS, _OUTSIDE])),
    "whole block and one more, float32": Case(4, torch.cat([_inside(112), _BORDERS, _OUTSIDE]), torch.float32),
}


def answers(case: Case, dtype: torch.dtype, interpolate: Interpolate) -> dict[str, Tensor]:
    """Values and every gradient that a fit sends to the table."""
    grid, positions = case.grid(dtype), case.positions.to(dtype)
    features, jacobian = interpolate(grid, positions, True)
    mixed = (features**3).sum() + (jacobian**2 * torch.linspace(0, 1, 3, dtype=dtype)).sum()
    (first,) = torch.autograd.grad(mixed, grid.table, retain_graph=True)
    weights = torch.linspace(-1, 1, features.shape[1], dtype=dtype)
    slope = torch.einsum("nf,nfi->ni", (1 - features.tanh() ** 2) * weights, jacobian)
    (second,) = torch.autograd.grad(((slope.norm(dim=-1) - 1) ** 2).mean(), grid.table)
    alone, nothing = interpolate(grid, positions, False)
    assert not nothing.numel()
    (of_alone,) = torch.autograd.grad((alone**2).sum(), grid.table)
    found = {"features": features, "jacobian": jacobian, "first": first, "second": second}
    found |= {"features alone": alone, "first of features alone": of_alone}
    return {name: value.detach().contiguous() for name, value in found.items()}


def eikonal_gradients(interpolate: Interpolate, weight: float = 1.0) -> dict[str, Tensor]:
    """What an eikonal loss sends to the parameters of a surface, in float64, with the grid by `interpolate`."""
    torch.manual_seed(6)
    grid = HashGridConfig(2, 2, 7, 4, 32)
    surface = SurfaceField(SurfaceConfig(grid=grid, hidden_width=8, normal_grid=grid)).double()
    with torch.no_grad():
        surface.grid.table.normal_(std=0.1)
    with mock.patch.object(HashGrid, "_interpolated", interpolate):
        point = surface(_inside(30).double(), torch.tensor([1.0, 0.5]))
    loss = point.signed_distance.abs().mean() + weight * ((point.gradient.norm(dim=-1) - 1) ** 2).mean()
    parameters = {"table": surface.grid.table, "first": surface.hidden.weight, "last": surface.head.weight}
    return dict(zip(parameters, torch.autograd.grad(loss, list(parameters.values())), strict=True))


def main(out: Path) -> None:
    from illuminerf.fields.hash_grid_triton import TritonInterpolation

    def kernels(grid: HashGrid, positions: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor]:
        features, jacobian = TritonInterpolation.apply(grid.table, positions, grid.layout, with_jacobian)
        return features, jacobian

    found = {
        f"{name}/{key}": value
        for name, case in CASES.items()
        for key, value in answers(case, case.dtype, kernels).items()
    }
    found |= {f"eikonal/{key}": value.contiguous() for key, value in eikonal_gradients(kernels).items()}
    save_file(found, out)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
