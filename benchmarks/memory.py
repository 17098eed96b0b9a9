"""Host memory of the stages that see whole captures: JSON on stdout.

    python benchmarks/memory.py --out FOLDER [--views 100] [--size 800] [--samples 16] [--stages NAME ...]

A shaded ball is photographed and its relit samples are made up; then every stage runs in a process of its own with few
steps (`CUDA_VISIBLE_DEVICES=` keeps all of it in host memory). `--stages render_radiance_cues relight_views` are left
out by default, since they take long; what they hold is one batch of views, whatever the number of views.
Peaks are resident memory in GB, with what libraries and weights take (`imports_gb`).
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.cues.renderer import CueSampling
from illuminerf.data.capture import write_capture
from illuminerf.fields.bounds import ball_interval
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.scene.cameras import Cameras, spiral_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import write_png
from illuminerf.stages import (
    estimate_geometry,
    fit_latent_nerf,
    import_capture,
    relight_views,
    render_novel_views,
    render_radiance_cues,
)
from illuminerf.workflow.artefact import peak_memory_gb

_RADIUS = 0.9
_DEFAULT = ("import_capture", "estimate_geometry", "fit_latent_nerf", "render_novel_views")
_SLOW = ("render_radiance_cues", "relight_views")


def ball_image(cameras: Cameras, view: int) -> np.ndarray:
    """Straight sRGB and alpha [height, width, 4] of a ball whose colour depends on the place."""
    origins, directions = (rays.reshape(-1, 3) for rays in cameras.image_rays(view))
    near, far = ball_interval(origins, directions, _RADIUS)
    normals = ((origins + near[:, None] * directions) / _RADIUS).numpy()
    hit = (far > near).numpy()[:, None]
    colour = np.clip(0.5 + 0.3 * np.sin(7 * normals + np.arange(3)) + 0.2 * normals[:, 2:], 0, 1) * hit
    return np.concatenate([colour, hit], -1).reshape(cameras.height, cameras.width, 4)


def make_inputs(root: Path, num_views: int, size: int, num_samples: int) -> None:
    """Photographs, relit samples (those of a view are links to one file) and a light."""
    cameras = spiral_cameras(num_views, 3.0, 0.8, size, size, -0.5, 1.4)
    images = (ball_image(cameras, view) for view in range(num_views))
    names = [f"{view:03d}" for view in range(num_views)]
    write_capture(root / "photographs", images, cameras, names, 1.0, np.zeros(3), "masked")
    for view in range(num_views):
        image = ball_image(cameras, view)
        first = root / "relit" / "samples" / f"{view:03d}_00.png"
        write_png(first, 0.7 * image[..., :3] * image[..., 3:])
        for sample in range(1, num_samples):
            os.link(first, first.with_name(f"{view:03d}_{sample:02d}.png"))
    EnvironmentMap(np.ones((16, 32, 3), np.float32)).save(root / "light.exr")


def run_stage(stage: str, root: Path, size: int, num_samples: int) -> None:
    """One stage on what lies in `root`; its settings are the embedded preset's, with few steps."""
    capture, geometry, cues = root / "import_capture", root / "estimate_geometry", root / "render_radiance_cues"
    steps = OptimiserConfig(num_steps=30, rays_per_step=512, warmup_steps=5)
    out = root / stage
    if stage == "import_capture":
        import_capture.run(root / "photographs", import_capture.Config(), out)
    elif stage == "estimate_geometry":
        config = estimate_geometry.Config(optimiser=steps, mesh_resolution=64, num_previews=1, num_held_out_views=0)
        estimate_geometry.run(capture, config, out)
    elif stage == "render_radiance_cues":
        sampling = CueSampling(samples_per_pixel=1)
        config_of_cues = render_radiance_cues.Config(sampling=sampling)
        render_radiance_cues.run(geometry, capture, root / "light.exr", config_of_cues, out)
    elif stage == "relight_views":
        relight_views.run(
            capture, cues, "embedded", None, relight_views.Config(num_samples=num_samples, num_steps=1), out
        )
    elif stage == "fit_latent_nerf":
        fit_latent_nerf.run(geometry, capture, root / "relit", fit_latent_nerf.Config(optimiser=steps), out)
    else:
        turntable = render_novel_views.TurntableConfig(num_views=1, height=size, width=size)
        config_of_views = render_novel_views.Config(turntable=turntable)
        render_novel_views.run(root / "fit_latent_nerf", None, config_of_views, out)


def measured(stage: str, args: argparse.Namespace) -> dict[str, float]:
    """Peak and seconds of one stage, run in a process of its own."""
    sizes = ["--size", str(args.size), "--samples", str(args.samples)]
    command = [sys.executable, __file__, "--out", str(args.out), *sizes, "--only", stage]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--stages", nargs="+", choices=[*_DEFAULT, *_SLOW], default=_DEFAULT)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.only:
        imports, start = peak_memory_gb(), time.perf_counter()
        run_stage(args.only, args.out, args.size, args.samples)
        seconds = time.perf_counter() - start
        print(json.dumps({"peak_gb": round(peak_memory_gb(), 2), "imports_gb": round(imports, 2), "s": round(seconds)}))
        return
    if not (args.out / "light.exr").exists():
        make_inputs(args.out, args.views, args.size, args.samples)
    result: dict[str, Any] = {"views": args.views, "size": args.size, "samples": args.samples}
    result["stages"] = {stage: measured(stage, args) for stage in args.stages}
    result["largest_gb"] = max(stage["peak_gb"] for stage in result["stages"].values())
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
