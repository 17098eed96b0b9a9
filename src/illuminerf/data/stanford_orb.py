"""The folder layout of the Stanford-ORB benchmark (Kuang et al. 2023).

    <root>/blender_HDR/<capture>/{train,test}/0061.exr         photographs, linear
    <root>/blender_LDR/<capture>/{train,test}/0061.png         the same in sRGB
    <root>/blender_*/<capture>/{train,test}_mask/0061.png      white on the object
    <root>/blender_*/<capture>/transforms_{train,test}.json    camera_angle_x in radians; frames of file_path and
                                                               transform_matrix
    <root>/blender_*/<capture>/transforms_novel.json           test views of the object's other captures, in this one's
                                                               world; each frame has scene_name and camera_angle_x
    <root>/ground_truth/<capture>/env_map/0061.exr             the light of a test view, in the axes of its camera
    <root>/ground_truth/<capture>/mesh_blender/mesh.obj        the scanned object in the capture's world

A capture, <object>_scene00x, is one object under one light. Cameras are OpenGL's, images are square.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.data.decoding import image_size
from illuminerf.data.resampling import area_downsampled
from illuminerf.data.source import rigid_pose
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import read_png, read_rgb_exr
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True, eq=False)
class OrbView:
    """A photograph of the benchmark and where it was taken from, in some capture's world."""

    capture: str
    """The capture that it belongs to."""
    name: str
    """Its file's, without suffix: "0061"."""
    split: str
    """train or test."""
    world_from_camera: np.ndarray
    """float64 [4, 4], OpenGL axes."""
    fov_radians: float
    """Horizontal."""


def object_of(capture: str) -> str:
    """teapot of teapot_scene001."""
    return capture.rpartition("_scene")[0] or capture


def find_captures(root: Path, objects: Sequence[str] = ()) -> list[str]:
    """Names of the captures of `objects` (which may be captures' names too), by default of all, in order.

    Raises:
        UserError: `root` is not the benchmark, or an object is not in it.
    """
    folders = sorted(path.parent for path in root.glob("blender_HDR/*/transforms_novel.json"))
    if not folders:
        raise UserError(
            "the benchmark is not where it should be",
            got=f"no blender_HDR/<object>_scene00x/transforms_novel.json in {root}",
            wanted="the folder that holds blender_HDR, blender_LDR and ground_truth",
            fix="unpack Stanford-ORB there, or write a small one with 'illuminerf data synthetic-orb'",
        )
    names = [folder.name for folder in folders]
    for wanted in objects:
        if wanted not in names and wanted not in map(object_of, names):
            raise UserError(
                f"the benchmark has no object {wanted!r}",
                got=f"{', '.join(dict.fromkeys(map(object_of, names)))} in {root}",
                wanted="names of these, or of their captures",
            )
    return [name for name in names if not objects or name in objects or object_of(name) in objects]


def photographs(root: Path, capture: str) -> Path:
    """The folder that the method may learn a capture from: of sRGB photographs, or of linear ones where only they are.

    Raises:
        UserError: there are none.
    """
    for variant in ("blender_LDR", "blender_HDR"):
        folder = root / variant / capture
        if (folder / "transforms_train.json").is_file() and (folder / "train").is_dir():
            return folder
    raise UserError(
        f"the benchmark has no photographs of {capture}",
        got=f"no train/ with transforms_train.json in blender_LDR or blender_HDR of {root}",
        wanted="blender_LDR (or blender_HDR) of this capture",
    )


def own_views(root: Path, capture: str) -> list[OrbView]:
    """The capture's own test views, in its world."""
    return _read_views(root, capture, "test")


def novel_views(root: Path, capture: str) -> dict[str, list[OrbView]]:
    """By capture, the test views of the same object under its other lights, in the world of `capture`."""
    found: dict[str, list[OrbView]] = {}
    for view in _read_views(root, capture, "novel"):
        found.setdefault(view.capture, []).append(view)
    return found


def cameras_of(views: Sequence[OrbView], size: int) -> Cameras:
    """Their cameras for images of `size` x `size` pixels."""
    focal = [0.5 * size / np.tan(0.5 * view.fov_radians) for view in views]
    intrinsics = np.array([[length, length, size / 2, size / 2] for length in focal])
    return Cameras(np.stack([view.world_from_camera for view in views]), intrinsics, size, size)


