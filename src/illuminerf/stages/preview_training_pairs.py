"""Training pairs -> one picture to look at before training on them.

A row per item: the object under each light, the four cues under the first, base colour, roughness, metallicity, normal,
and the item with a random material composited from its cues, as training may show it. Names and variations stand above.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw

from illuminerf.diffusion.augmentation import composited_target
from illuminerf.diffusion.training_items import training_item
from illuminerf.scene.images import srgb_from_linear, to_uint8, write_png
from illuminerf.scene.relighting_pairs import iterate_items
from illuminerf.workflow.device import torch_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import step_progress

_LABEL_HEIGHT = 14


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
    rows = []
    with step_progress("preview", config.num_items) as progress:
        for key, arrays, metadata in _spread(pairs, config.num_items):
            rows.append(_labelled(_pictures(key, arrays, config), _label(key, metadata)))
            progress.advance()
    if not rows:
        raise UserError(f"{pairs} holds no training items", wanted="pairs-000000.tar, ...", fix="render pairs first")
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    write_png(out, np.concatenate(rows).astype(np.float32) / 255)
    return out


def _spread(pairs: str | Path, wanted: int) -> Iterator[tuple[str, dict[str, np.ndarray], dict[str, Any]]]:
    total = sum(1 for _ in iterate_items(pairs))
    shown = set(np.linspace(0, total - 1, min(wanted, total)).round().astype(int).tolist())
    yield from (item for index, item in enumerate(iterate_items(pairs)) if index in shown)


def _pictures(key: str, arrays: dict[str, np.ndarray], config: Config) -> np.ndarray:
    item = training_item(key, arrays, arrays["alpha"].shape[0])
    alpha = item.alpha.float()
    exposure = 0.6 / float(item.targets.float().amax((1, 2, 3)).median().clamp_min(1e-3)) ** 0.5
    lit = [_coded(target * exposure, alpha) for target in item.targets.float()]
    cues = [_coded(cue * exposure, alpha) for cue in item.cues[0].float().unflatten(0, (4, 3))]
    surface = [
        _coded(item.albedo.float(), alpha),
        *(plane.float().expand(3, -1, -1) * alpha + 1 - alpha for plane in (item.roughness, item.metallic)),
        (torch.from_numpy(arrays["normal"].astype(np.float32)) * 0.5 + 0.5) * alpha + 1 - alpha,
    ]
    generator = torch_generator(config.seed, "preview", key)
    composited = _coded(composited_target(item, item, item.cues[0].float(), generator) * exposure, alpha)
    return np.concatenate([_cell(picture, config.cell) for picture in (*lit, *cues, *surface, composited)], 1)


def _coded(linear: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
    """Linear straight [3, h, w] over white, sRGB coded."""
    return srgb_from_linear(linear).clamp(0, 1) * alpha + 1 - alpha


def _cell(picture: torch.Tensor, size: int) -> np.ndarray:
    image = Image.fromarray(to_uint8(picture.permute(1, 2, 0).numpy()))
    return np.asarray(image.resize((size, size), Image.Resampling.BOX))


def _label(key: str, metadata: dict[str, Any]) -> str:
    lights = ", ".join(light["name"] for light in metadata.get("lights", []))
    variations = "; ".join(metadata.get("variations", []))
    return f"{key}  [{lights}]" + (f"  varied: {variations}" if variations else "")


def _labelled(row: np.ndarray, label: str) -> np.ndarray:
    strip = Image.new("RGB", (row.shape[1], _LABEL_HEIGHT), "white")
    ImageDraw.Draw(strip).text((2, 1), label, fill="black")
    return np.concatenate([np.asarray(strip), row])
