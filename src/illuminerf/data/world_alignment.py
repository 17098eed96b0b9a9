"""Worlds of cameras: which way is up in one, and how two of the same cameras lie to each other.

Structure from motion gives cameras in a world of arbitrary place, turn and scale. People hold cameras level: the right
axis of every camera is then perpendicular to the vertical, wherever it looks, and the vertical is what is most nearly
perpendicular to all of them.
"""

from dataclasses import dataclass

import numpy as np

from illuminerf.data.placement import nearest_point_to_rays
from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.errors import UserError

_ROUNDS = 30
_LEAST_TURN = 0.02  # of the right axes: the ratio of variances below which they count as one direction


@dataclass(frozen=True)
class Similarity:
    """p' = scale * rotation @ p + translation.

    Attributes:
        scale: positive.
        rotation: float64 [3, 3].
        translation: float64 [3].
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """[*points, 3] moved."""
        return self.scale * points @ self.rotation.T + self.translation

    def poses(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Rigid poses [views, 4, 4] in the other world: turned and moved, while the camera keeps its size."""
        moved = world_from_camera.copy()
        moved[:, :3, :3] = self.rotation @ world_from_camera[:, :3, :3]
        moved[:, :3, 3] = self.points(world_from_camera[:, :3, 3])
        return moved


def similarity_between(source: np.ndarray, target: np.ndarray) -> Similarity:
    """The similarity with least squared distance of `source` [points, 3], moved, to `target` [points, 3] (Umeyama 1991,
    eqs. 40 to 42).

    Raises:
        UserError: fewer than three points, or all on one line.
    """
    from_middle, to_middle = source.mean(0), target.mean(0)
    centred = source - from_middle
    if len(source) < 3 or np.linalg.matrix_rank(centred, tol=1e-9 * max(np.abs(centred).max(), 1e-30)) < 2:
        raise UserError(
            "two worlds cannot be aligned", got=f"{len(source)} cameras in a line", wanted="3 or more, apart"
        )
    u, singular, vt = np.linalg.svd((target - to_middle).T @ centred / len(source))
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float((singular * signs).sum() / (centred**2).sum(-1).mean())
    return Similarity(scale, rotation, to_middle - scale * rotation @ from_middle)


def pose_errors(estimated: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of poses [views, 4, 4] after the best similarity of the camera centres: the angle in degrees per view, and
    the distance of the centres divided by the true cameras' mean distance from where they look.
    """
    moved = similarity_between(estimated[:, :3, 3], true[:, :3, 3]).poses(estimated)
    focus = nearest_point_to_rays(true[:, :3, 3], -true[:, :3, 2])
    distance = np.linalg.norm(true[:, :3, 3] - focus, axis=-1).mean()
    apart = np.linalg.norm(moved[:, :3, 3] - true[:, :3, 3], axis=-1)
    return angles_degrees(moved[:, :3, :3], true[:, :3, :3]), apart / distance


def angles_degrees(rotation: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Angles between rotations [views, 3, 3]; exact for small ones, where the cosine of the trace is not."""
    chord = np.linalg.norm(rotation - other, axis=(-2, -1)) / (2 * np.sqrt(2))
    return np.asarray(np.degrees(2 * np.arcsin(np.clip(chord, 0, 1))))


def up_axis(world_from_camera: np.ndarray) -> np.ndarray:
    """The unit vector [3] most nearly perpendicular to the right axes of all cameras [views, 4, 4], on the side of
    their up axes.

    Distances to a plane are summed, not their squares, so that a few photographs taken on their side do not turn it.
    Cameras that all look one way leave it open; then it is as near to their mean up axis as it can be.
    """
    right, up = world_from_camera[:, :3, 0], world_from_camera[:, :3, 1]
    mean_up = up.mean(0)
    weights = np.ones(len(right))
    for _ in range(_ROUNDS):
        values, vectors = np.linalg.eigh(np.einsum("v,vi,vj->ij", weights, right, right))
        vertical = vectors[:, 0]
        if values[1] < _LEAST_TURN * values[2]:
            sideways = vectors[:, 2]
            vertical = mean_up - (mean_up @ sideways) * sideways
            break
        weights = 1 / np.maximum(np.abs(right @ vertical), 1e-3)
    vertical = vertical if np.linalg.norm(vertical) > 1e-9 else up[0]
    vertical = vertical / np.linalg.norm(vertical)
    return np.asarray(vertical if vertical @ mean_up >= 0 else -vertical)


def rotation_to_z(up: np.ndarray, front: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] that makes the unit vector `up` +z and brings `front` [3] to the half plane of -y."""
    ahead = front - (front @ up) * up
    if np.linalg.norm(ahead) < 1e-6 * max(float(np.linalg.norm(front)), 1e-30):  # straight above: any turn will do
        ahead = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    back = -ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(back, up), back, up])


def levelled(cameras: Cameras, up: np.ndarray, middle: np.ndarray) -> Similarity:
    """The turn and shift to a z-up world about `middle` [3], seen by the first camera from the front (-y)."""
    rotation = rotation_to_z(up, cameras.positions[0] - middle)
    return Similarity(1.0, rotation, -rotation @ middle)
