"""Light maps of the Stanford-ORB benchmark: measured for each test view, in the axes of its camera."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from illuminerf.data.stanford_orb import OrbView, light_path, own_views
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import read_rgb_exr
from illuminerf.workflow.artefact import fingerprint
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError

LIGHT_AXES_FROM_CAMERA = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""A test view's map is centred on the camera's -z, with +x at the right and +y on top. Ours is centred on +x, with -y
at the right and +z on top: this takes a direction in the camera to the one that holds the same pixel in our maps."""


def load_light(root: Path, view: OrbView, max_height: int = 512) -> EnvironmentMap:
    """The light of a view in the world of its pose, with at most `max_height` rows. Values that no light has (the
    published maps have a few NaN) count as dark."""
    path = light_path(root, view)
    image = read_rgb_exr(path)
    image = np.where(np.isfinite(image), np.maximum(image, 0), 0).astype(np.float32)
    light = EnvironmentMap(image, f"{view.capture}_{view.name}")
    return world_light(light.resized(min(max_height, image.shape[0])), view.world_from_camera)


def world_light(light: EnvironmentMap, world_from_camera: np.ndarray) -> EnvironmentMap:
    """A map in the axes of a camera [4, 4] as one in the world."""
    return light.turned(world_from_camera[:3, :3] @ LIGHT_AXES_FROM_CAMERA.T)


def camera_light(light: EnvironmentMap, world_from_camera: np.ndarray) -> EnvironmentMap:
    """The reverse of `world_light`."""
    return light.turned(LIGHT_AXES_FROM_CAMERA @ world_from_camera[:3, :3].T)


def most_typical(lights: Sequence[EnvironmentMap]) -> int:
    """Which of several maps of one light in one world differs least from all others, in stops averaged over the sphere.

    The paper uses one map per object and lighting and does not say which; an average of maps from a probe that moves
    would blur every lamp.
    """
    small = [light.resized(min(16, light.linear_rgb.shape[0])) for light in lights]
    weights = small[0].solid_angles()
    stops = [np.log2(np.maximum(light.linear_rgb, 1e-3)) for light in small]
    distances = [sum(float((np.abs(one - other) * weights).sum()) for other in stops) for one in stops]
    return int(np.argmin(distances))


def typical_view(root: Path, target: str, views: Sequence[OrbView]) -> int:
    """Which of `views` has the most typical map of the target's light. Maps are compared in the target's own world, so
    that every capture that is relit gets the same."""
    own = {view.name: view for view in own_views(root, target)}
    if not all(view.name in own for view in views):
        raise UserError(f"transforms_test.json of {target} lacks a view that another capture names")
    return most_typical([load_light(root, own[view.name], max_height=32) for view in views])


def write_light(root: Path, view: OrbView, max_height: int, path: Path) -> None:
    """Write what `load_light` gives to `path`, and beside it what it was made from: made once."""
    made_from = {
        "map": fingerprint(light_path(root, view)),
        "world_from_camera": view.world_from_camera.tolist(),
        "max_height": max_height,
    }
    record = path.with_suffix(".json")
    if not (path.is_file() and record.is_file() and read_json(record) == made_from):
        load_light(root, view, max_height).save(path)
        write_json(record, made_from)
