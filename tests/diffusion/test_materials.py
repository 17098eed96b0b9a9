"""Materials as multiples of cues: knots, sums, and the composite they stand for."""

import pytest
import torch

from illuminerf.diffusion.cue_coding import composited_srgb, encode_cues
from illuminerf.diffusion.materials import composited, lobe_shares, lobe_weights, true_texture
from illuminerf.scene.images import srgb_from_linear


@pytest.mark.parametrize(("roughness", "lobe"), [(0.0, 1), (0.05, 1), (0.13, 2), (0.34, 3), (0.9, 0)])
def test_a_cue_stands_for_its_own_roughness(roughness: float, lobe: int) -> None:
    shares = lobe_shares(torch.full((1, 1, 1), roughness))[:, 0, 0]
    torch.testing.assert_close(shares, torch.eye(4)[lobe])


def test_between_two_cues_there_is_half_of_each() -> None:
    shares = lobe_shares(torch.full((2, 1, 3, 3), (0.13 + 0.34) / 2))
    torch.testing.assert_close(shares[1, :, 2, 0], torch.tensor([0.0, 0.0, 0.5, 0.5]))
    torch.testing.assert_close(lobe_shares(torch.rand(5, 1, 4, 4)).sum(1), torch.ones(5, 4, 4))


def test_plastic_and_metal_by_hand() -> None:
    albedo = [0.8, 0.5, 0.2]
    plastic, metal = (torch.tensor([*albedo, metallic, 0.13])[:, None, None] for metallic in (0.0, 1.0))
    weights = lobe_weights(plastic)[:, :, 0, 0]
    torch.testing.assert_close(weights[0], torch.tensor(albedo))
    torch.testing.assert_close(weights[2], torch.full((3,), 0.04))
    assert (weights[[1, 3]] == 0).all()
    weights = lobe_weights(metal)[:, :, 0, 0]
    torch.testing.assert_close(weights[2], torch.tensor(albedo))
    assert (weights[[0, 1, 3]] == 0).all()


def test_the_true_texture_gives_the_composite() -> None:
    surface, cues = torch.rand(2, 5, 6, 6), 3 * torch.rand(2, 12, 6, 6)
    products = true_texture(surface) * encode_cues(cues)
    wanted = srgb_from_linear(composited(surface, cues))
    torch.testing.assert_close(composited_srgb(products), wanted, atol=1e-4, rtol=1e-4)
    assert (composited_srgb(true_texture(surface.flip(-1)) * encode_cues(cues)) - wanted).abs().max() > 0.1
