"""A Stable-Diffusion-class base of a few thousand random weights in the hub's layout, and DiLightNet's folder to it."""

import json
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKL, ControlNetModel, UNet2DConditionModel
from torch import nn

from illuminerf.diffusion.conditioning import ConditioningConfig, PyramidConfig, TextureConfig
from illuminerf.diffusion.controlled_base import ControlledBase, ControlledBaseConfig
from illuminerf.diffusion.frozen_base import load_base
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.checkpoint import save_checkpoint

WIDTH, TEXT_LENGTH, VOCABULARY = 16, 77, 24
WEIGHTS = "diffusion_pytorch_model.safetensors"
SCHEDULER = {
    "_class_name": "PNDMScheduler",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "num_train_timesteps": 1000,
    "prediction_type": "epsilon",
    "steps_offset": 1,
    "skip_prk_steps": True,
}
CONDITIONING = ConditioningConfig(
    tokens=PyramidConfig(widths=(8, 8, 8), out_channels=WIDTH),
    texture=TextureConfig(widths=(8, 8, 16), num_blocks=1),
    embedding=PyramidConfig(widths=(8, 8, 8, 8), out_channels=16),
)


def text_encoder(hidden_act: str = "gelu") -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """(config, weights) under the names of the hub's text encoders."""
    config = {
        "hidden_act": hidden_act,
        "hidden_size": WIDTH,
        "intermediate_size": 32,
        "layer_norm_eps": 1e-5,
        "max_position_embeddings": TEXT_LENGTH,
        "num_attention_heads": 2,
        "num_hidden_layers": 2,
        "vocab_size": VOCABULARY,
    }
    shapes = {
        "embeddings.token_embedding.weight": (VOCABULARY, WIDTH),
        "embeddings.position_embedding.weight": (TEXT_LENGTH, WIDTH),
        "final_layer_norm.weight": (WIDTH,),
        "final_layer_norm.bias": (WIDTH,),
    }
    for layer in range(2):
        sizes = {f"self_attn.{part}_proj": (WIDTH, WIDTH) for part in ("q", "k", "v", "out")}
        sizes |= {"mlp.fc1": (32, WIDTH), "mlp.fc2": (WIDTH, 32)}
        for name, size in sizes.items():
            shapes[f"encoder.layers.{layer}.{name}.weight"] = size
            shapes[f"encoder.layers.{layer}.{name}.bias"] = size[:1]
        for norm in ("layer_norm1", "layer_norm2"):
            shapes[f"encoder.layers.{layer}.{norm}.weight"] = (WIDTH,)
            shapes[f"encoder.layers.{layer}.{norm}.bias"] = (WIDTH,)
    generator = torch.Generator().manual_seed(0)
    weights = {f"text_model.{k}": torch.randn(v, generator=generator) for k, v in shapes.items()}
    return config, weights


def write_base(folder: Path, prediction_type: str = "epsilon", latent_channels: int = 4) -> Path:
    torch.manual_seed(0)
    unet = UNet2DConditionModel(
        sample_size=4, in_channels=latent_channels, out_channels=latent_channels, layers_per_block=1,
        block_out_channels=(16, 16),
        down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"), up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
        cross_attention_dim=WIDTH, attention_head_dim=2, norm_num_groups=4, use_linear_projection=True,
    )  # fmt: skip
    vae = AutoencoderKL(
        block_out_channels=(8, 8, 8, 8), down_block_types=("DownEncoderBlock2D",) * 4, norm_num_groups=4,
        up_block_types=("UpDecoderBlock2D",) * 4, latent_channels=latent_channels, layers_per_block=1,
    )  # fmt: skip
    for name, network in (("unet", unet), ("vae", vae)):
        network.save_config(folder / name)
        save_checkpoint(folder / name / WEIGHTS, network.state_dict(), {})
    write_json(folder / "scheduler" / "scheduler_config.json", SCHEDULER | {"prediction_type": prediction_type})
    config, weights = text_encoder()
    write_json(folder / "text_encoder" / "config.json", config)
    save_checkpoint(folder / "text_encoder" / "model.safetensors", weights, {})
    return folder


