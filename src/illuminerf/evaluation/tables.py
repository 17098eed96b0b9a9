"""Score tables for a terminal: ours first, published figures marked as such."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from illuminerf.evaluation.published import TENSOIR, GalleryScores, gallery_scores

PerLight = Mapping[str, Mapping[str, float]]
"""[scene][light]"""


def mean_of(cells: PerLight) -> float:
    """Mean over lights, then over scenes."""
    return float(np.mean([np.mean(list(lights.values())) for lights in cells.values()]))


def cell_table(
    psnr: PerLight,
    ssim: PerLight,
    lpips: PerLight | None = None,
    input_light: PerLight | None = None,
    rivals: Mapping[str, PerLight] | None = None,
) -> Table:
    """One row per scene and light, beside the PSNR of the gallery's renderings where they are known, and
    the mean. `input_light` is what doing nothing scores on the same frames; by default that of the gallery. `rivals`
    are the PSNR of other methods of the same run.
    """
    rivals = rivals or {}
    table = Table(title="Relighting, per scene and light (gallery: published renderings under the same rule)")
    for heading in ("scene", "light"):
        table.add_column(heading)
    for heading in ("PSNR", "SSIM", "LPIPS", *rivals, "paper", "TensoIR", "input light"):
        table.add_column(heading, justify="right")
    known: list[GalleryScores] = []
    for scene, lights in psnr.items():
        for light, value in lights.items():
            gallery = gallery_scores(scene, light)
            known += [gallery] if gallery else []
            beside: list[float | None] = [None] * 3
            if gallery:
                beside = [gallery.paper, gallery.tensoir, gallery.input_light]
            if input_light is not None:
                beside[2] = input_light[scene][light]
            distance = lpips[scene][light] if lpips else None
            table.add_row(scene, light, *_numbers([value], 2), *_numbers([ssim[scene][light], distance], 3),
                          *_numbers([rival.get(scene, {}).get(light) for rival in rivals.values()], 2),
                          *_numbers(beside, 2))  # fmt: skip
    complete = len(known) == sum(map(len, psnr.values()))
    columns = [[row.paper for row in known], [row.tensoir for row in known], [row.input_light for row in known]]
    means = [float(np.mean(column)) if complete else None for column in columns]
    if input_light is not None:
        means[2] = mean_of(input_light)
    table.add_section()
    table.add_row(
        "mean",
        "",
        *_numbers([mean_of(psnr)], 2),
        *_numbers([mean_of(ssim), mean_of(lpips) if lpips else None], 3),
        *_numbers([mean_of(rival) for rival in rivals.values()], 2),
        *_numbers(means, 2),
    )
    return table


@dataclass(frozen=True)
class MeanRow:
    """Means of one method of this run."""

    method: str
    psnr: float
    ssim: float
    lpips: float | None = None
    seconds: float | None = None
    """Of all stages."""


def published_table(
    psnr: float,
    ssim: float,
    lpips: float | None,
    covers: str,
    seconds: float | None = None,
    rivals: Sequence[MeanRow] = (),
) -> Table:
    """Our means, over what `covers` says, and those of `rivals`, above the published rows of the whole TensoIR
    benchmark."""
    table = Table(title="TensoIR benchmark: rows marked * are published figures for all 4 scenes and 5 lights")
    table.add_column("method")
    for heading in ("PSNR", "SSIM", "LPIPS"):
        table.add_column(heading, justify="right")
    table.add_column("source")
    for row in (MeanRow(f"ours ({covers})", psnr, ssim, lpips, seconds), *rivals):
        time = "" if row.seconds is None else f", {row.seconds:.0f} s"
        table.add_row(row.method, *_numbers([row.psnr], 2), *_numbers([row.ssim, row.lpips], 3), f"this run{time}")
    table.add_section()
    for figures in TENSOIR:
        note = f"{figures.source}; {figures.note}" if figures.note else figures.source
        numbers = (*_numbers([figures.psnr], 2), *_numbers([figures.ssim, figures.lpips], 3))
        table.add_row(f"{figures.method} *", *numbers, note)
    return table


def ablation_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """One row per latent NeRF, as ablation.json has them, beside the paper's figures for TensoIR's hotdog."""
    title = "Ablation (marked *: published for TensoIR's hotdog, 200 views under each of 5 lights)"
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("S", "codes"):
        table.add_column(heading)
    ours = ("PSNR", "SSIM", "LPIPS", "train PSNR", "samples differ", "views differ", "seconds")
    for heading in (*ours, "PSNR *", "SSIM *", "LPIPS *"):
        table.add_column(heading, justify="right")
    for row in rows:
        codes = "no" if not row["uses_latents"] else "shuffled" if row["shuffles_latents"] else "yes"
        agreement, published = row["consistency"], row["published"] or {}
        table.add_row(
            str(row["num_samples"]),
            codes,
            *_numbers([row.get("psnr")], 2),
            *_numbers([row.get("ssim"), row.get("lpips")], 3),
            *_numbers([row["train_psnr"]], 2),
            *_numbers([agreement["samples"], agreement["renderings"]], 4),
            *_numbers([row["seconds"]], 0),
            *_numbers([published.get("psnr"), published.get("ssim"), published.get("lpips")], 3),
        )
    return table


GEOMETRY_COLUMNS = (
    ("normal", "normal_degrees", 2),
    ("SDF", "gradient_normal_degrees", 2),
    ("face", "face_normal_degrees", 2),
    ("Chamf", "chamfer_percent", 3),
    ("F0.5", "f_score_half_percent", 3),
    ("F1", "f_score_1_percent", 3),
    ("IoU", "mask_iou", 3),
    ("PSNR", "psnr", 2),
    ("float", "floater_share", 3),
    ("s", "fit_seconds", 0),
)
"""Heading, key in scores.json, digits; together they fit a terminal."""
_NOT_OF_ABLATIONS = ("face_normal_degrees", "f_score_half_percent", "floater_share")
_GEOMETRY_CAPTION = (
    "degrees between true normals and predicted ones, those of the signed distance, of the faces; Chamfer distance in "
    "percent of the size; F-scores within 0.5 and 1 percent; IoU of masks; share of floaters; seconds of the fit"
)


def geometry_table(objects: Mapping[str, Mapping[str, Any]], mean: Mapping[str, float]) -> Table:
    """One row per object, and their mean."""
    table = _empty_geometry_table("Estimated geometry against the truth", "object")
    for name, scores in objects.items():
        table.add_row(name, *_geometry_cells(scores))
    table.add_section()
    table.add_row("mean", *_geometry_cells(mean))
    return table


def geometry_ablation_table(ablations: Mapping[str, Mapping[str, Any]]) -> Table:
    """One row per ablation: means over those objects that it and the full method reconstructed, and on a second line
    how far they are from the full method's."""
    title = "Geometry with one part of the method changed; below each number, its change"
    columns = tuple(column for column in GEOMETRY_COLUMNS if column[1] not in _NOT_OF_ABLATIONS)
    table = _empty_geometry_table(title, "ablation", columns)
    for name, found in ablations.items():
        mean, full, failed = found["mean"], found["of_full"], len(found["failed"])
        cells = []
        if mean is not None:
            cells = [f"{mean[key]:.{digits}f}\n{mean[key] - full[key]:+.{digits}f}" for _, key, digits in columns]
        table.add_row(name.replace("_", " ") + (f"\n{failed} without a surface" if failed else ""), *cells)
    return table


def _empty_geometry_table(
    title: str, first: str, columns: tuple[tuple[str, str, int], ...] = GEOMETRY_COLUMNS
) -> Table:
    table = Table(title=title, caption=_GEOMETRY_CAPTION, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(first, overflow="fold")
    for heading, _, _ in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _geometry_cells(scores: Mapping[str, Any]) -> list[str]:
    return [_numbers([scores[key]], digits)[0] for _, key, digits in GEOMETRY_COLUMNS]


def _numbers(values: Sequence[float | None], digits: int) -> list[str]:
    return ["-" if value is None else f"{value:.{digits}f}" for value in values]
