"""Kernels against their readable twins in float64, and the tests that need a GPU; prints JSON.

python benchmarks/gpu/check_kernels.py [--device auto] [--points 20000] [--tiny]

Relative errors (largest difference over largest value) between what `HashGrid` runs on the device and
`hash_grid.interpolate` on the CPU: features, Jacobian, gradient of the table, and the gradient of a loss on normals
against double backward through the positions. Where there is CUDA, `pytest -m gpu` runs as well.
Exit status 1 where anything is wrong.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from illuminerf.fields.hash_grid import HashGrid, HashGridConfig, interpolate
from illuminerf.workflow.device import resolve_device

TOLERANCE = 1e-9
_ROOT = Path(__file__).parents[2]


def pair_of_grids(config: HashGridConfig, device: torch.device) -> tuple[HashGrid, HashGrid]:
    """The same float64 grid on the device and on the CPU."""
    grid = HashGrid(config).double()
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=torch.Generator().manual_seed(1)))
    copy = HashGrid(config).double()
    copy.load_state_dict(grid.state_dict())
    return grid.to(device), copy


def ours(grid: HashGrid, positions: Tensor, frozen_slope: bool = False) -> dict[str, Tensor]:
    """Features, Jacobian and both gradients by what runs on the grid's device.

    Args:
        frozen_slope: leave out the term through the second derivative, which is wrong; the check must notice.
    """
    features, jacobian = grid.with_jacobian(positions)
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
    # the last levels are hashed, the first are dense
    config = HashGridConfig(4, 2, 7, 3, 24) if options.tiny else HashGridConfig(16, 2, 15, 16, 1024)
    count = 200 if options.tiny else options.points
    positions = torch.rand(count, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 1.9 - 0.95
    grid, copy = pair_of_grids(config, device)
    wanted = twins(copy, positions)
    errors = relative_errors(ours(grid, positions.to(device)), wanted)
    guard = relative_errors(ours(grid, positions.to(device), frozen_slope=True), wanted)["second_order"]
    tests = gpu_tests()
    is_right = max(errors.values()) < TOLERANCE and guard > 1e-4 and tests.get("exit_status", 0) == 0
    report = {
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
        "points": count,
        "relative_errors_float64": errors,
        "tolerance": TOLERANCE,
        "error_of_a_wrong_second_order": guard,
        "gpu_tests": tests,
        "passed": is_right,
    }
    print(json.dumps(report))
    sys.exit(0 if is_right else 1)


if __name__ == "__main__":
    main()
