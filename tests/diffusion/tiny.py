"""A relighting model of a few thousand weights, and items to train it on, for the tests of this folder."""

from pathlib import Path

import numpy as np
import torch

from illuminerf.diffusion.conditioning import ConditioningConfig, PyramidConfig, TextureConfig
from illuminerf.diffusion.latents import PatchLatentConfig
from illuminerf.diffusion.relighting_model import RelightingModel, RelightingModelConfig, UNetConfig
from illuminerf.scene.relighting_pairs import encode_item
from illuminerf.workflow.shards import sample_tar, write_shard
from illuminerf.workflow.storage import Storage

TINY = RelightingModelConfig(
    image_size=32,
    latents=PatchLatentConfig(block=8, keep=2),
    unet=UNetConfig(block_out_channels=(16, 16), cross_attention_dim=16, num_heads=2, norm_num_groups=4),
    conditioning=ConditioningConfig(
        tokens=PyramidConfig(widths=(8, 8, 8), out_channels=16, patch=4),
        texture=TextureConfig(widths=(8, 8, 16), num_blocks=1, patch=4, is_material=True),
        embedding=PyramidConfig(widths=(8, 8), out_channels=16, patch=4),
    ),
)


def tiny_model(seed: int = 0) -> RelightingModel:
    torch.manual_seed(seed)
    return RelightingModel(TINY).eval()


def with_noise_in_every_weight(model: RelightingModel, seed: int = 1) -> RelightingModel:
    """A stand-in for training: no layer is zero any more."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return model


def random_condition_inputs(batch: int, size: int, seed: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, 4, size, size, generator=generator), torch.rand(batch, 12, size, size, generator=generator)


def write_items(folder: Path, count: int = 3, size: int = 32) -> Path:
    """Lambertian discs with a little gloss, in one shard as the renderer writes it."""
    generator = torch.Generator().manual_seed(0)
    axis = torch.linspace(-1, 1, size)
    alpha = (axis[:, None] ** 2 + axis**2 < 0.7).float()
    plane = np.ones((size, size), np.float32)
    samples = []
    for index in range(count):
        across, down = torch.rand(2, 4, 12, 1, 1, generator=generator) * 1.2 - 0.6
        brightness = 0.2 + torch.rand(4, 12, 1, 1, generator=generator)
        cues = brightness * (1.3 + across * axis + down * axis[:, None]) * alpha
        albedo = (0.1 + 0.8 * torch.rand(3, 1, 1, generator=generator)).expand(3, size, size)
        files = encode_item(
            targets=(cues[:, :3] * albedo + 0.04 * cues[:, 9:]).numpy(),
            cues=cues.numpy(),
            alpha=alpha.numpy(),
            base_color=albedo.numpy(),
            roughness=0.34 * plane,
            metallic=0 * plane,
            normal=np.stack([0 * plane, 0 * plane, plane]),
            metadata={},
        )
        samples.append(sample_tar(f"disc{index}_0", files))
    write_shard(Storage(folder), "pairs-000000", samples, {})
    return folder
