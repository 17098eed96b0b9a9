"""Published benchmarks, reproduced by one command each."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.table import Table

from illuminerf import inverse_rendering, pipeline
from illuminerf.data.tensoir import load_test_cameras
from illuminerf.diffusion.pretrained import pretrained_model
from illuminerf.diffusion.relighting_scores import evaluate, held_out_pairs
from illuminerf.diffusion.sampling import Sampler
from illuminerf.diffusion.training_items import load_items
from illuminerf.evaluation.latex_tables import latex_tables
from illuminerf.evaluation.pictures import CellPictures
from illuminerf.evaluation.score_files import BASELINE_FOLDER, FILE_NAME, MethodScores, all_cells, read_score_files
from illuminerf.evaluation.score_report import score_page
from illuminerf.evaluation.tables import MeanRow, cell_table, published_table
from illuminerf.presets import DILIGHTNET, EMBEDDED, Preset, customised
from illuminerf.stages.compare_renderings import RenderedMethod, compare_renderings
from illuminerf.stages.score_predictions import score_input_light, score_predictions, write_predictions
from illuminerf.workflow.atomic import write_bytes, write_json
from illuminerf.workflow.device import resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.named_folders import named_folders
from illuminerf.workflow.progress import say, show_table, track

_ESTIMATES = {
    "": "sample",
    "_mean_of_samples": "mean",
    "_best_of_samples": "best",
    "_input": "input",
    "_albedo_cue": "mean_albedo",
    "_products": "anchor",
    "_upper_bound": "bound",
}
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
    baseline: Literal["inverse-rendering"] | None = None,
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
        baseline: Also fit materials and light to the photographs on the same geometry, relight them by path tracing,
            and score that beside the method, in <out>/inverse_rendering.
    """
    if score is not None and baseline is not None:
        raise UserError("a baseline needs a run", got="--score with --baseline", fix="leave one of them out")
    if score is not None:
        _report(score_predictions(root, score, scenes, lights, rescale, every, lpips, size), "these renderings", json)
        return
    if out is None or lights_dir is None:
        raise UserError("nothing to run or score", fix="give --out and --lights-dir to run the method, or --score")
    settings = customised(preset, samples=samples, size=size, seed=seed, device=device)
    if baseline is not None:
        inverse_rendering.check(settings)
    for scene in scenes:
        names, jobs = relight_scene(root / scene, lights, lights_dir, settings, size, every, out)
        if baseline is not None:
            _inverse_rendering(out / scene, names, jobs, settings, out / BASELINE_FOLDER)
    scores = score_predictions(root, out / "predictions", scenes, lights, rescale, every, lpips, size)
    scores["input_light"] = score_input_light(root, scenes, lights, rescale, every, size=size)["psnr"]
    scores["seconds"] = {scene: pipeline.seconds_by_stage(out / scene) for scene in scenes}
    scores["peak_memory_gb"] = {scene: pipeline.peak_memory_gb(out / scene) for scene in scenes}
    if baseline is not None:
        folder = out / BASELINE_FOLDER
        rival = score_predictions(root, folder / "predictions", scenes, lights, rescale, every, lpips, size)
        rival["input_light"] = scores["input_light"]
        rival["seconds"] = {s: inverse_rendering.seconds_by_stage(out / s, folder / s) for s in scenes}
        write_json(folder / FILE_NAME, rival)
        scores["rivals"] = {inverse_rendering.NAME: rival}
    write_json(out / FILE_NAME, scores)
    _report(scores, f"{len(scenes)} scenes, {len(lights)} lights, every {every}", json)


def report_command(
    folders: tyro.conf.Positional[tuple[Path, ...]],
    out: Path,
    root: Path | None = None,
    renderings: tuple[str, ...] = (),
    views: int = 3,
    title: str = "Relighting scores",
) -> None:
    """One HTML page and LaTeX tables from any score files of `benchmark tensoir`, beside published figures.

    Args:
        folders: Folders with a scores.json, or score files of other names; each is one method, called like it.
        out: The HTML file; the LaTeX tables are written beside it, with the ending .tex.
        root: Unpacked benchmark; with it the page shows pictures, without it only tables.
        renderings: NAME=FOLDER with <scene>/<light>/test_000.png: where a scored method's pictures are (by default
            in its folder's predictions/), or further pictures, shown as they are.
        views: Test views shown per scene and light.
        title: Of the page.
    """
    if out.suffix not in (".html", ".htm"):
        raise UserError("the report is an HTML file", got=f"--out {out}", wanted="a name such as report.html")
    if views < 1:
        raise UserError("there is no view to show", got=f"--views {views}", wanted="1, 2, 3, ...")
    if renderings and root is None:
        raise UserError("pictures are shown beside the truth", got="--renderings without --root", fix="give --root")
    methods = read_score_files(folders)
    pictures: Iterable[CellPictures] = ()
    if root is not None:
        cells = all_cells(methods)
        shown = compare_renderings(root, _rendered(methods, named_folders(renderings)), cells, views)
        pictures = track(shown, "pictures", len(cells))
    write_bytes(out, score_page(methods, pictures, title))
    write_bytes(out.with_suffix(".tex"), latex_tables(methods).encode())
    say(
        f"{out} and {out.with_suffix('.tex').name}: {len(methods)} methods, {len(all_cells(methods))} scenes and lights"
    )


