"""NovelViews + ground truth -> Scores.

The truth is a scene of the TensoIR benchmark (its test views under `light`) or a capture folder. Each novel
view is compared with the true view from the same direction; both are composited on white.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from illuminerf.data.capture import image_path
from illuminerf.data.tensoir import find_views, is_tensoir_scene, load_test_cameras, load_test_image
from illuminerf.evaluation.benchmark_rule import (
    LightScores,
    Rescale,
    ViewPair,
    channel_scale,
    rescaled_prediction,
    score_light,
    view_pair,
)
from illuminerf.evaluation.metrics import LPIPS_ABSENT, lpips_vgg
from illuminerf.evaluation.pictures import error_map, side_by_side
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import read_png, write_png
from illuminerf.workflow.artefact import fingerprint, open_artefact
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, track

ROTATION_TOLERANCE = 1e-3
"""Largest difference between the entries of two rotations that count as one direction of view."""


@dataclass(frozen=True)
class Config:
    """What is compared and how."""

    light: str = "unnamed"
    """The target light: picks the true images of a benchmark scene, and names the column of the scores."""
    scene: str = ""
    """The row of the scores; by default the name of the ground truth's folder."""
    rescale: Rescale = "median"
    """Per-channel factor before scoring: the benchmark's "median", "least_squares" over the masked pixels,
    or "none".
    """
    lpips: bool = False
    """Also compute LPIPS, where the optional package is installed."""

    def __post_init__(self) -> None:
        if not self.light:
            raise UserError("the target light has no name", wanted="a name such as city")


def run(novel_views: Path, ground_truth: Path, config: Config, out: Path) -> Path:
    """Score the novel views and draw their errors into `out`.

    Writes scores.json, error/<000>.png and side_by_side/<000>.png (ours rescaled, truth, absolute error).
    Raises UserError where a novel view has no true view from its direction or of its size.
    """
    truth = _Truth.read(ground_truth, config.light)
    cameras = Cameras.from_dict(read_json(novel_views / "cameras.json"))
    matches = matching_views(cameras, truth.cameras)
    inputs: dict[str, Path | str] = {"novel_views": novel_views, "truth": truth.digest(matches)}
    pairs = [_pair(novel_views, view, truth, match) for view, match in enumerate(matches)]
    with open_artefact(out, "evaluate_relighting", config, inputs) as artefact:
        if artefact.is_done:
            return out
        lpips = lpips_vgg(torch.device("cpu")) if config.lpips else None
        if config.lpips and lpips is None:
            say(LPIPS_ABSENT)
        scores = score_light(pairs, config.rescale, lpips=lpips)
        _draw(out, pairs, config.rescale)
        summary = _as_json(config.scene or ground_truth.name, config, scores)
        write_json(out / "scores.json", summary)
        artefact.finish({"psnr": float(np.mean(scores.psnr)), "ssim": float(np.mean(scores.ssim))})
    return out


def matching_views(cameras: Cameras, truth: Cameras) -> list[int]:
    """Per camera the first unused true camera with the same rotation (the worlds may differ by scale and
    offset).

    Raises UserError where there is none.
    """
    used: set[int] = set()
    matches = []
    for view in range(len(cameras)):
        rotation = cameras.world_from_camera[view, :3, :3]
        difference = np.abs(truth.world_from_camera[:, :3, :3] - rotation).max(axis=(1, 2))
        close = [int(index) for index in np.flatnonzero(difference < ROTATION_TOLERANCE) if index not in used]
        if not close:
            raise UserError(
                f"novel view {view} has no true view from its direction",
                got=f"{len(cameras)} novel views and {len(truth)} true views",
                wanted="novel views rendered with the cameras of the ground truth",
                fix="render with the ground truth's cameras",
            )
        used.add(close[0])
        matches.append(close[0])
    return matches


@dataclass(frozen=True)
class _Truth:
    """The ground truth before its images are read."""

    folder: Path
    light: str
    names: tuple[str, ...]
    cameras: Cameras
    is_benchmark: bool

    @staticmethod
    def read(folder: Path, light: str) -> "_Truth":
        if not folder.is_dir():
            raise UserError("the ground truth does not exist", got=str(folder), wanted="a benchmark scene or a capture")
        if is_tensoir_scene(folder):
            names, cameras = load_test_cameras(folder)
            if not any(light in view.lights() for view in find_views(folder, "test")):
                raise UserError(
                    f"the ground truth has no light {light!r}",
                    got=f"{', '.join(find_views(folder, 'test')[0].lights())} in {folder}",
                    wanted="the name of the target light",
                )
            return _Truth(folder, light, tuple(names), cameras, is_benchmark=True)
        cameras = Cameras.from_dict(read_json(folder / "cameras.json"))
        return _Truth(folder, light, tuple(map(str, range(len(cameras)))), cameras, is_benchmark=False)

    def digest(self, views: list[int]) -> str:
        """What the scores depend on; other lights and views may change."""
        paths = [self._path(view) for view in views]
        return "\n".join(f"{path.name} {fingerprint(path)}" for path in paths)

    def image(self, view: int) -> np.ndarray:
        """float32 [height, width, 4], straight sRGB."""
        if self.is_benchmark:
            return load_test_image(self.folder, self.names[view], self.light)
        return read_png(self._path(view))

    def _path(self, view: int) -> Path:
        if self.is_benchmark:
            return self.folder / self.names[view] / f"rgba_{self.light}.png"
        return image_path(self.folder, view)


def _pair(novel_views: Path, view: int, truth: _Truth, match: int) -> ViewPair:
    path = image_path(novel_views, view)
    prediction, wanted = read_png(path), truth.image(match)
    if prediction.shape[:2] != wanted.shape[:2]:
        raise UserError(
            "a novel view has another size than its true view",
            got=f"{prediction.shape[1]} x {prediction.shape[0]} pixels in {path}",
            wanted=f"{wanted.shape[1]} x {wanted.shape[0]}",
            fix="render at the size of the ground truth",
        )
    return view_pair(prediction, wanted)


def _draw(out: Path, pairs: list[ViewPair], rescale: Rescale) -> None:
    scale = channel_scale(pairs, rescale)
    for view, pair in enumerate(track(pairs, "draw errors")):
        scored = rescaled_prediction(pair, scale, rescale)
        write_png(out / "error" / f"{view:03d}.png", error_map(scored, pair.truth))
        write_png(out / "side_by_side" / f"{view:03d}.png", side_by_side(scored, pair.truth))


def _as_json(scene: str, config: Config, scores: LightScores) -> dict[str, Any]:
    summary: dict[str, Any] = {"rescale": config.rescale, "scale": {scene: {config.light: list(scores.scale)}}}
    per_view = {"psnr": list(scores.psnr), "ssim": list(scores.ssim)}
    if scores.lpips:
        per_view["lpips"] = list(scores.lpips)
    for metric, values in per_view.items():
        summary[metric] = {scene: {config.light: float(np.mean(values))}}
    return {**summary, "per_view": per_view}
