"""One synthetic capture in every format gives the same views; the stage loads, refuses and leaves nothing
behind.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from illuminerf.data.capture import Capture, load_capture, save_capture
from illuminerf.scene.cameras import Cameras
from illuminerf.stages.import_capture import Config, run
from illuminerf.workflow.errors import UserError
from tests.data.synthetic_capture import (
    CENTRE,
    RADIUS,
    ball_cameras,
    ball_images,
    write_nerf_synthetic,
    write_plain,
    write_plain_exr,
    write_tensoir,
    write_transforms,
)

CAMERAS = ball_cameras()
IMAGES = ball_images(CAMERAS)
KEEP = Config(placement="keep")

Writer = Callable[[Path, Cameras, np.ndarray], object]
WRITERS: dict[str, Writer] = {
    "tensoir": write_tensoir,
    "nerf_synthetic": write_nerf_synthetic,
    "transforms": write_transforms,
    "transforms per frame": lambda root, c, i: write_transforms(root, c, i, per_frame=True),
    "transforms with masks": lambda root, c, i: write_transforms(root, c, i, with_masks=True),
    "transforms with mask_path": lambda root, c, i: write_transforms(root, c, i, mask_path=True),
    "plain": write_plain,
    "plain with masks": lambda root, c, i: write_plain(root, c, i, with_masks=True),
    "plain exr": write_plain_exr,
}


def imported(tmp_path: Path, writer: Writer, config: Config = KEEP, cameras: Cameras = CAMERAS) -> Capture:
    writer(tmp_path / "source", cameras, ball_images(cameras))
    return load_capture(run(tmp_path / "source", config, tmp_path / "capture"))


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_same_views(tmp_path: Path, name: str) -> None:
    capture = imported(tmp_path, WRITERS[name])
    views = capture.views
    np.testing.assert_array_equal(np.round(np.asarray(views.srgb) * 255), IMAGES[..., :3])
    np.testing.assert_array_equal(np.round(np.asarray(views.alpha) * 255), IMAGES[..., 3])
    np.testing.assert_allclose(views.cameras.world_from_camera, CAMERAS.world_from_camera, atol=1e-9)
    np.testing.assert_allclose(views.cameras.intrinsics, CAMERAS.intrinsics, rtol=1e-9)
    assert capture.background == "masked" and len(capture.names) == len(CAMERAS)


def test_the_object_fills_the_unit_ball_and_the_placement_maps_back(tmp_path: Path) -> None:
    capture = imported(tmp_path, write_plain, Config(object_radius=0.8))
    centre = (CENTRE + capture.offset) * capture.scale
    assert np.linalg.norm(centre) < 0.08
    assert 0.55 < RADIUS * capture.scale <= 0.8
    back = capture.caller_cameras(capture.views.cameras)
    np.testing.assert_allclose(back.world_from_camera, CAMERAS.world_from_camera, atol=1e-9)
    again = capture.unit_ball_cameras(CAMERAS)
    np.testing.assert_allclose(again.world_from_camera, capture.views.cameras.world_from_camera, atol=1e-9)


def test_a_smaller_size_keeps_the_view(tmp_path: Path) -> None:
    capture = imported(tmp_path, write_plain, Config(size=24, placement="keep"))
    cameras = capture.views.cameras
    assert (cameras.width, cameras.height) == (24, 20)
    np.testing.assert_allclose(cameras.intrinsics, CAMERAS.intrinsics / 2)
    # binary alpha, 2 x 2 cells: the mean coverage is exact up to rounding
    np.testing.assert_allclose(np.mean(capture.views.alpha), IMAGES[..., 3].mean() / 255, atol=1e-3)


def test_images_are_never_enlarged(tmp_path: Path) -> None:
    assert imported(tmp_path, write_plain, Config(size=400, placement="keep")).views.cameras.width == 48


def test_differing_sizes_with_own_intrinsics_are_padded_to_one(tmp_path: Path) -> None:
    """Every second image is cropped; after import a world point projects to the same colour as before."""
    content = CAMERAS.to_dict()
    (tmp_path / "source" / "images").mkdir(parents=True)
    for view, frame in enumerate(content["frames"]):
        image = IMAGES[view]
        if view % 2:
            image = image[4:-6, 8:-2]
            frame["intrinsics"]["cx"] -= 8
            frame["intrinsics"]["cy"] -= 4
        frame["height"], frame["width"] = image.shape[:2]
        Image.fromarray(image).save(tmp_path / "source" / "images" / f"{view}.png")
    (tmp_path / "source" / "cameras.json").write_text(json.dumps(content))
    capture = load_capture(run(tmp_path / "source", KEEP, tmp_path / "capture"))
    cameras = capture.views.cameras
    assert (cameras.width, cameras.height) == (48, 40)
    before, _ = CAMERAS.project(CENTRE[None] + [[0.05, 0.02, -0.03]])
    after, _ = cameras.project(CENTRE[None] + [[0.05, 0.02, -0.03]])
    for view in range(len(cameras)):
        (old_x, old_y), (new_x, new_y) = before[view, 0], after[view, 0]
        assert abs(new_x - old_x - round(new_x - old_x)) < 1e-9
        wanted = IMAGES[view, int(old_y), int(old_x), :3]
        got = np.round(capture.views.srgb[view, int(new_y), int(new_x)] * 255)
        np.testing.assert_array_equal(got, wanted)


def test_plain_backgrounds_are_cut_out(tmp_path: Path) -> None:
    for background in ("white", "black"):
        cameras, images = CAMERAS, IMAGES.copy()
        images[images[..., 3] == 0] = [255] * 4 if background == "white" else [0, 0, 0, 255]
        source, out = tmp_path / background, tmp_path / f"{background}_capture"
        write_plain(source, cameras, images[..., :3])
        capture = load_capture(run(source, Config(background=background, placement="keep"), out))
        np.testing.assert_array_equal(np.round(np.asarray(capture.views.alpha) * 255), IMAGES[..., 3])
        assert capture.background == "masked"


def test_without_masks_everything_is_object_and_the_cameras_place_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_plain(tmp_path / "source", CAMERAS, IMAGES[..., :3])
    capture = load_capture(run(tmp_path / "source", Config(), tmp_path / "capture"))
    assert capture.background == "opaque" and np.min(capture.views.alpha) == 1
    np.testing.assert_allclose(-capture.offset, CENTRE, atol=1e-6)
    assert "no masks" in capsys.readouterr().err


def test_a_capture_can_be_imported_again(tmp_path: Path) -> None:
    first = imported(tmp_path, write_tensoir, Config())
    second = load_capture(run(tmp_path / "capture", KEEP, tmp_path / "again"))
    np.testing.assert_array_equal(first.views.srgb, second.views.srgb)
    save_capture(tmp_path / "saved", first)
    third = load_capture(tmp_path / "saved")
    np.testing.assert_array_equal(first.views.alpha, third.views.alpha)
    assert third.scale == first.scale and third.names == first.names


def test_equal_inputs_give_equal_bytes_and_a_finished_import_is_loaded(tmp_path: Path) -> None:
    imported(tmp_path, write_plain, Config())
    run(tmp_path / "source", Config(), tmp_path / "twin")
    assert (tmp_path / "twin" / "DONE").read_text() == (tmp_path / "capture" / "DONE").read_text()
    before = (tmp_path / "capture" / "capture.json").stat().st_mtime_ns
    run(tmp_path / "source", Config(), tmp_path / "capture")
    assert (tmp_path / "capture" / "capture.json").stat().st_mtime_ns == before


def test_other_settings_and_other_images_are_refused(tmp_path: Path) -> None:
    imported(tmp_path, write_plain, Config())
    with pytest.raises(UserError, match="size"):
        run(tmp_path / "source", Config(size=24), tmp_path / "capture")
    Image.fromarray(IMAGES[1]).save(tmp_path / "source" / "images" / "0.png")
    with pytest.raises(UserError, match="source"):
        run(tmp_path / "source", Config(), tmp_path / "capture")


def test_files_the_import_does_not_read_may_change(tmp_path: Path) -> None:
    imported(tmp_path, write_plain, Config())
    (tmp_path / "source" / "notes.txt").write_text("taken on a cloudy day")
    run(tmp_path / "source", Config(), tmp_path / "capture")


@pytest.mark.parametrize("config", [{"size": 4}, {"object_radius": 0.0}, {"object_radius": 1.5}])
def test_config_is_checked(config: dict[str, float]) -> None:
    with pytest.raises(UserError):
        Config(**config)  # type: ignore[arg-type]


@pytest.mark.data
def test_benchmark_scenes_fit_the_unit_ball(data_root: Path, tmp_path: Path) -> None:
    scene = data_root / "tensoir" / "hotdog"
    if not scene.is_dir():
        pytest.skip("no tensoir/hotdog under ILLUMINERF_DATA")
    capture = load_capture(run(scene, Config(size=100), tmp_path / "capture"))
    assert len(capture.views) == 100 and 0.6 < capture.scale < 0.8
    pixels, _ = capture.views.cameras.project(np.zeros((1, 3)))
    inside = [capture.views.alpha[view, int(y), int(x)] for view, (x, y) in enumerate(pixels[:, 0])]
    assert np.mean(inside) > 0.9
