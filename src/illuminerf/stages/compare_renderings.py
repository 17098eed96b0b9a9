"""Renderings of the TensoIR test views -> the pictures a reader wants to see beside their scores."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from illuminerf.data.developing import shrunk, with_alpha
from illuminerf.data.tensoir import INPUT_LIGHT, TensoirView, find_views, load_test_image
from illuminerf.evaluation.benchmark_rule import Rescale, on_white, rescaled_prediction, view_pair
from illuminerf.evaluation.metrics import psnr
from illuminerf.evaluation.pictures import CellPictures, Rendering, ViewPictures, error_map
from illuminerf.scene.images import read_png
from illuminerf.scene.web_page import evenly_spread
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class RenderedMethod:
    """Where a method's pictures are, and how its score rescaled them."""

    name: str
    folder: Path | None
    """<folder>/<scene>/<light>/<view>.png, RGB on white or straight RGBA; None where nobody knows."""
    rescale: Rescale = "none"
    scale: Mapping[str, Mapping[str, Sequence[float]]] = field(default_factory=dict)
    """[scene][light]: the factor of each channel; unused under "none"."""

    def picture(self, scene: str, light: str, view: str) -> Path | None:
        """The picture of a view, where there is one and it is known how to rescale it."""
        if self.folder is None or (self.rescale != "none" and light not in self.scale.get(scene, {})):
            return None
        path = self.folder / scene / light / f"{view}.png"
        return path if path.is_file() else None


def compare_renderings(
    root: Path, methods: Sequence[RenderedMethod], cells: Sequence[tuple[str, str]], num_views: int = 3
) -> Iterator[CellPictures]:
    """Pictures of each (scene, light) of `cells`: `num_views` views, evenly spread over those all methods show.

    What is missing is left out and noted. Renderings and truth of different sizes meet at the smaller one, averaged
    down as in scoring.

    Raises:
        UserError: `root` is no folder, or an image is damaged.
    """
    if not root.is_dir():
        raise UserError("the benchmark is missing", got=f"no folder {root}", wanted="<scene>/test_000/rgba_<light>.png")
    for scene, light in cells:
        yield _cell(root / scene, light, methods, num_views)


def _cell(scene: Path, light: str, methods: Sequence[RenderedMethod], num_views: int) -> CellPictures:
    try:
        true = [view for view in find_views(scene, "test") if light in view.lights()]
    except UserError:
        true = []
    if not true:
        return CellPictures(scene.name, light, (), ("The benchmark's folder has no truth of it.",))
    shown = {m.name: [view.name for view in true if m.picture(scene.name, light, view.name)] for m in methods}
    notes = [f"{name} has no pictures of it, or no score." for name, views in shown.items() if not views]
    drawn = [m for m in methods if shown[m.name]]
    of_all = [view for view in true if drawn and all(view.name in shown[m.name] for m in drawn)]
    of_any = [view for view in true if any(view.name in shown[m.name] for m in drawn)]
    views = []
    for view in evenly_spread(of_all or of_any, num_views):
        pictures, missing = _view(scene, light, view, drawn)
        views.append(pictures)
        notes += missing
    return CellPictures(scene.name, light, tuple(views), tuple(notes))


def _view(
    scene: Path, light: str, view: TensoirView, methods: Sequence[RenderedMethod]
) -> tuple[ViewPictures, list[str]]:
    truth = load_test_image(scene, view.name, light)
    renderings, notes = [], []
    for method in methods:
        path = method.picture(scene.name, light, view.name)
        if path is None:
            notes.append(f"{method.name} has no picture of {view.name}.")
            continue
        prediction = with_alpha(read_png(path))
        size = min(max(prediction.shape[:2]), max(truth.shape[:2]))
        pair = view_pair(shrunk(prediction, size), small_truth := shrunk(truth, size))
        if pair.prediction.shape != small_truth[..., :3].shape:
            notes.append(f"{method.name} shows {view.name} in another shape than the truth.")
            continue
        factors = np.array(method.scale.get(scene.name, {}).get(light, (1, 1, 1)), np.float64)
        scored = rescaled_prediction(pair, factors, method.rescale)
        error = error_map(scored, pair.truth)
        renderings.append(Rendering(method.name, scored, error, psnr(scored, pair.truth)))
    given = on_white(load_test_image(scene, view.name, INPUT_LIGHT)) if INPUT_LIGHT in view.lights() else None
    return ViewPictures(view.name, given, tuple(renderings), on_white(truth)), notes
