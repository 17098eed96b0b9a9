"""Renderings of the TensoIR test views, ours or anyone's -> scores by the benchmark's rule.

<predictions>/<scene>/<light>/test_000.png       RGB on white, or straight RGBA
<root>/<scene>/test_000/rgba_<light>.png         the truth, in the benchmark's own layout
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch

from illuminerf.data.tensoir import find_views, load_test_image
from illuminerf.evaluation.benchmark_rule import LightScores, Rescale, ViewPair, score_light, view_pair
from illuminerf.evaluation.metrics import ImageMetric, lpips_vgg
from illuminerf.evaluation.tables import mean_of
from illuminerf.scene.images import read_png
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

SCALE_EVERY = 10
"""The benchmark takes its factors from every 10th of its 200 views."""


class PairsOnDisk(Sequence[ViewPair]):
    """The views of one scene and light, each read when it is asked for."""

    def __init__(self, scene: Path, predictions: Path, light: str, names: Sequence[str]) -> None:
        self.scene, self.predictions, self.light, self.names = scene, predictions, light, names

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> ViewPair: ...
    @overload
    def __getitem__(self, index: slice) -> "PairsOnDisk": ...
    def __getitem__(self, index: int | slice) -> "ViewPair | PairsOnDisk":
        if isinstance(index, slice):
            return PairsOnDisk(self.scene, self.predictions, self.light, self.names[index])
        path = self.predictions / f"{self.names[index]}.png"
        prediction = read_png(path)
        truth = load_test_image(self.scene, self.names[index], self.light)
        if prediction.shape[:2] != truth.shape[:2]:
            raise UserError(
                "a prediction has another size than the truth",
                got=f"{prediction.shape[1]} x {prediction.shape[0]} pixels in {path}",
                wanted=f"{truth.shape[1]} x {truth.shape[0]}",
                fix="render at the benchmark's size, or give the benchmark at the size of the predictions",
            )
        return view_pair(prediction, truth)


def score_predictions(
    root: Path,
    predictions: Path,
    scenes: Sequence[str],
    lights: Sequence[str],
    rescale: Rescale = "median",
    every: int = 1,
    with_lpips: bool = False,
) -> dict[str, Any]:
    """Score `predictions` against the benchmark in `root`.

    Only views that both have, and whose number is a multiple of `every`, are scored. Returns plain JSON:
    psnr, ssim (and lpips) as [scene][light], their mean over lights and then scenes under "mean", the
    number of views and the factor per channel as [scene][light].

    Raises UserError where a scene, a light or all predictions of one are missing, or where sizes differ.
    """
    if every < 1:
        raise UserError("every must be positive", got=str(every), wanted="1, 2, 3, ...")
    if not scenes or not lights:
        raise UserError("nothing to score", got=f"scenes {list(scenes)}, lights {list(lights)}", wanted="one or more")
    lpips = lpips_vgg(torch.device("cpu")) if with_lpips else None
    cells = [(scene, light) for scene in scenes for light in lights]
    plans = [_pairs(root, predictions, scene, light, every) for scene, light in cells]  # all checked before any work
    scored = [_score(pairs, rescale, lpips) for pairs in track(plans, "score")]
    return _as_json(cells, scored, rescale)


def _pairs(root: Path, predictions: Path, scene: str, light: str, every: int) -> PairsOnDisk:
    if not (root / scene).is_dir():
        raise UserError(
            f"the benchmark has no scene {scene!r}", got=f"no folder {root / scene}", wanted="a scene folder"
        )
    folder = predictions / scene / light
    if not folder.is_dir():
        raise UserError(
            f"there are no predictions for {scene} under {light}",
            got=f"no folder {folder}",
            wanted=f"{predictions.name}/{scene}/{light}/test_000.png, ...",
            fix="render this light, or leave it out",
        )
    with_truth = [view for view in find_views(root / scene, "test", every) if light in view.lights()]
    if not with_truth:
        raise UserError(
            f"the benchmark has no truth for {scene} under {light}",
            got=f"no test_*/rgba_{light}.png in {root / scene}",
            wanted="the true test views",
            fix="unpack this light, or leave it out",
        )
    names = [view.name for view in with_truth if (folder / f"{view.name}.png").is_file()]
    if not names:
        raise UserError(
            f"no test view of {scene} under {light} has a prediction",
            got=f"no {with_truth[0].name}.png or any other of {len(with_truth)} views in {folder}",
            wanted="predictions named like the benchmark's test views",
            fix="name the images test_<number>.png",
        )
    return PairsOnDisk(root / scene, folder, light, names)


def _score(pairs: PairsOnDisk, rescale: Rescale, lpips: ImageMetric | None) -> LightScores:
    numbers = [int(name.rsplit("_", 1)[1]) for name in pairs.names]
    scale_views = [index for index, number in enumerate(numbers) if number % SCALE_EVERY == 0]
    return score_light(pairs, rescale, scale_views or None, lpips)


def _as_json(cells: list[tuple[str, str]], scored: list[LightScores], rescale: Rescale) -> dict[str, Any]:
    result: dict[str, Any] = {"rescale": rescale, "mean": {}}
    columns = {"psnr": [scores.psnr for scores in scored], "ssim": [scores.ssim for scores in scored]}
    if all(scores.lpips for scores in scored):
        columns["lpips"] = [scores.lpips for scores in scored]
    for metric, values in columns.items():
        result[metric] = _nested(cells, [float(np.mean(value)) for value in values])
        result["mean"][metric] = mean_of(result[metric])
    result["views"] = _nested(cells, [len(scores.psnr) for scores in scored])
    result["scale"] = _nested(cells, [list(scores.scale) for scores in scored])
    return result


def _nested(cells: list[tuple[str, str]], values: Sequence[Any]) -> dict[str, dict[str, Any]]:
    out: dict[str, dict[str, Any]] = {}
    for (scene, light), value in zip(cells, values, strict=True):
        out.setdefault(scene, {})[light] = value
    return out
