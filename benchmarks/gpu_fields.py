"""The fields on a GPU: are the kernels right, how fast are they, how long is the paper's fit; prints JSON.

python benchmarks/gpu_fields.py [--device cuda] [--preset paper] [--steps 25000] [--seconds 5] [--profile] [--tiny]

In this order: the Triton kernels against their readable twin (gpu/check_kernels.py); the device's ceilings, measured;
the hash grid at 2^17 points and 16 levels and at what the paper's surface asks for, kernel and plain torch in the same
run, and the bytes it must move at least (fields/hash_grid_triton.py) over its time as a share of the bandwidth; the
surface under an eikonal loss, whose gradient is of second order; both fits (forward, backward, Adam) at the paper's
sizes, 2^13 rays and 25 000 steps, in float32 and bfloat16 and, for some steps, in plain torch.

`--steps 200` times fewer steps and extrapolates minutes from them. With `--profile` the kernels that take most of a
step are named. `--tiny` runs in seconds, on a CPU too, with the Triton kernels through their interpreter: its speeds
say nothing, it is for tests. Exit status 1 where kernels are wrong, a loss is not finite or a step is faster than its
floor.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_steps
from illuminerf.fields.hash_grid import HashGrid, HashGridConfig
from illuminerf.fields.optimisation import OptimiserConfig, Stepper
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_guide import RayGuide
from illuminerf.fields.recorded_steps import RecordableLoss
from illuminerf.fields.shading_cache import cache_shading, latent_loss
from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.fields.surface import SurfaceField
from illuminerf.presets import PRESETS
from illuminerf.workflow.device import Precision, resolve_device, torch_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.fields import (  # noqa: E402
    KERNEL_GRID,
    kernel_against_twin,
    readable,
    sphere_pool,
    surface_against_twin,
)
from benchmarks.gpu import check_kernels  # noqa: E402
from benchmarks.gpu.method import ceilings, geometry_work, small_field  # noqa: E402

_STEPS, _GOAL_MINUTES, _PLAIN_STEPS, _CALLS, _KEPT, _IMAGES = 25_000, 5.0, 20, 10, 16, 1600
Step = Callable[[int], object]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--preset", default="paper", choices=PRESETS, help="whose fields and rays per step")
    parser.add_argument("--steps", type=int, default=_STEPS, help="of each fit; minutes are extrapolated from fewer")
    parser.add_argument("--seconds", type=float, default=5.0, help="for each measurement of a kernel")
    parser.add_argument("--profile", action="store_true", help="name the kernels that take most of a step")
    parser.add_argument("--tiny", action="store_true", help="small grids, few rays, a moment for everything")
    options = parser.parse_args()
    try:
        device = resolve_device(options.device)
        if device.type == "cpu" and not options.tiny:
            raise UserError(
                "this measures a GPU", got=options.device, fix="benchmarks/fields.py measures the fields on a CPU"
            )
    except UserError as error:
        sys.exit(str(error))
    report = measured(device, options)
    print(json.dumps(_rounded(report)))
    sys.exit(0 if report["passed"] else 1)


def measured(device: torch.device, options: argparse.Namespace) -> dict[str, Any]:
    """Everything, and whether it holds together."""
    preset = PRESETS[options.preset].geometry
    config, rays = preset.radiance_field, preset.optimiser.rays_per_step
    seconds, steps, points = options.seconds, options.steps, 1 << 17
    if options.tiny:
        config, rays, seconds, steps, points = small_field(), 64, 0.05, 3, 1 << 10
    kernels = checked_kernels(device, options.tiny)
    ceiling = ceilings(device, *((8, 128) if options.tiny else (1024, 8192)))
    speed = ceiling["gb_per_second"]
    work = geometry_work(config, rays, device)
    geometry, latent_nerf = fits(config, rays, steps, device, options.profile)
    floor = 1e3 * max(work["gflop"] / ceiling["gflop_per_second"], work["optimiser_mb"] / 1e3 / speed)
    # products in bfloat16 may be faster than the ceiling, which is of float32; caches help small arrays
    is_possible = 1e3 / geometry["steps_per_second"]["float32"] > 0.5 * floor
    return {
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
        "torch": torch.__version__,
        "load_average": round(os.getloadavg()[0], 2),
        "sizes": "tiny" if options.tiny else options.preset,
        "rays_per_step": rays,
        "kernels": kernels,
        "ceilings": ceiling,
        "hash_grid": kernel_against_twin(seconds, device, points)
        | {"roofline": roofline(KERNEL_GRID, points, seconds, device, speed)},
        "surface": surface_against_twin(seconds, device, points),
        "hash_grid_of_the_surface": roofline(config.surface.grid, 65 * rays, seconds, device, speed),
        "geometry_step": work | {"floor_ms": floor},
        "geometry": geometry,
        "latent_nerf": latent_nerf,
        "goal_minutes": _GOAL_MINUTES,
        "passed": bool(kernels["passed"] and math.isfinite(geometry["loss"] + latent_nerf["loss"]) and is_possible),
    }


def checked_kernels(device: torch.device, is_tiny: bool) -> dict[str, Any]:
    """`check_kernels.check`; without a GPU by a process of its own, in which Triton interprets."""
    if device.type == "cuda":
        return check_kernels.check(device, 200 if is_tiny else 20_000, is_tiny)
    command = [sys.executable, check_kernels.__file__, "--tiny", "--device", "cpu"]
    done = subprocess.run(command, env=os.environ | {"TRITON_INTERPRET": "1"}, capture_output=True, text=True)
    if done.returncode and not done.stdout:
        reason = done.stderr.strip().splitlines()[-1]
        return {"passed": "No module named 'triton'" in reason, "not_run": reason}
    return dict(json.loads(done.stdout.splitlines()[-1]))


def roofline(
    config: HashGridConfig, num_points: int, seconds: float, device: torch.device, gb_per_second: float
) -> dict[str, dict[str, float]]:
    """Least bytes of look-ups with their Jacobian over their time, and that as a share of the bandwidth.

    Points are anywhere in the box: for the caches the worst case.
    """
    grid = HashGrid(config).to(device)
    positions = torch.rand(num_points, 3, device=device) * 1.8 - 0.9
    gradients = [torch.rand_like(output) for output in grid.with_jacobian(positions)]

    def forward() -> None:
        with torch.no_grad():
            grid.with_jacobian(positions)

    def both() -> None:
        torch.autograd.backward(grid.with_jacobian(positions), gradients)
        grid.table.grad = None

    outputs, table = 16 * num_points * config.width, 4 * grid.table.numel()
    gigabytes = {"forward": (outputs + table) / 1e9, "forward_and_backward": (2 * outputs + 4 * table) / 1e9}
    result = {}
    for name, call in (("forward", forward), ("forward_and_backward", both)):
        spent = _seconds_of(call, seconds, device)
        speed = gigabytes[name] / spent
        result[name] = {"ms": 1e3 * spent, "least_gb": gigabytes[name], "of_bandwidth": speed / gb_per_second}
    return result


def _seconds_of(call: Callable[[], object], seconds: float, device: torch.device) -> float:
    """Median time of a call, of ten in a row each time, so that a GPU need not wait for Python."""
    times: list[float] = []
    start = time.perf_counter()
    while time.perf_counter() - start < seconds or len(times) < 4:
        _wait(device)
        before = time.perf_counter()
        for _ in range(_CALLS):
            call()
        _wait(device)
        times.append((time.perf_counter() - before) / _CALLS)
    return sorted(times[1:])[len(times[1:]) // 2]


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextmanager
def in_plain_torch() -> Iterator[None]:
    """On a GPU: hash grids and surfaces by their readable twins instead of their kernels."""
    without = mock.patch.object(SurfaceField, "_kernels", lambda surface, positions: None)
    with mock.patch.object(HashGrid, "_interpolated", readable), without:
        yield


def fits(
    config: FieldConfig, rays: int, steps: int, device: torch.device, is_profiled: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Speeds of geometry and latent NeRF on a sphere, with opaque surfaces as after some training."""
    torch.manual_seed(0)
    field = RadianceField(config).to(device)
    with torch.no_grad():
        field.surface.log_beta.fill_(-5.0)
    pool = sphere_pool(device, 64 if steps < 10 else 256)
    srgb = torch.full((len(pool), 3), 0.5, device=device)
    alpha = (torch.arange(len(pool), device=device) < pool.num_foreground).float()
    # all hash levels are on and rays are guided, as in most steps of a fit
    optimiser, losses = OptimiserConfig(num_steps=1, rays_per_step=rays), GeometryLossConfig()
    guide = RayGuide(pool)

    def geometry() -> RecordableLoss:
        return geometry_steps(field, losses, optimiser, pool, srgb, alpha, guide, 0)

    of_geometry = speeds("geometry", list(field.parameters()), geometry, field, optimiser, steps, is_profiled)

    covered = pool.foreground_subset(1 << 18, torch_generator(0, "pixels", device=device))
    cache = cache_shading(field, covered, _KEPT)
    codes = torch.nn.Parameter(torch.zeros(_IMAGES, config.appearance.latent_width, device=device))

    def latent_nerf() -> RecordableLoss:
        slots, generator = ShadingSlots(), torch.Generator(device)

        def loss() -> tuple[Tensor, dict[str, Tensor]]:
            index, image = (
                torch.randint(size, (rays,), generator=generator, device=device) for size in (len(covered), _IMAGES)
            )
            within = torch.rand(rays, 2, generator=generator, device=device) - 0.5
            latents = codes.index_select(0, image)
            return latent_loss(field, cache, index, srgb[index], latents, 1e-4, within, slots=slots)

        return RecordableLoss(lambda step: generator.manual_seed(step).device, loss, generator, rays * _KEPT, slots)

    parameters = [*field.appearance.parameters(), codes]
    return of_geometry, speeds("latent NeRF", parameters, latent_nerf, field, optimiser, steps, is_profiled)


