"""A light that only photographs of a painted duck tell of is found again; and the stage keeps what it made."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from illuminerf.cues.illumination import LightFit
from illuminerf.cues.materials import Material
from illuminerf.cues.renderer import CueSampling, render_cues
from illuminerf.cues.shading import render_shaded
from illuminerf.cues.surface_samples import ColorGathering
from illuminerf.data.capture import Capture, save_capture
from illuminerf.scene.cameras import Cameras, spiral_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_exr, write_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.procedural import duck_still_life
from illuminerf.stages import estimate_illumination
from illuminerf.workflow.artefact import fingerprint, read_metrics
from illuminerf.workflow.errors import UserError

CONFIG = estimate_illumination.Config(
    gathering=ColorGathering(num_points=1000), fit=LightFit(map_height=8), sampling=CueSampling(16), seed=3
)
SIZE, NUM_VIEWS = 48, 8


def lamp(height: int = 16) -> EnvironmentMap:
    """A wide warm lamp at one side above a dim, bluish room."""
    directions = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32)).directions()
    lobe = np.exp(5 * (directions @ np.array([0.64, -0.48, 0.6]) - 1))[..., None]
    return EnvironmentMap((0.15 * np.array([0.8, 0.9, 1]) + lobe * np.array([1.6, 1.4, 1.2])).astype(np.float32))


def duck() -> TriangleMesh:
    return duck_still_life(40)[0].mesh


def photographed() -> Cameras:
    return spiral_cameras(NUM_VIEWS, 3.0, 0.5, SIZE, SIZE, np.radians(-10), np.radians(70))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A duck in two matt paints, photographed under `lamp`."""
    folder, mesh = tmp_path_factory.mktemp("painted"), duck()
    is_dark = np.sin(9 * mesh.vertices[:, :1] + 5 * mesh.vertices[:, 1:2]) > 0
    paint = np.where(is_dark, np.array([0.15, 0.2, 0.35]), np.array([0.8, 0.55, 0.3])).astype(np.float32)
    views = render_shaded([(mesh, Material(paint, 1.0))], photographed(), lamp(), 32)
    save_capture(folder / "capture", Capture(views, tuple(map(str, range(NUM_VIEWS)))))
    mesh.save_glb(folder / "geometry" / "mesh.glb")
    return folder / "geometry", folder / "capture"


@pytest.fixture(scope="module")
def estimate(inputs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return estimate_illumination.run(*inputs, CONFIG, tmp_path_factory.mktemp("estimate") / "illumination")


def stored(illumination: Path) -> np.ndarray:
    """Shading and coverage of all views [views, 4, height, width]."""
    paths = [estimate_illumination.shading_path(illumination, view) for view in range(NUM_VIEWS)]
    return np.stack([np.stack([read_exr(path)[name] for name in "RGBA"]) for path in paths])


def log_shading(images: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Logarithms of the pixels `inside` [views, height, width]: [3, pixels]."""
    return np.log(np.maximum(images[:, :3].transpose(1, 0, 2, 3)[:, inside], 1e-3))


def agreement(light: EnvironmentMap, images: np.ndarray) -> float:
    """Mean correlation over channels of the log shading under `light` with that in `images`."""
    rendered = np.stack(list(render_cues(duck(), photographed(), light, CueSampling(16), 0, only_diffuse=True)))
    inside = (rendered[:, 3] == 1) & (images[:, 3] == 1)
    pairs = zip(log_shading(rendered, inside), log_shading(images, inside), strict=True)
    return float(np.mean([np.corrcoef(a, b)[0, 1] for a, b in pairs]))


def test_the_shading_is_that_of_the_true_light(estimate: Path) -> None:
    images = stored(estimate)
    assert agreement(lamp(), images) > 0.9
    assert agreement(lamp().rotated(np.pi), images) < 0.5  # a light from the other side would be noticed
    metrics = read_metrics(estimate)
    assert not metrics["is_fallback"] and metrics["num_points"] == 1000
    assert metrics["explained"] > 0.1


def test_the_light_is_neutral_and_the_lightest_paint_light(estimate: Path) -> None:
    images = stored(estimate)
    levels = np.exp(log_shading(images, images[:, 3] == 1).mean(1))
    assert levels.max() / levels.min() < 1.15
    assert 0.2 < EnvironmentMap.load(estimate / "light.exr").mean_radiance().mean() < 1.2
    assert (estimate / "preview.png").exists()


def test_resumed_equals_uninterrupted(inputs: tuple[Path, Path], estimate: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(estimate, broken)
    kept = estimate_illumination.shading_path(broken, 0)
    written = kept.stat().st_mtime_ns
    for name in ("DONE", "light.json", "light.exr", "preview.png"):
        (broken / name).unlink()
    estimate_illumination.shading_path(broken, 1).unlink()
    estimate_illumination.run(*inputs, CONFIG, broken)
    assert kept.stat().st_mtime_ns == written
    assert fingerprint(broken) == fingerprint(estimate)


def test_where_nothing_is_seen_the_light_is_uniform(
    inputs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(inputs[1], tmp_path / "capture")
    for path in (tmp_path / "capture" / "images").iterdir():
        write_png(path, np.zeros((SIZE, SIZE, 4), np.float32))
    out = estimate_illumination.run(inputs[0], tmp_path / "capture", CONFIG, tmp_path / "out")
    assert "taken to be uniform" in capsys.readouterr().err
    assert (EnvironmentMap.load(out / "light.exr").linear_rgb == 1).all()
    metrics = read_metrics(out)
    assert metrics["is_fallback"] and metrics["num_points"] == 0
    assert stored(out)[:, 0].max() > 0.5


def test_what_is_wrong_is_said(inputs: tuple[Path, Path], estimate: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="seed"):
        estimate_illumination.run(*inputs, replace(CONFIG, seed=4), estimate)
    (tmp_path / "geometry").mkdir()
    with pytest.raises(UserError, match="mesh"):
        estimate_illumination.run(tmp_path / "geometry", inputs[1], CONFIG, tmp_path / "out")
    with pytest.raises(UserError, match="quantile"):
        ColorGathering(quantile=1.5)
    with pytest.raises(UserError, match="map_height"):
        LightFit(map_height=2)
