"""From a source frame to the pixels of a capture: alpha, undistortion, size, straight 8-bit sRGB.

Wherever pixels are mixed (undistortion, change of size) they are linear and premultiplied, where averages
are right.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from illuminerf.data.decoding import read_straight
from illuminerf.data.distortion import undistorted_image
from illuminerf.data.plain_background import Backdrop, cut_out
from illuminerf.data.resampling import area_downsampled, padded, padding_to
from illuminerf.data.source import SourceCapture, SourceFrame
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear, to_uint8
from illuminerf.workflow.errors import UserError

PlainBackground = Literal["white", "black"]
"""Known beforehand; `plain_background.Backdrop` is one that was found."""
PLAIN_BACKGROUND_TOLERANCE = 8 / 255
"""A pixel this close to white (or black) in every channel can be background; JPEG noise stays below."""


@dataclass(frozen=True)
class SizePlan:
    """To what size each frame is brought, and the common size that all are padded to; (width, height) in
    pixels.
    """

    per_frame: tuple[tuple[int, int], ...]
    common: tuple[int, int]


def plan_sizes(source: SourceCapture, longest_side: int | None) -> SizePlan:
    """Every frame shrunk to `longest_side` pixels (never enlarged), then padded to the widest and the
    highest.
    """
    sizes = []
    for frame in source.frames:
        width, height = frame.camera.width, frame.camera.height
        shrink = min(1.0, longest_side / max(width, height)) if longest_side else 1.0
        sizes.append((max(1, round(width * shrink)), max(1, round(height * shrink))))
    return SizePlan(tuple(sizes), (max(size[0] for size in sizes), max(size[1] for size in sizes)))


def planned_cameras(source: SourceCapture, plan: SizePlan) -> Cameras:
    """The cameras of the developed images, in the caller's world."""
    intrinsics = []
    for frame, size in zip(source.frames, plan.per_frame, strict=True):
        camera = frame.camera
        to_x, to_y = size[0] / camera.width, size[1] / camera.height
        left, top = padding_to(size, plan.common)
        intrinsics.append([camera.fx * to_x, camera.fy * to_y, camera.cx * to_x + left, camera.cy * to_y + top])
    poses = np.stack([frame.world_from_camera for frame in source.frames])
    return Cameras(poses, np.array(intrinsics), plan.common[1], plan.common[0])


def plain_background_mask(srgb: np.ndarray, background: PlainBackground) -> np.ndarray:
    """bool [height, width]: True on the object, where `srgb` [height, width, 3] shows it on a plain
    background.

    Background is what is white (black) within PLAIN_BACKGROUND_TOLERANCE and connected to the border of the
    image, so highlights (dark parts) inside the object stay, and enclosed holes count as object.
    """
    if background == "white":
        plain = srgb.min(axis=-1) >= 1 - PLAIN_BACKGROUND_TOLERANCE
    else:
        plain = srgb.max(axis=-1) <= PLAIN_BACKGROUND_TOLERANCE
    labels, _ = ndimage.label(plain)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return ~np.isin(labels, border[border > 0])


def develop(
    frame: SourceFrame, size: tuple[int, int], common: tuple[int, int], background: PlainBackground | Backdrop | None
) -> np.ndarray:
    """uint8 [height, width, 4], straight sRGB, undistorted, of the `common` size (width, height).

    Alpha is that of the image times the mask; where there is neither and a plain `background` is named, it
    is cut out.
    """
    camera = frame.camera
    stored = (camera.width, camera.height)
    straight = read_straight(frame.image, stored)
    if straight.shape[:2] != stored[::-1]:
        raise UserError("an image changed while it was read", got=str(straight.shape[:2][::-1]), wanted=str(stored))
    srgb, alpha = straight[..., :3], straight[..., 3]
    if frame.mask is not None:
        alpha = alpha * _read_mask(frame)
    elif background is not None and alpha.min() == 1.0:
        if isinstance(background, Backdrop):
            straight = cut_out(srgb, background, frame.name)
            srgb, alpha = straight[..., :3], straight[..., 3]
        else:
            alpha = alpha * plain_background_mask(srgb, background)
    if alpha.max() < 0.5:
        raise UserError(
            "a view shows nothing of the object",
            got=f"an empty mask for {frame.mask or frame.image}",
            wanted="a mask that is white on the object",
            fix="correct the mask, or remove the view",
        )
    if size == stored and not any(camera.distortion):  # no pixel is mixed with another: linear light is not needed
        pixels = to_uint8(np.concatenate([srgb, alpha[..., None]], axis=-1))
        return padded(pixels * (pixels[..., 3:] > 0), common)
    rgba = np.concatenate([linear_from_srgb(srgb) * alpha[..., None], alpha[..., None]], axis=-1)
    rgba = undistorted_image(rgba, (camera.fx, camera.fy, camera.cx, camera.cy), camera.distortion)
    return padded(straight_srgb_uint8(area_downsampled(rgba, size[1], size[0])), common)


def _read_mask(frame: SourceFrame) -> np.ndarray:
    """float32 [height, width] in [0, 1]: the mask's alpha where it has one that varies, else its brightest
    channel.
    """
    assert frame.mask is not None
    mask = read_straight(frame.mask, (frame.camera.width, frame.camera.height))
    if mask.shape[:2] != (frame.camera.height, frame.camera.width):
        raise UserError(
            "a mask has another size than its image",
            got=f"{mask.shape[1]} x {mask.shape[0]} pixels in {frame.mask}",
            wanted=f"{frame.camera.width} x {frame.camera.height}",
            fix="save the mask at the size of the image",
        )
    return mask[..., 3] if mask[..., 3].min() < 1 else mask[..., :3].max(axis=-1)


def shrunk(straight: np.ndarray, longest_side: int) -> np.ndarray:
    """float32 [.., .., 4], straight sRGB and alpha like its argument, area-averaged to `longest_side` pixels;
    returned as it is where it is no larger.
    """
    height, width = straight.shape[:2]
    shrink = longest_side / max(height, width)
    if shrink >= 1:
        return straight
    linear = linear_from_srgb(straight[..., :3]) * straight[..., 3:]
    rgba = np.concatenate([linear, straight[..., 3:]], axis=-1)
    small = area_downsampled(rgba, max(1, round(height * shrink)), max(1, round(width * shrink)))
    return straight_srgb_uint8(small).astype(np.float32) / 255


def with_alpha(image: np.ndarray) -> np.ndarray:
    """[height, width, 4]: `image` [.., .., 3 or 4], opaque where it has no alpha."""
    return image if image.shape[-1] == 4 else np.dstack([image, np.ones_like(image[..., 0])])


def straight_srgb_uint8(rgba: np.ndarray) -> np.ndarray:
    """uint8 [height, width, 4], straight sRGB and alpha, from linear premultiplied float; black where alpha
    is 0.
    """
    alpha = np.clip(rgba[..., 3:], 0, 1)
    linear_rgb = np.clip(rgba[..., :3] / np.maximum(alpha, 1e-6), 0, 1)
    pixels = to_uint8(np.concatenate([srgb_from_linear(linear_rgb), alpha], axis=-1))
    return pixels * (pixels[..., 3:] > 0)
