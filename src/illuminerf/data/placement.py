"""Where the object is: the scale and offset that bring a capture into the unit ball.

With masks the object lies in their visual hull (Laurentini 1994), carved on a coarse grid with masks grown
by a voxel's footprint, so that thin parts survive. Without masks it is taken to be where the optical axes
meet, as large as the ball that fits into the typical camera's view. World axes are kept: z stays up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.errors import UserError

GRID = 48
MAX_DISAGREEING = 0.05
"""Share of the views that see a voxel and may miss it, so that one bad mask does not carve the object
away.
"""
MIN_SEEING = 0.25
"""Share of all views that must have a voxel in frame; less is no evidence for the object."""


@dataclass(frozen=True)
class Ball:
    """A ball in the caller's world."""

    centre: np.ndarray
    radius: float

    def placement(self, object_radius: float) -> tuple[float, np.ndarray]:
        """(scale, offset) of p' = (p + offset) * scale that gives the ball the radius `object_radius` about
        0.
        """
        return object_radius / self.radius, -self.centre


def focus_ball(cameras: Cameras) -> Ball:
    """The ball about the point closest to all optical axes that fits into the median camera's view."""
    axes = -cameras.world_from_camera[:, :3, 2]
    centre = nearest_point_to_rays(cameras.positions, axes)
    towards = centre - cameras.positions
    if np.mean(np.sum(towards * axes, -1) > 0) < 0.5:
        raise UserError(
            "the cameras look away from each other",
            got="optical axes that meet behind most cameras",
            wanted="views from around one object, poses with OpenGL axes (the camera looks along -z)",
            fix="if the poses have OpenCV axes, negate the second and third column of every matrix",
        )
    fx, fy, cx, cy = cameras.intrinsics.T
    margins = np.stack([cx / fx, (cameras.width - cx) / fx, cy / fy, (cameras.height - cy) / fy])
    half_angles = np.arctan(np.maximum(margins.min(axis=0), 1e-3))
    return Ball(centre, float(np.median(np.linalg.norm(towards, axis=-1) * np.sin(half_angles))))


