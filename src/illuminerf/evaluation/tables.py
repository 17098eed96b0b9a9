"""Score tables for a terminal: ours first, published figures marked as such."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
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
    table = Table(title="Ablation (marked *: published for TensoIR's hotdog, 200 views under each of 5 lights)")
    for heading in ("S", "codes"):
        table.add_column(heading)
    ours = ("PSNR", "SSIM", "LPIPS", "train PSNR", "samples differ", "renderings differ", "seconds")
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


def _numbers(values: Sequence[float | None], digits: int) -> list[str]:
    return ["-" if value is None else f"{value:.{digits}f}" for value in values]
