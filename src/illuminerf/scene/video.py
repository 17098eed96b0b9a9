"""Frames to MP4 and back, and to GIF."""

import math
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
from PIL import Image

from illuminerf.scene.images import to_uint8
from illuminerf.workflow.atomic import atomic_path
from illuminerf.workflow.errors import UserError


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


def write_gif(path: Path, frames: Iterable[np.ndarray], frames_per_second: int = 24) -> None:
    """Write sRGB frames, float [height, width, 3] in [0, 1], as a GIF that loops for ever, atomically.

    All frames share the first one's palette, which keeps plain backgrounds still; players know hundredths of a second,
    and slow down what is faster than fifty frames a second.
    """
    pictures = [Image.fromarray(to_uint8(frame)) for frame in frames]
    if not pictures:
        raise UserError(f"there are no frames for {path}")
    palette = pictures[0].quantize(256, Image.Quantize.MEDIANCUT)
    first, *others = [picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for picture in pictures]
    milliseconds = max(20, round(100 / frames_per_second) * 10)
    with atomic_path(path) as temporary:
        first.save(temporary, "GIF", save_all=True, append_images=others, duration=milliseconds, loop=0, optimize=False)


def video_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels; UserError where the file is missing or no video."""
    if not path.is_file():
        raise UserError(f"the video {path} is missing", fix="check the path")
    try:
        reader = imageio_ffmpeg.read_frames(path)
        width, height = next(reader)["size"]
        reader.close()
    except (OSError, RuntimeError, IndexError, KeyError, ValueError) as error:
        raise UserError(
            f"{path} is not a readable video", got=str(error).splitlines()[0], fix="copy it again"
        ) from error
    return int(width), int(height)


def read_video(path: Path, size: int) -> Iterator[np.ndarray]:
    """The frames of a square video, uint8 [size, size, 3], area-averaged.

    Raises:
        UserError: it cannot be decoded to its end.
    """
    return _decoded(path, ["-vf", f"scale={size}:{size}:flags=area"], (size, size, 3))


def read_grey_video(path: Path, width: int, height: int) -> Iterator[np.ndarray]:
    """Every frame that is stored, as uint8 [height, width], area-averaged.

    Raises:
        UserError: it cannot be decoded to its end.
    """
    options = ["-vf", f"scale={width}:{height}:flags=area,format=gray", "-fps_mode", "passthrough"]
    return _decoded(path, options, (height, width), "gray")


def read_chosen_frames(path: Path, chosen: Sequence[int]) -> Iterator[np.ndarray]:
    """The frames of these numbers, counted as `read_grey_video` does, in full size: uint8 [height, width, 3].

    Raises:
        UserError: it cannot be decoded to its end.
    """
    width, height = video_size(path)
    wanted = "+".join(f"eq(n\\,{number})" for number in chosen)
    return _decoded(path, ["-vf", f"select={wanted}", "-fps_mode", "passthrough"], (height, width, 3))


def _decoded(path: Path, options: list[str], shape: tuple[int, ...], pixels: str = "rgb24") -> Iterator[np.ndarray]:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), *options]
    command += ["-f", "rawvideo", "-pix_fmt", pixels, "-"]
    num_bytes = math.prod(shape)
    with (
        tempfile.TemporaryFile() as messages,
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=messages) as process,
    ):
        assert process.stdout is not None
        try:
            while len(frame := process.stdout.read(num_bytes)) == num_bytes:
                yield np.frombuffer(frame, np.uint8).reshape(shape)
        finally:  # also where the caller wants no more of them
            process.stdout.close()
            was_cut = process.poll() is None
            status = process.wait()
        messages.seek(0)
        said = messages.read().decode(errors="replace").strip().splitlines()
        if (status != 0 and not was_cut) or said or frame:
            raise UserError(
                f"{path} cannot be decoded", got=said[0] if said else "a frame that ends early", fix="copy it again"
            )
