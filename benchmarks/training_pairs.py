"""Where the time of a training item goes, and how noisy its pictures are; prints JSON.

python benchmarks/training_pairs.py [OBJECTS LIGHTS] [--objects 8] [--views 1] [--size 128] [--samples 64]
    [--cue-samples 64] [--reference-samples 4096] [--threads 1]

Without folders it takes objects and lights made from formulas. One process renders with `--threads` threads, as each
worker of `illuminerf render-training-pairs` does on a machine of so many cores. Seconds are wall, then CPU seconds of
this process, which count on a busy machine. PSNR is of sRGB-coded pictures (object over black, clipped to [0, 1])
against a rendering of the same item with other random numbers and many more paths; first light of the first view.
"""

import argparse
import dataclasses
import json
import os
import platform
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from illuminerf.cues import item_renderer, object_views
from illuminerf.cues.dents import DentVariation
from illuminerf.cues.item_renderer import MitsubaItemRenderer, RenderedItem
from illuminerf.cues.light_library import light_paths
from illuminerf.cues.mitsuba_variant import load_mitsuba
from illuminerf.cues.object_views import ObjectFile, ViewSettings, render_views
from illuminerf.cues.renderer import CUE_NAMES, CueSampling, MitsubaCueRenderer
from illuminerf.cues.shading import ShadedScene
from illuminerf.cues.training_cameras import CameraSphere
from illuminerf.cues.variations import MaterialVariation
from illuminerf.data.object_collection import list_objects
from illuminerf.evaluation.metrics import psnr
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.example_assets import write_example_assets
from illuminerf.scene.images import srgb_from_linear
from illuminerf.workflow.artefact import peak_memory_gb
from illuminerf.workflow.shards import LeftOut, sample_tar

# what the factory itself calls, by the step that it belongs to
STEPS: tuple[tuple[str, Any, str], ...] = (
    ("load", object_views, "load_object"),
    ("bake", item_renderer, "baked"),
    ("scene", ShadedScene, "__init__"),
    ("scene", MitsubaCueRenderer, "__init__"),
    ("targets", ShadedScene, "render"),
    ("cues", MitsubaCueRenderer, "render"),
    ("g_buffer", item_renderer, "surface_of"),
    ("encode", object_views, "encode_item"),
)


