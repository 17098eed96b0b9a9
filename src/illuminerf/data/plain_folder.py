"""This project's own folder of posed images: images/, cameras.json and, where alpha is not in the images,
masks/.

cameras.json is `Cameras.to_dict()`: height, width and frames, each with world_from_camera (4 x 4, OpenGL
axes, z up) and intrinsics {fx, fy, cx, cy}. A frame may add image and mask (paths relative to the folder),
height and width, and distortion {k1, k2, p1, p2, k3}. Without image the files of images/ are taken in
natural order. A capture folder, as `import_capture` writes it, has this layout too.
"""

from pathlib import Path
from typing import Any

from illuminerf.data.decoding import image_size
from illuminerf.data.source import (
    IMAGE_SUFFIXES,
    SourceCapture,
    SourceFrame,
    checked_camera,
    checked_capture,
    image_inside,
    mask_for,
    natural_order,
    rigid_pose,
)
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError


def is_plain_folder(root: Path) -> bool:
    """True where `root` holds cameras.json."""
    return (root / "cameras.json").is_file()


def read_plain_folder(root: Path, mask_folder: str = "masks") -> SourceCapture:
    """All frames of the folder `root`."""
    path = root / "cameras.json"
    content = read_json(path)
    entries = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise UserError(
            "cameras.json does not list frames",
            got=f"{type(content).__name__} in {path}",
            wanted='{"height": ..., "width": ..., "frames": [{"world_from_camera": ..., "intrinsics": ...}]}',
        )
    images = _images(root, path, entries)
    frames = []
    for image, entry in zip(images, entries, strict=True):
        mask = entry.get("mask")
        mask_file = image_inside(root, str(mask), path) if mask else mask_for(root, image, mask_folder)
        pose = rigid_pose(entry.get("world_from_camera"), f"{image.name} in {path}")
        name = image.relative_to(root).with_suffix("").as_posix().removeprefix("images/")
        size, focal, centre, distortion = _read_intrinsics(content, entry, image, path)
        camera = checked_camera(f"{image.name} in {path}", size, focal, centre, distortion)
        frames.append(SourceFrame(name, image, mask_file, pose, camera))
    return checked_capture(root, frames, shares_intrinsics=False)


def _images(root: Path, path: Path, entries: list[dict[str, Any]]) -> list[Path]:
    named = [entry.get("image") for entry in entries]
    if all(isinstance(name, str) for name in named):
        return [image_inside(root, str(name), path) for name in named]
    folder = root / "images"
    found = [file for file in folder.glob("*") if file.suffix.lower() in IMAGE_SUFFIXES]
    found.sort(key=lambda file: natural_order(file.name))
    if len(found) != len(entries):
        raise UserError(
            "images and cameras do not match one to one",
            got=f"{len(found)} images in {folder} and {len(entries)} frames in {path.name}",
            wanted="one image per frame, or an 'image' entry in every frame",
            fix="add the missing files or entries",
        )
    return [image_inside(root, f"images/{file.name}", path) for file in found]


def _read_intrinsics(
    content: dict[str, Any], entry: dict[str, Any], image: Path, path: Path
) -> tuple[tuple[int, int], tuple[float, float], tuple[float, float], list[float]]:
    """(width, height) on disk, focal lengths and centre at that size, distortion."""
    try:
        width, height = int(entry.get("width", content["width"])), int(entry.get("height", content["height"]))
        fx, fy, cx, cy = (float(entry["intrinsics"][key]) for key in ("fx", "fy", "cx", "cy"))
        given = entry.get("distortion", {})
        distortion = [float(given.get(name, 0.0)) for name in ("k1", "k2", "p1", "p2", "k3")]
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(
            f"the camera of {image.name} is not complete",
            got=f"{type(error).__name__} {error} in {path}",
            wanted="width, height and intrinsics {fx, fy, cx, cy}",
        ) from error
    size = image_size(image, (width, height))
    if min(width, height) < 1 or abs(width * size[1] - height * size[0]) > max(width, height, *size):
        raise UserError(
            "an image has another shape than its camera",
            got=f"{size[0]} x {size[1]} pixels in {image}",
            wanted=f"the aspect of {width} x {height}",
            fix="write width, height and the intrinsics per frame",
        )
    to_x, to_y = size[0] / width, size[1] / height
    return size, (fx * to_x, fy * to_y), (cx * to_x, cy * to_y), distortion
