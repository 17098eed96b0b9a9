"""How fast both fields and the relighting model are on this device, beside what the device could do; prints JSON.

python benchmarks/gpu/method.py [--device auto] [--preset paper] [--seconds 20] [--rays 8192]
    [--capture FOLDER --light LIGHT.exr --out RUN] [--tiny]

Ceilings are measured, not looked up: copying large arrays, and multiplying large matrices. The floor of a step is the
larger of its FLOPs over the one and its bytes over the other; bytes are those of the weights, gradients and Adam's
moments (seven passes over the weights) only, so the floor is too low where activations and table look-ups count.
With `--capture` the whole pipeline runs too, and is gone on with when the same command is run again.
Exit status 1 where a loss is not finite or something is faster than its floor.
"""

import argparse
import dataclasses
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from illuminerf import pipeline
from illuminerf.diffusion.pretrained import pretrained_model
from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_loss, level_weights
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.presets import PRESETS, Preset, customised
from illuminerf.workflow.device import resolve_device, torch_generator

sys.path.insert(0, str(Path(__file__).parents[2]))
from benchmarks.fields import fits, kernel_against_twin, sphere_pool  # noqa: E402
from benchmarks.relighting_model import gflop, images_per_second  # noqa: E402

_PASSES_OF_ADAM = 7  # weight, gradient and two moments read; weight and two moments written


