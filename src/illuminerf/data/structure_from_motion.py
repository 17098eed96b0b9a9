"""Camera poses from photographs alone, by COLMAP through pycolmap (extra `capture`).

Local features are found in every photograph, matched between all pairs (or neighbours in the order of taking), and
cameras are added one after another while all of them are adjusted together (Schoenberger and Frahm 2016). What few
features or a plain background starve is tried again: with lower thresholds for adding a camera, with features that
stand oblique views better, and by solving for all cameras at once. The attempt that places most photographs is kept.
"""

import importlib
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from illuminerf.data.solved_cameras import Solved, solved_from
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say

ENOUGH = 0.95
"""Share of the photographs that must be placed for no further attempt."""
_NEIGHBOURS = 12
_RELIABLE_PIXELS = 0.5
"""Reprojection errors well beyond this are put down to wrong matches."""
_ENOUGH_POINTS = 30
_FATAL = 3
"""Of the levels of pycolmap's log, the last."""


@dataclass(frozen=True)
class SolverConfig:
    """How poses are estimated."""

    lens: Literal["SIMPLE_RADIAL", "OPENCV"] = "SIMPLE_RADIAL"
    """COLMAP's camera model: one radial coefficient, or two and two tangential ones for a wide lens."""
    pairs: Literal["all", "neighbours"] = "all"
    """Which photographs are compared; "neighbours" is for hundreds of frames of one video."""
    max_attempts: int = 4
    """1: no second try where photographs are not placed; up to 4."""
    threads: int = 0
    """0: all cores. With 1 the result is the same each time on one machine."""
    seed: int = 0
    """Of robust estimation."""

    def __post_init__(self) -> None:
        if not 1 <= self.max_attempts <= 4 or self.threads < 0:
            raise UserError("max_attempts goes from 1 to 4 and threads from 0", got=str(self))


@dataclass(frozen=True)
class MatchingImage:
    """A photograph as features are looked for in it.

    Attributes:
        path: 8-bit image inside the folder of all.
        mask: 8-bit, 0 where no feature may lie; or None.
        size: width and height in pixels.
        focal: focal length in pixels where the file tells, else None.
    """

    path: Path
    mask: Path | None
    size: tuple[int, int]
    focal: float | None


def load_pycolmap() -> Any:
    """The package, quiet.

    Raises:
        UserError: it is not installed.
    """
    try:
        pycolmap = importlib.import_module("pycolmap")
    except ImportError as error:
        raise UserError(
            "poses cannot be estimated: pycolmap is not installed",
            got=str(error),
            fix="pip install 'illuminerf[capture]', or bring poses of your own (docs/captures.md)",
        ) from error
    pycolmap.logging.minloglevel = _FATAL
    return pycolmap


def solve(images: Sequence[MatchingImage], folder: Path, config: SolverConfig) -> Solved:
    """Poses of as many `images` as can be placed.

    Args:
        images: all below `folder`/images.
        folder: for images, masks and the files of the work.
        config: the settings.

    Raises:
        UserError: pycolmap is missing, or no attempt places three photographs.
    """
    solver = _Solver(load_pycolmap(), images, folder, config)
    attempts: list[tuple[str, Callable[[str], Solved | None]]] = [
        ("usual features", solver.with_usual_features),
        ("lower thresholds", solver.with_lower_thresholds),
        ("features for oblique views", solver.with_thorough_features),
        ("all cameras at once", solver.all_at_once),
    ]
    best: Solved | None = None
    for name, attempt in attempts[: config.max_attempts]:
        found = attempt(name)
        placed = len(found.cameras) if found else 0
        say(f"poses, {name}: {placed} of {len(images)} photographs placed")
        if found is not None and (best is None or _worth(found) > _worth(best)):
            best = found
        if best is not None and len(best.cameras) >= ENOUGH * len(images):
            break
    if best is None or len(best.cameras) < 3:
        raise UserError(
            "the photographs do not fit together",
            got=f"{len(best.cameras) if best else 0} of {len(images)} placed by {config.max_attempts} attempts",
            wanted="3 at the least, nearly all in a good capture",
            fix="take more photographs with smaller steps (10 degrees), sharp, with the object, or a patterned mat "
            "below it, filling the image; with a turntable set match to object, else to everything",
        )
    return best


def _worth(solved: Solved) -> tuple[int, int]:
    return len(solved.cameras), len(solved.points)