def speeds(
    name: str,
    parameters: list[torch.nn.Parameter],
    loss: Callable[[], RecordableLoss],
    field: RadianceField,
    optimiser: OptimiserConfig,
    steps: int,
    is_profiled: bool,
) -> dict[str, Any]:
    """Steps per second by what computes, minutes for the paper's steps, peak memory, and what takes the time."""
    device = parameters[0].device
    ways: list[tuple[str, Precision, bool, int]] = [
        ("float32_plain_torch", "float32", False, min(steps, _PLAIN_STEPS)),
        ("float32_not_recorded", "float32", False, min(steps, _PLAIN_STEPS)),
        ("float32", "float32", True, steps),
        ("bfloat16_not_recorded", "bfloat16", False, min(steps, _PLAIN_STEPS)),
        ("bfloat16", "bfloat16", True, steps),
    ]
    rates, peaks, numbers = {}, {}, {"loss": math.nan}
    for way, precision, records, count in ways:
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
        with field.computing_in(precision), in_plain_torch() if way.endswith("plain_torch") else nullcontext():
            stepper = Stepper(parameters, optimiser, loss(), records=records)
            list(stepper.run(0, 3 if steps < 10 else 40))  # slots settle, and a step is recorded
            _wait(device)
            start = time.perf_counter()
            *_, numbers = track(stepper.run(40, 40 + count), f"{name}, {way}", count)
            _wait(device)
            rates[way] = count / (time.perf_counter() - start)
            del stepper
        if device.type == "cuda":
            peaks[way] = torch.cuda.max_memory_allocated(device) / 1e9
    minutes = {way: _STEPS / rate / 60 for way, rate in rates.items()}
    result = {"timed_steps": steps, "steps_per_second": rates, "minutes": minutes, "device_memory_gb": peaks}
    result["over_plain_torch"] = rates["float32"] / rates["float32_plain_torch"]
    if is_profiled:
        with field.computing_in("bfloat16"):
            stepper = Stepper(parameters, optimiser, loss(), records=False)
            result["ms_by_kernel"] = _profile(lambda number: list(stepper.run(number, number + 1)), device)
    return result | {"loss": numbers["loss"]}


def _profile(step: Step, device: torch.device, num_steps: int = 5) -> dict[str, float]:
    """Milliseconds a step of the kernels that take most, and of all together."""
    activity = torch.profiler.ProfilerActivity
    with torch.profiler.profile(activities=[activity.CUDA if device.type == "cuda" else activity.CPU]) as profiler:
        for number in range(num_steps):
            step(number)
    attribute = "self_device_time_total" if device.type == "cuda" else "self_cpu_time_total"
    spent = {event.key[:90]: getattr(event, attribute) / 1e3 / num_steps for event in profiler.key_averages()}
    most = dict(sorted(spent.items(), key=lambda item: -item[1])[:16])
    return {"all": sum(spent.values()), **most}


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
