"""The stage: novel views meet their truth, whatever the order, scale and offset."""

import json
from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.capture import Capture, save_capture
from illuminerf.scene.cameras import Cameras, turntable_cameras
from illuminerf.scene.images import read_png, write_png
from illuminerf.scene.views import Views
from illuminerf.stages.evaluate_relighting import Config, matching_views, run
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError

SIZE = 16


@pytest.fixture
def truth(tmp_path: Path) -> Views:
    cameras = turntable_cameras(5, 4.0, 0.7, SIZE, SIZE)
    generator = np.random.default_rng(0)
    alpha = np.zeros((5, SIZE, SIZE), np.float32)
    alpha[:, 3:-3, 3:-3] = 1
    srgb = np.round(generator.uniform(0.2, 0.8, (5, SIZE, SIZE, 3)) * 255).astype(np.float32) / 255
    views = Views(cameras, (srgb * alpha[..., None]).astype(np.float32), alpha)
    save_capture(tmp_path / "truth", Capture(views, tuple("abcde")))
    return views


def save_novel_views(folder: Path, views: Views, order: list[int], factor: float = 1.0) -> None:
    for position, view in enumerate(order):
        image = np.dstack([views.srgb[view] * factor, views.alpha[view]])
        write_png(folder / "images" / f"{position:03d}.png", image)
    write_json(folder / "cameras.json", views.cameras[order].transformed(0.3, np.array([1.0, 2.0, 3.0])).to_dict())


def test_a_dimmed_copy_is_rescaled_and_scored(tmp_path: Path, truth: Views) -> None:
    save_novel_views(tmp_path / "novel", truth, [3, 1, 4], factor=0.5)
    config = Config(light="lamp", scene="mug")
    out = run(tmp_path / "novel", tmp_path / "truth", config, tmp_path / "scores")
    scores = read_json(out / "scores.json")
    assert scores["psnr"]["mug"]["lamp"] > 45
    assert scores["ssim"]["mug"]["lamp"] > 0.99
    np.testing.assert_allclose(scores["scale"]["mug"]["lamp"], [2, 2, 2], rtol=0.02)
    assert len(scores["per_view"]["psnr"]) == 3
    panel = read_png(out / "side_by_side" / "000.png")
    assert panel.shape == (SIZE, 3 * SIZE, 3)
    np.testing.assert_allclose(panel[5, SIZE + 5], truth.srgb[3, 5, 5], atol=1 / 255)
    assert read_png(out / "error" / "002.png").shape == (SIZE, SIZE, 3)
    raw = run(tmp_path / "novel", tmp_path / "truth", Config("lamp", "mug", rescale="none"), tmp_path / "raw")
    assert read_json(raw / "scores.json")["psnr"]["mug"]["lamp"] < 25


def test_a_finished_run_is_loaded(tmp_path: Path, truth: Views) -> None:
    save_novel_views(tmp_path / "novel", truth, [0, 1, 2])
    out = run(tmp_path / "novel", tmp_path / "truth", Config("lamp"), tmp_path / "scores")
    before = (out / "scores.json").stat().st_mtime_ns
    run(tmp_path / "novel", tmp_path / "truth", Config("lamp"), tmp_path / "scores")
    assert (out / "scores.json").stat().st_mtime_ns == before
    with pytest.raises(UserError, match="light"):
        run(tmp_path / "novel", tmp_path / "truth", Config("noon"), tmp_path / "scores")


def test_matching_ignores_scale_and_offset_but_not_direction(truth: Views) -> None:
    cameras = truth.cameras
    moved = cameras[[2, 0]].transformed(7.0, np.array([0.0, 1.0, -2.0]))
    assert matching_views(moved, cameras) == [2, 0]
    turned = cameras.world_from_camera.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    with pytest.raises(UserError, match="no true view"):
        matching_views(Cameras(turned, cameras.intrinsics, SIZE, SIZE), cameras)


def test_two_views_of_one_direction_are_matched_in_order(truth: Views) -> None:
    twice = truth.cameras[[1, 1, 2]]
    assert matching_views(twice, twice) == [0, 1, 2]


def test_a_benchmark_scene_is_ground_truth_too(tmp_path: Path, truth: Views) -> None:
    scene = tmp_path / "vase"
    for view, number in enumerate((0, 10, 20, 30, 40)):
        folder = scene / f"test_{number:03d}"
        write_png(folder / "rgba_lamp.png", np.dstack([truth.srgb[view], truth.alpha[view]]))
        pose = ",".join(map(repr, map(float, truth.cameras.world_from_camera[view].ravel())))
        content = {"cam_transform_mat": pose, "cam_angle_x": 0.7, "imw": SIZE, "imh": SIZE}
        (folder / "metadata.json").write_text(json.dumps(content))
    save_novel_views(tmp_path / "novel", truth, [1, 3])
    out = run(tmp_path / "novel", scene, Config(light="lamp"), tmp_path / "scores")
    assert read_json(out / "scores.json")["psnr"]["vase"]["lamp"] == 100.0
    with pytest.raises(UserError, match="no light 'disco'"):
        run(tmp_path / "novel", scene, Config(light="disco"), tmp_path / "other")


def test_errors_come_before_anything_is_written(tmp_path: Path, truth: Views) -> None:
    save_novel_views(tmp_path / "novel", truth, [0, 1])
    write_png(tmp_path / "novel" / "images" / "001.png", np.zeros((8, 8, 3)))
    with pytest.raises(UserError, match="8 x 8"):
        run(tmp_path / "novel", tmp_path / "truth", Config("lamp"), tmp_path / "scores")
    with pytest.raises(UserError, match="ground truth does not exist"):
        run(tmp_path / "novel", tmp_path / "nowhere", Config("lamp"), tmp_path / "scores")
    assert not (tmp_path / "scores").exists()


def test_the_light_needs_a_name() -> None:
    with pytest.raises(UserError, match="light"):
        Config(light="")
