"""Frames to MP4."""

from collections.abc import Iterable
from pathlib import Path

import imageio.v2 as imageio
import numpy as np

from illuminerf.scene.images import to_uint8
from illuminerf.workflow.atomic import atomic_path


def write_mp4(path: Path, frames: Iterable[np.ndarray], frames_per_second: int = 24) -> None:
    """Write sRGB frames, float [height, width, 3] in [0, 1], as H.264 that every player opens, atomically.

    Odd sizes are cut by one pixel: the usual chroma format needs even ones.
    """
    with (
        atomic_path(path) as temporary,
        imageio.get_writer(
            temporary,
            format="FFMPEG",
            mode="I",
            fps=frames_per_second,
            codec="libx264",
            pixelformat="yuv420p",
            quality=9,
            macro_block_size=2,
            ffmpeg_log_level="error",
        ) as writer,
    ):
        for frame in frames:
            even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
            writer.append_data(  # type: ignore[attr-defined]
                np.ascontiguousarray(to_uint8(even))
            )
