"""Kernels of hash grid and surface against their readable twins, and the tests that need a GPU; prints JSON.

python benchmarks/gpu/check_kernels.py [--device auto] [--points 20000] [--tiny]

Relative errors (largest difference over largest value) between kernels on the device and `hash_grid.interpolate` on the
CPU: features, Jacobian, gradient of the table, and the gradient of a loss on normals against double backward through
the positions. "hash_grid" is what `HashGrid` runs in float64, "triton" the Triton kernels, which need CUDA or
TRITON_INTERPRET=1. In float32 the twin computes in float32 too: near the borders of cells another rounding is another
cell, with another Jacobian. "surface" are the surface's Triton kernels in float32: distance, gradient, and what a loss
on both sends to the table and the layers. Where there is CUDA, `pytest -m gpu` runs as well. Exit status 1 where
anything is wrong.
"""

import argparse
import copy
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from illuminerf.fields.hash_grid import HashGrid, HashGridConfig, interpolate
from illuminerf.fields.surface import SurfaceConfig, SurfaceField
from illuminerf.workflow.device import resolve_device

TOLERANCES = {torch.float64: 1e-9, torch.float32: 1e-4}
Interpolate = Callable[[HashGrid, Tensor], tuple[Tensor, Tensor]]
_ROOT = Path(__file__).parents[2]


def check(device: torch.device, num_points: int, is_tiny: bool) -> dict[str, Any]:
    """Errors of all kernels that run on the device, by name, and of a wrong second order, which must be seen."""
    # the last levels are hashed, the first are dense
    config = HashGridConfig(4, 2, 7, 3, 24) if is_tiny else HashGridConfig(16, 4, 15, 16, 1024)
    kernels: list[tuple[str, Interpolate, torch.dtype]] = [("hash_grid", HashGrid.with_jacobian, torch.float64)]
    if device.type == "cuda" or os.environ.get("TRITON_INTERPRET") == "1":
        kernels = [("triton", by_triton, torch.float64), ("triton", by_triton, torch.float32), *kernels]
    report: dict[str, Any] = {"relative_errors": {}, "of_a_wrong_second_order": {}, "passed": True}
    for name, interpolate_, dtype in kernels:
        generator = torch.Generator().manual_seed(2)
        positions = torch.rand(num_points, 3, generator=generator, dtype=dtype) * 1.9 - 0.95
        grid, twin = pair_of_grids(config, device, dtype)
        wanted, there = twins(twin, positions), positions.to(device)
        errors = relative_errors(ours(grid, there, interpolate_), wanted)
        wrong = relative_errors(ours(grid, there, interpolate_, frozen_slope=True), wanted)["second_order"]
        name = f"{name} {dtype}".replace("torch.", "")
        report["relative_errors"][name], report["of_a_wrong_second_order"][name] = errors, wrong
        report["passed"] &= max(errors.values()) < TOLERANCES[dtype] and wrong > 3e-4
    if kernels[0][0] == "triton":
        errors, wrong = check_surface(device, num_points, is_tiny)
        report["relative_errors"]["surface float32"] = errors
        report["of_a_wrong_second_order"]["surface float32"] = wrong
        report["passed"] &= max(errors.values()) < TOLERANCES[torch.float32] and wrong > 3e-4
    return report


def check_surface(device: torch.device, num_points: int, is_tiny: bool) -> tuple[dict[str, float], float]:
    """Errors of the surface's Triton kernels, and of a twin whose normals leave the features as they are."""
    from illuminerf.fields.surface_triton import FusedSurface

    torch.manual_seed(3)
    grid = HashGridConfig(4, 2, 7, 3, 24) if is_tiny else HashGridConfig(10, 4, 15, 16, 1024)
    surface = SurfaceField(SurfaceConfig(grid))
    with torch.no_grad():
        surface.grid.table.normal_(std=0.1)
        surface.hidden.bias.mul_(0.1)
    moved = copy.deepcopy(surface).to(device)
    positions = torch.rand(num_points, 3) * 1.9 - 0.95
    levels = torch.linspace(1, 0.5, grid.num_levels)
    inputs = moved._kernel_inputs(positions.to(device), levels.to(device))
    found = surface_answers(moved, *FusedSurface.apply(*inputs))
    layout = (surface.grid._resolutions, surface.grid._sizes, surface.grid._offsets)
    features, jacobian = interpolate(positions, surface.grid.table, *layout, with_jacobian=True)
    columns = levels.repeat_interleave(grid.num_features)
    features, jacobian = features * columns, jacobian * columns[:, None]
    point = surface.residual(features, jacobian)
    frozen = surface.residual(features.detach(), jacobian).gradient
    wrong = relative_errors(found, surface_answers(surface, point.signed_distance, frozen))["table"]
    return relative_errors(found, surface_answers(surface, *point)), wrong


