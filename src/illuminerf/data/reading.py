"""Which reader a folder needs."""

from pathlib import Path
from typing import Literal

from illuminerf.data.plain_folder import is_plain_folder, read_plain_folder
from illuminerf.data.source import SourceCapture
from illuminerf.data.tensoir import is_tensoir_scene, read_scene
from illuminerf.data.transforms_json import read_transforms, transforms_file
from illuminerf.workflow.errors import UserError

CaptureFormat = Literal["tensoir", "transforms", "plain"]


def detect_format(root: Path, split: str) -> CaptureFormat:
    """The format of the folder `root`; UserError where it is missing, empty or none of the known ones."""
    if not root.exists():
        raise UserError("the capture folder does not exist", got=str(root), wanted="a folder of posed images")
    if not root.is_dir():
        raise UserError(
            "the capture is not a folder",
            got=str(root),
            wanted="a folder of posed images",
            fix="a video: run `illuminerf capture` on it first, see docs/own_photos.md",
        )
    if is_tensoir_scene(root):
        return "tensoir"
    if transforms_file(root, split):
        return "transforms"
    if is_plain_folder(root):
        return "plain"
    inside = sorted(path.name for path in root.iterdir())[:5]
    raise UserError(
        "the capture folder holds no camera poses",
        got=f"{', '.join(inside) if inside else 'an empty folder'} in {root}",
        wanted="transforms.json, cameras.json or train_000/metadata.json beside the images",
        fix="photographs without poses: run `illuminerf capture` on them first, see docs/own_photos.md",
    )


def read_source(
    root: Path,
    capture_format: CaptureFormat | None = None,
    split: str = "train",
    light: str = "sunset",
    mask_folder: str = "masks",
) -> SourceCapture:
    """The frames of `split` in `root`, of the given or the detected format."""
    found = detect_format(root, split)
    match capture_format or found:
        case "tensoir":
            return read_scene(root, light, split)
        case "transforms":
            return read_transforms(root, split, mask_folder)
        case "plain":
            return read_plain_folder(root, mask_folder)
