"""Which pixels of photographs without poses show the object: by given masks, alpha, a plain backdrop, or a network.

Whatever the source, it ends as what `developing.develop` reads: a mask file per frame, alpha, or a backdrop.
"""

import dataclasses
import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from illuminerf.data.decoding import read_straight
from illuminerf.data.developing import develop
from illuminerf.data.plain_background import Backdrop, find_backdrop
from illuminerf.data.source import SourceFrame
from illuminerf.scene.images import to_uint8, write_png
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, track

MaskSource = Literal["auto", "folder", "alpha", "plain", "rembg", "none"]
_NETWORK = "isnet-general-use"
_BLACK, _WHITE = 2 / 255, 253 / 255  # a network's faint doubts about the background are not soft edges


@dataclass(frozen=True)
class Masked:
    """Frames whose masks are settled.

    Attributes:
        frames: each with its mask, if masks are files.
        backdrop: the plain one that is cut away, or None.
        source: where masks come from.
    """

    frames: tuple[SourceFrame, ...]
    backdrop: Backdrop | None
    source: MaskSource

    def cut(self, frame: SourceFrame) -> np.ndarray:
        """uint8 [height, width, 4]: straight sRGB and alpha, as large as the file."""
        size = (frame.camera.width, frame.camera.height)
        return develop(frame, size, size, self.backdrop)


def settle_masks(frames: Sequence[SourceFrame], wanted: MaskSource, work: Path) -> Masked:
    """Find or make the masks of `frames`.

    Args:
        frames: with the masks of the mask folder where it has them.
        wanted: where masks come from; "auto" takes the first of the folder, alpha and a plain backdrop that is there.
        work: gets mask files that are made.

    Raises:
        UserError: what is wanted is not there.
    """
    bare = tuple(dataclasses.replace(frame, mask=None) for frame in frames)
    source = _found_source(frames) if wanted == "auto" else wanted
    match source:
        case "folder":
            return Masked(_all_masked(frames), None, source)
        case "alpha":
            return Masked(_all_with_alpha(bare), None, source)
        case "plain":
            return Masked(bare, find_backdrop(bare), source)
        case "rembg":
            return Masked(_cut_by_network(bare, work), None, source)
    return Masked(bare, None, "none")


def _found_source(frames: Sequence[SourceFrame]) -> MaskSource:
    if any(frame.mask for frame in frames):
        return "folder"
    if _has_alpha(frames[0]):
        return "alpha"
    try:
        backdrop = find_backdrop(frames)
    except UserError:
        backdrop = None
    if backdrop is None:
        say("no masks and no plain background: poses come from whole photographs and every pixel counts as object")
        return "none"
    say(f"the background is plain ({', '.join(f'{255 * value:.0f}' for value in backdrop.srgb)}): it is cut away")
    return "plain"


def _has_alpha(frame: SourceFrame) -> bool:
    return bool(read_straight(frame.image)[..., 3].min() < 1)


def _all_masked(frames: Sequence[SourceFrame]) -> tuple[SourceFrame, ...]:
    missing = [frame.image.name for frame in frames if frame.mask is None]
    if missing:
        raise UserError(
            "photographs lack their masks",
            got=f"none for {', '.join(missing[:3])}{' and more' if len(missing) > 3 else ''}",
            wanted=f"{frames[0].image.stem}.png and so on in the mask folder",
            fix="add them, or choose masks alpha, plain or rembg",
        )
    return tuple(frames)


def _all_with_alpha(frames: tuple[SourceFrame, ...]) -> tuple[SourceFrame, ...]:
    opaque = next((frame for frame in (frames[0], frames[-1]) if not _has_alpha(frame)), None)
    if opaque is not None:
        raise UserError(
            "a photograph has no transparent pixels", got=opaque.image.name, wanted="alpha", fix="choose other masks"
        )
    return frames


def _cut_by_network(frames: tuple[SourceFrame, ...], work: Path) -> tuple[SourceFrame, ...]:
    rembg = _load_rembg()
    session = rembg.new_session(_NETWORK)
    masked = []
    for frame in track(frames, "cut out the object"):
        size = (frame.camera.width, frame.camera.height)
        srgb = to_uint8(read_straight(frame.image, size)[..., :3])
        grey = rembg.remove(Image.fromarray(srgb), session=session, only_mask=True)
        alpha = np.asarray(grey.convert("L"), np.float32) / 255
        path = work / f"{frame.name}.png"
        write_png(path, np.where(alpha < _BLACK, 0, np.where(alpha > _WHITE, 1, alpha)))
        masked.append(dataclasses.replace(frame, mask=path))
    return tuple(masked)


def _load_rembg() -> Any:
    try:
        return importlib.import_module("rembg")
    except ImportError as error:
        raise UserError(
            "the object cannot be cut out by a network: rembg is not installed",
            got=str(error),
            fix="pip install 'illuminerf[cutout]' (it downloads its network at the first use), or give masks",
        ) from error
