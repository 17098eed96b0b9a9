"""The paper's ablation: what latent codes and more samples bring, on one object under one light.

    capture, geometry, own light, cues, max(S) samples of every photograph     once, as `illuminerf relight` does it
    first S samples --latent NeRF--> test views --> scores, consistency        once per row

Rows without codes are standard NeRFs. In the last row codes are shuffled at every step, so that they can explain
nothing; what it lacks against the row above is what codes explain.
"""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from illuminerf import pipeline
from illuminerf.data.capture import load_capture
from illuminerf.data.tensoir import find_test_views, is_tensoir_scene, load_test_cameras
from illuminerf.diffusion.pretrained import check_model
from illuminerf.evaluation.published import published_ablation
from illuminerf.evaluation.tables import ablation_table, mean_of
from illuminerf.presets import Preset, customised
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.stages import (
    evaluate_relighting,
    fit_latent_nerf,
    measure_consistency,
    relight_views,
    render_novel_views,
    render_radiance_cues,
)
from illuminerf.stages.score_predictions import score_predictions, write_predictions
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import atomic_path, read_json, write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, show_table


@dataclass(frozen=True)
class Row:
    """One latent NeRF."""

    num_samples: int
    """Samples of every photograph that it sees: S."""
    uses_latents: bool = True
    shuffles_latents: bool = False

    @property
    def name(self) -> str:
        """The folder's name."""
        codes = "no_codes" if not self.uses_latents else "shuffled_codes" if self.shuffles_latents else "codes"
        return f"{self.num_samples:02d}_{codes}"


@dataclass(frozen=True)
class UnseenViews:
    """Unseen views to render, and the truth, where there is any."""

    cameras: Path
    """cameras.json in the caller's world."""
    truth: Path | None = None
    """A scene of the TensoIR benchmark, or a folder with cameras.json and images/<000>.png."""
    names: tuple[str, ...] = ()
    """The benchmark's names of the views; empty for other captures."""
    every: int = 1
    """They are every n-th of the benchmark's."""
    size: int | None = None
    """Longest side in pixels to which the benchmark's images are averaged down."""


