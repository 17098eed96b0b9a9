"""Any supported folder of posed images -> Capture.

The images are decoded, cut out by their masks, undistorted, brought to one size and, with the cameras,
moved into the unit ball. All of it happens before `out` is touched: bad input leaves nothing behind.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from illuminerf.data.capture import Background, write_capture
from illuminerf.data.developing import PlainBackground, develop, plan_sizes, planned_cameras
from illuminerf.data.placement import Ball, focus_ball, hull_ball, mask_preview
from illuminerf.data.plain_background import Backdrop, find_backdrop
from illuminerf.data.reading import CaptureFormat, read_source
from illuminerf.data.source import SourceCapture
from illuminerf.scene.cameras import Cameras
from illuminerf.workflow.artefact import fingerprint, open_artefact
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, track

MAX_THREADS = 8
"""Each thread holds one image in float, some 16 bytes per pixel several times over."""


@dataclass(frozen=True)
class Config:
    """How a folder is read."""

    format: CaptureFormat | Literal["auto"] = "auto"
    """The folder's format; "auto" looks for the files that tell."""
    size: int | None = None
    """Longest side of the images in pixels; larger ones are area-averaged in linear light, none is
    enlarged.
    """
    light: str = "sunset"
    """Which images of a TensoIR scene are the input: rgba_<light>.png."""
    split: str = "train"
    """Which list of frames is read, where the folder has several."""
    mask_folder: str = "masks"
    """Folder beside the images with one mask per image, white on the object."""
    background: PlainBackground | Literal["none", "plain"] = "none"
    """Plain colour behind the object in images without alpha and masks: it is cut out from the border
    inward. "plain" is any even colour, found from the images' borders, and leaves soft outlines.
    """
    placement: Literal["auto", "masks", "cameras", "keep"] = "auto"
    """What the unit ball is found from: the masks' visual hull, the cameras alone, or "keep" the caller's
    world.
    """
    object_radius: float = 0.9
    """Radius of the object's bounding ball after placement, in units of the unit ball."""

    def __post_init__(self) -> None:
        if self.size is not None and self.size < 8:
            raise UserError("the image size is too small", got=f"size {self.size}", wanted="at least 8 pixels")
        if not 0 < self.object_radius <= 1:
            raise UserError("object_radius is out of range", got=str(self.object_radius), wanted="(0, 1]")


def run(source: Path, config: Config, out: Path) -> Path:
    """Import the folder `source` as a capture into `out`.

    Raises UserError, before anything is written, where the folder cannot be read as posed images of one
    object.
    """
    chosen = None if config.format == "auto" else config.format
    found = read_source(source, chosen, config.split, config.light, config.mask_folder)
    inputs: dict[str, Path | str] = {"source": _digest(found)}
    if (out / "DONE").exists():
        with open_artefact(out, "import_capture", config, inputs):
            return out
    plan = plan_sizes(found, config.size)
    cameras = planned_cameras(found, plan)
    images = _developed(found, plan.per_frame, plan.common, config)
    previews = [mask_preview(image[..., 3] > 127) for image in images]
    background: Background = "opaque" if _is_opaque(images, plan.per_frame) else "masked"
    if background == "opaque":
        say(
            "no masks: every pixel counts as object (alpha = 1). For an object on a plain background of any colour set "
            f"background plain; otherwise add masks/.{_looks_plain(found)}"
        )
    scale, offset = _place(cameras, previews, background, config)
    with open_artefact(out, "import_capture", config, inputs) as artefact:
        names = [frame.name for frame in found.frames]
        straight = (image / 255.0 for image in images)
        write_capture(out, straight, cameras.transformed(scale, offset), names, scale, offset, background)
        artefact.finish({"views": len(names), "height": cameras.height, "width": cameras.width})
    return out


def _digest(found: SourceCapture) -> str:
    """Names and contents of what the reader found, so that files it does not use may change."""
    parts = []
    for frame in found.frames:
        parts += [frame.name, repr(frame.camera), repr(frame.world_from_camera.tolist()), fingerprint(frame.image)]
        parts += [fingerprint(frame.mask)] if frame.mask else []
    return "\n".join(parts)


def _developed(
    found: SourceCapture, sizes: tuple[tuple[int, int], ...], common: tuple[int, int], config: Config
) -> list[np.ndarray]:
    """uint8 [height, width, 4] per view: straight sRGB."""
    background: PlainBackground | Backdrop | None = None
    if config.background == "plain":
        background = find_backdrop(found.frames)
    elif config.background != "none":
        background = config.background
    # Decoding leaves the interpreter's lock, so threads are enough; the order stays that of the frames.
    with ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1)) as pool:
        images = pool.map(lambda frame, size: develop(frame, size, common, background), found.frames, sizes)
        return list(track(images, "read images", total=len(found.frames)))


def _looks_plain(found: SourceCapture) -> str:
    try:
        backdrop = find_backdrop(found.frames)
    except UserError:
        return ""
    return "" if backdrop is None else " This one looks plain."


def _is_opaque(images: list[np.ndarray], sizes: tuple[tuple[int, int], ...]) -> bool:
    """True where the only transparent pixels are padding (or none)."""
    return all(
        int(np.count_nonzero(image[..., 3] < 255)) <= image[..., 3].size - size[0] * size[1]
        for image, size in zip(images, sizes, strict=True)
    )


def _place(
    cameras: Cameras, masks: list[np.ndarray], background: Background, config: Config
) -> tuple[float, np.ndarray]:
    """(scale, offset) of p' = (p + offset) * scale."""
    if config.placement == "keep":
        return 1.0, np.zeros(3)
    by_masks = config.placement == "masks" or (config.placement == "auto" and background == "masked")
    if config.placement == "masks" and background == "opaque":
        raise UserError(
            "the unit ball cannot be found from masks", got="no masks", fix="add masks, or set placement to cameras"
        )
    ball: Ball = hull_ball(cameras, masks) if by_masks else focus_ball(cameras)
    return ball.placement(config.object_radius)