class _Solver:
    """The attempts, which share features and matches."""

    def __init__(self, colmap: Any, images: Sequence[MatchingImage], folder: Path, config: SolverConfig) -> None:
        self.colmap, self.images, self.folder, self.config = colmap, images, folder, config
        self.root, self.masks = folder / "images", folder / "masks"
        self.names = [image.path.relative_to(self.root).as_posix() for image in images]
        self.database = folder / "usual.db"
        self.largest: Path | None = None

    def with_usual_features(self, name: str) -> Solved | None:
        """Everything as usual, save that faint features count too: objects have fewer than streets."""
        self._match(self.database, thorough=False)
        return self._grown(name, _strict)

    def with_lower_thresholds(self, name: str) -> Solved | None:
        """From the same matches, cameras are added on less evidence."""
        return self._grown(name, _lenient, self.largest) or self._grown(name, _lenient)

    def with_thorough_features(self, name: str) -> Solved | None:
        """Features of adapted shape over several sizes, and matches searched for again along epipolar lines."""
        self.database = self.folder / "thorough.db"
        self._match(self.database, thorough=True)
        return self._grown(name, _lenient)

    def all_at_once(self, name: str) -> Solved | None:
        """Rotations averaged, then positions and points solved for together."""
        options = self.colmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = self._num_threads(), self.config.seed
        options.mapper.random_seed = self.config.seed
        for part in (options.mapper.rotation_averaging, options.mapper.global_positioning):
            part.random_seed = self.config.seed
        self.colmap.set_random_seed(self.config.seed)
        out = self._empty("global")
        return self._best(self.colmap.global_mapping(self.database, self.root, out, options), name)

    def _num_threads(self) -> int:
        return self.config.threads or -1

    def _match(self, database: Path, thorough: bool) -> None:
        colmap = self.colmap
        colmap.set_random_seed(self.config.seed)
        say(f"poses: features of {len(self.images)} photographs{', thoroughly' if thorough else ''}")
        self._extract(database, thorough)
        matching = colmap.FeatureMatchingOptions()
        matching.num_threads, matching.guided_matching = self._num_threads(), thorough
        verification = colmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self.config.seed
        verification.min_num_inliers = 10 if thorough else 15
        options = {"matching_options": matching, "verification_options": verification}
        num = len(self.images)
        if self.config.pairs == "all":
            say(f"poses: {num * (num - 1) // 2} pairs are compared; a hundred photographs take minutes")
            colmap.match_exhaustive(database, device=colmap.Device.auto, **options)
        else:
            pairing = colmap.SequentialPairingOptions()
            pairing.overlap = _NEIGHBOURS
            colmap.match_sequential(database, pairing_options=pairing, device=colmap.Device.auto, **options)

    def _extract(self, database: Path, thorough: bool) -> None:
        colmap = self.colmap
        extraction = colmap.FeatureExtractionOptions()
        extraction.num_threads = self._num_threads()
        extraction.sift.peak_threshold = 0.002
        extraction.sift.max_num_features = 4096
        extraction.sift.estimate_affine_shape = extraction.sift.domain_size_pooling = thorough
        groups: dict[tuple[tuple[int, int], float | None], list[int]] = {}
        for index, image in enumerate(self.images):
            groups.setdefault((image.size, image.focal), []).append(index)
        for (size, focal), members in groups.items():  # one camera each: zooming or turning the camera makes another
            reader = colmap.ImageReaderOptions()
            reader.camera_model = self.config.lens
            if focal is not None:
                reader.camera_params = ",".join(map(str, _parameters(self.config.lens, focal, size)))
            if any(self.images[index].mask for index in members):
                reader.mask_path = str(self.masks)
            colmap.extract_features(
                database,
                self.root,
                image_names=[self.names[index] for index in members],
                camera_mode=colmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=extraction,
                device=colmap.Device.auto,
            )

    def _grown(self, name: str, loosen: Callable[[Any], None], start: Path | None = None) -> Solved | None:
        options = self.colmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = self._num_threads(), self.config.seed
        options.mapper.random_seed = options.triangulation.random_seed = self.config.seed
        options.min_model_size = 3
        loosen(options)
        self.colmap.set_random_seed(self.config.seed)
        out = self._empty(f"sparse_{loosen.__name__}_{self.database.stem}{'_more' if start else ''}")
        begun = {"input_path": start} if start else {}
        found = self.colmap.incremental_mapping(self.database, self.root, out, options, **begun)
        best = self._best(found, name)
        if best is not None and start is None:
            largest = max(found, key=lambda number: found[number].num_reg_images())
            self.largest = self._empty("largest")
            found[largest].write(self.largest)
        return best

    def _empty(self, name: str) -> Path:
        path = self.folder / name
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
        return path

    def _best(self, found: dict[int, Any], name: str) -> Solved | None:
        if not found:
            return None
        largest = max(found.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
        self._adjust_robustly(largest)
        return solved_from(largest, self.names, name)

    def _adjust_robustly(self, model: Any) -> None:
        """All cameras and points once more, under a loss that wrong matches hardly count in. Points that only two
        cameras see check nothing, so they go where both have enough others."""
        points = {number: model.point3D(number) for number in model.point3D_ids()}
        tracks = {number: {seen.image_id for seen in point.track.elements} for number, point in points.items()}
        checked = Counter(image for track in tracks.values() if len(track) > 2 for image in track)
        for number, track in tracks.items():
            if len(track) < 3 and all(checked[image] >= _ENOUGH_POINTS for image in track):
                model.delete_point3D(number)
        options = self.colmap.BundleAdjustmentOptions()
        options.ceres.loss_function_type = self.colmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = _RELIABLE_PIXELS
        options.ceres.solver_options.num_threads = self._num_threads()
        options.print_summary = False
        with _silenced():
            self.colmap.bundle_adjustment(model, options)
        self.colmap.logging.minloglevel = _FATAL


@contextmanager
def _silenced() -> Iterator[None]:
    """Nothing that is written to the standard error meanwhile is seen: the last adjustment turns pycolmap's log on,
    whatever was asked for."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _strict(options: Any) -> None:
    options.mapper.init_min_num_inliers = 50


def _lenient(options: Any) -> None:
    options.min_num_matches = 10
    options.mapper.init_min_num_inliers = 30
    options.mapper.init_min_tri_angle = 8.0
    options.mapper.abs_pose_min_num_inliers = 12
    options.mapper.abs_pose_min_inlier_ratio = 0.15
    options.mapper.max_reg_trials = 6
    options.triangulation.ignore_two_view_tracks = False


def _parameters(lens: str, focal: float, size: tuple[int, int]) -> list[float]:
    middle = [size[0] / 2, size[1] / 2]
    return [focal, *middle, 0.0] if lens == "SIMPLE_RADIAL" else [focal, focal, *middle, 0.0, 0.0, 0.0, 0.0]
