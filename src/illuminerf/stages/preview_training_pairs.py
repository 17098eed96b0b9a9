"""Training pairs -> one picture to look at before training on them.

A row per item: the object under each light, the four cues under the first, base colour, roughness, metallicity, normal,
and the item with a random material composited from its cues, as training may show it. What a column shows stands at
the top, names, lights and variations above each row.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from illuminerf.diffusion.augmentation import composited_target
from illuminerf.diffusion.training_items import training_item
from illuminerf.scene.images import srgb_from_linear, to_uint8, write_png
from illuminerf.scene.relighting_pairs import spread_items
from illuminerf.workflow.device import torch_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import step_progress

LABEL_HEIGHT = 14
"""Pixels of the line above a row, and of the headings at the top."""
GAP = 6
"""Pixels between groups of columns, and below a row."""
_GROUPS = (
    ("diffuse", "GGX 0.05", "GGX 0.13", "GGX 0.34"),
    ("base colour", "roughness", "metallic", "normal"),
    ("composited",),
)
_SMALL_TEXT = 10
# behind roughness and metallic, where white is a value
_PALE_BLUE = torch.tensor([0.80, 0.88, 1.0])[:, None, None]


@dataclass(frozen=True)
class Config:
    """What the sheet shows."""

    num_items: int = 24
    """Items, spread evenly over the pairs."""
    cell: int = 96
    """Pixels per picture."""
    seed: int = 0
    """Of the composited materials."""

    def __post_init__(self) -> None:
        if self.num_items < 1 or self.cell < 16:
            raise UserError("a sheet shows at least one item in pictures of at least 16 pixels")


def run(pairs: str | Path, config: Config, out: Path) -> Path:
    """Draw a contact sheet of training pairs.

    Args:
        pairs: what `render_training_pairs` made, or is still making: finished shards are shown.
        config: the settings.
        out: the .png to write.

    Raises:
        UserError: there are no finished shards, or one is damaged.
    """
    rows, num_lights = [], 0
    with step_progress("preview", config.num_items) as progress:
        for key, arrays, metadata in spread_items(pairs, config.num_items):
            num_lights = max(num_lights, len(arrays["targets"]))
            rows.append(_labelled(_row(key, arrays, config), _label(key, metadata)))
            progress.advance()
    if not rows:
        raise UserError(f"{pairs} holds no training items", wanted="pairs-000000.tar, ...", fix="render pairs first")
    rows.insert(0, _headings(num_lights, config.cell))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    write_png(out, np.concatenate(rows).astype(np.float32) / 255)
    return out


def column_starts(num_lights: int, cell: int) -> list[int]:
    """Left edges of all columns in pixels."""
    starts, x = [], 0
    for count in (num_lights, *map(len, _GROUPS)):
        starts += [x + cell * i for i in range(count)]
        x += cell * count + GAP
    return starts


def _headings(num_lights: int, cell: int) -> np.ndarray:
    titles = [*(f"light {i + 1}" for i in range(num_lights)), *(title for group in _GROUPS for title in group)]
    strips = np.concatenate([_text(title, cell) for title in titles], 1)
    return _with_gaps(strips, num_lights, cell)


def _with_gaps(row: np.ndarray, num_lights: int, cell: int) -> np.ndarray:
    """A row of pictures with white between lights, cues, surface and the composited one."""
    starts = column_starts(num_lights, cell)
    spaced = np.full((row.shape[0], starts[-1] + cell, 3), 255, np.uint8)
    for index, start in enumerate(starts):
        spaced[:, start : start + cell] = row[:, cell * index : cell * (index + 1)]
    return spaced


def _row(key: str, arrays: dict[str, np.ndarray], config: Config) -> np.ndarray:
    item = training_item(key, arrays, arrays["alpha"].shape[0])
    alpha = item.alpha.float()
    exposure = 0.6 / float(item.targets.float().amax((1, 2, 3)).median().clamp_min(1e-3)) ** 0.5
    lit = [_coded(target * exposure, alpha) for target in item.targets.float()]
    cues = [_coded(cue * exposure, alpha) for cue in item.cues[0].float().unflatten(0, (4, 3))]
    surface = [
        _coded(item.albedo.float(), alpha),
        *(plane.float() * alpha + _PALE_BLUE * (1 - alpha) for plane in (item.roughness, item.metallic)),
        (torch.from_numpy(arrays["normal"].astype(np.float32)) * 0.5 + 0.5) * alpha + 1 - alpha,
    ]
    generator = torch_generator(config.seed, "preview", key)
    composited = _coded(composited_target(item, item, item.cues[0].float(), generator) * exposure, alpha)
    pictures = np.concatenate([_cell(picture, config.cell) for picture in (*lit, *cues, *surface, composited)], 1)
    return _with_gaps(pictures, len(lit), config.cell)


def _coded(linear: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
    """Linear straight [3, h, w] over white, sRGB coded."""
    return srgb_from_linear(linear).clamp(0, 1) * alpha + 1 - alpha


def _cell(picture: torch.Tensor, size: int) -> np.ndarray:
    image = Image.fromarray(to_uint8(picture.permute(1, 2, 0).numpy()))
    return np.asarray(image.resize((size, size), Image.Resampling.BOX))


def _label(key: str, metadata: dict[str, Any]) -> str:
    lights = ", ".join(light["name"] for light in metadata.get("lights", []))
    variations = "; ".join(metadata.get("variations", []))
    return f"{key}   lights: {lights or 'unnamed'}" + (f"   varied: {variations}" if variations else "")


def _labelled(row: np.ndarray, label: str) -> np.ndarray:
    below = np.full((GAP, row.shape[1], 3), 255, np.uint8)
    return np.concatenate([_text(label, row.shape[1]), row, below])


def _text(text: str, width: int) -> np.ndarray:
    """One line of text on white, cut off at `width`."""
    strip = Image.new("RGB", (width, LABEL_HEIGHT), "white")
    font = ImageFont.load_default(_SMALL_TEXT)
    ImageDraw.Draw(strip).text((2, 1), text, fill="black", font=font)
    return np.asarray(strip)