def ablation_command(
    capture: tyro.conf.Positional[Path],
    light: Path,
    out: Path,
    samples: tuple[int, ...] = (1, 4, 16),
    test_cameras: Path | None = None,
    truth: Path | None = None,
    size: int | None = None,
    every: int = 1,
    pairs: int = 10,
    lpips: bool = False,
    temperature: float | None = None,
    preset: str = "embedded",
    model: str | None = None,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """The paper's ablation: no latent codes, codes with more and more samples, and shuffled codes.

    Everything up to the samples is made once. In the folder of an `illuminerf relight` run with the same settings,
    its stages are reused.

    Args:
        capture: Folder of posed photographs; a TensoIR scene is scored on its own test views under the light.
        light: Equirectangular .exr or .hdr map, for a TensoIR scene named like its images: city.exr for rgba_city.png.
        out: Folder of the run; run the same command again to go on after an interruption.
        samples: Samples per photograph, a row with codes each; the fewest also without, the most also shuffled.
        test_cameras: For other captures: cameras.json of unseen views.
        truth: For other captures: folder with cameras.json and images/ of the unseen views under the light.
        size: Run and score at this image size in pixels.
        every: Use every n-th test view of a TensoIR scene.
        pairs: Pairs of neighbouring photographs whose relit images are compared.
        lpips: Also compute LPIPS, where the optional package is installed.
        temperature: Of the relighting model's samples, where not the preset's: the higher, the more samples differ.
        preset: Settings of all stages: see `illuminerf presets`.
        model: Another relighting model than the preset's: a folder, embedded or dilightnet.
        seed: Of every random stream.
        device: auto, cpu or cuda.
    """
    if not samples or min(samples) < 1:
        raise UserError("nothing to compare", got=f"--samples {' '.join(map(str, samples))}", wanted="1 4 16")
    settings = customised(preset, samples=max(samples), size=size, seed=seed, device=device, model=model)
    if temperature is not None:
        settings = replace(settings, relighting=replace(settings.relighting, temperature=temperature))
    comparison = measure_consistency.Config(num_pairs=pairs, device=device)
    EnvironmentMap.load(light)
    views = _unseen_views(capture, light.stem, test_cameras, truth, size, every, out / "ablation" / light.stem)
    result = run(capture, light, rows_of(samples), views, settings, comparison, out, lpips)
    show_table(ablation_table(result["rows"]))
    say(f"done: {out / 'ablation' / light.stem / 'ablation.json'}")


def rows_of(samples: Sequence[int]) -> list[Row]:
    """The fewest samples without codes; all with codes; the most with shuffled codes."""
    numbers = sorted(set(samples))
    rows = [Row(numbers[0], uses_latents=False), *(Row(number) for number in numbers)]
    return [*rows, Row(numbers[-1], shuffles_latents=True)]


def run(
    source: Path,
    light: Path,
    rows: Sequence[Row],
    test_views: UnseenViews | None,
    preset: Preset,
    comparison: measure_consistency.Config,
    out: Path,
    lpips: bool = False,
) -> dict[str, Any]:
    """Fit, render and measure every row; what ablation.json holds is returned.

    Raises:
        UserError: bad input, or `out` was made with other settings.
    """
    check_model(preset.relighting_model)
    made = pipeline.estimate_object(source, preset, out)
    capture, geometry = made["capture"], made["geometry"]
    of_light = out / "lights" / light.stem
    made["cues"] = render_radiance_cues.run(geometry, capture, light, preset.cues, of_light / "cues")
    made["relit"] = relit = relight_views.run(
        capture, made["cues"], preset.relighting_model, made.get("illumination"), preset.relighting, of_light / "relit"
    )
    num_views, folder = len(load_capture(capture).views), out / "ablation" / light.stem
    measured = []
    for row in rows:
        say(f"row: {row.name}")
        drawn = relit
        if row.num_samples < preset.relighting.num_samples:
            drawn = first_samples(relit, num_views, row.num_samples, folder / f"first_{row.num_samples:02d}")
        config = replace(preset.latent_nerf, use_latents=row.uses_latents, shuffles_latents=row.shuffles_latents)
        latent_nerf = fit_latent_nerf.run(geometry, capture, drawn, config, folder / row.name / "latent_nerf")
        compared = measure_consistency.run(capture, drawn, latent_nerf, comparison, folder / row.name / "consistency")
        scores = {}
        if test_views is not None:
            cameras = pipeline.in_unit_ball(test_views.cameras, capture, folder / "unit_ball_cameras.json")
            rendered = render_novel_views.run(latent_nerf, cameras, preset.test_views, folder / row.name / "test_views")
            scores = _scores(rendered, test_views, light.stem, preset, lpips, folder / row.name)
        fitted, published = read_metrics(latent_nerf), published_ablation(row.num_samples, row.uses_latents)
        measured.append({
            **asdict(row),
            **scores,
            "train_psnr": fitted["train_psnr"],
            "seconds": fitted["seconds"],
            "consistency": read_json(compared / "consistency.json"),
            "published": None if row.shuffles_latents or published is None else asdict(published),
        })  # fmt: skip
    result = {
        "rows": measured,
        "light": light.stem,
        "shared_seconds": {stage: read_metrics(path)["seconds"] for stage, path in made.items()},
    }
    write_json(folder / "ablation.json", result)
    return result


def first_samples(relit: Path, num_views: int, num_samples: int, out: Path) -> Path:
    """Copy the first samples of every view into `out`. A sample's noise depends on its number and not on how many
    there are, so they are those that a run with fewer samples would draw (but for rounding).

    Raises:
        UserError: there are not so many.
    """
    for view in range(num_views):
        for sample in range(num_samples):
            source, target = (relight_views.sample_path(folder, view, sample) for folder in (relit, out))
            if not source.exists():
                raise UserError(f"{relit} has too few samples", got=f"no {source.name}", wanted=f"{num_samples}")
            if not target.exists() or target.read_bytes() != source.read_bytes():
                with atomic_path(target) as temporary:
                    shutil.copyfile(source, temporary)
    return out


def _unseen_views(
    capture: Path, light: str, cameras: Path | None, truth: Path | None, size: int | None, every: int, folder: Path
) -> UnseenViews | None:
    """What is rendered and compared with what; None where there is nothing."""
    if truth is not None and cameras is None:
        cameras = truth / "cameras.json"
    if cameras is not None:
        read_json(cameras)  # find a missing file before hours are spent
        return UnseenViews(cameras, truth)
    if not is_tensoir_scene(capture):
        return None
    capture = capture.resolve()  # the scene is called by its folder's name
    find_test_views(capture, [light], every)
    names, benchmark_cameras = load_test_cameras(capture, every, (size, size) if size else None)
    write_json(folder / "test_cameras.json", benchmark_cameras.to_dict())
    return UnseenViews(folder / "test_cameras.json", capture, tuple(names), every, size)


def _scores(rendered: Path, views: UnseenViews, light: str, preset: Preset, lpips: bool, out: Path) -> dict[str, float]:
    """psnr, ssim and perhaps lpips by the benchmark's rule, means over the views; empty without truth."""
    if views.truth is None:
        return {}
    if views.names:
        scene = views.truth.name
        write_predictions(rendered, views.names, out / "predictions" / scene / light)
        scores = score_predictions(
            views.truth.parent, out / "predictions", [scene], [light], "median", views.every, lpips, views.size
        )
    else:
        config = replace(preset.evaluation, light=light, lpips=lpips)
        scores = read_json(evaluate_relighting.run(rendered, views.truth, config, out / "scores") / "scores.json")
    return {metric: mean_of(scores[metric]) for metric in ("psnr", "ssim", "lpips") if metric in scores}
