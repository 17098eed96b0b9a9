"""Relit test views of Stanford-ORB, ours or anyone's -> scores by the benchmark's rule.

<predictions>/<capture>/<target>/0061.png      what was learnt from <capture>, under the light of <target>, seen as its
                                               test view 0061: sRGB (straight where it has alpha), or linear .exr

A view without a prediction counts as one that is white all over, as in the public code.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from illuminerf.data.resampling import area_downsampled
from illuminerf.data.stanford_orb import OrbView, load_mask, load_photograph, novel_views, scored_size
from illuminerf.evaluation.metrics import LPIPS_ABSENT, ImageMetric, lpips_vgg
from illuminerf.evaluation.orb_rule import RESOLUTION, OrbScores, eroded, score_image
from illuminerf.scene.images import linear_from_srgb, read_exr, read_png, srgb_from_linear, write_png
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, track

METRICS = ("psnr_h", "psnr_l", "ssim", "lpips")
MAX_THREADS = 8
"""Each holds a photograph of 2048 x 2048, some 50 MB."""
Image = Callable[[OrbView], np.ndarray]
"""Makes the linear image, float [size, size, 3], of a view."""


@dataclass(frozen=True, eq=False)
class Cell:
    """What one capture is scored on under one target light."""

    capture: str
    """What was learnt from."""
    target: str
    """The capture whose light and test views they are."""
    views: tuple[OrbView, ...]


def relighting_cells(root: Path, captures: Sequence[str]) -> list[Cell]:
    """All pairs of a capture and another light of its object.

    Raises:
        UserError: a capture has no other light.
    """
    cells = []
    for capture in captures:
        for target, views in sorted(novel_views(root, capture).items()):
            if target == capture:  # its own light, which is no relighting
                continue
            cells.append(Cell(capture, target, tuple(views)))
        if not any(cell.capture == capture for cell in cells):
            raise UserError(f"{capture} has no other light", got="none in its transforms_novel.json")
    return cells


def size_of(root: Path, cells: Sequence[Cell], size: int | None) -> int:
    """Pixels of a side that is scored: the benchmark's 512, less where the photographs are smaller or `size` is."""
    return scored_size(root, cells[0].views[0], min(size or RESOLUTION, RESOLUTION))


def write_predictions(novel_views: Path, views: Sequence[OrbView], folder: Path) -> None:
    """Bring the images of a NovelViews artefact, in the order of `views`, into <folder>/<name>.png on black."""
    for index, view in enumerate(views):
        channels = read_exr(novel_views / "linear" / f"{index:03d}.exr")
        linear_rgb = np.stack([channels[name] for name in "RGB"], -1)
        write_png(folder / f"{view.name}.png", srgb_from_linear(np.clip(linear_rgb, 0, 1)))


def score_orb_predictions(
    root: Path,
    predictions: Path,
    captures: Sequence[str],
    size: int | None = None,
    with_lpips: bool = False,
    truth: Image | None = None,
) -> dict[str, Any]:
    """Score `predictions` of `captures` against the benchmark in `root`, or against other images of its views.

    Returns:
        Plain JSON: every metric as [capture][target] under its name, "per_capture" over all images of a capture,
        "mean" over captures, and the numbers of "images" and of "missing" ones as [capture][target].

    Raises:
        UserError: there is no prediction at all, a file of the benchmark is missing, or an image has a wrong size.
    """
    cells = relighting_cells(root, captures)
    pixels = size_of(root, cells, size)
    missing = {cell: sum(prediction_path(predictions, cell, view) is None for view in cell.views) for cell in cells}
    if all(missing[cell] == len(cell.views) for cell in cells):
        first = cells[0]
        raise UserError(
            "there are no predictions",
            got=f"no {first.capture}/{first.target}/{first.views[0].name}.png, nor any other, in {predictions}",
            wanted="<capture>/<target capture>/<test view>.png (sRGB) or .exr (linear)",
            fix="check the path and the names",
        )
    for cell in (cell for cell in cells if missing[cell]):
        say(f"{cell.capture} under {cell.target}: {missing[cell]} of {len(cell.views)} missing, counted as white")

    def predicted(cell: Cell) -> Image:
        return lambda view: load_prediction(prediction_path(predictions, cell, view), pixels)

    lpips = available_lpips(with_lpips)
    scores = {}
    for cell in track(cells, "score"):
        scores[cell] = score_views(root, cell.views, predicted(cell), pixels, truth, lpips)
    return {**summary(scores), "missing": _nested(missing), "size": pixels}


