"""Speed of novel views, and how close they come to images of many samples: JSON on stdout.

    python benchmarks/rendering.py [--field FOLDER] [--size 800] [--check-size 100] [--preset embedded] [--device cpu]

Without `--field` (a Geometry or LatentNerf artefact) the field is a dented ball of the preset's sizes: what it costs is
what a fitted field of that preset costs, what it looks like is not. `--check-size 0` leaves the comparison out.
Errors are in grey levels (1/255), against the sampler of training with many samples and none left out: of the marched
image, and of the image with the samples of training.
"""

import argparse
import json
import os
import platform
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.image_rendering import RenderedImage, render_image, render_image_as_trained
from illuminerf.fields.radiance_field import FieldConfig, RadianceField
from illuminerf.fields.shell import surface_shell
from illuminerf.fields.storage import StoredField, load_field
from illuminerf.scene.cameras import Cameras, turntable_cameras
from illuminerf.workflow.device import resolve_device

_MANY = 256


def dented_ball(config: FieldConfig, device: torch.device) -> StoredField:
    """A field of the given sizes whose surface is a ball with dents, beta that of a finished fit."""
    torch.manual_seed(0)
    field = RadianceField(config)
    with torch.no_grad():
        field.surface.log_beta.fill_(float(np.log(4e-3)))
        field.surface.grid.table[: 5000 * 3].normal_(std=0.02)
        field.appearance.grid.table.normal_(std=0.1)
    axis = (torch.arange(64) + 0.5) / 32 - 1
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return StoredField(field.to(device).eval(), OccupiedCells((grid.norm(dim=-1) < 0.65).to(device)))


def timed(call: Any, device: torch.device) -> tuple[Any, float]:
    """What a call returns, and how long it took."""
    start = time.perf_counter()
    result = call()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return result, time.perf_counter() - start


def speed(stored: StoredField, cameras: Cameras, device: torch.device, with_training_samples: bool) -> dict[str, float]:
    """Seconds of one view either way, after a small one that compiles the kernels."""
    shell, shell_seconds = timed(lambda: surface_shell(stored.field.surface, stored.cells), device)
    small = cameras.resized(32, 32)
    render_image(stored.field, shell, small, 0)
    image, seconds = timed(lambda: render_image(stored.field, shell, cameras, 0), device)
    result = {"shell_seconds": shell_seconds, "seconds": seconds, "opaque_share": float((image.alpha > 0.5).mean())}
    if with_training_samples:
        render_image_as_trained(stored.field, stored.cells, small, 0)
        _, slow = timed(lambda: render_image_as_trained(stored.field, stored.cells, cameras, 0), device)
        result["seconds_as_trained"] = slow
    return result


def grey_levels(image: RenderedImage, wanted: RenderedImage) -> dict[str, dict[str, float]]:
    """Mean, 99.9th percentile and largest error of each output."""
    result = {}
    for name, value in vars(image).items():
        error = 255 * np.abs(value - getattr(wanted, name))
        summary = {"mean": error.mean(), "p99.9": np.quantile(error, 0.999), "max": error.max()}
        result[name] = {key: round(float(number), 3) for key, number in summary.items()}
    return result


def accuracy(stored: StoredField, cameras: Cameras) -> dict[str, Any]:
    """Errors of both ways against many samples."""
    field, config = stored.field, stored.field.config
    marched = render_image(field, surface_shell(field.surface, stored.cells), cameras, 0)
    trained = render_image_as_trained(field, stored.cells, cameras, 0)
    field.config = replace(config, num_samples=_MANY, num_proposal_samples=_MANY, min_weight=0.0)
    many = render_image_as_trained(field, stored.cells, cameras, 0, chunk=1024)
    field.config = config
    return {"marched": grey_levels(marched, many), "as_trained": grey_levels(trained, many)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", type=Path)
    parser.add_argument("--preset", choices=["embedded", "paper"], default="embedded")
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--check-size", type=int, default=100)
    parser.add_argument("--device", default="auto")
    args = parser.parse_args()
    device = resolve_device(args.device)
    config = FieldConfig.paper() if args.preset == "paper" else FieldConfig.embedded()
    stored = load_field(args.field, device) if args.field else dented_ball(config, device)
    result: dict[str, Any] = {
        "field": str(args.field) if args.field else f"ball, {args.preset}",
        "beta": round(float(stored.field.surface.beta.detach()), 5),
        "size": args.size,
        "device": str(device) if device.type == "cpu" else torch.cuda.get_device_name(device),
        "cpu": platform.processor() or platform.machine(),
        "threads": torch.get_num_threads(),
        "load_average": round(os.getloadavg()[0], 2),
    }
    cameras = turntable_cameras(1, 3.0, 0.7, args.size, args.size, 0.5)
    with_training_samples = bool(args.field) or args.preset == "embedded"
    measured = speed(stored, cameras, device, with_training_samples)
    result |= {name: round(value, 2) for name, value in measured.items()}
    if args.check_size:
        result["errors_in_grey_levels"] = accuracy(stored, cameras.resized(args.check_size, args.check_size))
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
