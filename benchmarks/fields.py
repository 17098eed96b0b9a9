"""Speed of the fields: JSON on stdout.

    python benchmarks/fields.py [--device cpu] [--preset embedded] [--seconds 10]

Rays per second of whole training steps (forward, backward, Adam) of both fits on a synthetic sphere, and how much
faster the CPU kernels are than their readable twins on 2^17 points and 16 levels.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from illuminerf.fields.bounds import OccupiedCells, ball_interval
from illuminerf.fields.geometry_fit import GeometryLossConfig, geometry_loss, level_weights
from illuminerf.fields.hash_grid import HashGrid, HashGridConfig, interpolate
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.ray_pool import RayPool, gather_rays
from illuminerf.fields.shading_cache import cache_shading, latent_loss
from illuminerf.fields.surface import SurfaceConfig, SurfaceField
from illuminerf.scene.cameras import sphere_cameras
from illuminerf.workflow.device import resolve_device, torch_generator

KERNEL_GRID = HashGridConfig(16, 2, 17, 16, 2048)


def seconds_per_call(call: Callable[[int], None], seconds: float, device: torch.device) -> float:
    """Mean time of a call after three warm-up calls."""
    for number in range(3):
        call(number)
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        call(count)
        count += 1
        if device.type == "cuda":
            torch.cuda.synchronize()
    return (time.perf_counter() - start) / count


def sphere_pool(device: torch.device, size: int) -> RayPool:
    """Rays of 12 views of a sphere of radius 0.6."""
    cameras = sphere_cameras(12, 2.5, 0.7, size, size, np.random.default_rng(0))
    masks = []
    for view in range(len(cameras)):
        near, far = ball_interval(*(rays.reshape(-1, 3) for rays in cameras.image_rays(view)), radius=0.6)
        masks.append((far > near).view(size, size).numpy().astype(np.float32))
    axis = (torch.arange(64, device=device) + 0.5) / 32 - 1
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return gather_rays(cameras, np.stack(masks), OccupiedCells(grid.norm(dim=-1) < 0.65), device)


def training_step(parameters: list[torch.nn.Parameter], loss_of: Callable[[int], Tensor]) -> Callable[[int], None]:
    """One step of Adam on `loss_of(step)`."""
    optimiser = torch.optim.Adam(parameters, lr=1e-4, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def step(number: int) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss_of(number).backward()
        optimiser.step()

    return step


def fits(config: FieldConfig, num_rays: int, seconds: float, device: torch.device) -> dict[str, float]:
    """Rays per second of both fits."""
    torch.manual_seed(0)
    field = RadianceField(config).to(device)
    with torch.no_grad():
        field.surface.log_beta.fill_(-5.0)
    pool = sphere_pool(device, 128)
    srgb = torch.full((len(pool), 3), 0.5, device=device)
    alpha = (torch.arange(len(pool), device=device) < pool.num_foreground).float()
    losses = GeometryLossConfig()
    levels = level_weights(field, losses, torch.ones((), device=device))

    def geometry(number: int) -> Tensor:
        generator = torch_generator(0, number, device=device)
        index = pool.draw(num_rays, generator)
        loss, _ = geometry_loss(field, losses, pool, srgb, alpha, index, levels, generator)
        return loss

    spent = seconds_per_call(training_step(list(field.parameters()), geometry), seconds, device)
    result = {"geometry_rays_per_second": num_rays / spent, "geometry_step_ms": 1e3 * spent}

    start = time.perf_counter()
    pool = pool.foreground_subset(20_000, torch_generator(0, "pixels", device=device))
    cache = cache_shading(field, pool, 4)
    result["cache_rays_per_second"] = len(pool) / (time.perf_counter() - start)
    codes = torch.nn.Parameter(torch.zeros(16, config.appearance.latent_width, device=device))
    batch = 2 * num_rays

    def latent(number: int) -> Tensor:
        generator = torch_generator(1, number, device=device)
        index = torch.randint(len(pool), (batch,), generator=generator, device=device)
        within = torch.rand(batch, 2, generator=generator, device=device) - 0.5
        latents = torch.nn.functional.embedding(pool.view[index], codes)
        return latent_loss(field, cache, index, srgb[index], latents, 1e-4, within)[0]

    spent = seconds_per_call(training_step([*field.appearance.parameters(), codes], latent), seconds, device)
    return result | {"latent_rays_per_second": batch / spent, "latent_step_ms": 1e3 * spent}


def kernel_against_twin(seconds: float, device: torch.device, num_points: int = 1 << 17) -> dict[str, float]:
    """Forward and backward of features and Jacobian at 16 levels: what the fields use on `device`, and its twin."""
    grid = HashGrid(KERNEL_GRID).to(device)
    positions = _random_positions(num_points, device)

    def backward(features: Tensor, jacobian: Tensor) -> None:
        (features.sum() + jacobian.sum()).backward()

    def kernel(_: int) -> None:
        backward(*grid.with_jacobian(positions))

    def twin(_: int) -> None:
        backward(*readable(grid, positions))

    fast, slow = seconds_per_call(kernel, seconds, device), seconds_per_call(twin, seconds, device)
    return {"kernel_ms": 1e3 * fast, "twin_ms": 1e3 * slow, "twin_over_kernel": slow / fast}


def surface_against_twin(seconds: float, device: torch.device, num_points: int = 1 << 17) -> dict[str, float]:
    """The same of the surface under an eikonal loss, whose gradient is of second order."""
    surface = SurfaceField(SurfaceConfig(grid=KERNEL_GRID)).to(device)
    positions = _random_positions(num_points, device)

    def backward(distance: Tensor, gradient: Tensor) -> None:
        (distance.abs().mean() + ((gradient.norm(dim=-1) - 1) ** 2).mean()).backward()

    def kernel(_: int) -> None:
        backward(*surface(positions))

    def twin(_: int) -> None:
        backward(*surface.residual(*readable(surface.grid, positions)))

    fast, slow = seconds_per_call(kernel, seconds, device), seconds_per_call(twin, seconds, device)
    return {"surface_kernel_ms": 1e3 * fast, "surface_twin_ms": 1e3 * slow, "surface_twin_over_kernel": slow / fast}


def _random_positions(num_points: int, device: torch.device) -> Tensor:
    return (torch.rand(num_points, 3, generator=torch.Generator().manual_seed(0)) * 1.8 - 0.9).to(device)


def readable(grid: HashGrid, positions: Tensor, with_jacobian: bool = True) -> tuple[Tensor, Tensor]:
    """What the grid's kernels compute, in plain torch."""
    layout = (grid._resolutions, grid._sizes, grid._offsets)
    return interpolate(positions, grid.table, *layout, with_jacobian=with_jacobian)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--preset", choices=["embedded", "paper"], default="embedded")
    parser.add_argument("--rays", type=int, default=512)
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    device = resolve_device(args.device)
    config = FieldConfig.paper() if args.preset == "paper" else FieldConfig.embedded()
    result: dict[str, object] = {
        "preset": args.preset,
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
        "cpu": platform.processor() or platform.machine(),
        "threads": torch.get_num_threads(),
        "load_average": round(os.getloadavg()[0], 2),
    }
    result |= {name: round(value, 2) for name, value in fits(config, args.rays, args.seconds, device).items()}
    if device.type == "cpu":
        ratios = kernel_against_twin(args.seconds, device) | surface_against_twin(args.seconds, device)
        result |= {name: round(value, 2) for name, value in ratios.items()}
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
