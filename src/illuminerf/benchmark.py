"""Published benchmarks, reproduced by one command each."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.table import Table

from illuminerf import pipeline
from illuminerf.data.tensoir import load_test_cameras
from illuminerf.diffusion.pretrained import pretrained_model
from illuminerf.diffusion.relighting_scores import evaluate
from illuminerf.diffusion.training_items import load_items
from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.evaluation.tables import cell_table, published_table
from illuminerf.presets import Preset, customised
from illuminerf.scene.images import read_png, write_png
from illuminerf.stages.score_predictions import score_input_light, score_predictions
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.device import resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import console

TENSOIR_LIGHTS = ("bridge", "city", "fireplace", "forest", "night")


def tensoir_command(
    root: tyro.conf.Positional[Path],
    scenes: tuple[str, ...],
    lights: tuple[str, ...] = TENSOIR_LIGHTS,
    lights_dir: Path | None = None,
    out: Path | None = None,
    score: Path | None = None,
    json: Path | None = None,
    rescale: Literal["median", "least_squares", "none"] = "median",
    size: int | None = None,
    every: int = 1,
    lpips: bool = False,
    preset: str = "embedded",
    samples: int | None = None,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """The TensoIR benchmark: run the whole method and score it, or score a folder of renderings with --score.

    Args:
        root: Unpacked benchmark: <scene>/train_000/rgba_sunset.png, <scene>/test_000/rgba_<light>.png, ...
        scenes: Scenes to run or score.
        lights: Target lights.
        lights_dir: Folder with <light>.exr; needed to run the method.
        out: Folder of the run; needed to run the method.
        score: Score these renderings, <scene>/<light>/test_000.png, instead of running the method.
        json: Also write the scores here.
        rescale: Per-channel rescaling; none where the renderings are rescaled already.
        size: Run and score at this image size in pixels; smaller than the benchmark's, truth is averaged down.
        every: Use every n-th test view.
        lpips: Also compute LPIPS, where the optional package is installed.
        preset: Settings of all stages: see `illuminerf presets`.
        samples: Samples per photograph.
        seed: Of every random stream.
        device: auto, cpu or cuda.
    """
    if score is not None:
        _report(score_predictions(root, score, scenes, lights, rescale, every, lpips, size), "these renderings", json)
        return
    if out is None or lights_dir is None:
        raise UserError("nothing to run or score", fix="give --out and --lights-dir to run the method, or --score")
    settings = customised(preset, samples=samples, size=size, seed=seed, device=device)
    for scene in scenes:
        relight_scene(root / scene, lights, lights_dir, settings, size, every, out)
    scores = score_predictions(root, out / "predictions", scenes, lights, rescale, every, lpips, size)
    scores["input_light"] = score_input_light(root, scenes, lights, rescale, every, size=size)["psnr"]
    scores["seconds"] = {scene: pipeline.seconds_by_stage(out / scene) for scene in scenes}
    scores["peak_memory_gb"] = {scene: pipeline.peak_memory_gb(out / scene) for scene in scenes}
    write_json(out / "scores.json", scores)
    _report(scores, f"{len(scenes)} scenes, {len(lights)} lights, every {every}", json)


def relighting_model_command(
    model: tyro.conf.Positional[str],
    data: tyro.conf.Positional[Path],
    json: Path | None = None,
    pairs: int = 48,
    samples: int = 4,
    steps: int = 4,
    temperature: float = 0.6,
    device: str = "auto",
) -> None:
    """Score a relighting model on rendered pairs of held-out objects and lights (see docs/model_card.md).

    Args:
        model: A model folder, or the word embedded.
        data: What render-training-pairs made of held-out objects and lights.
        json: Write the scores here.
        pairs: How many (input light, target light) pairs, spread over the renders.
        samples: Samples per pair.
        steps: Denoising steps.
        temperature: Factor on the initial noise.
        device: auto, cpu or cuda.
    """
    network = pretrained_model(model, resolve_device(device))
    items = load_items(data, network.config.image_size)
    scores, _ = evaluate(network, items, pairs, samples, steps, temperature=temperature)
    named = {
        "psnr": scores["sample"]["psnr"],
        "psnr_mean_of_samples": scores["mean"]["psnr"],
        "psnr_input": scores["input"]["psnr"],
        "psnr_albedo_cue": scores["mean_albedo"]["psnr"],
        "psnr_products": scores["anchor"]["psnr"],
        "psnr_upper_bound": scores["bound"]["psnr"],
        "ssim_mean_of_samples": scores["mean"]["ssim"],
        "ssim_input": scores["input"]["ssim"],
        "spread": scores["spread"]["srgb"],
    }
    if json is not None:
        write_json(json, named | {"renders": len(items), "pairs": pairs, "samples": samples, "steps": steps})
    table = Table(title=f"Relighting model on {len(items)} renders, {pairs} pairs: PSNR over the object, rescaled")
    table.add_column("estimate")
    table.add_column("PSNR", justify="right")
    for name, value in named.items():
        if name.startswith("psnr"):
            table.add_row(name.removeprefix("psnr_").replace("psnr", "one sample").replace("_", " "), f"{value:.2f}")
    console.print(table)


def relight_scene(
    scene: Path, lights: Sequence[str], lights_dir: Path, preset: Preset, size: int | None, every: int, out: Path
) -> None:
    """Run the method on one scene; the test views land in <out>/predictions/<scene>/<light>/<name>.png on white."""
    names, cameras = load_test_cameras(scene, every, (size, size) if size else None)
    test_cameras = out / scene.name / "test_cameras.json"
    write_json(test_cameras, cameras.to_dict())
    jobs = [pipeline.LightJob(_light(lights_dir, light), test_cameras) for light in lights]
    pipeline.relight(scene, jobs, preset, out / scene.name)
    for light in lights:
        rendered = out / scene.name / "lights" / light / "test_views" / "images"
        for view, name in enumerate(names):
            image = read_png(rendered / f"{view:03d}.png")
            write_png(out / "predictions" / scene.name / light / f"{name}.png", on_white(image))


def _light(folder: Path, name: str) -> Path:
    for suffix in (".exr", ".hdr"):
        if (folder / f"{name}{suffix}").is_file():
            return folder / f"{name}{suffix}"
    raise UserError(
        f"there is no light '{name}'", got=f"no {name}.exr or {name}.hdr in {folder}", fix="check --lights-dir"
    )


def _report(scores: dict[str, Any], covers: str, json: Path | None) -> None:
    if json is not None:
        write_json(json, scores)
    console.print(cell_table(scores["psnr"], scores["ssim"], scores.get("lpips"), scores.get("input_light")))
    mean = scores["mean"]
    console.print(published_table(mean["psnr"], mean["ssim"], mean.get("lpips"), covers))
