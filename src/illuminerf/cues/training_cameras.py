"""Cameras of training items: on a sphere, with the paper's focal length or one that fills the picture."""

from dataclasses import dataclass

import numpy as np

from illuminerf.scene.cameras import Cameras, sphere_cameras
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class CameraSphere:
    """Where the cameras of an object stand."""

    min_distance: float = 2.6
    """Nearest camera, in radii of the object."""
    max_distance: float = 3.8
    """Farthest camera."""
    min_elevation_radians: float = -0.4
    """Lowest camera. Deviation: the paper takes the whole sphere (-pi / 2); captures are seldom made from below."""
    focal_length: float | None = None
    """In widths of the picture (paper: 1, 512 pixels at 512 x 512); None: so that the object just fills the picture.
    Deviation: the paper's is fixed. Photographs are cut to the object before this project's model sees them."""
    margin: float = 1.06
    """Where the object fills the picture: half the picture over the object's farthest point from its centre."""

    def __post_init__(self) -> None:
        if not 1 < self.min_distance <= self.max_distance:
            raise UserError("camera distances must be over 1 and in order")
        if not -np.pi / 2 <= self.min_elevation_radians < np.pi / 2:
            raise UserError("the lowest elevation must lie in [-pi / 2, pi / 2)")
        if (self.focal_length is not None and self.focal_length <= 0) or self.margin < 1:
            raise UserError("the focal length must be positive and the margin at least 1")

    @staticmethod
    def paper() -> "CameraSphere":
        """Focal length 512 at 512 x 512 anywhere on a sphere, whose radius the paper does not say: 2.3 shows all."""
        return CameraSphere(2.3, 2.3, -np.pi / 2, 1.0)


def draw_camera(sphere: CameraSphere, size: int, vertices: np.ndarray, generator: np.random.Generator) -> Cameras:
    """One camera that looks at the centre of an object.

    Args:
        sphere: distances, elevations, focal length.
        size: height and width in pixels.
        vertices: the object's points [vertices, 3], in the unit sphere.
        generator: draws distance and direction.
    """
    distance = float(generator.uniform(sphere.min_distance, sphere.max_distance))
    low = sphere.min_elevation_radians
    camera = sphere_cameras(1, distance, np.pi / 2, size, size, generator, min_elevation_radians=low)
    intrinsics = camera.intrinsics.copy()
    if sphere.focal_length is None:
        points, _ = camera.project(vertices)
        intrinsics[:, :2] = size / 2 / (np.abs(points[0] / (size / 2) - 1).max() * sphere.margin)
    else:
        intrinsics[:, :2] = size * sphere.focal_length
    return Cameras(camera.world_from_camera, intrinsics, size, size)
