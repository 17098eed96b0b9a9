"""A patterned ball photographed from a ring, with poses known: what structure from motion is tried on."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from illuminerf.scene.cameras import Cameras, look_at

RADIUS = 1.0
_SIDE = 28


def ring_cameras(num_views: int, size: int, distance: float = 3.6) -> Cameras:
    """Level cameras in steps of 15 degrees, going up and down a little."""
    azimuth = np.radians(15.0 * np.arange(num_views))
    height = 0.8 + 0.5 * np.sin(2.1 * np.arange(num_views))
    positions = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], -1)
    poses = np.stack([look_at(position, np.zeros(3)) for position in positions])
    intrinsics = np.tile([1.3 * size, 1.3 * size, size / 2, size / 2], (num_views, 1))
    return Cameras(poses, intrinsics, size, size)


def patterned_ball(cameras: Cameras, view: int) -> np.ndarray:
    """float32 [height, width, 4]: a ball with a coarse random pattern, sRGB and alpha."""
    origins, directions = (rays.double().numpy() for rays in cameras.image_rays(view))
    along = -(origins * directions).sum(-1)
    gap = (origins**2).sum(-1) - along**2
    hit = gap < RADIUS**2
    places = origins + (along - np.sqrt(np.maximum(RADIUS**2 - gap, 0)))[..., None] * directions
    noise = np.random.default_rng(5).uniform(0.05, 0.95, (3, _SIDE, _SIDE, _SIDE))
    cells = ((places / RADIUS + 1) / 2 * (_SIDE - 1)).transpose(2, 0, 1)
    colour = np.stack([ndimage.map_coordinates(channel, cells, order=1, mode="nearest") for channel in noise], -1)
    return np.concatenate([colour * hit[..., None], hit[..., None]], -1).astype(np.float32)


def write_photographs(folder: Path, cameras: Cameras, with_alpha: bool = True) -> list[np.ndarray]:
    """IMG_<number>.png with alpha, or before a plain green wall; returns the images with alpha."""
    folder.mkdir(parents=True)
    images = [patterned_ball(cameras, view) for view in range(len(cameras))]
    for view, image in enumerate(images):
        wall = np.array([0.1, 0.7, 0.2]) * (1 - image[..., 3:])
        shown = image if with_alpha else image[..., :3] + wall
        Image.fromarray(np.round(shown * 255).astype(np.uint8)).save(folder / f"IMG_{view + 1}.png")
    return images