def surface_answers(surface: SurfaceField, distance: Tensor, gradient: Tensor) -> dict[str, Tensor]:
    """Distance, gradient, and the gradients of a loss on both."""
    layers = {"weight": surface.hidden.weight, "bias": surface.hidden.bias, "last": surface.head.weight}
    parameters = {"table": surface.grid.table} | layers
    loss = (distance**2).sum() + ((gradient.norm(dim=-1) - 1) ** 2).sum()
    gradients = torch.autograd.grad(loss, list(parameters.values()), retain_graph=True)
    return {"distance": distance, "gradient": gradient} | dict(zip(parameters, gradients, strict=True))


def by_triton(grid: HashGrid, positions: Tensor) -> tuple[Tensor, Tensor]:
    """The Triton kernels themselves, whatever `HashGrid` would choose."""
    from illuminerf.fields.hash_grid_triton import TritonInterpolation

    features, jacobian = TritonInterpolation.apply(grid.table, positions, grid.layout, True)
    return features, jacobian


def pair_of_grids(config: HashGridConfig, device: torch.device, dtype: torch.dtype) -> tuple[HashGrid, HashGrid]:
    """The same grid on the device and on the CPU."""
    grid = HashGrid(config).to(dtype)
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=torch.Generator().manual_seed(1)))
    twin = copy.deepcopy(grid)
    return grid.to(device), twin


def ours(grid: HashGrid, positions: Tensor, interpolate_: Interpolate, frozen_slope: bool = False) -> dict[str, Tensor]:
    """Features, Jacobian and both gradients by kernels on the grid's device.

    Args:
        frozen_slope: leave out the term through the second derivative, which is wrong; the check must notice.
    """
    features, jacobian = interpolate_(grid, positions)
    (first,) = torch.autograd.grad(_mixed(features, jacobian), grid.table, retain_graph=True)
    weights = _weights(features)
    bend = 1 - features.tanh() ** 2
    slope = torch.einsum("nf,nfi->ni", (bend.detach() if frozen_slope else bend) * weights, jacobian)
    (second,) = torch.autograd.grad(((slope.norm(dim=-1) - 1) ** 2).mean(), grid.table)
    return {"features": features, "jacobian": jacobian, "gradient": first, "second_order": second}


def twins(grid: HashGrid, positions: Tensor) -> dict[str, Tensor]:
    """The same four by the readable version and autograd through the positions."""
    layout = (grid._resolutions, grid._sizes, grid._offsets)
    features, jacobian = interpolate(positions, grid.table, *layout, with_jacobian=True)
    (first,) = torch.autograd.grad(_mixed(features, jacobian), grid.table)
    moving = positions.clone().requires_grad_()
    features_again, _ = interpolate(moving, grid.table, *layout)
    value = (features_again.tanh() @ _weights(features_again)).sum()
    (slope,) = torch.autograd.grad(value, moving, create_graph=True)
    (second,) = torch.autograd.grad(((slope.norm(dim=-1) - 1) ** 2).mean(), grid.table)
    return {"features": features, "jacobian": jacobian, "gradient": first, "second_order": second}


def _mixed(features: Tensor, jacobian: Tensor) -> Tensor:
    return (features**3).sum() + (jacobian**2 * torch.linspace(0, 1, 3).to(jacobian)).sum()


def _weights(features: Tensor) -> Tensor:
    return torch.linspace(-1, 1, features.shape[1]).to(features)


def relative_errors(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> dict[str, float]:
    """Largest difference over largest value, by name."""
    return {
        name: float((found[name].detach().cpu() - value.detach()).abs().max() / value.detach().abs().max())
        for name, value in wanted.items()
    }


def gpu_tests() -> dict[str, Any]:
    """Run `pytest -m gpu` of this checkout."""
    if not torch.cuda.is_available():
        return {"run": False, "why": "no CUDA here"}
    start = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-m", "gpu", "tests"]
    done = subprocess.run(command, cwd=_ROOT, capture_output=True, text=True)
    return {
        "run": True,
        "exit_status": done.returncode,
        "seconds": round(time.monotonic() - start, 1),
        "last_lines": done.stdout.splitlines()[-3:],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--tiny", action="store_true", help="few points and a small grid")
    options = parser.parse_args()
    device = resolve_device(options.device)
    count = 100 if options.tiny else options.points
    report = check(device, count, options.tiny)
    tests = gpu_tests()
    report["passed"] &= tests.get("exit_status", 0) == 0
    about = {"device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device), "points": count}
    report = about | report | {"gpu_tests": tests}
    print(json.dumps(report))
    sys.exit(0 if report["passed"] else 1)


if __name__ == "__main__":
    main()
