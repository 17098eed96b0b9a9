"""A painted sphere is taken apart into paint and light, and put together again under another light."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from illuminerf import inverse_rendering
from illuminerf.cues.fitted_materials import load_materials, save_materials
from illuminerf.cues.material_fit import MaterialFit
from illuminerf.cues.materials import Material
from illuminerf.cues.mitsuba_variant import find_llvm
from illuminerf.cues.shading import render_shaded
from illuminerf.data.capture import Capture, save_capture
from illuminerf.evaluation.metrics import psnr
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.pipeline import LightJob
from illuminerf.presets import Preset
from illuminerf.scene.cameras import Cameras, spiral_cameras
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_png
from illuminerf.scene.meshes import TriangleMesh, sphere_mesh
from illuminerf.stages import fit_materials, render_materials
from illuminerf.workflow.artefact import fingerprint, read_metrics
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.errors import UserError

pytestmark = pytest.mark.skipif(find_llvm() is None, reason="gradients need libLLVM 19 or newer")
STEPS = OptimiserConfig(
    num_steps=60,
    rays_per_step=384,
    first_learning_rate=0.08,
    last_learning_rate=0.01,
    warmup_steps=3,
    checkpoint_every=20,
)
CONFIG = fit_materials.Config(
    STEPS, MaterialFit(map_height=8, color_sides=(2, 4, 8), surface_sides=(2,), max_depth=2), seed=3
)
NUM_VIEWS, SIZE = 8, 24


def lamp(azimuth: float, height: int = 8) -> EnvironmentMap:
    """A wide lamp at one side of a dim room."""
    directions = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32)).directions()
    toward = np.array([0.8 * np.cos(azimuth), 0.8 * np.sin(azimuth), 0.6])
    lobe = np.exp(4 * (directions @ toward - 1))[..., None]
    return EnvironmentMap((0.2 + 1.2 * lobe * np.ones(3)).astype(np.float32), f"lamp{azimuth:.0f}")


def paint(mesh: TriangleMesh) -> np.ndarray:
    """Red above, blue below."""
    return np.where(mesh.vertices[:, 2:] > 0, [0.7, 0.25, 0.15], [0.15, 0.25, 0.6]).astype(np.float32)


def photographed(height: float = 60) -> Cameras:
    return spiral_cameras(NUM_VIEWS, 3.0, 0.5, SIZE, SIZE, np.radians(-height), np.radians(height))


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Sums of gradients come out the same only then."""
    from illuminerf.cues.mitsuba_variant import load_mitsuba

    load_mitsuba()
    drjit = pytest.importorskip("drjit")
    before = drjit.thread_count()
    drjit.set_thread_count(1)
    yield
    drjit.set_thread_count(before)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the method's run has made when inverse rendering begins."""
    folder, mesh = tmp_path_factory.mktemp("painted"), sphere_mesh(3, 0.7)
    views = render_shaded([(mesh, Material(paint(mesh), 0.6))], photographed(), lamp(0.5), 64)
    save_capture(folder / "capture", Capture(views, tuple(map(str, range(NUM_VIEWS)))))
    mesh.save_glb(folder / "geometry" / "mesh.glb")
    lamp(0.5).save(folder / "illumination" / "light.exr")
    lamp(4).save(folder / "lamp4.exr")
    write_json(folder / "lights" / "lamp4" / "test_cameras.json", photographed(40).to_dict())
    return folder


