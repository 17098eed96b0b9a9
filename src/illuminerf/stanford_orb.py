"""The Stanford-ORB benchmark, reproduced by one command.

per capture:                    photographs --> capture, geometry, own light
per target light (fixed):       the most typical of its maps --cues, samples, latent NeRF--> its test views
per target image (per-image):   the image's own map --cues, samples, latent NeRF--> that test view
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from illuminerf import pipeline
from illuminerf.data.orb_lights import typical_view, write_light
from illuminerf.data.stanford_orb import OrbView, cameras_of, check_files, find_captures, object_of, photographs
from illuminerf.diffusion.pretrained import check_model
from illuminerf.evaluation.orb_tables import capture_table, published_orb_table
from illuminerf.presets import Preset, customised
from illuminerf.stages import fit_latent_nerf, relight_views, render_novel_views, render_radiance_cues
from illuminerf.stages.score_orb_predictions import (
    Cell,
    relighting_cells,
    score_orb_predictions,
    size_of,
    write_predictions,
)
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, show_table

Illumination = Literal["fixed", "per-image"]


def stanford_orb_command(
    root: tyro.conf.Positional[Path],
    objects: tuple[str, ...] = (),
    out: Path | None = None,
    illumination: Illumination = "fixed",
    score: Path | None = None,
    json: Path | None = None,
    size: int | None = None,
    lpips: bool = False,
    preset: str = "embedded",
    model: str | None = None,
    samples: int | None = None,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """The Stanford-ORB benchmark: run the whole method and score it, or score a folder of renderings with --score.

    Every capture is relit under the other lights of its object.

    Args:
        root: Unpacked benchmark: blender_HDR, blender_LDR and ground_truth.
        objects: Objects (teapot) or captures (teapot_scene001); by default all.
        out: Folder of the run; needed to run the method. Run the same command again to go on after an interruption.
        illumination: fixed, as in the paper: one light map per object and lighting; per-image: the map of each test
            view, which relights and distils once per view.
        score: Score these renderings, <capture>/<target capture>/0061.png, instead of running the method.
        json: Also write the scores here.
        size: Run and score at this image size in pixels, below the benchmark's 512.
        lpips: Also compute LPIPS, where the optional package is installed.
        preset: Settings of all stages: see `illuminerf presets`.
        model: Another relighting model than the preset's: a folder, embedded or dilightnet.
        samples: Samples per photograph.
        seed: Of every random stream.
        device: auto, cpu or cuda.
    """
    captures = find_captures(root, objects)
    covers = f"{len({object_of(name) for name in captures})} objects, {len(captures)} captures"
    if score is not None:
        _report(score_orb_predictions(root, score, captures, size, lpips), covers, json)
        return
    if out is None:
        raise UserError("nothing to run or score", fix="give --out to run the method, or --score")
    settings = customised(preset, samples=samples, size=size, seed=seed, device=device, model=model)
    run(root, captures, illumination, settings, size, out)
    scores = score_orb_predictions(root, out / "predictions", captures, size, lpips)
    scores["illumination"] = illumination
    scores["seconds"] = {name: pipeline.seconds_by_stage(out / name) for name in captures}
    scores["peak_memory_gb"] = {name: pipeline.peak_memory_gb(out / name) for name in captures}
    write_json(out / "scores.json", scores)
    _report(scores, f"{covers}, {illumination} light", json)


@dataclass(frozen=True)
class RelightingJob:
    """One light, and the test views that are rendered under it."""

    name: str
    light: OrbView
    """The view whose map it is, in the world that the map is wanted in."""
    views: tuple[OrbView, ...]


def relighting_jobs(root: Path, cell: Cell, illumination: Illumination) -> list[RelightingJob]:
    """One light for all test views of a cell, or one for each."""
    if illumination == "per-image":
        return [RelightingJob(f"{cell.target}_{view.name}", view, (view,)) for view in cell.views]
    return [RelightingJob(cell.target, cell.views[typical_view(root, cell.target, cell.views)], cell.views)]


def run(
    root: Path, captures: Sequence[str], illumination: Illumination, preset: Preset, size: int | None, out: Path
) -> None:
    """Run the method; the test views land in <out>/predictions/<capture>/<target>/<name>.png.

    Raises:
        UserError: bad input, or `out` was made with other settings.
    """
    check_model(preset.relighting_model)
    cells = relighting_cells(root, captures)
    check_files(root, [view for cell in cells for view in cell.views])
    pixels = size_of(root, cells, size)
    preset = replace(preset, capture=replace(preset.capture, format="transforms", mask_folder="train_mask"))
    for capture in captures:
        shared = pipeline.estimate_object(photographs(root, capture), preset, out / capture)
        for cell in (cell for cell in cells if cell.capture == capture):
            for job in relighting_jobs(root, cell, illumination):
                say(f"{capture} under {job.name}")
                folder = out / capture / "lights" / job.name
                rendered = relight_job(root, job, shared, preset, pixels, folder)
                write_predictions(rendered, job.views, out / "predictions" / capture / cell.target)


def relight_job(root: Path, job: RelightingJob, shared: dict[str, Path], preset: Preset, size: int, out: Path) -> Path:
    """The per-light half of the method, without a turntable; returns the NovelViews."""
    capture, geometry = shared["capture"], shared["geometry"]
    light, cameras = out / "light.exr", out / "test_cameras.json"
    write_light(root, job.light, preset.cues.max_light_height, light)
    write_json(cameras, cameras_of(job.views, size).to_dict())
    cues = render_radiance_cues.run(geometry, capture, light, preset.cues, out / "cues")
    relit = relight_views.run(
        capture, cues, preset.relighting_model, shared.get("illumination"), preset.relighting, out / "relit"
    )
    latent_nerf = fit_latent_nerf.run(geometry, capture, relit, preset.latent_nerf, out / "latent_nerf")
    moved = pipeline.in_unit_ball(cameras, capture, out / "unit_ball_cameras.json")
    return render_novel_views.run(latent_nerf, moved, preset.test_views, out / "test_views")


def _report(scores: dict[str, Any], covers: str, json: Path | None) -> None:
    if json is not None:
        write_json(json, scores)
    show_table(capture_table(scores))
    show_table(published_orb_table(scores["mean"], covers))
