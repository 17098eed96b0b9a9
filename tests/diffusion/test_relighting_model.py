"""The controlled UNet: zero start, storage."""

from pathlib import Path

import pytest
import torch

from illuminerf.diffusion.conditioning import ConditioningConfig
from illuminerf.diffusion.latents import PatchLatentConfig
from illuminerf.diffusion.relighting_model import (
    RelightingModel,
    RelightingModelConfig,
    UNetConfig,
    load_model,
    save_model,
)
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import TINY, random_condition_inputs, tiny_model, with_noise_in_every_weight


def base_alone(model: RelightingModel, latent: torch.Tensor, timesteps: torch.Tensor) -> torch.Tensor:
    text = model.empty_text.expand(len(latent), -1, -1)
    return model.base(latent, timesteps, text, return_dict=False)[0]


@torch.no_grad()
def test_untrained_control_leaves_the_base_exactly_unchanged() -> None:
    model = tiny_model()
    image, cues = random_condition_inputs(2, 32)
    latent, timesteps = torch.randn(2, TINY.latents.channels, 4, 4), torch.tensor([3, 700])
    condition = model.condition(image, cues)
    assert torch.equal(model(latent, timesteps, condition), base_alone(model, latent, timesteps))
    trained = with_noise_in_every_weight(model)
    changed = trained(latent, timesteps, trained.condition(image, cues))
    assert not torch.allclose(changed, base_alone(trained, latent, timesteps), atol=1e-3)


@torch.no_grad()
def test_control_starts_as_a_copy_of_the_encoder() -> None:
    model = tiny_model()
    base = model.base.state_dict()
    copied = {k: v for k, v in model.control.state_dict().items() if not k.startswith("controlnet_")}
    assert {k.split(".")[0] for k in copied} == {"conv_in", "time_embedding", "down_blocks", "mid_block"}
    assert all(torch.equal(base[name], value) for name, value in copied.items())


def test_stable_diffusion_sizes_fit_without_weights() -> None:
    config = RelightingModelConfig(
        image_size=512,
        latents=PatchLatentConfig(block=8, keep=2),
        unet=UNetConfig(
            block_out_channels=(320, 640, 1280, 1280),
            attention_blocks=(True, True, True, False),
            decoder_attends=True,
            layers_per_block=2,
            cross_attention_dim=1024,
            num_heads=8,
            norm_num_groups=32,
        ),
        conditioning=ConditioningConfig(),
        latent_is_residual=False,
    )
    with torch.device("meta"):
        model = RelightingModel(config)
    assert 860e6 < sum(p.numel() for p in model.base.parameters()) < 872e6
    assert model.control.conv_in.weight.shape == (320, 12, 3, 3)
    assert len(model.control.controlnet_down_blocks) == 12


@torch.no_grad()
def test_save_and_load_round_trip(tmp_path: Path) -> None:
    model = with_noise_in_every_weight(tiny_model())
    save_model(model, tmp_path)
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {
        "unet",
        "controlnet",
        "conditioning",
        "vae",
        "scheduler",
    }
    assert not [path for path in tmp_path.rglob("*.bin")]
    loaded = load_model(tmp_path)
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())
    save_model(model, tmp_path / "half", half=True)
    halved = load_model(tmp_path / "half").state_dict()
    worst = max(float((value - halved[name]).abs().max()) for name, value in model.state_dict().items())
    assert 0 < worst < 2e-3


def test_unfit_weights_are_a_user_error(tmp_path: Path) -> None:
    save_model(tiny_model(), tmp_path)
    text = (tmp_path / "relighting_model.json").read_text()
    (tmp_path / "relighting_model.json").write_text(text.replace('"num_blocks": 1', '"num_blocks": 2'))
    with pytest.raises(UserError, match="do not fit"):
        load_model(tmp_path)


def test_inconsistent_widths_are_refused() -> None:
    with pytest.raises(ValueError, match="widths are equal"):
        RelightingModelConfig(unet=UNetConfig(block_out_channels=(32, 64)))
