"""A folder of photographs without poses, as they come from a camera.

Every photograph becomes a `SourceFrame` whose pose is not known yet and whose focal length is what its EXIF says, or a
guess; the same code that masks and develops posed images then serves these too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from illuminerf.data.decoding import image_size
from illuminerf.data.source import IMAGE_SUFFIXES, MIN_VIEWS, SourceFrame, checked_camera, mask_for, natural_order
from illuminerf.data.video_frames import VIDEO_SUFFIXES, write_sharp_frames
from illuminerf.workflow.errors import UserError

GUESSED_FOCAL = 1.2
"""Focal length in longest sides where no file tells: that of a phone's main camera, near enough to start from."""
_FULL_FRAME_MM = 36.0
_EXIF_IFD, _FOCAL_35MM, _EXPOSURE, _APERTURE, _ISO = 0x8769, 0xA405, 0x829A, 0x829D, 0x8827
_REFUSED_SUFFIXES = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")


@dataclass(frozen=True)
class Shot:
    """What a photograph's EXIF tells; None where it does not.

    Attributes:
        focal: focal length in longest sides of the image.
        exposure: time times ISO over the squared aperture, to compare within one capture.
    """

    focal: float | None
    exposure: float | None


def photographs_of(source: Path, mask_folder: str, num_frames: int, work: Path) -> list[SourceFrame]:
    """The photographs of a folder in natural order, or sharp frames of a video, as frames without poses.

    Args:
        source: the folder (images in it or in its images/), or the video.
        mask_folder: folder inside `source`, or a path, with one mask per photograph; it need not exist.
        num_frames: of a video.
        work: where frames of a video are written.

    Raises:
        UserError: there are too few, or one cannot be read.
    """
    if source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES:
        root, paths = work, write_sharp_frames(source, num_frames, work)
    else:
        root, paths = source, _image_files(source)
    if len(paths) < MIN_VIEWS:
        raise UserError(
            "there are too few photographs",
            got=f"{len(paths)} in {source}",
            wanted=f"at least {MIN_VIEWS}; 50 to 100 from all around make a good capture",
            fix="take more",
        )
    seen: dict[str, Path] = {}
    for path in paths:
        if path.stem in seen:
            raise UserError(
                "two photographs have one name", got=f"{seen[path.stem].name} and {path.name}", fix="rename one of them"
            )
        seen[path.stem] = path
    return [_unposed(path, mask_for(root, path, mask_folder)) for path in paths]


def _image_files(source: Path) -> list[Path]:
    if not source.is_dir():
        raise UserError(
            "there are no photographs",
            got=f"{source}, which is {'no image folder' if source.exists() else 'missing'}",
            wanted=f"a folder of photographs, or a video ({', '.join(VIDEO_SUFFIXES)})",
            fix="check the path",
        )
    found = [path for path in _files(source) if path.suffix.lower() in IMAGE_SUFFIXES]
    refused = left_out(source)
    if refused and not found:
        raise UserError(
            "the photographs are in a format that is not read",
            got=f"{len(refused)} files such as {refused[0]}",
            wanted=", ".join(IMAGE_SUFFIXES),
            fix="export them as JPEG or PNG in sRGB",
        )
    return sorted(found, key=lambda path: natural_order(path.name))


def left_out(source: Path) -> list[str]:
    """Names of photographs in a folder whose format is not read; none where `source` is a video."""
    return sorted(path.name for path in _files(source) if path.suffix.lower() in _REFUSED_SUFFIXES)


def _files(source: Path) -> list[Path]:
    folder = source / "images" if (source / "images").is_dir() else source
    if not folder.is_dir():
        return []
    return [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]


def _unposed(path: Path, mask: Path | None) -> SourceFrame:
    size = image_size(path)
    focal = (read_shot(path).focal or GUESSED_FOCAL) * max(size)
    camera = checked_camera(path.name, size, (focal, focal), (size[0] / 2, size[1] / 2))
    return SourceFrame(path.stem, path, mask, np.eye(4), camera)


def read_shot(path: Path) -> Shot:
    """The EXIF of an image that has some."""
    try:
        with Image.open(path) as image:
            if image.format not in ("JPEG", "MPO", "TIFF", "WEBP"):
                return Shot(None, None)
            values = image.getexif().get_ifd(_EXIF_IFD)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, KeyError):
        return Shot(None, None)
    focal = _positive(values.get(_FOCAL_35MM))
    time, aperture, iso = (_positive(values.get(key)) for key in (_EXPOSURE, _APERTURE, _ISO))
    exposure = time * (iso or 100.0) / (aperture or 1.0) ** 2 if time else None
    return Shot(focal / _FULL_FRAME_MM if focal else None, exposure)


def _positive(value: object) -> float | None:
    """A number from EXIF, where rationals can be anything."""
    if isinstance(value, Sequence) and not isinstance(value, str) and value:
        value = value[0]
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None
