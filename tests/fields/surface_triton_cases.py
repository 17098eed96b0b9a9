"""What the surface's Triton kernels are asked in their test; run as a script, it answers by Triton's interpreter.

A process of its own, as for `triton_cases.py`:

    TRITON_INTERPRET=1 python surface_triton_cases.py ANSWERS.safetensors
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import torch
from safetensors.torch import save_file
from torch import Tensor

from illuminerf.fields.hash_grid import HashGrid, HashGridConfig, interpolate
from illuminerf.fields.surface import SurfaceConfig, SurfaceField


@dataclass(frozen=True)
class Case:
    """A surface over two dense levels and a hashed one, and where it is asked."""

    num_features: int
    num_hidden: int
    num_points: int = 70
    levels: tuple[float, ...] | None = None
    dtype: torch.dtype = torch.float64
    shrunk: float = 1.0

    def surface(self, dtype: torch.dtype) -> SurfaceField:
        torch.manual_seed(4)
        grid = HashGridConfig(3, self.num_features, 9, 3, 12)
        surface = SurfaceField(SurfaceConfig(grid, self.num_hidden, HashGridConfig(1, 1, 4, 1, 1), 4))
        with torch.no_grad():
            surface.grid.table.normal_(std=0.1)
            surface.hidden.bias.mul_(0.1)
        return surface.to(dtype)

    def positions(self, dtype: torch.dtype) -> Tensor:
        """Inside, on the faces of cells, and outside the box."""
        generator = torch.Generator().manual_seed(self.num_points)
        positions = torch.rand(self.num_points, 3, generator=generator) * 2.2 - 1.1
        positions[:8] = (positions[:8] * 4).round() / 4
        return positions.to(dtype) * self.shrunk


CASES = {
    "levels fade in": Case(2, 16, levels=(1.0, 0.6, 0.0)),
    "no powers of two": Case(3, 20),
    "one point": Case(1, 5, num_points=1),
    "float32": Case(4, 24, num_points=129, levels=(1.0, 1.0, 0.3), dtype=torch.float32),
}


def answers(case: Case, dtype: torch.dtype) -> dict[str, Tensor]:
    """Values, and the gradients of losses on distances, on normals and on both together."""
    surface, positions = case.surface(dtype), case.positions(dtype)
    levels = None if case.levels is None else torch.tensor(case.levels)
    distance, gradient = surface(positions, levels)
    with torch.no_grad():
        found = {"distance": distance, "gradient": gradient, "alone": surface.signed_distance(positions, levels)}
    waves = torch.sin(7 * positions.sum(-1))
    losses = {
        # gradients of sums come as one number, expanded
        "distances": distance.sum(),
        "slopes": gradient.sum(),
        "both": (distance**2 * waves).sum() + ((gradient.norm(dim=-1) - 1) ** 2).sum() + (gradient @ gradient[0]).sum(),
    }
    layers = {"weight": surface.hidden.weight, "bias": surface.hidden.bias, "last": surface.head.weight}
    parameters = {"table": surface.grid.table} | layers
    for name, loss in losses.items():
        gradients = torch.autograd.grad(loss, list(parameters.values()), retain_graph=True)
        found |= {f"{name} to {key}": value for key, value in zip(parameters, gradients, strict=True)}
    return {name: value.detach().contiguous() for name, value in found.items()}


@contextmanager
def by_twins() -> Iterator[None]:
    """Hash grids and surfaces in plain torch."""

    def readable(grid: HashGrid, positions: Tensor, with_jacobian: bool) -> tuple[Tensor, Tensor]:
        return interpolate(positions, grid.table, grid._resolutions, grid._sizes, grid._offsets, with_jacobian)

    with (
        mock.patch.object(HashGrid, "_interpolated", readable),
        mock.patch.object(SurfaceField, "_kernels", lambda surface, positions: None),
    ):
        yield


def main(out: Path) -> None:
    from illuminerf.fields import surface_triton

    assert surface_triton.why_not(torch.device("cpu"), 3, 4, 24) == ""
    found = {}
    # two programs have three tiles of points and more to share
    with (
        mock.patch.object(SurfaceField, "_kernels", lambda surface, positions: surface_triton),
        mock.patch.object(surface_triton, "_MOST_PARTS", 2),
    ):
        for name, case in CASES.items():
            found |= {f"{name}/{key}": value for key, value in answers(case, case.dtype).items()}
    save_file(found, out)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
