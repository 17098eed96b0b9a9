"""Files that say where to look from: our cameras.json, any transforms.json, and nerfstudio's camera paths.

All are in the caller's world, the one of the photographs' poses. A camera path of nerfstudio's viewer lives in the
world that nerfstudio made of them; its `dataparser_transforms.json`, where a copy lies beside the path, takes it back.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.data.source import rigid_pose
from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError

_WANTED = "cameras.json, transforms.json or a nerfstudio camera path"


def read_camera_path(path: Path, height: int, width: int) -> tuple[Cameras, int | None]:
    """The cameras of a file, in the caller's world, and its frames per second where it says them.

    Args:
        path: the JSON file, or a folder with a cameras.json.
        height: image height where the file has none.
        width: image width where the file has none.

    Raises:
        UserError: the file is of none of the three kinds, or something in it is missing or impossible.
    """
    content = read_json(path / "cameras.json" if path.is_dir() else path)
    if not isinstance(content, dict):
        raise UserError(f"{path} is no camera path", got=type(content).__name__, wanted=_WANTED)
    try:
        if isinstance(content.get("camera_path"), list):
            return _nerfstudio_path(content, path, height, width)
        frames = content.get("frames")
        if isinstance(frames, list) and frames and "transform_matrix" in frames[0]:
            return _transforms(content, path, height, width), None
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise UserError(
            f"{path} is not in the expected form", got=f"{type(error).__name__}: {error}", wanted=_WANTED
        ) from error
    if isinstance(frames, list) and frames:
        return Cameras.from_dict(content), None
    raise UserError(f"{path} lists no cameras", got=f"keys {', '.join(sorted(content)) or 'none'}", wanted=_WANTED)


def _nerfstudio_path(content: dict[str, Any], path: Path, height: int, width: int) -> tuple[Cameras, int | None]:
    kind = str(content.get("camera_type", "perspective")).lower()
    if kind != "perspective":
        raise UserError(
            f"{path} is not a path of perspective cameras", got=kind, fix="choose perspective in the viewer"
        )
    if not content["camera_path"]:
        raise UserError(f"{path} lists no cameras", fix="add keyframes in the viewer and export again")
    height, width = int(content.get("render_height", height)), int(content.get("render_width", width))
    poses, intrinsics = [], []
    for number, entry in enumerate(content["camera_path"]):
        pose = np.array(entry["camera_to_world"], np.float64)
        poses.append(rigid_pose(pose.reshape(4, 4).tolist(), f"camera {number} of {path}"))
        intrinsics.append(_intrinsics(math.radians(float(entry["fov"])), None, height, width, path))
    cameras = Cameras(np.stack(poses), np.stack(intrinsics), height, width)
    beside = path.parent / "dataparser_transforms.json"
    if beside.is_file():
        cameras = _in_world_of_photographs(cameras, read_json(beside), beside)
    seconds = float(content.get("seconds") or 0)
    rate = len(cameras) / seconds if seconds > 0 else float(content.get("fps") or 0)
    return cameras, max(1, round(rate)) if rate > 0 else None


def _in_world_of_photographs(cameras: Cameras, transforms: dict[str, Any], path: Path) -> Cameras:
    """Undo nerfstudio's p' = scale * transform(p)."""
    scale = float(transforms["scale"])
    rigid = rigid_pose(np.vstack([transforms["transform"], [0, 0, 0, 1]]).tolist(), f"transform in {path}")
    unscaled = cameras.transformed(1 / scale, np.zeros(3))
    poses = np.linalg.inv(rigid) @ unscaled.world_from_camera
    return Cameras(poses, unscaled.intrinsics, unscaled.height, unscaled.width)


def _transforms(content: dict[str, Any], path: Path, height: int, width: int) -> Cameras:
    height, width = int(content.get("h", height)), int(content.get("w", width))
    poses, intrinsics = [], []
    for number, entry in enumerate(content["frames"]):
        poses.append(rigid_pose(entry["transform_matrix"], f"frame {number} of {path}"))
        keys = {**content, **entry}
        if (int(keys.get("h", height)), int(keys.get("w", width))) != (height, width):
            raise UserError(f"frame {number} of {path} has another size than the first", wanted="one size")
        if "fl_x" in keys:
            fx = float(keys["fl_x"])
            fy, cx, cy = (
                float(keys.get("fl_y", fx)),
                float(keys.get("cx", width / 2)),
                float(keys.get("cy", height / 2)),
            )
            intrinsics.append(np.array([fx, fy, cx, cy]))
        else:
            across = keys.get("camera_angle_x")
            down = float(keys["camera_angle_y"]) if across is None else None
            intrinsics.append(_intrinsics(down, None if across is None else float(across), height, width, path))
    return Cameras(np.stack(poses), np.stack(intrinsics), height, width)


def _intrinsics(down: float | None, across: float | None, height: int, width: int, path: Path) -> np.ndarray:
    """Square pixels and a centred axis, from the vertical (`down`) or the horizontal field of view in radians."""
    angle, side = (down, height) if down is not None else (across, width)
    if angle is None or not 0 < angle < math.pi:
        raise UserError(f"{path} has an impossible field of view", got=f"{angle} radians", wanted="between 0 and pi")
    focal = 0.5 * side / math.tan(0.5 * angle)
    return np.array([focal, focal, width / 2, height / 2])
