"""Closed forms: the block transform is orthonormal, the power law keeps products."""

import pytest
import torch

from illuminerf.diffusion.cue_coding import MAX_RADIANCE, composited_srgb, decode_cues, encode_cues
from illuminerf.diffusion.latents import PatchLatentConfig, PatchLatents
from illuminerf.scene.images import srgb_from_linear


def test_keeping_all_frequencies_is_lossless() -> None:
    latents = PatchLatents(PatchLatentConfig(block=8, keep=8))
    image = torch.rand(2, 3, 32, 40)
    latent = latents.encode(image)
    assert latent.shape == (2, 192, 4, 5)
    torch.testing.assert_close(latents.decode(latent), image, atol=1e-5, rtol=0)
    torch.testing.assert_close(latent.square().sum(), image.square().sum(), rtol=1e-5, atol=0)  # Parseval


def test_keeping_fewer_is_exact_for_smooth_images_only() -> None:
    latents = PatchLatents(PatchLatentConfig(block=8, keep=4))
    flat = torch.rand(1, 3, 2, 2).repeat_interleave(8, 2).repeat_interleave(8, 3)
    torch.testing.assert_close(latents.decode(latents.encode(flat)), flat, atol=1e-5, rtol=0)
    noise = torch.rand(1, 3, 16, 16)
    assert (latents.decode(latents.encode(noise)) - noise).abs().max() > 0.1


def test_measured_scale_whitens_and_round_trips() -> None:
    latents = PatchLatents(PatchLatentConfig())
    images = 0.1 * torch.randn(64, 3, 32, 32) + 0.3 * torch.randn(64, 3, 1, 1)
    covered = torch.ones(64, 1, 4, 4)
    latents.measure(images, covered, momentum=1.0)
    spread = latents.encode(images).square().mean((0, 2, 3))
    torch.testing.assert_close(spread, torch.ones(48), atol=1e-3, rtol=0)
    before = PatchLatents(PatchLatentConfig())
    torch.testing.assert_close(latents.decode(latents.encode(images)), before.decode(before.encode(images)))


def test_uncovered_blocks_do_not_count_for_the_scale() -> None:
    latents = PatchLatents(PatchLatentConfig())
    images = torch.randn(8, 3, 16, 16)
    images[..., 8:] = 100.0
    covered = torch.ones(8, 1, 2, 2)
    covered[..., 1] = 0
    latents.measure(images, covered, momentum=1.0)
    assert latents.scale.max() < 3


def test_power_law_keeps_products() -> None:
    albedo, cue = torch.rand(12, 4, 4), 4 * torch.rand(12, 4, 4)
    torch.testing.assert_close(encode_cues(albedo * cue), encode_cues(albedo) * encode_cues(cue))
    with pytest.raises(AssertionError):
        torch.testing.assert_close(srgb_from_linear(albedo * cue), srgb_from_linear(albedo) * srgb_from_linear(cue))


def test_coding_is_inverted_up_to_the_clip() -> None:
    linear = torch.tensor([0.0, 1e-4, 0.2, 1.0, 7.0, MAX_RADIANCE, 1e3]).expand(12, 1, 7)
    torch.testing.assert_close(decode_cues(encode_cues(linear)), linear.clamp_max(MAX_RADIANCE), rtol=1e-4, atol=1e-6)


def test_composite_adds_lobes_in_linear_light() -> None:
    lobes = torch.rand(1, 4, 3, 5, 5)
    expected = srgb_from_linear(lobes.sum(1))
    torch.testing.assert_close(composited_srgb(encode_cues(lobes.flatten(1, 2))), expected, rtol=1e-4, atol=1e-5)
    assert torch.isfinite(composited_srgb(torch.zeros(1, 12, 2, 2, requires_grad=True))).all()


def test_composite_has_finite_gradients_in_the_dark() -> None:
    products = torch.zeros(1, 12, 2, 2, requires_grad=True)
    composited_srgb(products).sum().backward()
    assert products.grad is not None and torch.isfinite(products.grad).all()
