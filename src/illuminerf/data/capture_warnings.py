"""What is wrong, or may be, with photographs whose poses were just estimated: said before hours are spent on them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FEW_VIEWS, GOOD_VIEWS = 20, 50
_LARGE_GAP_DEGREES, _NARROW_DEGREES = 60.0, 20.0
_SMALL_OBJECT, _CUT_OFF = 0.03, 0.02
_BLURRED = 0.25
_LARGE_ERROR = 1.5
_FEW_POINTS = 20
_EXPOSURE_STOPS = 0.3
_NARROW_LENS, _WIDE_LENS = 0.5, 4.0


@dataclass(frozen=True)
class Quality:
    """Measurements of a capture, of its placed photographs where nothing else is said.

    Attributes:
        num_photographs: all that were given.
        unplaced: names of those without a pose.
        names: of the placed ones, and in the same order:
        azimuths: degrees of the cameras about the object's vertical.
        elevations: degrees above the horizontal.
        errors: mean reprojection errors in pixels.
        num_points: points seen.
        sharpness: variance of the Laplacian.
        object_shares: of the image's pixels.
        border_shares: of the image's border that is object.
        exposures: relative exposures that EXIF tells, where it does.
        focal: mean focal length in longest sides.
        has_masks: whether object and background are told apart.
    """

    num_photographs: int
    unplaced: tuple[str, ...]
    names: tuple[str, ...]
    azimuths: np.ndarray
    elevations: np.ndarray
    errors: np.ndarray
    num_points: np.ndarray
    sharpness: np.ndarray
    object_shares: np.ndarray
    border_shares: np.ndarray
    exposures: tuple[float, ...]
    focal: float
    has_masks: bool


def warnings_of(quality: Quality) -> list[str]:
    """Sentences, the gravest first; none for a good capture."""
    found = [*_about_poses(quality), *_about_coverage(quality), *_about_images(quality)]
    if quality.has_masks:
        found += _about_masks(quality)
    else:
        found.append("There are no masks: the reconstruction has to explain the surroundings too. Cut the object out.")
    return found


def _about_poses(quality: Quality) -> list[str]:
    found, num_placed = [], len(quality.names)
    if quality.unplaced:
        found.append(
            f"{len(quality.unplaced)} of {quality.num_photographs} photographs could not be placed and are left out: "
            f"{_listed(quality.unplaced)}."
        )
    if num_placed < GOOD_VIEWS:
        grade = "Few views: expect holes" if num_placed < FEW_VIEWS else "Rather few views"
        found.append(f"{grade}. There are {num_placed}; 50 to 100 from all around make a good reconstruction.")
    large = float(np.nanmedian(quality.errors)) if num_placed else 0.0
    if large > _LARGE_ERROR:
        found.append(f"Points are off by {large:.1f} pixels: did the object move, or the camera zoom?")
    doubtful = _names(quality, quality.num_points < _FEW_POINTS)
    if doubtful:
        found.append(f"Poses that rest on fewer than {_FEW_POINTS} points: {_listed(doubtful)}.")
    if not _NARROW_LENS < quality.focal < _WIDE_LENS:
        found.append(f"The focal length of {quality.focal:.2f} image widths is unusual: are the poses right?")
    return found


def _about_coverage(quality: Quality) -> list[str]:
    found, gap = [], largest_gap(quality.azimuths)
    if gap > _LARGE_GAP_DEGREES:
        found.append(f"No camera over {gap:.0f} degrees around the object: that side is seen poorly or not at all.")
    if len(quality.elevations) and np.ptp(quality.elevations) < _NARROW_DEGREES:
        low, high = quality.elevations.min(), quality.elevations.max()
        found.append(f"All cameras look from {low:.0f} to {high:.0f} degrees above: add a ring from higher or lower.")
    return found


def _about_images(quality: Quality) -> list[str]:
    found = []
    blurred = _names(quality, quality.sharpness < _BLURRED * np.median(quality.sharpness))
    if blurred:
        found.append(f"Much less sharp than the others: {_listed(blurred)}.")
    if len(quality.exposures) > 1:
        stops = float(np.log2(max(quality.exposures) / min(quality.exposures)))
        if stops > _EXPOSURE_STOPS:
            found.append(f"Exposure changes by {stops:.1f} stops between photographs: lock it, and the white balance.")
    return found


def _about_masks(quality: Quality) -> list[str]:
    found = []
    cut_off = _names(quality, quality.border_shares > _CUT_OFF)
    if cut_off:
        found.append(f"The object, or its mask, runs into the image's border: {_listed(cut_off)}.")
    share = float(np.median(quality.object_shares))
    if share < _SMALL_OBJECT:
        found.append(f"The object fills {share:.1%} of the images: go nearer, or crop.")
    usual = np.median(quality.object_shares)
    odd = _names(quality, (quality.object_shares > 3 * usual) | (quality.object_shares < usual / 3))
    if odd:
        found.append(f"Masks of quite another size than the others: {_listed(odd)}.")
    return found


def largest_gap(azimuths: np.ndarray) -> float:
    """Degrees of the widest sector without a camera; 360 for none."""
    if len(azimuths) < 2:
        return 360.0
    ordered = np.sort(np.mod(azimuths, 360))
    return float(np.diff(np.append(ordered, ordered[0] + 360)).max())


def _names(quality: Quality, which: np.ndarray) -> list[str]:
    return [name for name, chosen in zip(quality.names, which, strict=True) if chosen]


def _listed(names: Sequence[str], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
