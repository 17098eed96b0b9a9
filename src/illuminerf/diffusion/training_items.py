"""Rendered training items: one object from one camera under a few lights, with its cues and G-buffer.

They are read from the shards that `render_training_pairs` writes (see `scene.relighting_pairs`).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from illuminerf.scene.images import linear_from_srgb
from illuminerf.scene.relighting_pairs import iterate_items
from illuminerf.workflow.errors import UserError

_SMALLEST_COVERAGE = 0.02
_LARGEST_RADIANCE = 1000.0


@dataclass(frozen=True)
class TrainingItem:
    """One object from one camera; everything straight (not premultiplied), linear and float16 unless said."""

    name: str
    targets: Float[Tensor, "lights 3 height width"]
    cues: Float[Tensor, "lights 12 height width"]
    alpha: Float[Tensor, "1 height width"]
    albedo: Float[Tensor, "3 height width"]
    roughness: Float[Tensor, "1 height width"]
    metallic: Float[Tensor, "1 height width"]
    is_dented: bool = False
    """Whether the cues come from geometry that is not quite the targets'."""


def load_items(folder: str | Path, size: int) -> list[TrainingItem]:
    """Read every item in the finished shards of `folder` (or an fsspec URL), area-averaged to `size` pixels, by name.

    Items with almost no covered pixels or without light are left out.

    Raises:
        UserError: there is no item, or one is damaged or larger than `size` by no whole factor.
    """
    items = [
        replace(training_item(key, arrays, size), is_dented=bool(metadata.get("dent_tilts_degrees")))
        for key, arrays, metadata in iterate_items(folder)
    ]
    if not items:
        raise UserError(f"{folder} holds no training items", wanted="pairs-000000.tar, ...", fix="render pairs first")
    return sorted((item for item in items if _is_usable(item)), key=lambda item: item.name)


def training_item(name: str, arrays: dict[str, np.ndarray], size: int) -> TrainingItem:
    """One item from its dense arrays (see `scene.relighting_pairs.decode_item`), area-averaged to `size` pixels.

    Raises:
        UserError: the item is larger than `size` by no whole factor.
    """
    tensors = {field: torch.from_numpy(values) for field, values in arrays.items()}
    height = tensors["targets"].shape[-1]
    if height % size:
        raise UserError(f"{name} is {height} pixels wide", wanted=f"a multiple of {size}")
    factor = height // size

    def averaged(values: Tensor) -> Tensor:
        return functional.avg_pool2d(values, factor) if factor > 1 else values

    covered = tensors["alpha"].float()[None, None] / 255
    alpha = averaged(covered)
    straight = (alpha > _SMALLEST_COVERAGE) / alpha.clamp_min(_SMALLEST_COVERAGE)

    def radiance(name: str) -> Tensor:
        finite = torch.nan_to_num(tensors[name].float(), 0.0, _LARGEST_RADIANCE, 0.0)
        return (averaged(finite.clamp(0, _LARGEST_RADIANCE)) * straight).clamp_max(_LARGEST_RADIANCE).half()

    def surface(name: str) -> Tensor:
        # weighted by coverage: off the object there are zeros, which would darken its edges
        values = tensors[name].float().reshape(1, -1, height, height) / 255
        linear = linear_from_srgb(values) if name == "albedo" else values
        return (averaged(linear * covered) / alpha.clamp_min(_SMALLEST_COVERAGE))[0].clamp_max(1).half()

    return TrainingItem(
        name, radiance("targets"), radiance("cues"), alpha[0].half(), surface("albedo"), surface("roughness"),
        surface("metallic"),
    )  # fmt: skip


def _is_usable(item: TrainingItem) -> bool:
    covered = float(item.alpha.float().mean())
    return covered > 0.01 and float(item.cues[:, :3].float().mean((1, 2, 3)).min()) > 1e-4


def diffuse_level(cues: Float[Tensor, "12 height width"], alpha: Float[Tensor, "1 height width"]) -> Tensor:
    """Mean diffuse cue over covered pixels and colours: how bright the light is on this object."""
    return ((cues[:3] * alpha).sum() / (3 * alpha.sum()).clamp_min(1e-3)).clamp_min(1e-4)