class Stopwatch:
    """Wall and CPU seconds by step, of the factory's own functions while `running`."""

    def __init__(self) -> None:
        self.seconds: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(2))
        self.rendered: list[tuple[tuple[Any, ...], RenderedItem]] = []
        """Arguments and result of every item that was rendered."""

    @contextmanager
    def running(self) -> Iterator[None]:
        """Measure while the block lasts."""
        with ExitStack() as stack:
            for step, owner, name in STEPS:
                stack.enter_context(patch.object(owner, name, self._timed(step, getattr(owner, name))))
            render = MitsubaItemRenderer.render

            def recorded(renderer: MitsubaItemRenderer, *arguments: Any) -> RenderedItem:
                item = render(renderer, *arguments)
                self.rendered.append((arguments, item))
                return item

            stack.enter_context(patch.object(MitsubaItemRenderer, "render", recorded))
            with self.measured("total"):
                yield

    @contextmanager
    def measured(self, step: str) -> Iterator[None]:
        """Add the block's time to a step."""
        start = np.array([time.perf_counter(), time.process_time()])
        try:
            yield
        finally:
            self.seconds[step] += np.array([time.perf_counter(), time.process_time()]) - start

    def _timed(self, step: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def timed(*arguments: Any, **named: Any) -> Any:
            with self.measured(step):
                return function(*arguments, **named)

        return timed


def view_settings(options: argparse.Namespace) -> ViewSettings:
    """The factory's settings; `--paper` takes its cameras, light size, textures and unvaried objects from the paper."""
    base = ViewSettings.paper() if options.paper else ViewSettings()
    return dataclasses.replace(
        base,
        num_views=options.views,
        num_lights=options.lights,
        size=options.size,
        samples_per_pixel=options.samples,
        cue_sampling=CueSampling(options.cue_samples, device=options.device),
        light_height=min(base.light_height, options.light_height),
        materials=base.materials if options.vary else MaterialVariation.none(),
        dents=base.dents if options.vary else DentVariation(0.0),
        cameras=base.cameras if options.paper else CameraSphere(),
    )


def measured(objects: list[ObjectFile], lights: list[EnvironmentMap], settings: ViewSettings) -> dict[str, Any]:
    """Time and bytes of all views of `objects`, and what was rendered of each first view."""
    watch = Stopwatch()
    views = list(range(settings.num_views))
    warm_up = Stopwatch()
    with warm_up.running():  # another seed, so that nothing of it is remembered
        list(render_views(objects, 0, lights, dataclasses.replace(settings, seed=settings.seed + 1), [0]))
    sizes, first_views, left_out = [], [], {}
    for index, item in enumerate(objects):
        before = len(watch.rendered)
        with watch.running():
            made = list(render_views(objects, index, lights, settings, views))
        for view, files in made:
            if isinstance(files, LeftOut):
                left_out[f"{item.id}_{view}"] = files.message
            else:
                sizes.append(len(sample_tar(item.id, files)))
        first_views += watch.rendered[before : before + 1]
    return {
        "first_item": warm_up.seconds["total"],
        "seconds": dict(watch.seconds),
        "sizes": sizes,
        "first_views": first_views,
        "left_out": left_out,
    }


def per_item(seconds: dict[str, np.ndarray], num_items: int) -> dict[str, list[float]]:
    """[wall, CPU] seconds by step; `other` is drawing, reading of lights and hashing."""
    known = sum(value for step, value in seconds.items() if step != "total")
    steps = {step: seconds.get(step, np.zeros(2)) for step in dict.fromkeys(step for step, _, _ in STEPS)}
    steps |= {"other": np.maximum(seconds["total"] - known, 0), "total": seconds["total"]}
    return {step: [round(float(x) / num_items, 4) for x in value] for step, value in steps.items()}


def samples_per_second(seconds: dict[str, np.ndarray], settings: ViewSettings, num_items: int) -> dict[str, float]:
    """Paths per CPU second; a cue stack is four pictures."""
    pixels = num_items * settings.num_lights * settings.size**2
    paths = {
        "targets": pixels * settings.samples_per_pixel,
        "cues": pixels * 4 * settings.cue_sampling.samples_per_pixel,
    }
    return {name: round(count / float(seconds[name][1])) for name, count in paths.items()}


def noise(first_views: list[tuple[tuple[Any, ...], RenderedItem]], settings: ViewSettings, samples: int) -> Any:
    """Mean PSNR over objects, [whole picture, inside the mask], of each picture."""
    sampling = dataclasses.replace(settings.cue_sampling, samples_per_pixel=samples)
    renderer = MitsubaItemRenderer(samples, sampling, settings.bakes_textures)
    rows: dict[str, list[list[float]]] = defaultdict(list)
    for (parts, camera, lights, seed, cue_mesh), item in first_views:
        reference = renderer.render(parts, camera, lights[:1], seed + 1, cue_mesh)
        inside = reference.alpha > 0.5
        for name, image, wanted in zip((*CUE_NAMES, "target"), _pictures(item), _pictures(reference), strict=True):
            coded, truth = (srgb_from_linear(np.clip(x, 0, 1)) for x in (image, wanted))
            rows[name].append([psnr(coded, truth), psnr(coded[:, inside], truth[:, inside])])
    return {name: [round(float(x), 2) for x in np.mean(values, 0)] for name, values in rows.items()}


def _pictures(item: RenderedItem) -> list[np.ndarray]:
    """Four cues and the target under the first light, [3, height, width] each."""
    return [*item.cues[0].reshape(4, 3, *item.alpha.shape), item.targets[0]]


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", metavar="FOLDER", help="OBJECTS and LIGHTS")
    parser.add_argument("--objects", type=int, default=8, help="at most so many, spread over the collection")
    parser.add_argument("--views", type=int, default=1, help="per object")
    parser.add_argument("--lights", type=int, default=4, help="per view")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--samples", type=int, default=ViewSettings().samples_per_pixel, help="of targets")
    parser.add_argument("--cue-samples", type=int, default=CueSampling().samples_per_pixel)
    parser.add_argument("--reference-samples", type=int, default=4096, help="0: no reference, no PSNR")
    parser.add_argument("--light-height", type=int, default=512, help="at most so many rows")
    parser.add_argument("--vary", action="store_true", help="with the factory's variations; else objects as they are")
    parser.add_argument("--paper", action="store_true", help="the paper's cameras and lights, textures not baked")
    parser.add_argument("--threads", type=int, default=1, help="0: all")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    options = parser.parse_args()
    if len(options.folders) not in (0, 2):
        parser.error("name OBJECTS and LIGHTS, or neither")
    return options


def main() -> None:
    options = parsed()
    os.environ["ILLUMINERF_RENDER_THREADS"] = str(options.threads)
    with tempfile.TemporaryDirectory() as temporary:
        folders = options.folders or write_example_assets(Path(temporary))
        everything = list_objects(folders[0])
        chosen = np.linspace(0, len(everything) - 1, min(options.objects, len(everything))).round().astype(int)
        objects = [ObjectFile(everything[i].id, str(everything[i].path), everything[i].licence) for i in chosen]
        settings = view_settings(options)
        lights = [EnvironmentMap.load(path).resized(settings.light_height) for path in light_paths(folders[1])]
        found = measured(objects, lights, settings)
        num_items, seconds = len(found["sizes"]), found["seconds"]
        wall, cpu = (float(x) / num_items for x in seconds["total"])
        pairs = settings.num_lights * (settings.num_lights - 1)
        report = {
            "variant": load_mitsuba(options.device).variant(),
            "threads": options.threads,
            "objects": [item.id for item in objects] if options.folders else "made from formulas",
            "views": options.views,
            "lights": options.lights,
            "size": options.size,
            "samples_per_pixel": {"targets": options.samples, "cues": options.cue_samples},
            "seconds_per_item_wall_cpu": per_item(seconds, num_items),
            "first_item_seconds_wall_cpu": [round(float(x), 3) for x in found["first_item"]],
            "items_per_hour": {"wall": round(3600 / wall), "cpu": round(3600 / cpu)},
            "ordered_pairs_per_hour": {"wall": round(3600 * pairs / wall), "cpu": round(3600 * pairs / cpu)},
            "paths_per_cpu_second": samples_per_second(seconds, settings, num_items),
            "kilobytes_per_item": round(float(np.mean(found["sizes"])) / 1e3, 1),
            "left_out": found["left_out"],
            "peak_memory_gb": round(peak_memory_gb(), 3),
            "load_average": round(os.getloadavg()[0], 2),
            "processor": platform.processor() or platform.machine(),
        }
        if options.reference_samples:
            report["reference_samples"] = options.reference_samples
            report["psnr_whole_inside"] = noise(found["first_views"], settings, options.reference_samples)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