def available_lpips(is_wanted: bool) -> ImageMetric | None:
    """LPIPS on the CPU, or None where it is not wanted or absent, of which one line tells."""
    lpips = lpips_vgg(torch.device("cpu")) if is_wanted else None
    if is_wanted and lpips is None:
        say(LPIPS_ABSENT)
    return lpips


def score_views(
    root: Path, views: Sequence[OrbView], prediction: Image, size: int, truth: Image | None, lpips: ImageMetric | None
) -> list[OrbScores]:
    """One score per view; `truth` None: the photographs."""

    def score(view: OrbView) -> OrbScores:
        wanted = load_photograph(root, view, size) if truth is None else truth(view)
        mask = load_mask(root, view, size)
        if not eroded(mask).any():
            raise UserError("a mask shows nothing", got=f"{view.capture}/{view.split}_mask/{view.name}.png")
        return score_image(prediction(view), wanted, mask, lpips)

    with ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1)) as pool:  # decoding leaves the interpreter's lock
        return list(pool.map(score, views))


def summary(scores: Mapping[Cell, Sequence[OrbScores]]) -> dict[str, Any]:
    """Means: per cell, over all images of a capture, and of the captures' means."""
    result: dict[str, Any] = {"per_capture": {}, "mean": {}}
    for metric in METRICS:
        values = {cell: [asdict(score)[metric] for score in found] for cell, found in scores.items()}
        if any(value is None for row in values.values() for value in row):
            continue
        result[metric] = _nested({cell: float(np.mean(row)) for cell, row in values.items()})
        of_capture: dict[str, list[float]] = {}
        for cell, row in values.items():
            of_capture.setdefault(cell.capture, []).extend(row)
        for capture, row in of_capture.items():
            result["per_capture"].setdefault(capture, {})[metric] = float(np.mean(row))
        result["mean"][metric] = float(np.mean([np.mean(row) for row in of_capture.values()]))
    return {**result, "images": _nested({cell: len(found) for cell, found in scores.items()})}


def prediction_path(predictions: Path, cell: Cell, view: OrbView) -> Path | None:
    """The view's prediction, None where there is none."""
    folder = predictions / cell.capture / cell.target
    return next((path for kind in ("exr", "png") if (path := folder / f"{view.name}.{kind}").is_file()), None)


def load_prediction(path: Path | None, size: int) -> np.ndarray:
    """float [size, size, 3], linear, over black; all ones where there is no file. Larger images are averaged down."""
    if path is None:
        return np.ones((size, size, 3))
    if path.suffix == ".exr":
        channels = read_exr(path)
        if not all(name in channels for name in "RGB"):
            raise UserError("a prediction lacks colour", got=f"{', '.join(channels)} in {path}", wanted="R, G, B")
        linear_rgb = np.stack([channels[name] for name in "RGB"], -1)
    else:
        image = read_png(path)
        linear_rgb = linear_from_srgb(image[..., :3]) * (image[..., 3:] if image.shape[-1] == 4 else 1)
    if not np.isfinite(linear_rgb).all():
        raise UserError("a prediction holds values that are not finite", got=str(path), wanted="finite radiance")
    if linear_rgb.shape[0] != linear_rgb.shape[1] or linear_rgb.shape[0] < size:
        raise UserError(
            "a prediction has another size than the truth",
            got=f"{linear_rgb.shape[1]} x {linear_rgb.shape[0]} pixels in {path}",
            wanted=f"{size} x {size}",
            fix="render at the benchmark's size, or score at a smaller one with --size",
        )
    return area_downsampled(linear_rgb, size, size)


def _nested(values: Mapping[Cell, Any]) -> dict[str, dict[str, Any]]:
    out: dict[str, dict[str, Any]] = {}
    for cell, value in values.items():
        out.setdefault(cell.capture, {})[cell.target] = value
    return out
