"""The loss: zero for the truth, v by hand, learnable."""

import math
from pathlib import Path

import pytest
import torch

from illuminerf.diffusion.augmentation import AugmentationConfig, make_batch
from illuminerf.diffusion.cue_coding import encode_cues
from illuminerf.diffusion.materials import true_texture
from illuminerf.diffusion.objective import (
    Batch,
    Draws,
    LossWeights,
    anchor_loss,
    best_gain,
    materials_loss,
    relative_loss,
    step_totals,
    stratified_timesteps,
    training_loss,
)
from illuminerf.diffusion.training_config import Config, Phase
from illuminerf.diffusion.training_items import load_items
from illuminerf.diffusion.training_state import WeightAverage, learning_rate
from illuminerf.scene.images import srgb_from_linear
from tests.diffusion.tiny import tiny_model, write_items


def lambertian_batch(brightness: float = 0.4) -> tuple[torch.Tensor, Batch]:
    torch.manual_seed(0)
    lobes = brightness * torch.rand(2, 4, 3, 16, 16)
    alpha = (torch.rand(2, 1, 16, 16) > 0.3).float()
    target = srgb_from_linear(lobes.sum(1)).clamp_max(1) * alpha
    products = encode_cues(lobes.flatten(1, 2))
    return products, Batch(
        torch.cat([target, alpha], 1), products, target, alpha, torch.rand(2, 5, 16, 16), torch.zeros(2, 3, 16, 16)
    )


def test_anchor_loss_is_zero_for_the_truth_and_by_hand_otherwise() -> None:
    products, batch = lambertian_batch(brightness=0.15)
    assert float(anchor_loss(products, batch)) < 1e-8
    grey = batch._replace(target=(batch.target + 0.1) * batch.alpha)
    assert float(anchor_loss(products, grey)) == pytest.approx(0.01, rel=1e-3)


def test_brighter_than_saturated_is_free_but_brighter_than_the_truth_is_not() -> None:
    products, batch = lambertian_batch(brightness=3.0)
    assert (batch.target == 1).any()
    assert float(anchor_loss(products, batch)) < 1e-6
    darker = batch._replace(target=0.9 * batch.target)
    assert float(anchor_loss(products, darker)) > 1e-3


def test_the_best_gain_takes_out_a_gain_per_channel_and_nothing_else() -> None:
    products, batch = lambertian_batch(brightness=0.15)
    gain = torch.tensor([0.5, 1.0, 2.0]).repeat(4)[:, None, None]
    dimmed = encode_cues(gain * products**2.2)
    rescaled = dimmed * best_gain(dimmed, batch)
    assert float(anchor_loss(rescaled, batch)) < 1e-6 < float(anchor_loss(dimmed, batch))
    shaded = products * torch.linspace(0.5, 1, 16)
    assert float(anchor_loss(shaded * best_gain(shaded, batch), batch)) > 1e-4


def test_relative_loss_is_the_logarithm_that_psnr_averages() -> None:
    products, batch = lambertian_batch(brightness=0.15)
    grey = batch._replace(target=(batch.target + 0.1) * batch.alpha)
    assert float(relative_loss(products, grey)) == pytest.approx(2 * math.log(0.01 + 1e-4), rel=1e-3)
    assert float(relative_loss(products, batch)) == pytest.approx(2 * math.log(1e-4), rel=1e-2)


def test_materials_loss_is_zero_for_the_truth_and_by_hand_otherwise() -> None:
    _, batch = lambertian_batch()
    truth = true_texture(batch.surface)
    assert float(materials_loss(truth, batch)) == 0
    assert float(materials_loss(truth + 0.1, batch)) == pytest.approx(4 * 0.01, rel=1e-4)  # four lobes
    outside = truth + (1 - batch.alpha)
    assert float(materials_loss(outside, batch)) == 0


def test_learning_rate_by_hand() -> None:
    rates = [learning_rate(step, 2.0, 4, 100, 0.5) for step in (0, 1, 3, 40, 50, 75, 99)]
    assert rates == pytest.approx([0.5, 1.0, 2.0, 2.0, 2.0, 1.0, 0.04])


def test_weight_average_by_hand() -> None:
    model = torch.nn.Linear(1, 1)
    average = WeightAverage(model, decay=0.5)
    start = float(average.tensors["weight"])
    with torch.no_grad():
        model.weight.add_(1.0)
    average.update(model, lambda name: 100)
    assert float(average.tensors["weight"]) == pytest.approx(start + 0.5)


def test_what_begins_to_learn_late_does_not_stay_near_its_beginning() -> None:
    config = Config(phases=(Phase(100, 64, "products"), Phase(50, 128)))
    assert config.steps_trained("conditioning.texture.out.weight", 120) == 120
    assert config.steps_trained("base.conv_in.weight", 120) == 20
    model = torch.nn.Linear(1, 1)
    late, early = WeightAverage(model, decay=0.999), WeightAverage(model, decay=0.999)
    start = float(model.weight.detach())
    with torch.no_grad():
        model.weight.add_(1.0)
    for step in range(100, 120):
        late.update(model, lambda name, step=step: config.steps_trained("base." + name, step))
        early.update(model, lambda name, step=step: step)
    assert float(late.tensors["weight"]) > start + 0.99 and float(early.tensors["weight"]) < start + 0.9


@pytest.mark.parametrize("with_diffusion", [False, True])
def test_a_few_steps_lower_the_loss(tmp_path: Path, with_diffusion: bool) -> None:
    items = load_items(write_items(tmp_path), 32)
    model = tiny_model().train()
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    weights = LossWeights(diffusion=float(with_diffusion))
    losses = []
    for step in range(40):
        seeds = tuple(range(8 * (step % 4), 8 * (step % 4) + 8))
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        batch = make_batch(items, AugmentationConfig(composited_share=0.0), generators)
        draws = Draws(stratified_timesteps(8, generators[0]), seeds)
        totals = step_totals([batch], 8, weights.outside)
        loss, parts = training_loss(model, batch, draws, totals, weights, scale_momentum=0.1 if step < 4 else 0.0)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(float(loss.detach()))
    assert set(parts) == {"anchor", "rescaled", "materials"} | ({"diffusion"} if with_diffusion else set())
    assert sum(losses[-4:]) < 0.7 * sum(losses[:4])
