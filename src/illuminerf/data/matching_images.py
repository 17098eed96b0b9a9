"""Photographs as structure from motion sees them: upright, of moderate size, with or without their surroundings."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np
from scipy import ndimage

from illuminerf.data.decoding import read_straight
from illuminerf.data.developing import shrunk
from illuminerf.data.object_masks import Masked
from illuminerf.data.photographs import read_shot
from illuminerf.data.source import SourceFrame
from illuminerf.data.structure_from_motion import MatchingImage
from illuminerf.scene.images import composite, to_uint8, write_png
from illuminerf.workflow.progress import track

Matched = Literal["object", "everything"]
_MAX_THREADS = 4
_RIM = 2
"""Pixels inside the outline where no feature counts: there it sees the outline itself, which moves with the camera."""


def write_matching_images(masked: Masked, matched: Matched, longest_side: int, folder: Path) -> list[MatchingImage]:
    """Write `folder`/images and, to match the object alone, `folder`/masks.

    Args:
        masked: the photographs.
        matched: "object" hides what is not object.
        longest_side: pixels; larger photographs are averaged down.
        folder: empty.
    """

    def write(frame: SourceFrame) -> MatchingImage:
        return _write_one(frame, masked, matched, longest_side, folder)

    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    with ThreadPoolExecutor(min(_MAX_THREADS, os.cpu_count() or 1)) as pool:
        return list(track(pool.map(write, masked.frames), "prepare photographs", total=len(masked.frames)))


def _write_one(frame: SourceFrame, masked: Masked, matched: Matched, side: int, folder: Path) -> MatchingImage:
    path, mask = folder / "images" / f"{frame.name}.png", None
    if matched == "object":
        straight = shrunk(masked.cut(frame).astype(np.float32) / 255, side)
        srgb, alpha = straight[..., :3], straight[..., 3]
        mask = folder / "masks" / f"{path.name}.png"
        write_png(mask, feature_mask(alpha).astype(np.float32))
        shown = composite(srgb, alpha, float(np.median(srgb[alpha > 0.5])))  # a faint outline draws few features
    else:
        shown = shrunk(read_straight(frame.image, (frame.camera.width, frame.camera.height)), side)[..., :3]
    write_png(path, shown)
    focal = read_shot(frame.image).focal
    size = (shown.shape[1], shown.shape[0])
    return MatchingImage(path, mask, size, focal * max(size) if focal else None)


def feature_mask(alpha: np.ndarray) -> np.ndarray:
    """bool [height, width]: where features of the object may lie."""
    return np.asarray(ndimage.binary_erosion(alpha > 0.5, np.ones((3, 3)), iterations=_RIM, border_value=1))


def small_photograph(frame: SourceFrame, masked: Masked, longest_side: int) -> np.ndarray:
    """uint8 [height, width, 4]: the photograph's own colours everywhere, over white, and its mask."""
    straight = shrunk(read_straight(frame.image, (frame.camera.width, frame.camera.height)), longest_side)
    alpha = shrunk(masked.cut(frame).astype(np.float32) / 255, longest_side)[..., 3]
    return to_uint8(np.dstack([composite(straight[..., :3], straight[..., 3], 1.0), alpha]))
