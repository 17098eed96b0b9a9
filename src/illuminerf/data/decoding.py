"""Decoding of one source image to straight sRGB with alpha, whatever file it comes from.

Display-referred files (PNG of 8 or 16 bits, JPEG, WebP, TIFF, BMP; grey, palette or colour) hold sRGB with
straight alpha; EXR holds linear RGB, premultiplied. CMYK is refused: without its profile its colours are a
guess.
"""

from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from illuminerf.data.deep_png import is_deep_colour_png, read_deep_png
from illuminerf.scene.images import DECODING_ERRORS, read_exr, srgb_from_linear
from illuminerf.workflow.errors import UserError

MAX_PIXELS = 120_000_000
"""Larger images are refused before they are decoded: a few kilobytes can unpack to gigabytes."""

EXIF_ORIENTATION = 0x0112
_TURNED = (5, 6, 7, 8)
"""Orientations that swap width and height."""


def _unreadable(path: Path, error: BaseException) -> UserError:
    return UserError(
        "an image cannot be read",
        got=f"{path}: {error}",
        wanted="a whole PNG, JPEG, WebP, TIFF, BMP or EXR file",
        fix="copy or export the file again, or remove the view",
    )


def _check_size(path: Path, width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise UserError(
            "an image has an impossible size",
            got=f"{width} x {height} pixels in {path}",
            wanted=f"at least one pixel and at most {MAX_PIXELS:,}",
            fix="export the image smaller",
        )


def _open(path: Path) -> Image.Image:
    """An image whose header is read and whose size is sane; its pixels are not decoded yet."""
    try:
        image = Image.open(path)
    except Image.DecompressionBombError as error:
        raise UserError(
            "an image has an impossible size",
            got=f"{path}: {error}",
            wanted=f"at most {MAX_PIXELS:,} pixels",
            fix="export the image smaller",
        ) from error
    except DECODING_ERRORS as error:
        raise _unreadable(path, error) from error
    _check_size(path, *image.size)
    return image


def _orientation(path: Path, image: Image.Image) -> int:
    """The EXIF orientation, 1 to 8; 1 is upright, and what is no number is taken for it."""
    try:
        if image.format == "PNG":  # asking Pillow for it would decode all pixels
            exif = Image.Exif()
            exif.load(image.info.get("exif", b""))
        else:
            exif = image.getexif()
        orientation = exif.get(EXIF_ORIENTATION, 1)
    except DECODING_ERRORS as error:
        raise _unreadable(path, error) from error
    return orientation if isinstance(orientation, int) else 1


def image_size(path: Path, declared: tuple[int, int] | None = None) -> tuple[int, int]:
    """(width, height) as `read_straight` returns it, from the header alone."""
    if path.suffix.lower() == ".exr":
        try:
            with OpenEXR.File(str(path), header_only=True) as file:
                low, high = file.header()["dataWindow"]
        except DECODING_ERRORS as error:
            raise _unreadable(path, error) from error
        width, height = int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)
    else:
        with _open(path) as image:
            width, height = image.size
            if _orientation(path, image) in _TURNED and declared != (width, height):
                width, height = height, width
    _check_size(path, width, height)
    return width, height


def _read_exr_straight(path: Path) -> np.ndarray:
    try:
        channels = read_exr(path)
    except DECODING_ERRORS as error:
        raise _unreadable(path, error) from error
    grey = channels.get("Y")
    rgb = [plane for plane in (channels.get(name, grey) for name in "RGB") if plane is not None]
    if len(rgb) < 3:
        raise UserError(
            "an EXR image lacks colour", got=f"channels {sorted(channels)} in {path}", wanted="R, G, B [, A]"
        )
    alpha = np.clip(channels.get("A", np.ones_like(rgb[0])), 0, 1)[..., None]
    premultiplied = np.maximum(np.stack(rgb, axis=-1), 0)
    if not (np.isfinite(premultiplied).all() and np.isfinite(alpha).all()):
        raise UserError(
            "an image holds values that are not finite", got=f"NaN or infinity in {path}", wanted="finite RGB"
        )
    linear_rgb = np.where(alpha > 0, premultiplied / np.maximum(alpha, 1e-6), 0)
    return np.concatenate([srgb_from_linear(linear_rgb), alpha], axis=-1).astype(np.float32)


def read_straight(path: Path, declared: tuple[int, int] | None = None) -> np.ndarray:
    """float32 [height, width, 4] in [0, 1]: sRGB and straight alpha; of an EXR the sRGB is unclipped.

    An EXIF orientation is applied, so that the image stands upright; where `declared`, the (width, height)
    that the poses were estimated for, equals the stored size of a sideways image, it is left as stored.
    """
    _check_size(path, *image_size(path, declared))
    if path.suffix.lower() == ".exr":
        return _read_exr_straight(path)
    with _open(path) as image:
        if image.mode in ("CMYK", "LAB", "F"):
            raise UserError(
                "an image is in a colour space that cannot be read faithfully",
                got=f"{image.mode} in {path}",
                wanted="RGB, RGBA, grey or palette",
                fix="convert it to sRGB in the program that wrote it",
            )
        orientation = _orientation(path, image)
        if orientation in _TURNED and declared == image.size:
            orientation = 1
        try:
            deep = image.format == "PNG" and is_deep_colour_png(path)
            pixels = read_deep_png(path) if deep else _pillow_pixels(image)
        except (Image.DecompressionBombError, *DECODING_ERRORS) as error:
            raise _unreadable(path, error) from error
    return np.ascontiguousarray(_upright(pixels, orientation))


def _pillow_pixels(image: Image.Image) -> np.ndarray:
    if image.mode.startswith("I"):  # 16-bit grey; Pillow's own conversion to 8 bits clips instead of scaling
        grey = np.clip(np.asarray(image, dtype=np.float32) / 65535, 0, 1)[..., None]
        return np.concatenate([grey.repeat(3, -1), np.ones_like(grey)], axis=-1)
    return np.asarray(image.convert("RGBA"), dtype=np.float32) / 255


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undo the eight EXIF orientations; unknown codes count as upright."""
    match orientation:
        case 2:
            return pixels[:, ::-1]
        case 3:
            return pixels[::-1, ::-1]
        case 4:
            return pixels[::-1]
        case 5:
            return pixels.swapaxes(0, 1)
        case 6:
            return np.rot90(pixels, -1)
        case 7:
            return pixels[::-1, ::-1].swapaxes(0, 1)
        case 8:
            return np.rot90(pixels, 1)
    return pixels
