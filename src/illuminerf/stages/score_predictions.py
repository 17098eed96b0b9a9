"""Renderings of the TensoIR test views, ours or anyone's -> scores by the benchmark's rule.

<predictions>/<scene>/<light>/test_000.png       RGB on white, or straight RGBA
<root>/<scene>/test_000/rgba_<light>.png         the truth, in the benchmark's own layout
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from illuminerf.data.developing import shrunk, with_alpha
from illuminerf.data.tensoir import INPUT_LIGHT, TensoirView, find_views, load_test_image
from illuminerf.evaluation.benchmark_rule import LightScores, Rescale, ViewPair, on_white, score_light, view_pair
from illuminerf.evaluation.metrics import LPIPS_ABSENT, ImageMetric, lpips_vgg
from illuminerf.evaluation.tables import mean_of
from illuminerf.scene.images import read_png, write_png
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, track

SCALE_EVERY = 10
"""The benchmark takes its factors from every 10th of its 200 views."""


@dataclass(frozen=True)
class PairsOnDisk:
    """The views of one scene and light, each read when it is asked for."""

    scene: Path
    light: str
    names: Sequence[str]
    predictions: Sequence[Path]
    size: int | None = None
    """Pixels that larger images are averaged down to."""

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> ViewPair:
        path = self.predictions[index]
        prediction = read_png(path)
        truth = load_test_image(self.scene, self.names[index], self.light)
        if self.size is not None:
            truth = shrunk(truth, self.size)
            prediction = shrunk(with_alpha(prediction), self.size)
        if prediction.shape[:2] != truth.shape[:2]:
            raise UserError(
                "a prediction has another size than the truth",
                got=f"{prediction.shape[1]} x {prediction.shape[0]} pixels in {path}",
                wanted=f"{truth.shape[1]} x {truth.shape[0]}",
                fix="render at the benchmark's size, or give the benchmark at the size of the predictions",
            )
        return view_pair(prediction, truth)


def write_predictions(novel_views: Path, names: Sequence[str], folder: Path) -> None:
    """Bring the images of a NovelViews artefact, in the order of `names`, into <folder>/<name>.png on white."""
    for view, name in enumerate(names):
        write_png(folder / f"{name}.png", on_white(read_png(novel_views / "images" / f"{view:03d}.png")))


def score_predictions(
    root: Path,
    predictions: Path,
    scenes: Sequence[str],
    lights: Sequence[str],
    rescale: Rescale = "median",
    every: int = 1,
    with_lpips: bool = False,
    size: int | None = None,
) -> dict[str, Any]:
    """Score `predictions` against the benchmark in `root`.

    Only views that both have, and whose number is a multiple of `every`, are scored. Returns plain JSON:
    psnr, ssim (and lpips) as [scene][light], their mean over lights and then scenes under "mean", the
    number of views and the factor per channel as [scene][light]. With `size`, larger images are averaged
    down to that many pixels before they are compared.

    Raises UserError where a scene, a light or all predictions of one are missing, or where sizes differ.
    """
    cells = _cells(scenes, lights, every)
    plans = [_predicted(root, predictions, scene, light, every) for scene, light in cells]
    return _scored(cells, [replace(pairs, size=size) for pairs in plans], rescale, with_lpips)


def score_input_light(
    root: Path,
    scenes: Sequence[str],
    lights: Sequence[str],
    rescale: Rescale = "median",
    every: int = 1,
    with_lpips: bool = False,
    size: int | None = None,
    input_light: str = INPUT_LIGHT,
) -> dict[str, Any]:
    """The scores of not relighting: the true test views under the input light stand in for every target
    light.

    Geometry is perfect and only the light is wrong, so a method that scores less does not relight. Same
    result as `score_predictions`, same errors.
    """
    cells = _cells(scenes, lights, every)
    plans = []
    for scene, light in cells:
        views = _with_truth(root, scene, light, every)
        paths = [view.image(input_light) for view in views]
        plans.append(PairsOnDisk(root / scene, light, [view.name for view in views], paths))
    return _scored(cells, [replace(pairs, size=size) for pairs in plans], rescale, with_lpips)


def _cells(scenes: Sequence[str], lights: Sequence[str], every: int) -> list[tuple[str, str]]:
    if every < 1:
        raise UserError("every must be positive", got=str(every), wanted="1, 2, 3, ...")
    if not scenes or not lights:
        raise UserError("nothing to score", got=f"scenes {list(scenes)}, lights {list(lights)}", wanted="one or more")
    return [(scene, light) for scene in scenes for light in lights]


def _with_truth(root: Path, scene: str, light: str, every: int) -> list[TensoirView]:
    if not (root / scene).is_dir():
        raise UserError(
            f"the benchmark has no scene {scene!r}", got=f"no folder {root / scene}", wanted="a scene folder"
        )
    views = [view for view in find_views(root / scene, "test", every) if light in view.lights()]
    if not views:
        raise UserError(
            f"the benchmark has no truth for {scene} under {light}",
            got=f"no test_*/rgba_{light}.png in {root / scene}",
            wanted="the true test views",
            fix="unpack this light, or leave it out",
        )
    return views


def _predicted(root: Path, predictions: Path, scene: str, light: str, every: int) -> PairsOnDisk:
    views = _with_truth(root, scene, light, every)
    folder = predictions / scene / light
    if not folder.is_dir():
        raise UserError(
            f"there are no predictions for {scene} under {light}",
            got=f"no folder {folder}",
            wanted=f"{predictions.name}/{scene}/{light}/test_000.png, ...",
            fix="render this light, or leave it out",
        )
    names = [view.name for view in views if (folder / f"{view.name}.png").is_file()]
    if not names:
        raise UserError(
            f"no test view of {scene} under {light} has a prediction",
            got=f"no {views[0].name}.png or any other of {len(views)} views in {folder}",
            wanted="predictions named like the benchmark's test views",
            fix="name the images test_<number>.png",
        )
    return PairsOnDisk(root / scene, light, names, [folder / f"{name}.png" for name in names])


def _scored(
    cells: list[tuple[str, str]], plans: list[PairsOnDisk], rescale: Rescale, with_lpips: bool
) -> dict[str, Any]:
    lpips = lpips_vgg(torch.device("cpu")) if with_lpips else None
    if with_lpips and lpips is None:
        say(LPIPS_ABSENT)
    scores = [_score(pairs, rescale, lpips) for pairs in track(plans, "score")]
    return _as_json(cells, scores, rescale)


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
