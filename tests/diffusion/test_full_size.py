"""Cutting out, putting back, filling holes; the shipped weights."""

from pathlib import Path

import numpy as np
import pytest
import torch

from illuminerf.diffusion.full_size import (
    Photograph,
    cut_out,
    object_square,
    put_back,
    relight_photographs,
    straight_cues,
)
from illuminerf.diffusion.pretrained import model_folder, pretrained_model
from illuminerf.diffusion.sampling import sample_relit
from illuminerf.scene.images import linear_from_srgb
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import random_condition_inputs, tiny_model, with_noise_in_every_weight


@pytest.mark.parametrize("place", [(2, 9, 3, 12), (0, 20, 5, 9), (14, 20, 22, 30), (0, 20, 0, 30)])
def test_cut_out_and_put_back(place: tuple[int, int, int, int]) -> None:
    top, bottom, left, right = place
    alpha = torch.zeros(20, 30)
    alpha[top:bottom, left:right] = 1
    image = torch.rand(3, 20, 30) * alpha
    square = object_square(alpha)
    piece = cut_out(image, square)
    assert piece.shape[1] == piece.shape[2] == square[2]
    torch.testing.assert_close(put_back(piece, square, 20, 30), image)


def test_holes_in_the_mesh_take_the_nearest_cue() -> None:
    coverage = np.zeros((4, 6), np.float32)
    coverage[:, :3] = 0.5
    cues = np.ones((12, 4, 6), np.float32) * np.arange(6) * coverage
    straight = straight_cues(cues, coverage)
    np.testing.assert_allclose(straight[:, :, :3], np.broadcast_to(np.arange(3), (12, 4, 3)))
    np.testing.assert_allclose(straight[:, :, 3:], 2.0)
    assert (straight_cues(cues, 0 * coverage) == 0).all()


def test_at_the_models_own_size_it_is_plain_sampling() -> None:
    model = with_noise_in_every_weight(tiny_model())
    image, coded = random_condition_inputs(1, 32)
    image[:, 3] = 1
    shading = torch.rand(1, 3, 32, 32)
    relit = relight_photographs(model, [Photograph(image[0], coded[0] ** 2.2, shading[0] ** 2.2)], [[7]], 3)[0]
    wanted = sample_relit(model, image, coded, [[7]], 3, shading=shading)[0]
    torch.testing.assert_close(relit, wanted, atol=1e-4, rtol=0)
    assert (sample_relit(model, image, coded, [[7]], 3)[0] - wanted).abs().max() > 0.01


def test_a_dim_light_is_exposed_for_the_model_and_dim_again_in_the_result() -> None:
    model = with_noise_in_every_weight(tiny_model())
    image, coded = random_condition_inputs(1, 32)
    image[:, 3] = 1
    cues, unknown = 0.3 * coded[0] ** 2.2, torch.zeros(3, 32, 32)
    plain = relight_photographs(model, [Photograph(image[0], cues, unknown)], [[7]], 3)[0]
    dim = relight_photographs(model, [Photograph(image[0], 0.1 * cues, unknown)], [[7]], 3, exposure=10.0)[0]
    unclipped = (plain > 0.01) & (plain < 0.99)
    assert unclipped.float().mean() > 0.3
    ratio = linear_from_srgb(dim)[unclipped] / linear_from_srgb(plain)[unclipped]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.1), atol=1e-3, rtol=0)
    blind = relight_photographs(model, [Photograph(image[0], 0.1 * cues, unknown)], [[7]], 3)[0]
    assert (linear_from_srgb(blind)[unclipped] / linear_from_srgb(plain)[unclipped] - 0.1).abs().mean() > 0.01


def test_missing_models_are_explained(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no relighting model"):
        model_folder(tmp_path)


def test_shipped_weights_load_and_are_small() -> None:
    folder = model_folder("embedded")
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert size < 30e6
    assert not [path for path in folder.rglob("*") if path.suffix not in {".json", ".safetensors", ""}]
    model = pretrained_model("embedded")
    image, coded = random_condition_inputs(1, model.config.image_size)
    relit = sample_relit(model, image, coded, [[0, 1]], 2)
    assert torch.isfinite(relit).all()
