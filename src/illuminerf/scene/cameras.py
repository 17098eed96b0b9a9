"""Pinhole cameras.

OpenGL axes (x right, y up, looking along -z) in a z-up world; `world_from_camera` is 4x4 and rigid.
Pixel (column i, row j) has its centre at (i + 0.5, j + 0.5), rows run downward.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class Cameras:
    """A batch of pinhole cameras that share one image size.

    Attributes:
        world_from_camera: float64 [views, 4, 4], rigid.
        intrinsics: float64 [views, 4] = fx, fy, cx, cy in pixels.
        height: image height in pixels.
        width: image width in pixels.
    """

    world_from_camera: np.ndarray
    intrinsics: np.ndarray
    height: int
    width: int
    _copies: dict[torch.device, tuple[Tensor, ...]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        poses, intrinsics = self.world_from_camera, self.intrinsics
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or intrinsics.shape != (len(poses), 4):
            raise UserError(
                "camera arrays have the wrong shape",
                got=f"{poses.shape} and {intrinsics.shape}",
                wanted="[n,4,4] and [n,4]",
            )
        if not np.isfinite(poses).all() or not np.isfinite(intrinsics).all():
            bad = int(np.flatnonzero(~np.isfinite(poses).all((1, 2)) | ~np.isfinite(intrinsics).all(1))[0])
            raise UserError(
                f"camera {bad} has NaN or infinite values", fix="estimate that pose again or remove the view"
            )
        rotations = poses[:, :3, :3]
        drift = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
        drift = np.where(np.linalg.det(rotations) > 0, drift, np.inf)
        if len(poses) and drift.max() > 1e-3:
            bad = int(drift.argmax())
            raise UserError(
                f"camera {bad} is not a rigid pose",
                got=f"a 3x3 block that is {drift[bad]:.3g} away from a rotation",
                wanted="a rotation (orthonormal, determinant +1)",
                fix="remove any scale or mirroring from the poses",
            )
        if len(intrinsics) and intrinsics[:, :2].min() <= 0:
            raise UserError("a camera has no positive focal length", got=f"{intrinsics[:, :2].min():.3g} pixels")

    def __len__(self) -> int:
        return len(self.world_from_camera)

    def __getitem__(self, index: int | slice | list[int] | np.ndarray) -> "Cameras":
        if isinstance(index, (int, np.integer)):
            index = [int(index)]
        return Cameras(self.world_from_camera[index], self.intrinsics[index], self.height, self.width)

    @property
    def positions(self) -> np.ndarray:
        """Camera centres in the world, float64 [views, 3]."""
        return self.world_from_camera[:, :3, 3]

    def resized(self, height: int, width: int) -> "Cameras":
        """The same views with another number of pixels."""
        scale = np.array([width / self.width, height / self.height] * 2)
        return Cameras(self.world_from_camera, self.intrinsics * scale, height, width)

    def transformed(self, scale: float, offset: np.ndarray) -> "Cameras":
        """The same cameras in a world where p became (p + offset) * scale."""
        poses = self.world_from_camera.copy()
        poses[:, :3, 3] = (poses[:, :3, 3] + np.asarray(offset, np.float64)) * scale
        return Cameras(poses, self.intrinsics, self.height, self.width)

    def rays(
        self, view_index: Int[Tensor, " rays"], pixels_xy: Float[Tensor, "rays 2"]
    ) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"]]:
        """World origins and unit directions of the rays through image points, on the device of the index."""
        all_poses, all_intrinsics = self._on(view_index.device)
        poses = all_poses[view_index]
        fx, fy, cx, cy = all_intrinsics[view_index].unbind(-1)
        x, y = pixels_xy.double().unbind(-1)
        in_camera = torch.stack([(x - cx) / fx, -(y - cy) / fy, -torch.ones_like(x)], -1)
        directions = torch.einsum("rij,rj->ri", poses[:, :3, :3], in_camera)
        directions = directions / directions.norm(dim=-1, keepdim=True)
        return poses[:, :3, 3].float(), directions.float()

    def _on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Poses and intrinsics on a device, copied there once."""
        if device not in self._copies:
            both = self.world_from_camera, self.intrinsics
            self._copies[device] = tuple(torch.from_numpy(values).to(device) for values in both)
        poses, intrinsics = self._copies[device]
        return poses, intrinsics

    def image_rays(self, view: int) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 3"]]:
        """Origins and unit directions of all pixel centres of one view."""
        pixels_xy = pixel_centres(self.height, self.width).reshape(-1, 2)
        index = torch.full((len(pixels_xy),), view, dtype=torch.long)
        origins, directions = self.rays(index, pixels_xy)
        shape = (self.height, self.width, 3)
        return origins.reshape(shape), directions.reshape(shape)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image points [views, points, 2] and depths along the axis [views, points] of points [points, 3]."""
        camera_from_world = np.linalg.inv(self.world_from_camera)
        in_camera = np.einsum("vij,pj->vpi", camera_from_world[:, :3, :3], points) + camera_from_world[:, None, :3, 3]
        depth = -in_camera[..., 2]
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        fx, fy, cx, cy = (self.intrinsics[:, None, i] for i in range(4))
        return np.stack([fx * in_camera[..., 0] / safe + cx, -fy * in_camera[..., 1] / safe + cy], -1), depth

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return {
            "height": self.height,
            "width": self.width,
            "frames": [
                {
                    "world_from_camera": pose.tolist(),
                    "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), k.tolist(), strict=True)),
                }
                for pose, k in zip(self.world_from_camera, self.intrinsics, strict=True)
            ],
        }

    @staticmethod
    def from_dict(content: Any) -> "Cameras":
        """Read what `to_dict` made.

        Raises:
            UserError: a key is missing or a value is not what it should be.
        """
        try:
            frames = content["frames"]
            poses = np.array([frame["world_from_camera"] for frame in frames], np.float64).reshape(len(frames), 4, 4)
            names = ("fx", "fy", "cx", "cy")
            intrinsics = np.array([[frame["intrinsics"][n] for n in names] for frame in frames], np.float64)
            height, width = int(content["height"]), int(content["width"])
            if min(height, width) < 1:
                raise ValueError(f"{width} x {height} pixels")
            return Cameras(poses, intrinsics.reshape(len(frames), 4), height, width)
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            raise UserError(
                "cameras are not in the expected form",
                got=f"{type(error).__name__}: {error}",
                wanted="height, width, frames with world_from_camera (4x4) and intrinsics {fx, fy, cx, cy}",
            ) from error


def pixel_centres(height: int, width: int) -> Float[Tensor, "height width 2"]:
    """Image points (x, y) of all pixel centres."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([columns, rows], -1).float() + 0.5


