"""Photographs before a plain backdrop of any colour: which pixels show the object, and how much of it.

The backdrop's colour is what most of the images' borders show, over the whole capture; within a view it may change
evenly from side to side, as a lit wall does. Background is what looks like it and is connected to the border, so
highlights and paint of the same colour inside the object stay. Enclosed areas of exactly the backdrop's flat colour
are holes that one looks through, unless the backdrop is white or black: clipped highlights and deep shadows are too.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from illuminerf.data.decoding import read_straight
from illuminerf.data.source import SourceFrame
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear
from illuminerf.scene.views import spread_evenly
from illuminerf.workflow.errors import UserError

MIN_TOLERANCE, MAX_TOLERANCE = 8 / 255, 32 / 255
"""How far, in any channel, a pixel may be from the backdrop and still be part of it; what is uneven gets more, and what
would need more than the most is not plain."""
_NEAR = 0.15  # border pixels further from the common colour are object, not unevenness
_BORDER_SHARE = 0.02
_PIXELS_PER_VIEW = 4000
_VIEWS_ASKED = 24
_LEAST_PLAIN_BORDER, _LEAST_PLAIN_BORDER_OF_VIEW = 0.6, 0.2
_EXTREME = 0.03
_LEAST_HOLE, _LEAST_PART = 2e-4, 0.01  # shares of the image, of the largest part
_LEAST_ALPHA = 0.05


@dataclass(frozen=True)
class Backdrop:
    """One plain background behind all views.

    Attributes:
        srgb: float32 [3].
        tolerance: largest difference, in any channel, of what is still background.
    """

    srgb: np.ndarray
    tolerance: float

    @property
    def is_extreme(self) -> bool:
        """Black or white, which clipped parts of the object are too."""
        return bool((self.srgb > 1 - _EXTREME).all() or (self.srgb < _EXTREME).all())


def find_backdrop(frames: Sequence[SourceFrame]) -> Backdrop | None:
    """The backdrop of those frames that have neither alpha nor a mask; None where all have.

    Raises:
        UserError: it is not plain.
    """
    bare = [frame for frame in frames if frame.mask is None]
    chosen = spread_evenly(len(bare), _VIEWS_ASKED)
    images = (read_straight(bare[i].image, (bare[i].camera.width, bare[i].camera.height)) for i in chosen)
    opaque = [_border_pixels(image[..., :3]) for image in images if image[..., 3].min() == 1]
    return backdrop_of(opaque) if opaque else None


def backdrop_of(borders: Iterable[tuple[np.ndarray, np.ndarray]]) -> Backdrop:
    """The backdrop from border pixels per view: their sRGB [pixels, 3] and places [pixels, 2] in the image.

    Raises:
        UserError: it is not plain.
    """
    views = list(borders)
    common = np.median(np.concatenate([srgb for srgb, _ in views]), axis=0).astype(np.float32)
    away = np.concatenate([_distance(srgb, _plane(srgb, at, common, at)) for srgb, at in views])
    near = away[away < _NEAR]
    tolerance = max(MIN_TOLERANCE, 1.5 * float(np.quantile(near, 0.9)) + 4 / 255) if len(near) else 1.0
    plain = float((away <= tolerance).mean())
    if tolerance > MAX_TOLERANCE or plain < _LEAST_PLAIN_BORDER:
        raise UserError(
            "the background of the photographs is not plain",
            got=f"{plain:.0%} of the images' borders within {255 * tolerance:.0f} of 255 of their common colour "
            f"({', '.join(f'{255 * value:.0f}' for value in common)})",
            wanted=f"{_LEAST_PLAIN_BORDER:.0%} or more within {255 * MAX_TOLERANCE:.0f} of 255",
            fix="photograph the object before an evenly lit wall or cloth with some of it all around, or cut it out "
            "and put the masks into masks/",
        )
    return Backdrop(common, tolerance)


def cut_out(srgb: np.ndarray, backdrop: Backdrop, name: str) -> np.ndarray:
    """float32 [height, width, 4]: straight sRGB without the backdrop's share, and alpha.

    Args:
        srgb: float32 [height, width, 3].
        backdrop: behind all views.
        name: of the view, for the error.

    Raises:
        UserError: this view's border does not show the backdrop.
    """
    behind = _backdrop_image(srgb, backdrop.srgb)
    is_object = _object_mask(_distance(srgb, behind), backdrop)
    ring = _ring(is_object.shape)
    if 1 - is_object[ring].mean() < _LEAST_PLAIN_BORDER_OF_VIEW:
        raise UserError(
            f"view {name} has no plain background",
            got=f"{1 - is_object[ring].mean():.0%} of its border in the backdrop's colour",
            wanted=f"{_LEAST_PLAIN_BORDER_OF_VIEW:.0%} or more",
            fix="remove the view, or give masks",
        )
    return _unmixed(srgb, behind, is_object, backdrop.tolerance)


def _object_mask(distance: np.ndarray, backdrop: Backdrop) -> np.ndarray:
    plain = distance <= backdrop.tolerance
    labels, count = ndimage.label(plain)
    is_background = np.zeros(count + 1, bool)
    is_background[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    if not backdrop.is_extreme and count:
        number = np.arange(count + 1)
        area = ndimage.sum_labels(plain, labels, number)
        mean = ndimage.mean(distance, labels, number)
        is_background |= (area >= max(16, _LEAST_HOLE * plain.size)) & (mean <= backdrop.tolerance / 2)
    is_background[0] = False
    return _large_parts(~is_background[labels])


def _large_parts(mask: np.ndarray) -> np.ndarray:
    """Without dust: parts far smaller than the largest."""
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    if count < 2:
        return mask
    area = np.bincount(labels.ravel())[1:]
    return mask & np.concatenate([[False], area >= _LEAST_PART * area.max()])[labels]


def _unmixed(srgb: np.ndarray, behind: np.ndarray, is_object: np.ndarray, tolerance: float) -> np.ndarray:
    """Pixels of the outline hold some of the backdrop: how much is read off, in linear light, between the colours of
    the backdrop and of the nearest pixel well inside."""
    alpha = is_object.astype(np.float32)
    inside = ndimage.binary_erosion(is_object, np.ones((3, 3)), iterations=2, border_value=1)
    outline = is_object & ~ndimage.binary_erosion(is_object, np.ones((3, 3)), border_value=1)
    straight = srgb.copy()
    if inside.any() and outline.any():
        far, nearest = ndimage.distance_transform_edt(~inside, return_indices=True)
        row, column = np.nonzero(outline & (far < 4))
        own = nearest[:, row, column]
        mixed, back, front = (
            linear_from_srgb(image) for image in (srgb[row, column], behind[row, column], srgb[own[0], own[1]])
        )
        apart = front - back
        share = ((mixed - back) * apart).sum(-1) / np.maximum((apart**2).sum(-1), 1e-8)
        # where object and backdrop are alike, noise would decide
        share = np.where(_distance(srgb[own[0], own[1]], behind[row, column]) > 3 * tolerance, share.clip(0, 1), 1)
        share = np.where(share < _LEAST_ALPHA, 0, share)
        pure = (mixed - (1 - share[:, None]) * back) / np.maximum(share, _LEAST_ALPHA)[:, None]
        alpha[row, column] = share
        straight[row, column] = srgb_from_linear(np.clip(pure, 0, 1))
    return np.concatenate([straight * (alpha > 0)[..., None], alpha[..., None]], -1).astype(np.float32)


def _backdrop_image(srgb: np.ndarray, common: np.ndarray) -> np.ndarray:
    """The backdrop of a view, also behind the object: [height, width, 3]."""
    height, width = srgb.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    places = np.stack([columns / width, rows / height], -1).reshape(-1, 2)
    return _plane(*_border_pixels(srgb), common, places).reshape(height, width, 3)


def _plane(srgb: np.ndarray, at: np.ndarray, common: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The backdrop's colour at `places` [.., 2]: linear in the image's coordinates, least squares over those border
    pixels of a view that are close to the common colour."""
    wanted = np.broadcast_to(common, (len(places), 3)).astype(np.float32)
    near = _distance(srgb, common) < _NEAR
    if near.mean() < _LEAST_PLAIN_BORDER_OF_VIEW:
        return wanted
    ones = np.ones((len(at), 1))
    for _ in range(2):
        found = np.linalg.lstsq(np.hstack([ones, at])[near], srgb[near], rcond=None)[0]
        residual = _distance(srgb, np.hstack([ones, at]) @ found)
        near &= residual <= max(float(np.quantile(residual[near], 0.9)), 2 / 255)
    plane = np.hstack([np.ones((len(places), 1)), places]) @ found
    return np.clip(plane, common - _NEAR, common + _NEAR).clip(0, 1).astype(np.float32)


def _border_pixels(srgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evenly chosen pixels of the border, sRGB [pixels, 3], and their places [pixels, 2] from 0 to 1."""
    row, column = np.nonzero(_ring(srgb.shape[:2]))
    step = max(1, len(row) // _PIXELS_PER_VIEW)
    row, column = row[::step], column[::step]
    return srgb[row, column], np.stack([column / srgb.shape[1], row / srgb.shape[0]], -1)


def _ring(shape: tuple[int, ...]) -> np.ndarray:
    width = max(1, round(_BORDER_SHARE * min(shape[:2])))
    ring = np.ones(shape[:2], bool)
    ring[width:-width, width:-width] = False
    return ring


def _distance(srgb: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Largest difference of any channel."""
    return np.asarray(np.abs(srgb - other).max(-1))
