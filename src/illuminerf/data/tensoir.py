"""The folder layout of the TensoIR-Synthetic benchmark (Jin et al. 2023).

    <root>/<scene>/train_000/{rgba_<light>.png, metadata.json}    the input views, used under one light
    <root>/<scene>/test_000/{rgba_<light>.png, metadata.json}     the test views, under every light

`metadata.json` holds cam_transform_mat (16 comma-separated numbers, row by row, OpenGL axes), cam_angle_x
(the horizontal field of view in radians), imw and imh (pixels). Images are straight RGBA in sRGB.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.data.decoding import image_size, read_straight
from illuminerf.data.source import (
    SourceCapture,
    SourceFrame,
    checked_camera,
    checked_capture,
    file_inside,
    natural_order,
    rigid_pose,
)
from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError

INPUT_LIGHT = "sunset"


@dataclass(frozen=True)
class TensoirView:
    """One view of the benchmark on disk."""

    name: str
    folder: Path

    def image(self, light: str) -> Path:
        """Path of the view's image under `light`; UserError names the lights there are."""
        path = self.folder / f"rgba_{light}.png"
        if not path.is_file():
            raise UserError(
                f"{self.folder} has no image under the light {light!r}",
                got=f"lights {', '.join(self.lights()) or 'none'}",
                wanted=path.name,
                fix="name one of these lights, or unpack the missing one",
            )
        return path

    def lights(self) -> list[str]:
        """The lights this view has an image under."""
        return sorted(path.stem.removeprefix("rgba_") for path in self.folder.glob("rgba_*.png"))


def is_tensoir_scene(scene: Path) -> bool:
    """True where `scene` looks like one scene of the benchmark."""
    return any(scene.glob("train_*/metadata.json")) or any(scene.glob("test_*/metadata.json"))


def find_views(scene: Path, split: str, every: int = 1) -> list[TensoirView]:
    """The views of `split` ("train" or "test") whose number is a multiple of `every`, in order."""
    folders = [path for path in scene.glob(f"{split}_*") if (path / "metadata.json").is_file()]
    folders = [path for path in folders if path.name.removeprefix(f"{split}_").isdigit()]
    folders.sort(key=lambda path: natural_order(path.name))
    views = [TensoirView(path.name, path) for path in folders if int(path.name.rsplit("_", 1)[1]) % every == 0]
    if not views:
        raise UserError(
            f"the benchmark scene has no {split} views",
            got=f"no {split}_<number>/metadata.json (every {every}) in {scene}",
            wanted="the layout of TensoIR-Synthetic",
            fix="give the folder of one scene, such as hotdog",
        )
    return views


def read_scene(scene: Path, light: str = INPUT_LIGHT, split: str = "train") -> SourceCapture:
    """The input views of a scene under `light`."""
    frames = []
    for view in find_views(scene, split):
        image = file_inside(scene, f"{view.name}/{view.image(light).name}", view.folder)
        size = image_size(image)
        pose, focal = _read_metadata(view, size)
        camera = checked_camera(view.name, size, (focal, focal), (size[0] / 2, size[1] / 2))
        frames.append(SourceFrame(view.name, image, None, pose, camera))
    return checked_capture(scene, frames, shares_intrinsics=True)


def _read_metadata(view: TensoirView, size: tuple[int, int]) -> tuple[np.ndarray, float]:
    """(world_from_camera, focal length in pixels at `size`)."""
    path = view.folder / "metadata.json"
    content: Any = read_json(path)
    try:
        matrix = content["cam_transform_mat"]
        values = [float(value) for value in matrix.split(",")] if isinstance(matrix, str) else matrix
        fov_radians = float(content["cam_angle_x"])
        declared = (int(content.get("imw", size[0])), int(content.get("imh", size[1])))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(
            "the metadata of a benchmark view is not what it should be",
            got=f"{type(error).__name__} {error} in {path}",
            wanted="cam_transform_mat, cam_angle_x, imw and imh",
        ) from error
    if not 0 < fov_radians < np.pi:
        raise UserError("a field of view is impossible", got=f"cam_angle_x {fov_radians} in {path}", wanted="(0, pi)")
    if min(declared) < 1 or abs(declared[0] * size[1] - declared[1] * size[0]) > max(*declared, *size):
        raise UserError(
            "a benchmark image has another shape than its metadata says",
            got=f"{size[0]} x {size[1]} pixels in {view.folder}",
            wanted=f"the aspect of {declared[0]} x {declared[1]}",
        )
    return rigid_pose(values, str(path)), 0.5 * size[0] / np.tan(0.5 * fov_radians)


def load_test_cameras(scene: Path, every: int = 1, size: tuple[int, int] | None = None) -> tuple[list[str], Cameras]:
    """Names and cameras of the test views whose number is a multiple of `every`, in the benchmark's world.

    `size` is (height, width) in pixels; by default that of the images on disk (or of the metadata where
    there are no images). Bring them into a capture's unit ball with `cameras.transformed(capture.scale,
    capture.offset)`.
    """
    views = find_views(scene, "test", every)
    poses, focals, sizes = [], [], set()
    for view in views:
        lights = view.lights()
        if lights:
            stored = image_size(view.image(lights[0]))
        else:
            content = read_json(view.folder / "metadata.json")
            stored = (int(content["imw"]), int(content["imh"]))
        pose, focal = _read_metadata(view, stored)
        poses.append(pose)
        focals.append(focal)
        sizes.add(stored)
    if len(sizes) > 1:
        raise UserError(f"the test views of {scene} differ in size", got=str(sorted(sizes)), wanted="one size")
    width, height = sizes.pop()
    intrinsics = np.array([[focal, focal, width / 2, height / 2] for focal in focals])
    cameras = Cameras(np.stack(poses), intrinsics, height, width)
    return [view.name for view in views], cameras.resized(*size) if size else cameras


def load_test_image(scene: Path, name: str, light: str) -> np.ndarray:
    """float32 [height, width, 4]: straight sRGB and alpha of the test view `name` under `light`."""
    return read_straight(TensoirView(name, scene / name).image(light))


def find_test_views(scene: Path, lights: Sequence[str], every: int = 1) -> list[str]:
    """Names of the test views whose number is a multiple of `every`, checked to have an image under each
    light.
    """
    views = find_views(scene, "test", every)
    for view in views:
        for light in lights:
            view.image(light)
    return [view.name for view in views]
