"""What a relighting model consists of: parameters by module, layers by shape; without weights, on the meta device."""

from typing import Any, NamedTuple

import torch
from diffusers import AutoencoderKL, UNet2DConditionModel
from torch import nn

from illuminerf.diffusion.conditioning import NUM_CUE_CHANNELS, NUM_IMAGE_CHANNELS, NUM_SHADING_CHANNELS
from illuminerf.diffusion.controlled_base import ControlledBase, ControlledBaseConfig
from illuminerf.diffusion.dilightnet import DILIGHTNET
from illuminerf.diffusion.frozen_base import FrozenBase
from illuminerf.diffusion.pretrained import EMBEDDED, model_folder
from illuminerf.diffusion.relighting_model import RelightingModel, RelightingModelConfig
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.config import from_json
from illuminerf.workflow.errors import UserError

SD21_UNET: dict[str, Any] = {
    "in_channels": 4,
    "out_channels": 4,
    "block_out_channels": (320, 640, 1280, 1280),
    "layers_per_block": 2,
    "down_block_types": ("CrossAttnDownBlock2D",) * 3 + ("DownBlock2D",),
    "up_block_types": ("UpBlock2D",) + ("CrossAttnUpBlock2D",) * 3,
    "cross_attention_dim": 1024,
    "attention_head_dim": (5, 10, 20, 20),
    "use_linear_projection": True,
}
SD21_VAE: dict[str, Any] = {
    "block_out_channels": (128, 256, 512, 512),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 2,
    "latent_channels": 4,
}
PAPER = ControlledBaseConfig(base=DILIGHTNET.base, revision=DILIGHTNET.revision)
"""The paper's tables on SD 2.1. Deviation: the paper's base is Google's own, with 8 latent channels instead of 4."""


class Layer(NamedTuple):
    """One row of the paper's tables."""

    kind: str
    """Convolution as (kernel, stride, padding), or what else it is."""
    shape: tuple[int, ...]
    """Of its output: height, width, channels; or tokens, width."""


def model_on_meta(name: str) -> RelightingModel | ControlledBase:
    """The architecture of "embedded", "dilightnet" or "paper" without weights; the latter two on SD 2.1.

    Raises:
        UserError: no such model.
    """
    if name == EMBEDDED:
        config = from_json(RelightingModelConfig, read_json(model_folder(EMBEDDED) / "relighting_model.json"))
        with torch.device("meta"):
            return RelightingModel(config)
    if name not in ("dilightnet", "paper"):
        raise UserError("unknown model", got=repr(name), wanted="embedded, dilightnet or paper")
    with torch.device("meta"):
        unet, vae = UNet2DConditionModel(**SD21_UNET), AutoencoderKL(**SD21_VAE)
        base = FrozenBase(unet, vae, {"prediction_type": "v_prediction"}, torch.empty(77, 1024))
        return ControlledBase(DILIGHTNET if name == "dilightnet" else PAPER, base)


def parameter_counts(model: RelightingModel | ControlledBase) -> dict[str, int]:
    """Parameters by module, in the order of the data."""
    conditioning = model.conditioning
    parts: dict[str, nn.Module | None] = {
        "ConvNet 1 (tokens)": conditioning.tokens,
        "ConvNet 2 (texture)": conditioning.texture,
        "ConvNet 3 (embedding)": conditioning.embedding,
        "ConvNet 4 (first convolution of the copy)": model.control.conv_in,
        "control (copy of encoder and middle block)": model.control,
    }
    if isinstance(model, ControlledBase):
        parts |= {"base UNet (frozen)": model.base.unet, "base VAE (frozen)": model.base.vae}
    else:
        parts["base UNet"] = model.base
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items() if part is not None}
    counts["control (copy of encoder and middle block)"] -= counts["ConvNet 4 (first convolution of the copy)"]
    counts["trained"] = sum(p.numel() for p in model.parameters() if p.requires_grad)
    counts["all"] = sum(p.numel() for p in model.parameters())
    return counts


def layer_tables(model: RelightingModel | ControlledBase) -> dict[str, list[Layer]]:
    """Every layer of ConvNets 1 to 4 with its output's shape at the model's own size; `model` is on the meta device."""
    size, config = model.image_size, model.conditioning.config
    tables: dict[str, list[Layer]] = {}
    if model.conditioning.tokens is not None:
        rows = _rows(model.conditioning.tokens, torch.empty(1, NUM_IMAGE_CHANNELS, size, size, device="meta"))
        height, width, channels = rows[-1].shape
        rows += [Layer("flatten", (height * width, channels)), Layer("zero padding", (config.text_length, channels))]
        tables["ConvNet 1"] = rows
    image = torch.empty(1, NUM_IMAGE_CHANNELS, size, size, device="meta")
    cues = torch.empty(1, NUM_CUE_CHANNELS, size, size, device="meta")
    tables["ConvNet 2"] = _rows(model.conditioning.texture, image, cues, cues[:, :NUM_SHADING_CHANNELS])
    tables["ConvNet 3"] = _rows(model.conditioning.embedding, cues)
    latent = torch.empty(1, *model.latent_shape(size, size), device="meta")
    tables["ConvNet 4"] = _rows(model.control.conv_in, latent)
    return tables


@torch.no_grad()
def _rows(network: nn.Module, *images: torch.Tensor) -> list[Layer]:
    rows: list[Layer] = []

    def record(layer: nn.Module, _: Any, out: torch.Tensor) -> None:
        assert isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)
        numbers = f"({layer.kernel_size[0]}, {layer.stride[0]}, {layer.padding[0]})"
        name = "transposed " if isinstance(layer, nn.ConvTranspose2d) else ""
        rows.append(Layer(name + numbers, (out.shape[2], out.shape[3], out.shape[1])))

    layers = [layer for layer in network.modules() if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)]
    hooks = [layer.register_forward_hook(record) for layer in layers]
    network(*images)
    for hook in hooks:
        hook.remove()
    return rows
