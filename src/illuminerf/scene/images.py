"""Images: sRGB coding, compositing, PNG and EXR files. Arrays are [..., height, width, channels]."""

import errno
import struct
import warnings
import zlib
from pathlib import Path
from typing import TypeVar

import numpy as np
import OpenEXR
import torch
from PIL import Image
from torch import Tensor

from illuminerf.workflow.atomic import atomic_path
from illuminerf.workflow.errors import UserError

Array = TypeVar("Array", np.ndarray, Tensor)
MAX_PIXELS = 2**27
"""Of one picture (16384 x 8192, the largest lights). Larger ones are refused before they are decoded: a few kilobytes
can unpack to gigabytes."""
_MAX_VALUES = 2**29
"""Of all channels of an EXR together: 2 GiB as float32."""
DECODING_ERRORS = (OSError, SyntaxError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError,
                   AssertionError, RuntimeError, struct.error, zlib.error)  # fmt: skip
"""What image libraries raise on broken content."""


def srgb_from_linear(linear_rgb: Array) -> Array:
    """sRGB coding (IEC 61966-2-1) of linear values; the power law goes on above 1, unclipped."""
    if isinstance(linear_rgb, Tensor):
        value = linear_rgb.clamp_min(0.0)
        return torch.where(value <= 0.0031308, 12.92 * value, 1.055 * value.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)
    value = np.maximum(linear_rgb, 0)
    return np.where(
        value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 0.0031308) ** (1 / 2.4) - 0.055
    ).astype(linear_rgb.dtype)


def linear_from_srgb(srgb: Array) -> Array:
    """Inverse of `srgb_from_linear`."""
    if isinstance(srgb, Tensor):
        value = srgb.clamp_min(0.0)
        return torch.where(value <= 0.04045, value / 12.92, ((value.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
    value = np.maximum(srgb, 0)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4).astype(
        srgb.dtype
    )


def composite(srgb: Array, alpha: Array, background: float) -> Array:
    """Straight colour [..., 3] over a plain background, in sRGB values; alpha is [...]."""
    return srgb * alpha[..., None] + background * (1 - alpha[..., None])


def read_png(path: Path) -> np.ndarray:
    """Read an 8-bit PNG as float32 [height, width, 3 or 4] in [0, 1].

    Raises:
        UserError: the file is missing or not an image.
    """
    return read_png_bytes(path).astype(np.float32) / 255.0


def read_png_bytes(path: Path) -> np.ndarray:
    """Read an 8-bit PNG as uint8 [height, width, 3 or 4].

    Raises:
        UserError: the file is missing or not an image.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own limit is checked
            with Image.open(path) as image:
                check_size(path, *image.size)
                mode = "RGBA" if "A" in image.getbands() else "RGB"
                return np.asarray(image.convert(mode))
    except FileNotFoundError as error:
        raise UserError(f"{path} is missing", fix="check the path") from error
    except (Image.DecompressionBombError, *DECODING_ERRORS) as error:
        raise UserError(f"{path} is not a readable image", got=str(error), fix="export it again as PNG") from error


def check_size(path: Path, width: int, height: int, num_channels: int = 1) -> None:
    """UserError where a picture has no pixels or too many."""
    if width < 1 or height < 1 or width * height > MAX_PIXELS or width * height * num_channels > _MAX_VALUES:
        raise UserError(
            f"{path} has an impossible size",
            got=f"{width} x {height} pixels, {num_channels} channels",
            wanted=f"at least one pixel, at most {MAX_PIXELS:,}, and at most {_MAX_VALUES:,} values",
            fix="export it smaller",
        )


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Float [0, 1] to the nearest of 256 levels."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write float [height, width], [.., 3] or [.., 4] in [0, 1] as an 8-bit PNG, atomically."""
    with atomic_path(path) as temporary:
        Image.fromarray(to_uint8(image)).save(temporary, compress_level=4)


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Read all channels of an EXR as float32 [height, width] by name.

    Raises:
        UserError: the file is missing or not an EXR.
    """
    if not Path(path).is_file():
        raise UserError(f"{path} is missing", wanted="an EXR file", fix="check the path")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            header = file.header()
            low, high = header["dataWindow"]
            size = [int(last) - int(first) + 1 for first, last in zip(low, high, strict=True)]
            check_size(path, size[0], size[1], max(len(header["channels"]), 1))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: np.asarray(c.pixels, np.float32) for name, c in file.channels().items()}
    except DECODING_ERRORS as error:
        raise UserError(f"{path} is not a readable EXR", got=str(error), fix="export it again") from error


def write_exr(path: Path, channels: dict[str, np.ndarray], half: bool = True) -> None:
    """Write float channels [height, width] by name, atomically, in half or single precision, zip compressed.

    Values beyond the largest half (65504) are clamped to it.

    Raises:
        UserError: the file cannot be written.
    """
    kind = np.float16 if half else np.float32
    limit = float(np.finfo(kind).max)
    pixels = {name: np.ascontiguousarray(np.clip(c, -limit, limit).astype(kind)) for name, c in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File(header, dict(pixels)).write(str(temporary))
        except RuntimeError as error:  # it does not say whether the disk was full
            raise OSError(errno.EIO, str(error), str(path)) from error
        if not _holds(temporary, pixels):  # what fails while the library closes its file, it keeps to itself
            raise OSError(errno.EIO, "a file was not written whole", str(path))


def _holds(path: Path, pixels: dict[str, np.ndarray]) -> bool:
    """Whether an EXR has just these channels, bit by bit."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            found = {name: channel.pixels for name, channel in file.channels().items()}
    except DECODING_ERRORS:
        return False
    return found.keys() == pixels.keys() and all(found[name].tobytes() == pixels[name].tobytes() for name in pixels)


def read_rgb_exr(path: Path) -> np.ndarray:
    """Read R, G, B of an EXR as float32 [height, width, 3]; a single luminance channel is repeated."""
    channels = read_exr(path)
    if "Y" in channels and "R" not in channels:
        return np.repeat(channels["Y"][..., None], 3, -1)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise UserError(f"{path} has no RGB channels", got=", ".join(sorted(channels)), wanted="R, G, B")
    return np.stack([channels[name] for name in "RGB"], -1)


def write_rgb_exr(path: Path, linear_rgb: np.ndarray, half: bool = True) -> None:
    """Write linear radiance [height, width, 3]."""
    write_exr(path, {name: linear_rgb[..., i] for i, name in enumerate("RGB")}, half)