def photograph_path(root: Path, view: OrbView) -> Path:
    """The linear photograph."""
    return root / "blender_HDR" / view.capture / view.split / f"{view.name}.exr"


def mask_path(root: Path, view: OrbView) -> Path:
    """The mask of the photograph."""
    return root / "blender_HDR" / view.capture / f"{view.split}_mask" / f"{view.name}.png"


def light_path(root: Path, view: OrbView) -> Path:
    """The map of the light, in the axes of the view's camera."""
    return root / "ground_truth" / view.capture / "env_map" / f"{view.name}.exr"


def check_files(root: Path, views: Sequence[OrbView]) -> None:
    """UserError where a view has no photograph, mask or light: found before hours are spent."""
    for view in views:
        for path in (photograph_path(root, view), mask_path(root, view), light_path(root, view)):
            if not path.is_file():
                raise UserError(
                    f"the benchmark lacks a file of {view.capture}",
                    got=f"no {path}",
                    wanted="photograph, mask and light of every test view",
                    fix="unpack blender_HDR and ground_truth of all of the object's captures",
                )


def scored_size(root: Path, view: OrbView, size: int) -> int:
    """Pixels of a side that a photograph is compared at: `size`, or its own where that is less.

    Raises:
        UserError: it is not square.
    """
    path = photograph_path(root, view)
    width, height = image_size(path)
    if width != height:
        raise UserError("a photograph is not square", got=f"{width} x {height} pixels in {path}", wanted="as published")
    return min(size, width)


def load_photograph(root: Path, view: OrbView, size: int) -> np.ndarray:
    """float32 [size, size, 3]: the linear photograph, area-averaged; noise below 0 counts as 0."""
    path = photograph_path(root, view)
    image = read_rgb_exr(path)
    if not np.isfinite(image).all():
        raise UserError("a photograph holds values that are not finite", got=str(path), wanted="finite radiance")
    return np.maximum(_averaged(image, size, path), 0)


def load_mask(root: Path, view: OrbView, size: int) -> np.ndarray:
    """bool [size, size]: where more than half of a pixel shows the object."""
    path = mask_path(root, view)
    return _averaged(read_png(path)[..., :1], size, path)[..., 0] > 0.5


def _averaged(image: np.ndarray, size: int, path: Path) -> np.ndarray:
    if image.shape[0] != image.shape[1] or image.shape[0] < size:
        raise UserError(
            "an image of the benchmark has another size than the others",
            got=f"{image.shape[1]} x {image.shape[0]} pixels in {path}",
            wanted=f"{size} x {size} or more, square",
        )
    return area_downsampled(image, size, size)


def _read_views(root: Path, capture: str, split: str) -> list[OrbView]:
    path = root / "blender_HDR" / capture / f"transforms_{split}.json"
    content = read_json(path)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise UserError("a transforms file lists no frames", got=str(path), wanted='{"frames": [...]}')
    return [_read_view(path, content, frame, index, capture, split) for index, frame in enumerate(frames)]


def _read_view(path: Path, content: dict[str, Any], frame: Any, index: int, capture: str, split: str) -> OrbView:
    where = f"frame {index} of {path}"
    try:
        file = Path(str(frame["file_path"]))
        fov_radians = float(frame.get("camera_angle_x", content.get("camera_angle_x")))
        owner = str(frame["scene_name"]) if split == "novel" else capture
        pose = frame["transform_matrix"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{where} is not complete",
            got=f"{type(error).__name__} {error}",
            wanted="file_path, transform_matrix, camera_angle_x and, of novel views, scene_name",
        ) from error
    if not 0 < fov_radians < np.pi:
        raise UserError(f"{where} has an impossible field of view", got=str(fov_radians), wanted="radians in (0, pi)")
    names = (owner, file.parent.name or "test", file.stem)
    if any(not name or "/" in name or name.startswith(".") for name in names):
        raise UserError(f"{where} names no photograph of the benchmark", got=str(names), wanted="scene_name, test/0061")
    return OrbView(owner, file.stem, names[1], rigid_pose(pose, where), fov_radians)