def relighting_model_command(
    model: tyro.conf.Positional[str],
    data: tyro.conf.Positional[str],
    json: Path | None = None,
    pairs: int = 200,
    samples: int = 4,
    steps: int | None = None,
    sampler: Sampler | None = None,
    temperature: float | None = None,
    knows_shading: bool = False,
    device: str = "auto",
) -> None:
    """Score a relighting model on rendered pairs of held-out objects and lights (see docs/model_card.md).

    Over the object's pixels, after the least-squares scale per image and channel in linear light.

    Args:
        model: A model folder, or the word embedded or dilightnet.
        data: What render-training-pairs made of held-out objects and lights.
        json: Write the scores here.
        pairs: How many different (input light, target light) pairs at most, spread over the renders.
        samples: Samples per pair.
        steps: Denoising steps; the model's usual number where it is left out.
        sampler: ddpm, ddim or dpm_solver; the model's usual one where it is left out.
        temperature: Factor on the initial noise; the model's usual one where it is left out.
        knows_shading: Tell the model the diffuse cue under the input light, which the pipeline estimates from all
            photographs together, and which no baseline here has.
        device: auto, cpu or cuda.
    """
    network = pretrained_model(model, resolve_device(device))
    items = load_items(data, network.image_size)
    usual = (EMBEDDED if network.latent_is_residual else DILIGHTNET).relighting
    num_steps = usual.num_steps if steps is None else steps
    chosen_sampler = usual.sampler if sampler is None else sampler
    factor = usual.temperature if temperature is None else temperature
    num_pairs = len(held_out_pairs(items, pairs))
    scores, _ = evaluate(network, items, num_pairs, samples, num_steps, chosen_sampler, 8, factor, knows_shading)
    named = {
        f"{metric}{suffix}": scores[estimate][metric]
        for metric in ("psnr", "ssim")
        for suffix, estimate in _ESTIMATES.items()
        if estimate in scores
    }
    named["spread"] = scores["spread"]["srgb"]
    if json is not None:
        how = {"samples": samples, "steps": num_steps, "sampler": chosen_sampler, "temperature": factor}
        how["knows_shading"] = knows_shading
        write_json(json, named | {"renders": len(items), "pairs": num_pairs, **how})
    drawn = f"{len(items)} renders, {num_pairs} pairs, {samples} samples"
    table = Table(title=f"Relighting model on {drawn}: over the object, rescaled")
    table.add_column("estimate")
    table.add_column("PSNR", justify="right")
    table.add_column("SSIM", justify="right")
    for suffix, estimate in _ESTIMATES.items():
        if estimate in scores:
            label = suffix.removeprefix("_").replace("_", " ") or "one sample"
            table.add_row(label, f"{named[f'psnr{suffix}']:.2f}", f"{named[f'ssim{suffix}']:.3f}")
    show_table(table)


def relight_scene(
    scene: Path, lights: Sequence[str], lights_dir: Path, preset: Preset, size: int | None, every: int, out: Path
) -> tuple[list[str], list[pipeline.LightJob]]:
    """Run the method on one scene; the test views land in <out>/predictions/<scene>/<light>/<name>.png on white.

    Returns:
        The names of the test views and what the method was asked for.
    """
    names, cameras = load_test_cameras(scene, every, (size, size) if size else None)
    test_cameras = out / scene.name / "test_cameras.json"
    write_json(test_cameras, cameras.to_dict())
    jobs = [pipeline.LightJob(_light(lights_dir, light), test_cameras) for light in lights]
    pipeline.relight(scene, jobs, dataclasses.replace(preset, relit_mesh=None), out / scene.name)
    for light in lights:
        rendered = out / scene.name / "lights" / light / "test_views"
        write_predictions(rendered, names, out / "predictions" / scene.name / light)
    return names, jobs


def _inverse_rendering(
    run: Path, names: Sequence[str], jobs: Sequence[pipeline.LightJob], preset: Preset, out: Path
) -> None:
    """Relight the scene of a run the other way; the test views land in <out>/predictions as the method's do."""
    say(f"{inverse_rendering.NAME}: {run.name}")
    views = inverse_rendering.relight(run, jobs, preset, out / run.name)
    for light, rendered in views.items():
        write_predictions(rendered, names, out / "predictions" / run.name / light)


def _rendered(methods: Sequence[MethodScores], folders: dict[str, Path]) -> list[RenderedMethod]:
    """The scored methods, rescaled as their scores say, then the further ones of `folders`, as they are."""
    scored = []
    for method in methods:
        usual = method.path.parent / "predictions" if method.path.name == FILE_NAME else None
        folder = folders.get(method.name, usual)
        scored.append(RenderedMethod(method.name, folder, method.rescale, method.scale))
    names = {method.name for method in methods}
    return scored + [RenderedMethod(name, folder) for name, folder in folders.items() if name not in names]


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
    rivals = scores.get("rivals", {})
    columns = {name: rival["psnr"] for name, rival in rivals.items()}
    table = cell_table(scores["psnr"], scores["ssim"], scores.get("lpips"), scores.get("input_light"), columns)
    show_table(table)
    ours = _mean_row("", scores)
    rows = [_mean_row(f"{name}, same geometry", rival) for name, rival in rivals.items()]
    show_table(published_table(ours.psnr, ours.ssim, ours.lpips, covers, ours.seconds, rows))


def _mean_row(name: str, scores: dict[str, Any]) -> MeanRow:
    mean, stages = scores["mean"], scores.get("seconds", {})
    seconds = sum(sum(scene.values()) for scene in stages.values()) if stages else None
    return MeanRow(name, mean["psnr"], mean["ssim"], mean.get("lpips"), seconds)
