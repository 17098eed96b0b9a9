"""Radiance cues per second, and how far each cue is from one of many more paths; prints JSON.

python benchmarks/render_cues.py [--size 128] [--samples 64] [--reference-samples 1024] [--mesh x.glb] [--light x.exr]
"""

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np

from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.cues.renderer import CUE_NAMES, CueSampling, MitsubaCueRenderer
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.workflow.artefact import peak_memory_gb


def studio(height: int = 256) -> EnvironmentMap:
    """Three small bright lamps in a dim room."""
    radiance = np.full((height, 2 * height, 3), 0.05, np.float32)
    for row, column, tint in ((60, 90, (1, 0.9, 0.8)), (90, 300, (0.8, 0.9, 1)), (150, 420, (1, 1, 1))):
        radiance[row : row + 12, column : column + 16] = 60 * np.array(tint, np.float32)
    return EnvironmentMap(radiance, "studio")


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """dB of the sRGB-coded pictures over the whole image."""
    coded, wanted = (srgb_from_linear(np.clip(x, 0, 1)) for x in (image, reference))
    return float(-10 * np.log10(np.mean((coded - wanted) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--reference-samples", type=int, default=1024)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--specular-depth", type=int, default=CueSampling().specular_depth)
    parser.add_argument("--mesh", type=Path, help="a .glb in the unit ball; default a sphere of 20,480 faces")
    parser.add_argument("--light", type=Path, help="an environment map; default three lamps")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    options = parser.parse_args()
    mesh = TriangleMesh.load_glb(options.mesh) if options.mesh else sphere_mesh(5)
    light = EnvironmentMap.load(options.light) if options.light else studio()
    cameras = turntable_cameras(options.views, 3.2, 0.65, options.size, options.size)
    sampling = CueSampling(options.samples, specular_depth=options.specular_depth, device=options.device)
    renderer = MitsubaCueRenderer(mesh, light, sampling)
    start = time.perf_counter()
    renderer.render(cameras, 0, light, 0)
    first_seconds = time.perf_counter() - start
    start, cpu_start = time.perf_counter(), time.process_time()
    images = [renderer.render(cameras, view, light, view) for view in range(options.views)]
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    many = CueSampling(options.reference_samples, specular_depth=options.specular_depth, device=options.device)
    reference = MitsubaCueRenderer(mesh, light, many).render(cameras, 0, light, 10**6)
    decibels = {
        name: round(psnr(images[0][3 * i : 3 * i + 3], reference[3 * i : 3 * i + 3]), 2)
        for i, name in enumerate(CUE_NAMES)
    }
    print(
        json.dumps(
            {
                "variant": load_mitsuba(options.device).variant(),
                "size": options.size,
                "samples_per_pixel": options.samples,
                "specular_depth": options.specular_depth,
                "faces": len(mesh.faces),
                "first_view_seconds": round(first_seconds, 3),
                "views_per_second": round(options.views / seconds, 3),
                "cpu_seconds_per_view": round(cpu_seconds / options.views, 3),
                "psnr_against_reference": decibels,
                "reference_samples": options.reference_samples,
                "peak_memory_gb": round(peak_memory_gb(), 3),
                "processor": platform.processor() or platform.machine(),
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
