"""What every reader of a foreign folder returns: frames with poses, before any pixel is decoded.

A *source* is the caller's folder as it lies on disk. A `SourceFrame` names one of its images, its mask and
its camera; `SourceCapture` is the list of them. Readers (`tensoir`, `transforms_json`, `plain_folder`)
check the text files and look for the images; `decoding` reads the pixels.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from illuminerf.workflow.errors import UserError

MIN_VIEWS = 3
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".webp", ".tif", ".tiff", ".bmp")
RIGIDITY_TOLERANCE = 1e-2
"""Largest entry of R^T R - I that is still put down to rounding in a text file (and then projected out)."""


@dataclass(frozen=True)
class SourceCamera:
    """A pinhole camera with OpenCV distortion, for an image of `width` x `height` pixels.

    Principal point and focal lengths are in pixels, with the centre of the top-left pixel at (0.5, 0.5).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1, k2, p1, p2, k3."""


@dataclass(frozen=True)
class SourceFrame:
    """One image of a source folder with its pose; nothing is decoded yet."""

    name: str
    image: Path
    mask: Path | None
    world_from_camera: np.ndarray
    """float64 [4, 4], rigid, OpenGL axes, in the caller's world."""
    camera: SourceCamera


@dataclass(frozen=True)
class SourceCapture:
    """All frames of one source folder."""

    root: Path
    frames: tuple[SourceFrame, ...]
    shares_intrinsics: bool
    """True where one set of intrinsics in the source stands for every image: their sizes must then agree."""


def file_inside(root: Path, relative: str, declared_in: Path) -> Path:
    """The path of `relative` under `root`; absolute paths, `..` and links that leave `root` raise
    UserError.
    """
    candidate = root / relative
    resolved_root = root.resolve()
    try:
        resolved = candidate.resolve()
        resolved.exists()
    except (OSError, ValueError) as error:  # a loop of links, an embedded null, a name too long for any disk
        raise UserError(
            "a capture names a file that cannot be resolved",
            got=f"{relative!r} in {declared_in}",
            wanted="a plain path",
        ) from error
    if not resolved.is_relative_to(resolved_root):
        raise UserError(
            "a capture names a file outside its own folder",
            got=f"{relative!r} in {declared_in}",
            wanted=f"a path under {root}",
            fix="copy the file into the capture folder and name it relative to that folder",
        )
    return candidate


def image_inside(root: Path, relative: str, declared_in: Path) -> Path:
    """The existing image that `relative` names; a name without a suffix is tried with the known ones."""
    candidate = file_inside(root, relative, declared_in)
    if candidate.is_file():
        return candidate
    if candidate.suffix.lower() not in IMAGE_SUFFIXES:
        for suffix in IMAGE_SUFFIXES:
            with_suffix = file_inside(root, relative + suffix, declared_in)
            if with_suffix.is_file():
                return with_suffix
    raise UserError(
        "an image named by the capture is missing",
        got=f"no file {candidate}",
        wanted=f"the image {relative!r} that {declared_in.name} lists",
        fix="put the image back or remove its entry",
    )


def mask_for(root: Path, image: Path, mask_folder: str) -> Path | None:
    """The mask that goes with `image` by name: <mask_folder>/<stem>.png, or <mask_folder>/<file name>.png."""
    folder = root / mask_folder
    for name in (f"{image.stem}.png", f"{image.name}.png", image.name):
        if (folder / name).is_file():
            return file_inside(root, f"{mask_folder}/{name}", folder)
    return None


def rigid_pose(matrix: object, where: str) -> np.ndarray:
    """float64 [4, 4] pose from nested lists (3 or 4 rows), its rotation projected on SO(3).

    Raises UserError where it is not a matrix, not finite, a reflection, or scales or shears by more than
    RIGIDITY_TOLERANCE.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.size in (12, 16) and pose.ndim == 1:
        pose = pose.reshape(-1, 4)
    if pose.shape not in ((3, 4), (4, 4)):
        raise UserError(f"the camera pose of {where} is not a matrix", got=f"shape {list(pose.shape)}", wanted="4 x 4")
    if not np.isfinite(pose).all():
        raise UserError(
            f"the camera pose of {where} is not finite",
            got="NaN or infinity",
            wanted="16 finite numbers",
            fix="remove the view, or estimate its pose again",
        )
    if pose.shape == (4, 4) and not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        raise UserError(
            f"the camera pose of {where} is not rigid", got=f"last row {pose[3].tolist()}", wanted="[0, 0, 0, 1]"
        )
    rotation = pose[:3, :3]
    bounded = np.clip(rotation, -1e6, 1e6)  # the product of larger numbers overflows
    error = float(np.abs(bounded.T @ bounded - np.eye(3)).max())
    determinant = float(np.linalg.det(bounded))
    if error > RIGIDITY_TOLERANCE or determinant < 0:
        raise UserError(
            f"the camera pose of {where} is not rigid",
            got=f"determinant {determinant:.4g}, largest entry of R^T R - I {error:.3g}",
            wanted="a rotation: determinant 1, orthonormal axes",
            fix="remove scale, shear or mirroring from the world_from_camera matrix",
        )
    u, _, vt = np.linalg.svd(rotation)
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = pose[:3, 3]
    return rigid


def checked_camera(
    where: str,
    size: tuple[int, int],
    focal: Sequence[float],
    centre: Sequence[float],
    distortion: Sequence[float] = (0.0,) * 5,
) -> SourceCamera:
    """A SourceCamera of `size` = (width, height) after checking that its numbers can be a camera's."""
    numbers = np.array([*focal, *centre, *distortion], dtype=np.float64)
    if not np.isfinite(numbers).all() or min(focal) <= 0:
        raise UserError(
            f"the intrinsics of {where} are not those of a camera",
            got=f"focal lengths {list(focal)}, centre {list(centre)}, distortion {list(distortion)}",
            wanted="finite numbers in pixels, focal lengths above zero",
        )
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers.tolist()
    return SourceCamera(fx, fy, cx, cy, size[0], size[1], (k1, k2, p1, p2, k3))


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """Sort key under which r_2 comes before r_10."""
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", name)]


def checked_capture(root: Path, frames: Sequence[SourceFrame], shares_intrinsics: bool) -> SourceCapture:
    """A SourceCapture after the checks that need all frames: enough views, and sizes that shared intrinsics
    allow.
    """
    if not frames:
        raise UserError("the capture has no posed images", got=f"none in {root}", wanted=f"at least {MIN_VIEWS}")
    if len(frames) < MIN_VIEWS:
        raise UserError(
            "the capture has too few views",
            got=f"{len(frames)} in {root}",
            wanted=f"at least {MIN_VIEWS}, and some tens for a good reconstruction",
            fix="add photographs with poses",
        )
    sizes = {(frame.camera.width, frame.camera.height): frame.name for frame in frames}
    if shares_intrinsics and len(sizes) > 1:
        shown = ", ".join(f"{width} x {height} ({name})" for (width, height), name in list(sizes.items())[:3])
        raise UserError(
            "images of differing size share one set of intrinsics",
            got=shown,
            wanted="one size, or fl_x, fl_y, cx, cy, w and h written for every frame",
            fix="resize the images to one size, or write the intrinsics per frame",
        )
    positions = np.stack([frame.world_from_camera[:3, 3] for frame in frames])
    if np.ptp(positions, axis=0).max() == 0.0:
        raise UserError(
            "all cameras of the capture are at one point",
            got=f"{positions[0].tolist()} for {len(frames)} views",
            wanted="views from around the object",
        )
    return SourceCapture(root, tuple(frames), shares_intrinsics)