def look_at(position: np.ndarray, target: np.ndarray, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """`world_from_camera` [4, 4] of a camera at `position` that looks at `target`."""
    position, target = np.asarray(position, np.float64), np.asarray(target, np.float64)
    backward = position - target
    backward /= np.linalg.norm(backward)
    right = np.cross(np.asarray(up, np.float64), backward)
    if np.linalg.norm(right) < 1e-6:  # looking along `up`: any right vector will do
        right = np.cross([0.0, 1.0, 0.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], -1)
    pose[:3, 3] = position
    return pose


def _cameras_at(positions: np.ndarray, fov_radians: float, height: int, width: int) -> Cameras:
    focal = 0.5 * width / np.tan(0.5 * fov_radians)
    poses = np.stack([look_at(position, np.zeros(3)) for position in positions])
    intrinsics = np.tile(np.array([focal, focal, width / 2, height / 2], np.float64), (len(positions), 1))
    return Cameras(poses, intrinsics, height, width)


def sphere_cameras(
    num_views: int,
    radius: float,
    fov_radians: float,
    height: int,
    width: int,
    generator: np.random.Generator,
    min_elevation_radians: float = -np.pi / 2,
    max_elevation_radians: float = np.pi / 2,
) -> Cameras:
    """Cameras that look at the origin from uniformly random places on a sphere (or a band of it)."""
    low, high = np.sin(min_elevation_radians), np.sin(max_elevation_radians)
    z = generator.uniform(low, high, num_views)
    azimuth = generator.uniform(-np.pi, np.pi, num_views)
    ring = np.sqrt(1 - z**2)
    positions = radius * np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], -1)
    return _cameras_at(positions, fov_radians, height, width)


def spiral_cameras(
    num_views: int,
    radius: float,
    fov_radians: float,
    height: int,
    width: int,
    min_elevation_radians: float,
    max_elevation_radians: float,
) -> Cameras:
    """Cameras that look at the origin from evenly spread places on a band of a sphere (a golden spiral)."""
    low, high = np.sin(min_elevation_radians), np.sin(max_elevation_radians)
    z = low + (high - low) * (np.arange(num_views) + 0.5) / num_views
    azimuth = np.arange(num_views) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    positions = radius * np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], -1)
    return _cameras_at(positions, fov_radians, height, width)


def turntable_cameras(
    num_views: int,
    radius: float,
    fov_radians: float,
    height: int,
    width: int,
    elevation_radians: float = np.pi / 6,
) -> Cameras:
    """Cameras on a circle of constant elevation, counter-clockwise seen from above, starting at azimuth 0."""
    azimuth = np.arange(num_views) * (2 * np.pi / num_views)
    ring, z = np.cos(elevation_radians), np.full(num_views, np.sin(elevation_radians))
    positions = radius * np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], -1)
    return _cameras_at(positions, fov_radians, height, width)