def tiny_config(base: Path | str, **changes: Any) -> ControlledBaseConfig:
    return ControlledBaseConfig(**({"base": str(base), "image_size": 32, "conditioning": CONDITIONING} | changes))


def tiny_controlled(folder: Path) -> ControlledBase:
    torch.manual_seed(0)
    return ControlledBase(tiny_config(folder), load_base(folder)).eval()


class PublishedEmbedding(nn.Module):
    """Layers with the names and order of DiLightNet's public conditioning embedding; used for its names and results."""

    def __init__(self, widths: tuple[int, int, int], pyramid: tuple[int, ...], out_channels: int) -> None:
        super().__init__()
        a, b, c = widths
        residual = [nn.Module() for _ in range(4)]
        for block in residual:
            block.conv = nn.Sequential(
                nn.Conv2d(c, c, 3, 1, 1), nn.GroupNorm(8, c), nn.SiLU(), nn.Conv2d(c, c, 3, 1, 1)
            )
        layers = [
            nn.Conv2d(4, a, 3, 1, 1), nn.SiLU(),
            nn.Conv2d(a, b, 3, 2, 1), nn.GroupNorm(8, b), nn.SiLU(),
            nn.Conv2d(b, c, 3, 2, 1), nn.GroupNorm(8, c), nn.SiLU(),
            *residual,
            nn.ConvTranspose2d(c, b, 4, 2, 1), nn.GroupNorm(8, b), nn.SiLU(),
            nn.ConvTranspose2d(b, a, 4, 2, 1), nn.GroupNorm(8, a), nn.SiLU(),
            nn.Conv2d(a, 12, 3, 1, 1),
        ]  # fmt: skip
        self.neural_texture_encoder = nn.Module()
        self.neural_texture_encoder.model = nn.ModuleList(layers)
        self.conv_in = nn.Conv2d(12, pyramid[0], 3, 1, 1)
        self.blocks = nn.ModuleList()
        for fine, coarse in zip(pyramid[:-1], pyramid[1:], strict=True):
            self.blocks.extend([nn.Conv2d(fine, fine, 3, 1, 1), nn.Conv2d(fine, coarse, 3, 2, 1)])
        self.conv_out = nn.Conv2d(pyramid[-1], out_channels, 3, 1, 1)

    def forward(self, sixteen: torch.Tensor) -> torch.Tensor:
        features, cues = sixteen.split([4, 12], 1)
        for layer in self.neural_texture_encoder.model:
            features = features + layer.conv(features) if hasattr(layer, "conv") else layer(features)
        features = nn.functional.silu(self.conv_in(features * cues))
        for block in self.blocks:
            features = nn.functional.silu(block(features))
        return self.conv_out(features)


def write_published(folder: Path, base: Path) -> PublishedEmbedding:
    """DiLightNet's folder as the hub has it, with random weights nowhere zero; returns its conditioning embedding."""
    unet = load_base(base).unet
    torch.manual_seed(3)
    control = ControlNetModel.from_unet(unet)
    embedding = PublishedEmbedding((8, 8, 16), (8, 8, 8, 8), 16)
    control.controlnet_cond_embedding = embedding
    with torch.no_grad():
        for parameter in control.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    control.save_config(folder)
    config = json.loads((folder / "config.json").read_text())
    config |= {
        "_class_name": "NeuralTextureControlNetModel",
        "conditioning_channels": 4,
        "shading_hint_channels": 12,
        "conditioning_embedding_out_channels": [8, 8, 8, 8],
    }
    write_json(folder / "config.json", config)
    save_checkpoint(folder / WEIGHTS, control.state_dict(), {})
    return embedding
