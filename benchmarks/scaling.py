"""How the cost of each stage grows: time against views, pixels, samples and steps, with a line through the points.

    python benchmarks/scaling.py > scaling.json

Everything is measured on the bundled capture at sizes of seconds. Prints JSON: by stage and quantity the points, the
line through their CPU seconds (fixed, per unit) and the largest distance from it as a share of the largest. CPU seconds
are those of all threads; on a busy machine they say more than the clock. Peak memory is the process's so far, so it
only says by how much the last points of a row needed more than all before.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from illuminerf.cues.renderer import CueSampling
from illuminerf.data.capture import load_capture, write_capture
from illuminerf.demo import bundled_capture
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.scene.images import to_uint8
from illuminerf.stages import (
    estimate_geometry,
    fit_latent_nerf,
    import_capture,
    relight_views,
    render_novel_views,
    render_radiance_cues,
)
from illuminerf.workflow.artefact import peak_memory_gb

LIGHT = bundled_capture() / "lights" / "evening.exr"
VIEWS, SIZES, SAMPLES, STEPS, FRAMES = (2, 4, 8, 16), (32, 64, 96, 128), (1, 2, 4, 8), (20, 40, 80), (1, 2, 4)
SIZE, NUM_VIEWS = 64, 4
_STEPS = OptimiserConfig(num_steps=20, rays_per_step=256, warmup_steps=5)


def part_of(capture: Path, num_views: int, size: int, out: Path) -> Path:
    """The first views of a capture, smaller, in the same world."""
    loaded = load_capture(capture)
    views = loaded.views
    images = []
    for view in range(num_views):
        straight = np.dstack([views.srgb[view], views.alpha[view]])
        images.append(np.asarray(Image.fromarray(to_uint8(straight)).resize((size, size)), np.float32) / 255)
    cameras = views.cameras[list(range(num_views))].resized(size, size)
    names = [f"{view:03d}" for view in range(num_views)]
    write_capture(out, images, cameras, names, loaded.scale, loaded.offset, loaded.background)
    return out


def line_through(x: list[float], seconds: list[float]) -> dict[str, float]:
    """Least squares."""
    per_unit, fixed = np.polyfit(x, seconds, 1)
    distance = np.abs(np.polyval([per_unit, fixed], x) - seconds).max() / max(seconds)
    return {"fixed": float(fixed), "per_unit": float(per_unit), "largest_distance": float(distance)}


class Bench:
    """Artefacts by what they depend on, and the clock."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.number = folder, 0
        self.whole = import_capture.run(bundled_capture(), import_capture.Config(), self.new())
        self.geometry = self.fit(self.capture(NUM_VIEWS, SIZE), 100)

    def new(self) -> Path:
        """A folder that is not there yet."""
        self.number += 1
        return self.folder / f"{self.number:03d}"

    def capture(self, num_views: int, size: int) -> Path:
        return part_of(self.whole, num_views, size, self.new())

    def fit(self, capture: Path, num_steps: int) -> Path:
        settings = estimate_geometry.Config(
            optimiser=replace(_STEPS, num_steps=num_steps), mesh_resolution=40, num_previews=0, num_held_out_views=0
        )
        return estimate_geometry.run(capture, settings, self.new())

    def cues(self, capture: Path, samples_per_pixel: int = 4) -> Path:
        settings = render_radiance_cues.Config(sampling=CueSampling(samples_per_pixel), max_light_height=32)
        return render_radiance_cues.run(self.geometry, capture, LIGHT, settings, self.new())

    def relit(self, capture: Path, cues: Path, num_samples: int) -> Path:
        settings = relight_views.Config(num_samples=num_samples, num_steps=1, batch_size=1)
        return relight_views.run(capture, cues, "embedded", None, settings, self.new())

    def latent_nerf(self, capture: Path, relit: Path, num_steps: int = 20) -> Path:
        settings = fit_latent_nerf.Config(optimiser=replace(_STEPS, num_steps=num_steps))
        return fit_latent_nerf.run(self.geometry, capture, relit, settings, self.new())

    def frames(self, num_frames: int, size: int) -> Path:
        turn = render_novel_views.TurntableConfig(num_views=num_frames, height=size, width=size)
        return render_novel_views.run(self.geometry, None, render_novel_views.Config(turntable=turn), self.new())


def measured(
    x: tuple[int, ...], unit: Callable[[int], float], work: Callable[[int], Callable[[], Any]]
) -> dict[str, Any]:
    """CPU seconds of `work(value)()` for every value, and the line through them."""
    units, seconds, wall, memory = [], [], [], []
    for value in x:
        prepared = work(value)
        start, start_wall = time.process_time(), time.perf_counter()
        prepared()
        seconds.append(time.process_time() - start)
        wall.append(round(time.perf_counter() - start_wall, 3))
        units.append(unit(value))
        memory.append(round(peak_memory_gb(), 3))
    points = {"x": units, "cpu_seconds": [round(s, 3) for s in seconds], "wall_seconds": wall}
    return points | {"peak_memory_gb": memory} | line_through(units, seconds)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=4, help="points per row at most")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        print(json.dumps(rows(bench, arguments.points), indent=1))


def rows(bench: Bench, points: int) -> dict[str, Any]:
    """All rows by "<stage> by <quantity>"."""
    by_views = {count: bench.capture(count, SIZE) for count in VIEWS[:points]}
    by_size = {size: bench.capture(NUM_VIEWS, size) for size in SIZES[:points]}
    first = by_views[VIEWS[0]]
    warm = bench.relit(first, bench.cues(first), 1)  # kernels are compiled, weights are read
    for capture in by_size.values():
        bench.cues(capture)  # there are kernels for every size of image
    bench.latent_nerf(first, warm, 2)
    bench.frames(1, 16)
    cues_by_views: dict[int, Path] = {}
    cues_by_size: dict[int, Path] = {}

    def keep(cues: dict[int, Path], key: int, capture: Path) -> Callable[[], Any]:
        return lambda: cues.setdefault(key, bench.cues(capture))

    def pixels(size: int) -> float:
        return size * size * NUM_VIEWS / 1000

    kept = by_views[NUM_VIEWS]
    table = {
        "cues by views": measured(tuple(by_views), float, lambda n: keep(cues_by_views, n, by_views[n])),
        "cues by thousand pixels": measured(tuple(by_size), pixels, lambda s: keep(cues_by_size, s, by_size[s])),
        "samples by views": measured(
            tuple(by_views), float, lambda n: lambda: bench.relit(by_views[n], cues_by_views[n], 1)
        ),
        "samples by thousand pixels": measured(
            tuple(by_size), pixels, lambda s: lambda: bench.relit(by_size[s], cues_by_size[s], 1)
        ),
        "samples by S": measured(SAMPLES[:points], float, lambda n: lambda: bench.relit(kept, cues_by_views[4], n)),
        "geometry by steps": measured(STEPS[:points], float, lambda n: lambda: bench.fit(kept, n)),
        "latent NeRF by steps": measured(STEPS[:points], float, lambda n: lambda: bench.latent_nerf(first, warm, n)),
        "frames by number": measured(FRAMES[:points], float, lambda n: lambda: bench.frames(n, SIZE)),
    }
    return table


if __name__ == "__main__":
    main()
