"""The paper's architecture on a tiny base: exact zero start, frozen base, storage; full size on the meta device."""

from pathlib import Path

import pytest
import torch
from diffusers import DDPMScheduler

from illuminerf.diffusion.conditioning import ConditioningConfig, PyramidConfig
from illuminerf.diffusion.controlled_base import ControlledBase, save_controlled
from illuminerf.diffusion.empty_text import load_empty_text, save_empty_text
from illuminerf.diffusion.frozen_base import load_base
from illuminerf.diffusion.full_size import Photograph, relight_photographs
from illuminerf.diffusion.pretrained import pretrained_model
from illuminerf.diffusion.sampling import Sampler, sample_relit, sampling_schedule
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import random_condition_inputs, with_noise_in_every_weight
from tests.diffusion.tiny_base import (
    TEXT_LENGTH,
    VOCABULARY,
    WEIGHTS,
    WIDTH,
    tiny_config,
    tiny_controlled,
    write_base,
)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_base(tmp_path_factory.mktemp("base"))


def base_alone(model: ControlledBase, latent: torch.Tensor, timesteps: torch.Tensor) -> torch.Tensor:
    text = model.base.empty_text.expand(len(latent), -1, -1)
    return model.base.unet(latent, timesteps, text, return_dict=False)[0]


@torch.no_grad()
def test_untrained_control_leaves_the_base_bitwise_unchanged(base: Path) -> None:
    model = tiny_controlled(base)
    image, cues = random_condition_inputs(2, 32)
    latent, timesteps = torch.randn(2, *model.latent_shape(32, 32)), torch.tensor([3, 700])
    condition = model.condition(image, cues)
    assert (condition.tokens == 0).all() and (condition.embedding == 0).all()
    assert torch.equal(model(latent, timesteps, condition), base_alone(model, latent, timesteps))
    for part in (model.control.controlnet_mid_block, model.control.controlnet_down_blocks[0]):
        changed = tiny_controlled(base)
        changed.load_state_dict(model.state_dict())
        name = next(n for n, m in model.named_modules() if m is part)
        changed.get_submodule(name).bias.fill_(1e-3)  # type: ignore[operator, union-attr]
        assert not torch.equal(changed(latent, timesteps, condition), base_alone(model, latent, timesteps))


def test_the_base_has_no_gradient_and_is_not_trained(base: Path) -> None:
    model = tiny_controlled(base).train()
    assert not model.base.unet.training and not model.base.vae.training and model.control.training
    with_noise_in_every_weight(model.conditioning)  # type: ignore[arg-type]
    for block in model.control.controlnet_down_blocks:
        torch.nn.init.normal_(block.weight)
    image, cues = random_condition_inputs(1, 32)
    latent = torch.randn(1, *model.latent_shape(32, 32))
    model(latent, torch.tensor([10]), model.condition(image, cues)).square().mean().backward()
    assert all(parameter.grad is None and not parameter.requires_grad for parameter in model.base.parameters())
    assert all(p.grad is not None for p in model.conditioning.parameters())
    trained = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    assert trained and all(name.startswith(("control.", "conditioning.")) for name in trained)
    assert model.control.conv_in.weight.grad is not None  # ConvNet 4


@torch.no_grad()
def test_empty_text_is_computed_once_and_stored(base: Path, tmp_path: Path) -> None:
    embedding = load_empty_text(base)
    assert embedding.shape == (TEXT_LENGTH, WIDTH)
    torch.testing.assert_close(embedding.mean(), load_base(base).empty_text.mean())
    save_empty_text(embedding, tmp_path)
    assert torch.equal(load_empty_text(tmp_path), embedding)
    with pytest.raises(UserError, match="neither text encoder weights"):
        load_empty_text(tmp_path / "nothing")


