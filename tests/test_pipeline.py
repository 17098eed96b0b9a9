"""The whole method, tiny, on a CPU, without downloads."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from illuminerf import demo, pipeline
from illuminerf.data.capture import load_capture
from illuminerf.evaluation.benchmark_rule import score_light, view_pair
from illuminerf.fields.mesh_fit import SurfaceRegressionConfig
from illuminerf.presets import PRESETS, Preset, customised
from illuminerf.run_folder import RunFolder
from illuminerf.scene.images import read_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.stages import fit_latent_nerf, render_novel_views
from illuminerf.workflow.artefact import fingerprint
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError

LIGHT = demo.bundled_capture() / "lights" / "evening.exr"
STAGES = ("capture", "geometry", "lights/evening/cues", "lights/evening/relit", "lights/evening/latent_nerf")


def tiny(samples: int = 1) -> Preset:
    """All stages for real, at sizes that take seconds."""
    preset = customised("demo", size=32, samples=samples, device="cpu")
    steps = dataclasses.replace(preset.geometry.optimiser, num_steps=12, rays_per_step=64, checkpoint_every=4)
    return dataclasses.replace(
        preset,
        geometry=dataclasses.replace(preset.geometry, optimiser=steps, mesh_resolution=40, num_previews=1),
        illumination=dataclasses.replace(
            preset.illumination,
            gathering=dataclasses.replace(preset.illumination.gathering, num_points=500),
            fit=dataclasses.replace(preset.illumination.fit, map_height=8),
        ),
        cues=dataclasses.replace(
            preset.cues, sampling=dataclasses.replace(preset.cues.sampling, samples_per_pixel=4), max_light_height=16
        ),
        relighting=dataclasses.replace(preset.relighting, num_steps=1),
        latent_nerf=fit_latent_nerf.Config(optimiser=steps),
        turntable=render_novel_views.Config(
            turntable=render_novel_views.TurntableConfig(num_views=2, height=32, width=32)
        ),
    )


NUM_VIEWS = 5


def few_photographs(folder: Path) -> Path:
    """The first views of the bundled capture."""
    cameras = read_json(demo.bundled_capture() / "cameras.json")
    cameras["frames"] = cameras["frames"][:NUM_VIEWS]
    write_json(folder / "cameras.json", cameras)
    (folder / "images").mkdir(exist_ok=True)
    for view in range(NUM_VIEWS):
        shutil.copy(demo.bundled_capture() / "images" / f"{view:03d}.png", folder / "images")
    return folder


def run_tiny(out: Path, preset: Preset | None = None) -> None:
    photographs = few_photographs(out.parent / "photographs")
    pipeline.relight(photographs, [pipeline.LightJob(LIGHT)], preset or tiny(), out)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "whole"
    run_tiny(out)
    return out


def test_a_run_leaves_what_the_readme_promises(finished: Path) -> None:
    page = (finished / "report.html").read_text()
    assert "<video" in page and "http" not in page.replace("http-equiv", ""), "the report must open offline"
    sources = re.findall(r"src='([^']{5})", page)
    assert len(sources) > 10 and set(sources) == {"data:"}, "pictures and film must be inside"
    assert (finished / "turntable.mp4").stat().st_size > 500
    assert (finished / "relit.glb").read_bytes() == RunFolder(finished).light().mesh.read_bytes()
    assert (finished / "mesh.glb").stat().st_size > 500
    assert len(list((finished / "lights/evening/relit/samples").glob("*.png"))) == NUM_VIEWS


def test_seconds_and_memory_are_on_record(finished: Path) -> None:
    seconds = pipeline.seconds_by_stage(finished)
    assert {"capture", "geometry", "cues", "relit", "latent_nerf", "turntable"} <= set(seconds)
    assert 0.1 < pipeline.peak_memory_gb(finished) < 24


def test_a_second_run_loads_everything(finished: Path) -> None:
    before = {stage: (finished / stage / "DONE").stat().st_mtime_ns for stage in STAGES}
    run_tiny(finished)
    assert {stage: (finished / stage / "DONE").stat().st_mtime_ns for stage in STAGES} == before


def test_other_settings_are_refused(finished: Path) -> None:
    with pytest.raises(UserError, match="num_samples is 1 there and 2 here"):
        run_tiny(finished, tiny(samples=2))


@pytest.mark.slow
def test_killed_again_and_again_the_result_is_the_same(finished: Path, tmp_path: Path) -> None:
    """SIGKILL after 6, 9, 13, ... seconds, of which the first few are start-up, then once to the end."""
    out = tmp_path / "killed"
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from pathlib import Path\n"
    code += f"import test_pipeline; test_pipeline.run_tiny(Path({str(out)!r}))"
    environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2")}
    num_kills = 0
    for seconds in (6, 9, 13, 17):
        process = subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.DEVNULL)
        try:
            process.wait(timeout=seconds)
            break
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            num_kills += 1
            time.sleep(0.1)
    run_tiny(out)
    assert num_kills > 0
    for stage in STAGES:
        assert fingerprint(out / stage) == fingerprint(finished / stage), stage


def test_doing_nothing_scores_what_the_rule_says() -> None:
    truth = [read_png(path) for path in sorted((demo.bundled_capture() / "test/evening/images").glob("*.png"))]
    assert demo.input_light_psnr(demo.bundled_capture()) == pytest.approx(19.61, abs=0.05)
    assert min(score_light([view_pair(image, image) for image in truth]).psnr) > 45


def test_presets_for_a_gpu_say_so_without_one(capsys: pytest.CaptureFixture[str]) -> None:
    customised("gpu", device="cpu")
    assert "meant for a GPU" in capsys.readouterr().err
    customised("embedded", device="cpu")
    assert "GPU" not in capsys.readouterr().err


def test_every_preset_says_what_it_is_for() -> None:
    assert all(len(preset.description) > 40 for preset in PRESETS.values())
    with pytest.raises(UserError, match="unknown preset"):
        customised("best")


@pytest.mark.slow
def test_scores_file_of_the_demo_has_the_documented_keys(tmp_path: Path) -> None:
    scores = demo.run(tmp_path / "demo", tiny())
    written = json.loads((tmp_path / "demo" / "scores.json").read_text())
    assert set(written) == {"psnr", "ssim", "input_light_psnr", "seconds", "peak_memory_gb"} == set(scores)


def test_a_mesh_takes_the_place_of_the_estimate(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimated mesh, as someone else's: cues and field are made from it, and the rest follows."""
    capture, mesh = load_capture(finished / "capture"), TriangleMesh.load_glb(finished / "geometry" / "mesh.glb")
    vertices = (mesh.vertices / capture.scale - capture.offset).astype(np.float32)
    TriangleMesh(vertices, mesh.faces, mesh.vertex_normals).save_glb(tmp_path / "mine.glb")
    settings = dataclasses.replace(
        pipeline.mesh_settings(tiny()),
        regression=SurfaceRegressionConfig(num_steps=4, points_per_step=256),
        spacing=0.04,
        ray_size=32,
        occupancy_side=24,
    )
    smooth = dataclasses.replace(tiny().geometry.radiance_field, radiance_normals="predicted")
    assert settings.radiance_field == smooth and settings.optimiser.num_steps == 12 // 5
    monkeypatch.setattr(pipeline, "mesh_settings", lambda _: settings)
    photographs, out = few_photographs(tmp_path), tmp_path / "run"
    with pytest.raises(UserError, match="is missing"):
        pipeline.relight(photographs, [pipeline.LightJob(LIGHT)], tiny(), out, tmp_path / "absent.glb")
    assert not out.exists()
    pipeline.relight(photographs, [pipeline.LightJob(LIGHT)], tiny(), out, tmp_path / "mine.glb")
    np.testing.assert_allclose(TriangleMesh.load_glb(out / "mesh.glb").vertices, mesh.vertices, atol=1e-5)
    assert (out / "report.html").is_file() and (out / "turntable.mp4").is_file()
    for stage in ("geometry", "lights/evening/latent_nerf"):
        assert fingerprint(out / stage) != fingerprint(finished / stage)