def nearest_point_to_rays(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The point with the least sum of distances to the lines [lines, 3], by reweighted least squares.

    Raises UserError where the lines are parallel, for then there is no such point.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights = np.ones(len(origins))
    point = origins.mean(axis=0)
    for _ in range(20):
        matrix = np.einsum("l,lij->ij", weights, across)
        eigenvalues = np.linalg.eigvalsh(matrix)
        if eigenvalues[0] < 1e-5 * eigenvalues[-1]:
            raise UserError(
                "all cameras look in one direction, so the object's distance is unknown",
                got=f"{len(origins)} parallel optical axes",
                wanted="views from around the object",
            )
        point = np.linalg.solve(matrix, np.einsum("l,lij,lj->i", weights, across, origins))
        distances = np.linalg.norm(np.einsum("lij,lj->li", across, point - origins), axis=-1)
        weights = 1 / np.maximum(distances, 1e-3 * np.linalg.norm(point - origins, axis=-1).mean() + 1e-12)
    return point


def hull_ball(cameras: Cameras, masks: Sequence[np.ndarray]) -> Ball:
    """The ball about the visual hull of `masks`: one bool [rows, columns] per camera, of any resolution.

    Where no camera looks from below (or above), the hull runs on into a cone behind the object. Then the ball that
    the outlines ask for is the smaller one, and it is taken.
    """
    carved, outlined = _carved_ball(cameras, masks), outline_ball(cameras, masks)
    return outlined if outlined.radius < carved.radius else carved


def outline_ball(cameras: Cameras, masks: Sequence[np.ndarray]) -> Ball:
    """The ball about the point nearest to the rays through the masks' middles that covers every mask."""
    centre, spread, off_axis = _outlines(cameras, masks)
    return Ball(centre, float((spread + off_axis).max()))


def _carved_ball(cameras: Cameras, masks: Sequence[np.ndarray]) -> Ball:
    centre, spread, _ = _outlines(cameras, masks)
    ball = Ball(centre, 1.3 * float(np.median(spread)))
    for _ in range(6):  # until the hull lies inside the grid: the first guess rests on the outlines alone
        kept, step = _carve(cameras, masks, ball)
        outermost = np.abs(kept - ball.centre).max() if len(kept) else 0.0
        if outermost < ball.radius - 1.5 * step:
            break
        ball = Ball(ball.centre, ball.radius * 1.5)
    for _ in range(2):
        ball = _ball_around(kept, step)
        kept, step = _carve(cameras, masks, Ball(ball.centre, ball.radius * 1.05))
    return _ball_around(kept, step)


def _ball_around(voxels: np.ndarray, step: float) -> Ball:
    if not len(voxels):
        raise UserError(
            "masks and poses do not agree",
            got="no point in space that lies inside the masks of all views",
            wanted="masks of one object that does not move, white on the object, and OpenGL poses (looking along -z)",
            fix="check the masks are not inverted; negate columns 2 and 3 of OpenCV poses",
        )
    centre = (voxels.min(axis=0) + voxels.max(axis=0)) / 2
    return Ball(centre, float(np.linalg.norm(voxels - centre, axis=-1).max() + step / 2))


def _outlines(cameras: Cameras, masks: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The point nearest to the rays through the masks' middles; per mask its radius at that point's distance, and by
    how much its ray misses the point, in world units.
    """
    directions, spreads = [], []
    for view, mask in enumerate(masks):
        rows, columns = np.nonzero(mask)
        x = (columns + 0.5) * (cameras.width / mask.shape[1])
        y = (rows + 0.5) * (cameras.height / mask.shape[0])
        fx, fy, cx, cy = cameras.intrinsics[view]
        plane = np.stack([(x - cx) / fx, -(y - cy) / fy, -np.ones_like(x)], -1)
        middle = (plane.min(axis=0) + plane.max(axis=0)) / 2
        spreads.append(float(np.linalg.norm(plane - middle, axis=-1).max()))
        world = cameras.world_from_camera[view, :3, :3] @ middle
        directions.append(world / np.linalg.norm(world))
    rays = np.stack(directions)
    centre = nearest_point_to_rays(cameras.positions, rays)
    away = centre - cameras.positions
    distance = np.linalg.norm(away, axis=-1)
    off_axis = np.linalg.norm(away - np.sum(away * rays, axis=-1, keepdims=True) * rays, axis=-1)
    return centre, distance * np.array(spreads), off_axis


def _carve(cameras: Cameras, masks: Sequence[np.ndarray], ball: Ball) -> tuple[np.ndarray, float]:
    """(centres [voxels, 3] of the voxels in the hull, voxel size) on a cubic grid around `ball`."""
    axis = (np.arange(GRID) + 0.5) / GRID * 2 - 1
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points = ball.centre + ball.radius * cube
    step = 2 * ball.radius / GRID
    seen = np.zeros(len(points), np.int32)
    hit = np.zeros(len(points), np.int32)
    for view, mask in enumerate(masks):
        pixels, depth = (values[0] for values in cameras[view].project(points))
        to_mask = np.array([mask.shape[1] / cameras.width, mask.shape[0] / cameras.height])
        columns, rows = np.floor(pixels * to_mask).astype(np.int64).T
        inside = (depth > 0) & (columns >= 0) & (columns < mask.shape[1]) & (rows >= 0) & (rows < mask.shape[0])
        distance = max(float(np.linalg.norm(ball.centre - cameras.positions[view])) - ball.radius, step)
        footprint = 0.87 * step / distance * float(cameras.intrinsics[view, 0]) * float(to_mask[0])
        grown = ndimage.maximum_filter(mask, size=2 * int(np.ceil(min(footprint, max(mask.shape)))) + 1)
        seen += inside
        hit[inside] += grown[rows[inside], columns[inside]]
    enough = seen >= max(2, MIN_SEEING * len(masks))
    return points[enough & (hit >= seen - np.floor(MAX_DISAGREEING * seen))], step


def mask_preview(mask: np.ndarray, longest_side: int = 200) -> np.ndarray:
    """bool, at most `longest_side` pixels: where any pixel of the cell of `mask` [height, width] is True."""
    factor = int(np.ceil(max(mask.shape) / longest_side))
    rows, columns = (-(-side // factor) for side in mask.shape)
    # Cells of equal size over the whole image, so that the preview has the same field of view.
    row_of = np.arange(mask.shape[0]) * rows // mask.shape[0]
    column_of = np.arange(mask.shape[1]) * columns // mask.shape[1]
    out = np.zeros((rows, columns), bool)
    marked_rows, marked_columns = np.nonzero(mask)
    out[row_of[marked_rows], column_of[marked_columns]] = True
    return out