def test_empty_text_is_start_end_and_padding_seen_causally(tmp_path: Path) -> None:
    base = write_base(tmp_path)
    first = load_empty_text(base)
    tensors, _ = load_checkpoint(base / "text_encoder" / "model.safetensors")
    table = tensors["text_model.embeddings.token_embedding.weight"]
    for token, unchanged in ((0, 2), (VOCABULARY - 1, 1), (VOCABULARY - 2, 0), (5, TEXT_LENGTH)):
        altered = table.clone()
        altered[token] += torch.linspace(-1, 1, WIDTH)  # a constant would vanish in the first norm
        changed = tensors | {"text_model.embeddings.token_embedding.weight": altered}
        save_checkpoint(base / "text_encoder" / "model.safetensors", changed, {})
        same = (load_empty_text(base) - first).abs().amax(1) < 1e-6
        assert int(same.sum()) == unchanged and same[:unchanged].all()
    save_checkpoint(base / "text_encoder" / "model.safetensors", tensors, {})
    write_json(base / "tokenizer" / "special_tokens_map.json", {"pad_token": "<|endoftext|>"})
    assert not torch.allclose(load_empty_text(base)[2:], first[2:])
    assert torch.allclose(load_empty_text(base)[:2], first[:2], atol=1e-6)


def test_vae_attention_under_its_old_names_loads(base: Path, tmp_path: Path) -> None:
    folder = write_base(tmp_path)
    tensors, _ = load_checkpoint(folder / "vae" / WEIGHTS)
    new = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}
    old = {}
    for name, value in tensors.items():
        for now, then in new.items():
            if f".{now}." in name:
                name = name.replace(f".{now}.", f".{then}.")
                value = value[:, :, None, None] if value.ndim == 2 else value
        old[name] = value
    assert set(old) != set(tensors)
    save_checkpoint(folder / "vae" / WEIGHTS, old, {})
    loaded, expected = load_base(folder).vae.state_dict(), load_base(base).vae.state_dict()
    assert all(torch.equal(value, loaded[name]) for name, value in expected.items())


def test_latents_are_scaled_and_noise_moves_them(base: Path) -> None:
    frozen = load_base(base)
    image = 2 * torch.rand(2, 3, 32, 32) - 1
    mean = frozen.encode(image)
    assert mean.shape == (2, 4, 4, 4)
    expected = frozen.vae.encode(image).latent_dist.mean.detach() * 0.18215
    torch.testing.assert_close(mean, expected)
    assert not torch.allclose(frozen.encode(image, torch.ones_like(mean)), mean)
    torch.testing.assert_close(frozen.decode(mean), frozen.vae.decode(mean / 0.18215).sample.detach())
    schedule = frozen.noise_schedule()
    assert isinstance(schedule, DDPMScheduler) and schedule.config.prediction_type == "epsilon"
    assert float(schedule.alphas_cumprod[-1]) == pytest.approx(0.0047, rel=0.01)


@torch.no_grad()
def test_save_and_load_round_trip(base: Path, tmp_path: Path) -> None:
    model = tiny_controlled(base)
    with_noise_in_every_weight(model.control)
    with_noise_in_every_weight(model.conditioning)  # type: ignore[arg-type]
    save_controlled(model, tmp_path)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix not in {".json", ".safetensors"}]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["conditioning", "controlnet", "relighting_model.json"]
    loaded = pretrained_model(tmp_path)
    assert isinstance(loaded, ControlledBase)
    assert all(torch.equal(value, loaded.state_dict()[name]) for name, value in model.state_dict().items())
    image, cues = random_condition_inputs(1, 32)
    ours, theirs = (sample_relit(m, image, cues, [[4]], 2) for m in (model, loaded))
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)


