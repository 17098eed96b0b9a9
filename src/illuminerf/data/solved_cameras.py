"""Cameras and points that structure from motion found, and how they are read off a pycolmap.Reconstruction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class SolvedCamera:
    """One photograph's camera.

    Attributes:
        world_from_camera: float64 [4, 4], OpenGL axes, in a world of arbitrary turn and scale.
        intrinsics: fx, fy, cx, cy in pixels of the matching image.
        distortion: OpenCV's k1, k2, p1, p2, k3.
        num_points: how many of the points it sees.
        error: mean reprojection error in pixels of the matching image.
    """

    world_from_camera: np.ndarray
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, float, float, float, float]
    num_points: int
    error: float


@dataclass(frozen=True)
class Solved:
    """What an attempt found: cameras by the index of their image, and points with sRGB colours.

    Attributes:
        cameras: those that could be placed.
        points: float64 [points, 3].
        colours: uint8 [points, 3].
        attempt: which one it was, in words.
    """

    cameras: dict[int, SolvedCamera]
    points: np.ndarray
    colours: np.ndarray
    attempt: str


def solved_from(model: Any, names: Sequence[str], attempt: str) -> Solved:
    """What this project needs of a pycolmap.Reconstruction; `names` are those of its images, in order."""
    index_of = {name: index for index, name in enumerate(names)}
    model.update_point_3d_errors()
    cameras = {}
    for number in model.reg_image_ids():
        image = model.image(number)
        cameras[index_of[image.name]] = _solved_camera(image, model)
    points = [model.point3D(number) for number in sorted(model.point3D_ids())]
    places = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    colours = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
    return Solved(dict(sorted(cameras.items())), places, colours, attempt)


def _solved_camera(image: Any, model: Any) -> SolvedCamera:
    camera_from_world = np.eye(4)
    camera_from_world[:3] = image.cam_from_world().matrix()
    world_from_camera = np.linalg.inv(camera_from_world)
    world_from_camera[:3, 1:3] *= -1  # COLMAP's cameras look along +z with y down
    values = [float(value) for value in image.camera.params]
    if len(values) == 4:  # SIMPLE_RADIAL
        focal, cx, cy, k1 = values
        intrinsics, distortion = (focal, focal, cx, cy), (k1, 0.0, 0.0, 0.0, 0.0)
    else:  # OPENCV
        fx, fy, cx, cy, k1, k2, p1, p2 = values
        intrinsics, distortion = (fx, fy, cx, cy), (k1, k2, p1, p2, 0.0)
    seen = [model.point3D(point.point3D_id).xyz for point in image.points2D if point.has_point3D()]
    shown = [point.xy for point in image.points2D if point.has_point3D()]
    error = float("nan")
    if seen:
        in_camera = np.array(seen) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        projected = image.camera.img_from_cam(in_camera)
        error = float(np.linalg.norm(projected - np.array(shown), axis=-1).mean())
    return SolvedCamera(world_from_camera, intrinsics, distortion, len(seen), error)
