"""Sharp frames of a video, evenly spread over it.

The video is cut into as many windows of equal length as frames are wanted, and each gives its sharpest frame: the one
whose Laplacian varies most. Neighbours show nearly the same, so within a window this compares blur and not content.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from illuminerf.scene.images import write_png
from illuminerf.scene.video import read_chosen_frames, read_grey_video, video_size
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, track

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
_JUDGED_SIDE = 640
"""Pixels of the longest side at which sharpness is measured: blur that is smaller does no harm."""
_MARGIN = 0.2
"""Of each window, at both ends, that is not searched, so that no two frames are neighbours."""


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian of an image [height, width] with values from 0 to 255."""
    return float(ndimage.laplace(grey.astype(np.float32)).var())


def sharpest_of_windows(values: Sequence[float], count: int) -> list[int]:
    """The indices of at most `count` frames, the sharpest of each window, in order.

    Args:
        values: sharpness of every frame.
        count: windows.
    """
    if len(values) <= count:
        return list(range(len(values)))
    chosen = []
    for window in np.array_split(np.arange(len(values)), count):
        margin = int(_MARGIN * len(window))
        searched = window[margin : len(window) - margin]
        chosen.append(int(searched[np.asarray(values)[searched].argmax()]))
    return chosen


def write_sharp_frames(video: Path, count: int, folder: Path) -> list[Path]:
    """Write at most `count` frames of `video` as frame_<number>.png into `folder`.

    Raises:
        UserError: it is no video, or cannot be decoded.
    """
    width, height = video_size(video)
    shrink = min(1.0, _JUDGED_SIDE / max(width, height))
    small = max(8, round(width * shrink)), max(8, round(height * shrink))
    values = [sharpness(frame) for frame in track(read_grey_video(video, *small), "look for sharp frames")]
    if not values:
        raise UserError(f"{video} holds no frames", fix="copy it again")
    chosen = sharpest_of_windows(values, count)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, frame in zip(chosen, read_chosen_frames(video, chosen), strict=True):
        paths.append(folder / f"frame_{number:05d}.png")
        write_png(paths[-1], frame.astype(np.float32) / 255)
    say(f"{len(paths)} sharp frames of {len(values)} in {video.name}")
    return paths
