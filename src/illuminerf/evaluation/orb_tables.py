"""Stanford-ORB's score tables for a terminal: ours first, published figures marked as such."""

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from illuminerf.evaluation.published import ILLUMINATION_STUDY, STANFORD_ORB

_HEADINGS = {"psnr_h": "PSNR-H", "psnr_l": "PSNR-L", "ssim": "SSIM", "lpips": "LPIPS"}
_DIGITS = {"psnr_h": 2, "psnr_l": 2, "ssim": 3, "lpips": 3}


def capture_table(scores: Mapping[str, Any]) -> Table:
    """One row per capture and target light, of what `score_orb_predictions` returns, and the mean over captures."""
    table = Table(title="Relighting, per capture and target light")
    for heading in ("capture", "light of"):
        table.add_column(heading, overflow="fold")
    for heading in (*_HEADINGS.values(), "images", "missing"):
        table.add_column(heading, justify="right")
    for capture, targets in scores["images"].items():
        for target, images in targets.items():
            row = {metric: scores[metric][capture][target] for metric in _HEADINGS if metric in scores}
            table.add_row(capture, target, *_cells(row), str(images), str(scores["missing"][capture][target]))
    table.add_section()
    totals = [str(sum(sum(row.values()) for row in scores[key].values())) for key in ("images", "missing")]
    table.add_row("mean", "", *_cells(scores["mean"]), *totals)
    return table


def published_orb_table(mean: Mapping[str, float], covers: str) -> Table:
    """Our means, over what `covers` says, above the published rows of the whole benchmark."""
    table = Table(title="Stanford-ORB: rows marked * are published figures for all 14 objects under 3 lights")
    table.add_column("method")
    for heading in _HEADINGS.values():
        table.add_column(heading, justify="right")
    table.add_column("source")
    table.add_row(f"ours ({covers})", *_cells(mean), "this run")
    table.add_section()
    for row in STANFORD_ORB:
        table.add_row(f"{row.method} *", *_cells({metric: getattr(row, metric) for metric in _HEADINGS}), row.source)
    return table


def study_table(methods: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Table:
    """Means by method against references under a fixed and a per-image light ("fixed", "per_image"), above the
    paper's."""
    table = Table(title="Against renderings of the scanned objects (rows marked *: published, 14 objects, 3 lights)")
    table.add_column("method")
    for heading in ("relit under", "reference"):
        table.add_column(heading, no_wrap=True)
    for heading in _HEADINGS.values():
        table.add_column(heading, justify="right")
    for name, means in methods.items():
        for reference in ("fixed", "per_image"):
            table.add_row(name, "", reference.replace("_", " "), *_cells(means[reference]))
    table.add_section()
    for row in ILLUMINATION_STUDY:
        for reference, numbers in (("fixed", row.fixed), ("per image", row.per_image)):
            cells = _cells(dict(zip(_HEADINGS, numbers, strict=True)))
            table.add_row(f"{row.method} *", row.illumination, reference, *cells)
    return table


def _cells(values: Mapping[str, float]) -> list[str]:
    return [f"{values[metric]:.{_DIGITS[metric]}f}" if metric in values else "-" for metric in _HEADINGS]
