"""Masks of a ball, for tests of bounds and rays."""

import numpy as np

from illuminerf.fields.bounds import ball_interval
from illuminerf.scene.cameras import Cameras, sphere_cameras


def sphere_views(radius: float, num_views: int = 24) -> tuple[Cameras, np.ndarray]:
    """Masks of a sphere about the origin, seen from a distance of 3."""
    cameras = sphere_cameras(num_views, 3.0, 0.8, 48, 48, np.random.default_rng(0))
    masks = []
    for view in range(num_views):
        origins, directions = cameras.image_rays(view)
        near, far = ball_interval(origins.reshape(-1, 3), directions.reshape(-1, 3), radius)
        masks.append((far > near).reshape(48, 48).numpy())
    return cameras, np.stack(masks).astype(np.float32)