@pytest.fixture(scope="module")
def materials(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fit") / "materials"
    return fit_materials.run(run / "geometry", run / "capture", run / "illumination", CONFIG, out)


def color_error(found: np.ndarray, mesh: TriangleMesh) -> float:
    """Mean difference of base colours where photographs show them, after the best gain of each channel."""
    seen, wanted = np.abs(mesh.vertices[:, 2]) < 0.6, paint(mesh)
    gain = (found[seen] * wanted[seen]).sum(0) / (found[seen] ** 2).sum(0)
    return float(np.abs(found[seen] * gain - wanted[seen]).mean())


def test_the_paint_is_found(materials: Path) -> None:
    mesh, material = load_materials(materials)
    color = np.asarray(material.base_color)
    assert color_error(color, mesh) < 0.09
    assert color_error(np.full_like(color, 0.5), mesh) > 0.14  # what was not fitted would be noticed
    # red is bright above and dark below, blue the other way round
    above, below = color[mesh.vertices[:, 2] > 0.2].mean(0), color[mesh.vertices[:, 2] < -0.2].mean(0)
    assert above[0] > 2 * below[0] and below[2] > 2 * above[2]
    assert np.asarray(material.metallic).mean() < 0.3
    assert read_metrics(materials)["train_psnr"] > 18
    assert (materials / "preview.png").exists() and not (materials / "checkpoint.safetensors").exists()


def test_relit_it_looks_like_the_truth(run: Path, materials: Path, tmp_path: Path) -> None:
    config = render_materials.Config(samples_per_pixel=64)
    mesh, material = load_materials(materials)
    grey = tmp_path / "grey"
    count = len(mesh.vertices)
    save_materials(grey, mesh, Material(np.full((count, 3), 0.4), np.full(count, 0.5), np.zeros(count)), lamp(0.5))
    truth = render_shaded([(mesh, Material(paint(mesh), 0.6))], photographed(40), lamp(4), 64)
    wanted = np.stack(list(truth.premultiplied()))
    cameras = run / "lights" / "lamp4" / "test_cameras.json"

    def score(folder: Path) -> float:
        out = render_materials.run(folder, cameras, run / "lamp4.exr", config, tmp_path / f"views_{folder.name}")
        images = np.stack([read_png(out / "images" / f"{view:03d}.png") for view in range(NUM_VIEWS)])
        return psnr(images[..., :3] * images[..., 3:], wanted)

    assert score(materials) > max(score(grey) + 3, 23)


def test_interrupted_and_resumed_equals_uninterrupted(
    run: Path, materials: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, loss, calls = tmp_path / "materials", fit_materials.photometric_loss, []
    inputs = (run / "geometry", run / "capture", run / "illumination")

    def interrupted(*arguments: object) -> object:
        calls.append(1)
        if len(calls) == 27:
            raise KeyboardInterrupt
        return loss(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(fit_materials, "photometric_loss", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit_materials.run(*inputs, CONFIG, out)
    assert not (out / "DONE").exists()
    fit_materials.run(*inputs, CONFIG, out)
    assert len(calls) == 27 + 60 - 20
    assert fingerprint(out) == fingerprint(materials)


def test_the_same_run_relit_the_other_way(run: Path, tmp_path: Path) -> None:
    fast = replace(CONFIG, optimiser=replace(STEPS, num_steps=2))
    preset = Preset("tiny", "", materials=fast, material_views=render_materials.Config(samples_per_pixel=4))
    jobs = [LightJob(run / "lamp4.exr")]
    views = inverse_rendering.relight(run, jobs, preset, tmp_path / "out")
    assert len(list((views["lamp4"] / "images").glob("*.png"))) == NUM_VIEWS
    seconds = inverse_rendering.seconds_by_stage(run, tmp_path / "out")
    assert set(seconds) == {"materials", "test_views"} and min(seconds.values()) > 0
    kept = (views["lamp4"] / "linear" / "000.exr").stat().st_mtime_ns
    (views["lamp4"] / "DONE").unlink()
    (views["lamp4"] / "linear" / "001.exr").unlink()
    inverse_rendering.relight(run, jobs, preset, tmp_path / "out")
    assert (views["lamp4"] / "linear" / "000.exr").stat().st_mtime_ns == kept
    assert (views["lamp4"] / "linear" / "001.exr").exists()


def test_what_is_wrong_is_said(run: Path, materials: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="seed"):
        fit_materials.run(run / "geometry", run / "capture", run / "illumination", replace(CONFIG, seed=4), materials)
    broken = tmp_path / "broken"
    shutil.copytree(materials, broken)
    sphere_mesh(2, 0.7).save_glb(broken / "mesh.glb")
    with pytest.raises(UserError, match="not those of its mesh"):
        load_materials(broken)
    with pytest.raises(UserError, match="one sample"):
        render_materials.Config(samples_per_pixel=0)
