"""Three kinds of camera files, one camera."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from illuminerf.data.camera_paths import read_camera_path
from illuminerf.scene.cameras import Cameras, turntable_cameras
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.errors import UserError

CAMERAS = turntable_cameras(3, 2.5, 0.8, 30, 40)


def same(read: Cameras, wanted: Cameras = CAMERAS) -> bool:
    return (
        (read.height, read.width) == (wanted.height, wanted.width)
        and np.allclose(read.world_from_camera, wanted.world_from_camera, atol=1e-5)
        and np.allclose(read.intrinsics, wanted.intrinsics, atol=1e-4)
    )


def nerfstudio_path(cameras: Cameras = CAMERAS, **more: Any) -> dict[str, Any]:
    fov = math.degrees(2 * math.atan(0.5 * cameras.height / cameras.intrinsics[0, 1]))
    frames = [
        {"camera_to_world": pose.ravel().tolist(), "fov": fov, "aspect": 4 / 3} for pose in cameras.world_from_camera
    ]
    size = {"render_height": cameras.height, "render_width": cameras.width}
    return {"camera_type": "perspective", **size, "camera_path": frames, "fps": 24, "seconds": 0.25, **more}


def transforms(**intrinsics: float) -> dict[str, Any]:
    frames = [{"transform_matrix": pose.tolist()} for pose in CAMERAS.world_from_camera]
    return {"frames": frames, "w": 40, "h": 30, **intrinsics}


def read(folder: Path, content: Any) -> tuple[Cameras, int | None]:
    write_json(folder / "path.json", content)
    return read_camera_path(folder / "path.json", 30, 40)


def test_our_own(tmp_path: Path) -> None:
    assert same(read(tmp_path, CAMERAS.to_dict())[0])
    write_json(tmp_path / "cameras.json", CAMERAS.to_dict())
    assert same(read_camera_path(tmp_path, 5, 5)[0])


def test_transforms_json(tmp_path: Path) -> None:
    focal = float(CAMERAS.intrinsics[0, 0])
    assert same(read(tmp_path, transforms(camera_angle_x=0.8))[0])
    assert same(read(tmp_path, transforms(fl_x=focal, fl_y=focal, cx=20, cy=15))[0])
    assert same(read(tmp_path, transforms(camera_angle_y=2 * math.atan(15 / focal)))[0])
    assert not same(read(tmp_path, transforms(camera_angle_x=0.9))[0])


def test_nerfstudio_with_its_frame_rate(tmp_path: Path) -> None:
    cameras, rate = read(tmp_path, nerfstudio_path())
    assert same(cameras) and rate == 12, "3 views in a quarter of a second"
    assert read(tmp_path, nerfstudio_path(seconds=0))[1] == 24


def test_nerfstudios_own_world_is_undone(tmp_path: Path) -> None:
    turn = np.array([[0, -1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, 1, 0.1]])
    moved = np.vstack([turn, [0, 0, 0, 1]]) @ CAMERAS.world_from_camera
    moved[:, :3, 3] *= 0.4
    content = nerfstudio_path(Cameras(moved, CAMERAS.intrinsics, 30, 40))
    assert not same(read(tmp_path, content)[0])
    write_json(tmp_path / "dataparser_transforms.json", {"transform": turn.tolist(), "scale": 0.4})
    assert same(read(tmp_path, content)[0])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ([], "no camera path"),
        ({}, "lists no cameras"),
        ({"frames": []}, "lists no cameras"),
        (nerfstudio_path(camera_type="fisheye"), "fisheye"),
        (nerfstudio_path(camera_path=[]), "keyframes"),
        (nerfstudio_path(camera_path=[{"camera_to_world": [1, 2], "fov": 50}]), "expected form"),
        (transforms(), "camera_angle_y"),
        (transforms(camera_angle_x=4.0), "impossible field of view"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, content: Any, says: str) -> None:
    with pytest.raises(UserError, match=says):
        read(tmp_path, content)
