"""Test views and cameras of the benchmark's layout."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from illuminerf.data.tensoir import find_test_views, find_views, load_test_cameras, load_test_image
from illuminerf.workflow.errors import UserError
from tests.data.synthetic_capture import FOV, ball_cameras, ball_images, write_tensoir

CAMERAS = ball_cameras(5, 24, 24)
IMAGES = ball_images(CAMERAS)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_tensoir(tmp_path / "train", CAMERAS, IMAGES, "city")
    for view, number in enumerate((0, 5, 10, 100, 20)):
        (tmp_path / "train" / f"train_{view:03d}").rename(tmp_path / f"test_{number:03d}")
    return tmp_path


def test_views_come_by_number(scene: Path) -> None:
    assert [view.name for view in find_views(scene, "test")] == [f"test_{n:03d}" for n in (0, 5, 10, 20, 100)]
    assert find_test_views(scene, ["city"], every=20) == ["test_000", "test_020", "test_100"]
    with pytest.raises(UserError, match="no train views"):
        find_views(scene, "train")


def test_cameras_are_those_written(scene: Path) -> None:
    names, cameras = load_test_cameras(scene, every=10)
    assert names == ["test_000", "test_010", "test_020", "test_100"]
    np.testing.assert_allclose(cameras.world_from_camera, CAMERAS.world_from_camera[[0, 2, 4, 3]], atol=1e-9)
    np.testing.assert_allclose(cameras.intrinsics[:, 0], 12 / np.tan(FOV / 2))
    _, small = load_test_cameras(scene, size=(12, 12))
    np.testing.assert_allclose(small.intrinsics[0] * 2, cameras.intrinsics[0])


def test_cameras_need_no_images(scene: Path) -> None:
    for image in scene.glob("test_*/rgba_city.png"):
        image.unlink()
    assert load_test_cameras(scene)[1].width == 24


def test_images_are_straight(scene: Path) -> None:
    image = load_test_image(scene, "test_010", "city")
    np.testing.assert_array_equal(np.round(image * 255), IMAGES[2])
    with pytest.raises(UserError, match="lights city"):
        find_test_views(scene, ["city", "night"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cam_angle_x": 4.0}, "field of view"),
        ({"cam_transform_mat": "1,2,3"}, "not a matrix"),
        ({"imw": 48}, "another shape"),
        ({"cam_angle_x": "wide"}, "not what it should be"),
    ],
)
def test_bad_metadata(scene: Path, change: dict[str, object], message: str) -> None:
    path = scene / "test_000" / "metadata.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(UserError, match=message):
        load_test_cameras(scene)


def test_sizes_must_agree(scene: Path) -> None:
    Image.fromarray(IMAGES[0]).resize((12, 12)).save(scene / "test_000" / "rgba_city.png")
    with pytest.raises(UserError, match="differ in size"):
        load_test_cameras(scene)
