"""`transforms.json` as NeRF-synthetic, instant-ngp and nerfstudio write it.

Poses are world_from_camera with OpenGL axes. nerfstudio's `applied_transform` records a change of world
that the poses already contain, so it is checked and not applied again. Intrinsics come per frame, per file,
or as camera_angle_x; keys: fl_x, fl_y, cx, cy, w, h, k1, k2, p1, p2, k3. A frame may name a `mask_path`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.data.decoding import image_size
from illuminerf.data.source import (
    SourceCamera,
    SourceCapture,
    SourceFrame,
    checked_camera,
    checked_capture,
    image_inside,
    mask_for,
    rigid_pose,
)
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError

_PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_INTRINSIC_KEYS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")


def transforms_file(root: Path, split: str = "train") -> Path | None:
    """The file that lists the frames of `split`: transforms_<split>.json, else transforms.json."""
    for name in (f"transforms_{split}.json", "transforms.json"):
        if (root / name).is_file():
            return root / name
    return None


def read_transforms(root: Path, split: str = "train", mask_folder: str = "masks") -> SourceCapture:
    """The frames of `split` in the folder `root`."""
    path = transforms_file(root, split)
    if path is None:
        raise UserError(f"no transforms.json for the split {split!r}", got=f"none in {root}", wanted="transforms.json")
    content = read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise UserError(
            "a transforms file does not list frames",
            got=f"{type(content).__name__} without a list 'frames' in {path}",
            wanted='{"camera_angle_x": ..., "frames": [{"file_path": ..., "transform_matrix": ...}]}',
        )
    _check_model(content, path)
    frames = [
        _read_frame(root, path, content, entry, index, mask_folder)
        for index, entry in enumerate(_entries_of_split(content, split))
    ]
    described = [entry for entry in content["frames"] if isinstance(entry, dict)]
    per_frame = all(any(key in entry for key in _INTRINSIC_KEYS) for entry in described)
    return checked_capture(root, frames, shares_intrinsics=not per_frame)


def _check_model(content: dict[str, Any], path: Path) -> None:
    model = content.get("camera_model", "OPENCV")
    fisheye = content.get("is_fisheye", False)
    if fisheye or str(model).upper() not in _PINHOLE_MODELS or content.get("k4"):
        raise UserError(
            "the camera model is not supported",
            got=f"{'fisheye' if fisheye else model} in {path}",
            wanted="a pinhole with k1, k2, k3, p1, p2",
            fix="undistort the images first, for instance with COLMAP's image_undistorter",
        )
    applied = content.get("applied_transform")
    if applied is not None:
        rigid_pose(applied, f"applied_transform in {path}")


def _entries_of_split(content: dict[str, Any], split: str) -> list[Any]:
    """nerfstudio lists the file names of each split; without such a list every frame is meant."""
    chosen = content.get(f"{split}_filenames")
    if not isinstance(chosen, list):
        return list(content["frames"])
    names = set(map(str, chosen))
    return [entry for entry in content["frames"] if isinstance(entry, dict) and str(entry.get("file_path")) in names]


def _read_frame(
    root: Path, path: Path, content: dict[str, Any], entry: Any, index: int, mask_folder: str
) -> SourceFrame:
    where = f"frame {index} of {path}"
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise UserError(f"{where} names no image", got=str(entry)[:80], wanted="file_path and transform_matrix")
    if "transform_matrix" not in entry:
        raise UserError(f"{where} has no pose", got=f"keys {sorted(entry)}", wanted="transform_matrix")
    image = image_inside(root, entry["file_path"], path)
    pose = rigid_pose(entry["transform_matrix"], f"{entry['file_path']} in {path}")
    camera = _read_camera({**_shared(content), **entry}, image, where)
    mask = entry.get("mask_path")
    mask_file = image_inside(root, str(mask), path) if mask else mask_for(root, image, mask_folder)
    return SourceFrame(image.relative_to(root).with_suffix("").as_posix(), image, mask_file, pose, camera)


def _shared(content: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in content.items() if key != "frames"}


def _read_camera(keys: dict[str, Any], image: Path, where: str) -> SourceCamera:
    """The camera for the image as it is on disk; intrinsics written for another size are scaled to it."""
    try:
        declared = (int(keys["w"]), int(keys["h"])) if "w" in keys and "h" in keys else None
        size = image_size(image, declared)
        width, height = declared or size
        if min(width, height) < 1:
            raise ValueError(f"w {width}, h {height}")
        if abs(width * size[1] - height * size[0]) > max(width, height, *size):
            raise UserError(
                f"{where}: the image has another shape than its intrinsics",
                got=f"{size[0]} x {size[1]} pixels in {image}",
                wanted=f"the aspect of w x h = {width} x {height}",
                fix="write w, h and the intrinsics per frame, or bring the images to one size",
            )
        fx, fy = _focal_lengths(keys, width, height, where)
        centre = float(keys.get("cx", width / 2)), float(keys.get("cy", height / 2))
        distortion = [float(keys.get(name, 0.0)) for name in ("k1", "k2", "p1", "p2", "k3")]
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{where}: intrinsics are not numbers", got=str(error), wanted="numbers in pixels") from error
    to_x, to_y = size[0] / width, size[1] / height
    return checked_camera(where, size, (fx * to_x, fy * to_y), (centre[0] * to_x, centre[1] * to_y), distortion)


def _focal_lengths(keys: dict[str, Any], width: int, height: int, where: str) -> tuple[float, float]:
    if "fl_x" in keys:
        fx = float(keys["fl_x"])
        return fx, float(keys.get("fl_y", fx))
    angles = {name: float(keys[name]) for name in ("camera_angle_x", "camera_angle_y") if name in keys}
    if not angles:
        raise UserError(f"{where} has no focal length", got=f"keys {sorted(keys)}", wanted="fl_x or camera_angle_x")
    if not all(0 < angle < np.pi for angle in angles.values()):
        raise UserError(f"{where} has an impossible field of view", got=str(angles), wanted="radians in (0, pi)")
    if "camera_angle_x" in angles:  # square pixels; a camera_angle_y beside it is rounded more coarsely
        focal = 0.5 * width / float(np.tan(0.5 * angles["camera_angle_x"]))
    else:
        focal = 0.5 * height / float(np.tan(0.5 * angles["camera_angle_y"]))
    return focal, focal