def best_seconds(call: Callable[[], Any], device: torch.device, repeats: int) -> float:
    """Fastest of some calls after one warm-up."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    return min(seconds[1:])


def ceilings(device: torch.device, megabytes: int, side: int) -> dict[str, float]:
    """Copy bandwidth (bytes read and written a second) and float32 matrix FLOPs a second."""
    source = torch.zeros(megabytes * 2**20 // 4, device=device)
    target = torch.empty_like(source)
    copy = best_seconds(lambda: target.copy_(source), device, 5)
    one, other = (torch.rand(side, side, device=device) for _ in range(2))
    product = best_seconds(lambda: one @ other, device, 5)
    return {"gb_per_second": 2 * source.numel() * 4 / copy / 1e9, "gflop_per_second": 2 * side**3 / product / 1e9}


def geometry_work(config: FieldConfig, num_rays: int, device: torch.device) -> dict[str, float]:
    """GFLOP of matrix products and MB of optimiser traffic of one geometry step, its loss, and memory at its peak."""
    field = RadianceField(config).to(device)
    pool = sphere_pool(device, 64)
    generator = torch_generator(0, 0, device=device)
    index = pool.draw(num_rays, generator)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    alpha = (torch.arange(len(pool), device=device) < pool.num_foreground).float()
    srgb = torch.full((len(pool), 3), 0.5, device=device)
    losses = GeometryLossConfig()
    levels = level_weights(field, losses, torch.ones((), device=device))
    with FlopCounterMode(display=False) as counter:
        loss, _ = geometry_loss(field, losses, pool, srgb, alpha, index, levels, generator)
        loss.backward()
    weights = sum(parameter.numel() for parameter in field.parameters())
    peak = torch.cuda.max_memory_allocated() / 1e9 if device.type == "cuda" else 0.0
    return {
        "gflop": counter.get_total_flops() / 1e9,
        "optimiser_mb": 4 * _PASSES_OF_ADAM * weights / 1e6,
        "loss": float(loss.detach()),
        "device_memory_gb": peak,
    }


def relighting(device: torch.device, batch: int, steps: list[int]) -> dict[str, Any]:
    """Images a second of the embedded model, and the FLOPs of one."""
    model = pretrained_model("embedded", device)
    size = model.config.image_size
    image, cues = (
        torch.rand(batch, channels, size, size).to(device, memory_format=torch.channels_last) for channels in (4, 12)
    )
    return {
        "batch": batch,
        "gflop": gflop(model, image[:1], cues[:1]),
        "images_per_second": {str(count): images_per_second(model, image, cues, count, 2) for count in steps},
    }


def tiny_preset(device: str) -> Preset:
    """All stages for real at sizes that take seconds."""
    preset = customised("demo", size=32, samples=1, device=device)
    change = dataclasses.replace
    steps = change(preset.geometry.optimiser, num_steps=8, rays_per_step=64)
    return change(
        preset,
        geometry=change(preset.geometry, optimiser=steps, mesh_resolution=32, num_previews=1),
        illumination=change(preset.illumination, gathering=change(preset.illumination.gathering, num_points=500)),
        cues=change(
            preset.cues, sampling=change(preset.cues.sampling, samples_per_pixel=2, device="cpu"), max_light_height=16
        ),
        relighting=change(preset.relighting, num_steps=1),
        latent_nerf=change(preset.latent_nerf, optimiser=steps),
        turntable=change(
            preset.turntable, turntable=change(preset.turntable.turntable, num_views=2, height=16, width=16)
        ),
    )


def whole_pipeline(options: argparse.Namespace) -> dict[str, Any]:
    """Seconds by stage and peak memory of a run that was finished now or before."""
    preset = tiny_preset(options.device) if options.tiny else customised(options.preset, device=options.device)
    if not options.tiny:  # Mitsuba's cuda variant is another question: render_pairs.py
        sampling = dataclasses.replace(preset.cues.sampling, device=options.cue_device)
        preset = dataclasses.replace(preset, cues=dataclasses.replace(preset.cues, sampling=sampling))
    pipeline.relight(options.capture, [pipeline.LightJob(options.light)], preset, options.out)
    return {
        "seconds_by_stage": {k: round(v, 1) for k, v in pipeline.seconds_by_stage(options.out).items()},
        "peak_memory_gb": round(pipeline.peak_memory_gb(options.out), 2),
    }


def small_field() -> FieldConfig:
    """The embedded field with coarse grids."""
    config = FieldConfig.embedded()
    grid = HashGridConfig(4, 2, 10, 8, 32)
    surface = dataclasses.replace(config.surface, grid=grid)
    return dataclasses.replace(config, surface=surface)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="paper")
    parser.add_argument("--rays", type=int, default=8192)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--light", type=Path)
    parser.add_argument("--cue-device", default="cpu", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--out", type=Path, default=Path("runs/gpu_method"))
    parser.add_argument("--tiny", action="store_true", help="small grids, few rays, a second for everything")
    options = parser.parse_args()
    device = resolve_device(options.device)
    if (options.capture is None) != (options.light is None):
        parser.error("name a capture and a light, or neither")
    config = FieldConfig.paper() if options.preset == "paper" else FieldConfig.embedded()
    rays, seconds, batch, steps = options.rays, options.seconds, 64, [1, 4, 8, 16]
    sizes = (1024, 8192) if device.type == "cuda" else (256, 1024)
    if options.tiny:
        config, rays, seconds, batch, steps, sizes = small_field(), 64, 0.2, 1, [1], (8, 128)
    ceiling = ceilings(device, *sizes)
    work = geometry_work(config, rays, device)
    speed = fits(config, rays, seconds, device)
    floor = 1e3 * max(
        work["gflop"] / ceiling["gflop_per_second"], work["optimiser_mb"] / 1e3 / ceiling["gb_per_second"]
    )
    twin = kernel_against_twin(seconds, device, 1 << 10 if options.tiny else 1 << 17)
    # small matrices and caches may beat ceilings measured on large arrays by some per cent, not by half
    is_right = math.isfinite(work["loss"]) and speed["geometry_step_ms"] > 0.5 * floor
    report: dict[str, Any] = {
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
        "preset": "tiny" if options.tiny else options.preset,
        "rays_per_step": rays,
        "threads": torch.get_num_threads(),
        "load_average": round(os.getloadavg()[0], 2),
        "ceilings": {name: round(value, 1) for name, value in ceiling.items()},
        "geometry_step": {name: round(value, 4) for name, value in work.items()},
        "geometry_floor_ms": round(floor, 4),
        "speed": {name: round(value, 2) for name, value in speed.items()},
        "step_over_floor": round(speed["geometry_step_ms"] / floor, 1),
        "hash_grid": {name: round(value, 3) for name, value in twin.items()},
        "relighting_model": relighting(device, batch, steps),
    }
    if options.capture:
        report["pipeline"] = whole_pipeline(options)
    print(json.dumps(report | {"passed": is_right}))
    sys.exit(0 if is_right else 1)


if __name__ == "__main__":
    main()
