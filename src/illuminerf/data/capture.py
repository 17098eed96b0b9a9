"""The capture: posed images of one object under one unknown light, in the unit ball, on disk and in memory.

capture.json          scale, offset (p' = (p + offset) * scale from the caller's world), background, names
cameras.json          `Cameras.to_dict()`, in the unit ball's world
images/<000>.png      8-bit sRGB, straight RGBA; all of one size, undistorted
"""

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from illuminerf.data.decoding import image_size
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import read_png_bytes, write_png
from illuminerf.scene.views import EightBitImages, Views
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.errors import UserError

Background = Literal["masked", "opaque"]


@dataclass(frozen=True)
class Capture:
    """Views of one object in the unit ball, and the way back to the caller's world."""

    views: Views
    names: tuple[str, ...]
    """The image's name in the caller's folder, per view."""
    scale: float = 1.0
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """float64 [3]; a point p of the caller's world is at (p + offset) * scale here."""
    background: Background = "masked"
    """"masked": alpha separates the object from what is behind it; "opaque": alpha is 1 wherever the camera
    saw.
    """

    def __post_init__(self) -> None:
        if len(self.names) != len(self.views):
            raise ValueError(f"{len(self.names)} names for {len(self.views)} views")
        if self.offset.shape != (3,) or not np.isfinite(self.offset).all() or not 0 < self.scale < np.inf:
            raise ValueError(f"scale {self.scale}, offset {self.offset}: want a positive number and three numbers")

    def unit_ball_cameras(self, cameras: Cameras) -> Cameras:
        """Cameras of the caller's world (test views, for instance) in this capture's unit ball."""
        return cameras.transformed(self.scale, self.offset)

    def caller_cameras(self, cameras: Cameras) -> Cameras:
        """The reverse of `unit_ball_cameras`."""
        return cameras.transformed(1 / self.scale, -self.offset * self.scale)


def image_path(folder: Path, view: int) -> Path:
    """images/<000>.png of the capture in `folder`."""
    return folder / "images" / f"{view:03d}.png"


def write_capture(
    folder: Path,
    images: Iterable[np.ndarray],
    cameras: Cameras,
    names: Sequence[str],
    scale: float,
    offset: np.ndarray,
    background: Background,
) -> None:
    """Write a capture's files; `images` are float [height, width, 4] in [0, 1] and may be made one at a
    time.
    """
    for view, image in enumerate(images):
        write_png(image_path(folder, view), image)
    write_json(folder / "cameras.json", cameras.to_dict())
    write_json(
        folder / "capture.json",
        {"scale": scale, "offset": offset.tolist(), "background": background, "names": list(names)},
    )


def save_capture(folder: Path, capture: Capture) -> None:
    """Write `capture` as a plain folder that `load_capture` and `import_capture` read."""
    images = (np.dstack([srgb, alpha]) for srgb, alpha in zip(capture.views.srgb, capture.views.alpha, strict=True))
    write_capture(
        folder, images, capture.views.cameras, capture.names, capture.scale, capture.offset, capture.background
    )


def load_cameras(folder: Path) -> Cameras:
    """The cameras of the capture in `folder`, for those who need no pixels.

    Raises UserError where it is missing or unfinished.
    """
    if not (folder / "capture.json").is_file():
        raise UserError(
            f"{folder} is not a capture", got="no capture.json", wanted="what `import_capture` writes",
            fix="import the images first",
        )  # fmt: skip
    if (folder / "config.json").exists() and not (folder / "DONE").exists():
        raise UserError(f"the capture {folder} is unfinished", fix="import it again; what is done is kept")
    return Cameras.from_dict(read_json(folder / "cameras.json"))


def _check_size(folder: Path, cameras: Cameras) -> None:
    """UserError where the first image is of another size than the cameras say, before memory is spent by their word."""
    size = image_size(image_path(folder, 0))
    if size != (cameras.width, cameras.height):
        raise UserError(
            f"image 0 of the capture {folder} has the wrong shape",
            got=f"{size[1]} x {size[0]}",
            wanted=f"{cameras.height} x {cameras.width}",
            fix="import the capture again into a new folder",
        )


def load_capture(folder: Path) -> Capture:
    """Read the capture in `folder`.

    Raises UserError where it is missing, unfinished, corrupt, or its images are not those of its cameras.
    """
    cameras = load_cameras(folder)
    content = read_json(folder / "capture.json")
    num_views = len(cameras)
    if not num_views:
        raise UserError(f"the capture {folder} has no views", fix="import the photographs again into a new folder")
    _check_size(folder, cameras)
    pixels = np.empty((num_views, cameras.height, cameras.width, 4), np.uint8)

    def read(view: int) -> None:
        image = read_png_bytes(image_path(folder, view))
        if image.shape != (cameras.height, cameras.width, 4):
            raise UserError(
                f"image {view} of the capture {folder} has the wrong shape",
                got=" x ".join(map(str, image.shape)),
                wanted=f"{cameras.height} x {cameras.width} x 4",
                fix="import the capture again into a new folder",
            )
        pixels[view] = image

    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:  # decoding leaves the interpreter's lock
        list(pool.map(read, range(num_views)))
    try:
        return Capture(
            Views(cameras, EightBitImages(pixels[..., :3]), EightBitImages(pixels[..., 3])),
            tuple(map(str, content["names"])),
            float(content["scale"]),
            np.array(content["offset"], np.float64),
            "masked" if content["background"] == "masked" else "opaque",
        )
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"{folder / 'capture.json'} is not that of a capture",
            got=f"{type(error).__name__}: {error}",
            wanted="scale, offset, background and one name per view",
            fix="import the capture again into a new folder",
        ) from error
