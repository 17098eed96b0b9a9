"""Score files, as `illuminerf benchmark tensoir` writes them, read back and checked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from illuminerf.evaluation.benchmark_rule import Rescale
from illuminerf.evaluation.tables import PerLight, mean_of
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError

FILE_NAME = "scores.json"
BASELINE_FOLDER = "inverse_rendering"
"""Beside a run's score file: that of inverse rendering on the same geometry."""
METRICS = ("psnr", "ssim", "lpips")
Cell = tuple[str, str]
"""Scene and light."""


@dataclass(frozen=True)
class MethodScores:
    """One method's score file."""

    name: str
    path: Path
    rescale: Rescale
    metrics: dict[str, PerLight]
    """By name: "psnr" in dB, "ssim", and "lpips" where it was computed."""
    scale: dict[str, dict[str, tuple[float, ...]]]
    """[scene][light]: the factor of each channel."""
    views: dict[str, dict[str, int]]
    """[scene][light]; empty where the file does not tell."""
    input_light: PerLight
    """PSNR in dB of the true views under the photographs' light; empty where the file does not tell."""
    seconds: dict[str, dict[str, float]]
    """[scene][stage]."""
    peak_memory_gb: dict[str, float]
    """[scene]."""

    def value(self, metric: str, cell: Cell) -> float | None:
        """A metric of one scene and light, where there is one."""
        scene, light = cell
        return self.metrics.get(metric, {}).get(scene, {}).get(light)

    def mean(self, metric: str) -> float | None:
        """Over lights, then over scenes."""
        return mean_of(self.metrics[metric]) if metric in self.metrics else None

    def cells(self) -> list[Cell]:
        """What was scored."""
        return cells_of(self.metrics["psnr"])


def cells_of(table: PerLight) -> list[Cell]:
    """All (scene, light) of a table, in its order."""
    return [(scene, light) for scene, lights in table.items() for light in lights]


def all_cells(methods: Sequence[MethodScores]) -> list[Cell]:
    """What any of `methods` was scored on, scene by scene."""
    return sorted({cell for method in methods for cell in method.cells()})


def read_score_files(paths: Sequence[Path]) -> list[MethodScores]:
    """Read folders with a scores.json, or score files of any name; a method is named after its folder or file.

    Where a folder also holds the scores of inverse rendering in `BASELINE_FOLDER`, that is a method too.

    Raises:
        UserError: there is none, one is missing, damaged or not a score file, or two have the same name.
    """
    if not paths:
        raise UserError("there is nothing to report", got="no folder", wanted="folders with a scores.json")
    found: dict[str, Path] = {}
    for path in paths:
        file = path / FILE_NAME if path.is_dir() else path
        if not file.is_file():
            raise UserError(
                "a score file is missing",
                got=f"no {file if path.is_dir() else path}",
                wanted=f"a folder with a {FILE_NAME}, or a score file",
                fix="check the path, or run illuminerf benchmark tensoir first",
            )
        name = _name(file)
        if name in found and found[name] != file:
            raise UserError(
                "two methods have the same name",
                got=f"{name!r} for {found[name]} and {file}",
                wanted="folders with different names",
                fix="rename one of the folders",
            )
        found[name] = file
        baseline = path / BASELINE_FOLDER / FILE_NAME
        if baseline.is_file():
            found[_name(baseline)] = baseline
    return [_read(name, file) for name, file in found.items()]


def _name(file: Path) -> str:
    whole = file.resolve()
    if whole.name == FILE_NAME and whole.parent.name == BASELINE_FOLDER:
        return f"{whole.parent.parent.name}, inverse rendering"
    return " ".join((whole.parent.name if file.name == FILE_NAME else whole.stem).split())


def _read(name: str, path: Path) -> MethodScores:
    content = read_json(path)
    try:
        return _parsed(name, path, content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{path} is not a score file",
            got=f"{type(error).__name__}: {error}",
            wanted="psnr, ssim and scale by scene and light, and rescale, as illuminerf benchmark tensoir writes them",
            fix="score the renderings again with illuminerf benchmark tensoir --score",
        ) from error


def _parsed(name: str, path: Path, content: Any) -> MethodScores:
    if content["rescale"] not in get_args(Rescale):
        raise ValueError(f"rescale {content['rescale']!r}")
    metrics: dict[str, PerLight] = {
        metric: _per_light(content, metric) for metric in METRICS if metric in content or metric != "lpips"
    }
    cells = sorted(cells_of(metrics["psnr"]))
    if not cells:
        raise ValueError("no scene and light in psnr")
    scale = {
        scene: {light: tuple(_number(factor, "scale") for factor in factors) for light, factors in lights.items()}
        for scene, lights in content["scale"].items()
    }
    present = {metric: sorted(cells_of(table)) for metric, table in metrics.items()}
    present["scale"] = sorted((scene, light) for scene, lights in scale.items() for light in lights)
    for key, covered in present.items():
        if covered != cells:
            raise ValueError(f"{key} and psnr are of different scenes and lights")
    if any(len(factors) != 3 for lights in scale.values() for factors in lights.values()):
        raise ValueError("scale without three factors")
    views = _per_light(content, "views") if "views" in content else {}
    return MethodScores(
        name,
        path,
        content["rescale"],
        metrics,
        scale,
        {scene: {light: int(count) for light, count in lights.items()} for scene, lights in views.items()},
        _per_light(content, "input_light") if "input_light" in content else {},
        _per_light(content, "seconds") if "seconds" in content else {},
        {scene: _number(peak, "peak_memory_gb") for scene, peak in content.get("peak_memory_gb", {}).items()},
    )


def _per_light(content: Any, key: str) -> dict[str, dict[str, float]]:
    if key not in content:
        raise ValueError(f"no {key}")
    return {
        scene: {light: _number(value, key) for light, value in lights.items()}
        for scene, lights in content[key].items()
        if lights
    }


def _number(value: Any, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{key} is {value!r}, not a number")
    return float(value)
