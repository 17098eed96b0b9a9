"""Stanford-ORB's layout: what is found, how it is averaged down, and what is missing."""

import json
from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.reading import read_source
from illuminerf.data.stanford_orb import (
    cameras_of,
    check_files,
    find_captures,
    load_mask,
    load_photograph,
    novel_views,
    object_of,
    own_views,
    photographs,
    scored_size,
)
from illuminerf.scene.images import read_rgb_exr, write_png, write_rgb_exr
from illuminerf.workflow.errors import UserError
from tests.data.written_orb import CAPTURES, FOV, NAMES, write_orb


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_orb(tmp_path / "orb")


def test_captures_are_found_by_object_or_name(root: Path) -> None:
    assert find_captures(root) == list(CAPTURES)
    assert find_captures(root, ["duck"]) == ["duck_scene001", "duck_scene003"]
    assert find_captures(root, ["cup_scene002", "duck"]) == ["cup_scene002", "duck_scene001", "duck_scene003"]
    assert object_of("toy_car_scene002") == "toy_car"
    with pytest.raises(UserError, match="'vase'.*got cup, duck"):
        find_captures(root, ["vase"])
    with pytest.raises(UserError, match="synthetic-orb"):
        find_captures(root / "ground_truth")


def test_novel_views_belong_to_the_other_capture_and_have_their_own_field_of_view(root: Path) -> None:
    novel = novel_views(root, "cup_scene001")
    assert list(novel) == ["cup_scene002"]
    assert [(view.name, view.split, view.capture) for view in novel["cup_scene002"]] == [
        (name, "test", "cup_scene002") for name in NAMES
    ]
    cameras = cameras_of(novel["cup_scene002"], 100)
    np.testing.assert_allclose(cameras.intrinsics[:, 0], [50 / np.tan(0.3), 50 / np.tan(0.305)])
    np.testing.assert_allclose(cameras.intrinsics[:, 2:], 50)
    own = own_views(root, "cup_scene002")
    assert [view.fov_radians for view in own] == [FOV, FOV]
    assert np.abs(own[0].world_from_camera - novel["cup_scene002"][0].world_from_camera).max() > 0.1


def test_photographs_are_read_with_their_masks(root: Path) -> None:
    source = read_source(photographs(root, "cup_scene001"), "transforms", mask_folder="train_mask")
    assert len(source.frames) == 3
    assert all(frame.image.suffix == ".png" and frame.mask is not None for frame in source.frames)


def test_linear_photographs_stand_in_where_there_are_no_others(root: Path) -> None:
    (root / "blender_LDR" / "cup_scene001" / "transforms_train.json").unlink()
    folder = photographs(root, "cup_scene001")
    assert folder.parent.name == "blender_HDR"
    frames = read_source(folder, "transforms", mask_folder="train_mask").frames
    assert all(frame.image.suffix == ".exr" for frame in frames)
    (folder / "transforms_train.json").unlink()
    with pytest.raises(UserError, match="no photographs of cup_scene001"):
        photographs(root, "cup_scene001")


def test_large_photographs_are_area_averaged_in_linear_light(root: Path) -> None:
    view = own_views(root, "cup_scene001")[0]
    path = root / "blender_HDR" / "cup_scene001" / "test" / "0003.exr"
    image = read_rgb_exr(path)
    image[0, 0] = -0.5
    write_rgb_exr(path, image, half=False)
    small = load_photograph(root, view, 6)
    wanted = image.reshape(6, 4, 6, 4, 3).mean((1, 3))
    np.testing.assert_allclose(small, np.maximum(wanted, 0), atol=1e-6)
    assert np.abs(small - image[::4, ::4]).max() > 0.1, "not every fourth pixel"
    assert scored_size(root, view, 512) == 24 and scored_size(root, view, 6) == 6


def test_masks_are_averaged_before_the_threshold(root: Path) -> None:
    view = own_views(root, "cup_scene001")[0]
    mask = np.zeros((24, 24), np.float32)
    mask[:4, :4] = 1
    mask[4:8, :2] = 1  # exactly one half
    mask[8:12, :3] = 1
    write_png(root / "blender_HDR" / "cup_scene001" / "test_mask" / "0003.png", mask)
    np.testing.assert_array_equal(load_mask(root, view, 6)[:4, 0], [True, False, True, False])


def test_missing_files_are_named(root: Path) -> None:
    views = novel_views(root, "cup_scene001")["cup_scene002"]
    check_files(root, views)
    gone = root / "ground_truth" / "cup_scene002" / "env_map" / "0011.exr"
    gone.unlink()
    with pytest.raises(UserError, match="env_map/0011.exr"):
        check_files(root, views)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"scene_name": None}, "names no photograph|not complete"),
        ({"file_path": "../../secret/0003", "scene_name": "../x"}, "names no photograph"),
        ({"camera_angle_x": 4.0}, "field of view"),
        ({"transform_matrix": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "not rigid"),
        ({"file_path": 0.5, "transform_matrix": "none"}, "not a matrix"),
    ],
)
def test_bad_frames(root: Path, damage: dict[str, object], message: str) -> None:
    path = root / "blender_HDR" / "cup_scene001" / "transforms_novel.json"
    content = json.loads(path.read_text())
    content["frames"][0] |= damage
    if damage == {"scene_name": None}:
        del content["frames"][0]["scene_name"]
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=message):
        novel_views(root, "cup_scene001")


def test_photographs_must_be_square_and_large_enough(root: Path) -> None:
    view = own_views(root, "cup_scene001")[0]
    with pytest.raises(UserError, match="24 x 24"):
        load_photograph(root, view, 48)
    write_rgb_exr(root / "blender_HDR" / "cup_scene001" / "test" / "0003.exr", np.ones((12, 24, 3), np.float32))
    with pytest.raises(UserError, match="not square"):
        scored_size(root, view, 512)