def test_what_does_not_fit_is_a_user_error(base: Path, tmp_path: Path) -> None:
    narrow = ConditioningConfig(PyramidConfig((8, 8), 12), tiny_config(base).conditioning.texture)
    with pytest.raises(UserError, match="do not fit the base"):
        ControlledBase(tiny_config(base, conditioning=narrow), load_base(base))
    save_controlled(ControlledBase(tiny_config("someone/somewhere"), load_base(base)), tmp_path)
    with pytest.raises(UserError, match="not on this machine.*unet/config.json"):
        pretrained_model(tmp_path)
    broken = write_base(tmp_path / "broken")
    (broken / "unet" / WEIGHTS).unlink()
    with pytest.raises(UserError, match="holds no weights"):
        load_base(broken)
    config = read_json(broken / "vae" / "config.json") | {"latent_channels": 8}
    write_json(broken / "vae" / "config.json", config)
    save_checkpoint(broken / "unet" / WEIGHTS, load_checkpoint(base / "unet" / WEIGHTS)[0], {})
    with pytest.raises(UserError, match="do not fit"):
        load_base(broken)


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm_solver"])
def test_a_seed_decides_a_sample_whatever_the_batch(base: Path, sampler: Sampler) -> None:
    model = with_noise_in_every_weight(tiny_controlled(base))  # type: ignore[arg-type]
    image, cues = random_condition_inputs(2, 32)
    together = sample_relit(model, image, cues, [[1, 2], [3, 4]], 3, sampler)
    alone = sample_relit(model, image[1:], cues[1:], [[4]], 3, sampler)
    torch.testing.assert_close(together[1, 1], alone[0, 0], atol=1e-4, rtol=0)
    assert (together[1, 0] - together[1, 1]).abs().max() > 1e-2


@pytest.mark.parametrize("sampler", ["ddpm", "ddim", "dpm_solver"])
def test_samplers_find_a_known_point_from_its_noise(base: Path, sampler: Sampler) -> None:
    """With the exact noise of a point distribution, under the base's schedule, every sampler must end on the point."""
    trained = load_base(base).noise_schedule()
    scheduler = sampling_schedule(sampler, 20, trained)
    assert scheduler.config.prediction_type == "epsilon"
    point, latent = torch.tensor([0.7, -1.1]).reshape(1, 2, 1, 1), torch.randn(1, 2, 1, 1)
    extra = {"generator": torch.Generator().manual_seed(0)} if sampler == "ddpm" else {}
    for timestep in scheduler.timesteps:
        cumulative = trained.alphas_cumprod[timestep]
        noise = (latent - cumulative.sqrt() * point) / (1 - cumulative).sqrt()
        latent = scheduler.step(noise, timestep, latent, return_dict=False, **extra)[0]
    torch.testing.assert_close(latent, point, atol=0.01, rtol=0)


def test_a_base_with_eight_latent_channels_as_in_the_paper(tmp_path: Path) -> None:
    model = tiny_controlled(write_base(tmp_path, latent_channels=8))
    assert model.latent_shape(512, 512) == (8, 64, 64)
    assert model.control.conv_in.weight.shape[:2] == (16, 8)
    image, cues = random_condition_inputs(1, 32)
    assert torch.isfinite(sample_relit(model, image, cues, [[0]], 2)).all()


def test_both_kinds_relight_photographs(base: Path) -> None:
    model = with_noise_in_every_weight(tiny_controlled(base))  # type: ignore[arg-type]
    image, cues = torch.rand(4, 40, 44), torch.rand(12, 40, 44)
    image[3] = 0
    image[3, 5:35, 6:40] = 1
    image[:3] *= image[3]
    photograph = Photograph(image, cues, torch.zeros_like(cues[:3]))
    relit = relight_photographs(model, [photograph], [[1, 2, 3]], 2)[0]
    assert relit.shape == (3, 3, 40, 44)
    assert (relit[:, :, image[3] == 0] == 0).all() and float(relit.max()) <= 1
    few = relight_photographs(model, [photograph], [[1, 2, 3]], 2, samples_at_once=2)[0]
    torch.testing.assert_close(few, relit, atol=1e-4, rtol=0)
    assert (relit[0] - relit[1]).abs().max() > 1e-3
