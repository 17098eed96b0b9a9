"""Items and augmentations: exact for light transport, deterministic."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save

from illuminerf.diffusion.augmentation import (
    AugmentationConfig,
    make_batch,
    plain_example,
    stack_examples,
)
from illuminerf.diffusion.cue_coding import decode_cues
from illuminerf.diffusion.materials import composited
from illuminerf.diffusion.objective import Batch
from illuminerf.diffusion.relighting_scores import held_out_pairs, masked_psnr, masked_ssim, rescaled
from illuminerf.diffusion.training_items import diffuse_level, load_items, training_item
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear
from illuminerf.scene.relighting_pairs import iterate_items
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.shards import sample_tar, write_shard
from illuminerf.workflow.storage import Storage
from tests.diffusion.tiny import write_items

EXACT = AugmentationConfig(composited_share=0.0)


def drawn(items: list, count: int, config: AugmentationConfig, seed: int = 0) -> Batch:
    return make_batch(items, config, [torch.Generator().manual_seed(100 * seed + number) for number in range(count)])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_items(tmp_path)


def relation_error(batch: object) -> float:
    """The discs obey target = albedo * diffuse + 0.04 * gloss: how far from it, for the best albedo per channel."""
    cues = decode_cues(batch.coded_cues).unflatten(1, (4, 3))  # type: ignore[attr-defined]
    target = linear_from_srgb(batch.target / batch.alpha.clamp_min(1e-3))  # type: ignore[attr-defined]
    inside = (batch.alpha > 0.99) & (batch.target < 0.99)  # type: ignore[attr-defined]
    diffuse = (target - 0.04 * cues[:, 3]) / cues[:, 0].clamp_min(1e-3)
    count = inside.sum((2, 3), keepdim=True).clamp_min(1)
    mean = (diffuse * inside).sum((2, 3), keepdim=True) / count
    return float(((diffuse - mean).abs() * inside).max())


def test_mixtures_tints_shuffles_and_flips_keep_light_transport(folder: Path) -> None:
    items = load_items(folder, 32)
    batch = drawn(items, 24, EXACT)
    assert relation_error(batch) < 0.02
    wrong = batch._replace(coded_cues=batch.coded_cues.roll(1, 1))  # channels out of step
    assert relation_error(wrong) > 0.1


def test_composited_materials_differ_from_the_render(folder: Path) -> None:
    items = load_items(folder, 32)
    batch = drawn(items, 24, AugmentationConfig(composited_share=1.0))
    assert all(torch.isfinite(tensor).all() for tensor in batch)
    assert relation_error(batch) > 0.05


def test_same_generator_same_batch(folder: Path) -> None:
    items = load_items(folder, 32)
    batches = [drawn(items, 4, AugmentationConfig(), seed) for seed in (3, 3, 4)]
    assert all(torch.equal(a, b) for a, b in zip(batches[0], batches[1], strict=True))
    assert not torch.equal(batches[0].target, batches[2].target)


def test_input_and_target_come_from_different_lights(folder: Path) -> None:
    items = load_items(folder, 32)
    batch = drawn(items, 16, AugmentationConfig(mixture_share=0.0, composited_share=0.0, exposure=0.0))
    difference = (batch.masked_image[:, :3] - batch.target).abs().amax((1, 2, 3))
    assert (difference > 0.01).all()


def test_items_are_straight_and_averaged_exactly(folder: Path) -> None:
    item = load_items(folder, 32)[0]
    small = load_items(folder, 16)[0]
    targets = torch.from_numpy(next(iterate_items(folder))[1]["targets"]).float()
    torch.testing.assert_close((item.targets * item.alpha).float(), targets, atol=2e-3, rtol=0)
    energy = torch.nn.functional.avg_pool2d(targets, 2)
    torch.testing.assert_close((small.targets * small.alpha).float(), energy, atol=3e-3, rtol=0)


def test_edges_keep_their_materials_when_averaged_down() -> None:
    """Blocks of which half is covered, and by halves: straight values stay what they are on the object."""
    alpha = np.zeros((8, 8), np.uint8)
    alpha[:, 1::2] = 128
    alpha[:, 3::4] = 255
    coded = round(255 * float(srgb_from_linear(torch.tensor(0.5))))
    arrays = {
        "targets": np.zeros((1, 3, 8, 8), np.float16),
        "cues": np.zeros((1, 12, 8, 8), np.float16),
        "alpha": alpha,
        "albedo": np.where(alpha > 0, coded, 0).astype(np.uint8)[None].repeat(3, 0),
        "roughness": np.where(alpha > 0, 102, 0).astype(np.uint8),
        "metallic": np.where(alpha > 0, 255, 0).astype(np.uint8),
    }
    for size in (8, 4, 2):
        item = training_item("a", arrays, size)
        is_covered = item.alpha[0] > 0
        for values, wanted in ((item.albedo, 0.5), (item.roughness, 0.4), (item.metallic, 1.0)):
            torch.testing.assert_close(
                values[:, is_covered].float(), torch.full_like(values[:, is_covered].float(), wanted), atol=3e-3, rtol=0
            )
    # a plain mean in sRGB makes the edge a fifth as bright
    plain = torch.nn.functional.avg_pool2d(torch.from_numpy(arrays["albedo"]).float() / 255, 2)
    assert float((linear_from_srgb(plain) - 0.5).abs().min()) > 0.3


def test_albedo_is_averaged_as_light() -> None:
    """Black and white, half each, reflect half the light; the mean in sRGB reflects a fifth."""
    checks = (np.indices((4, 4)).sum(0) % 2 * 255).astype(np.uint8)
    arrays = {
        "targets": np.zeros((1, 3, 4, 4), np.float16), "cues": np.zeros((1, 12, 4, 4), np.float16),
        "alpha": np.full((4, 4), 255, np.uint8), "albedo": checks[None].repeat(3, 0), "roughness": checks,
        "metallic": checks,
    }  # fmt: skip
    item = training_item("a", arrays, 2)
    assert bool((item.albedo == 0.5).all()) and bool(((item.roughness - 0.5).abs() < 1e-3).all())
    assert float(linear_from_srgb(torch.tensor(0.5))) < 0.25


def test_plain_examples_are_exposed_alike(folder: Path) -> None:
    item = load_items(folder, 32)[0]
    example = plain_example(item, 0, 2)
    image, cues, target, alpha, surface, shading = example
    assert float(diffuse_level(cues, alpha)) == pytest.approx(0.55, rel=1e-2)
    assert not shading.any()
    batch = stack_examples([example])
    assert batch.masked_image.shape == (1, 4, 32, 32)
    assert float(batch.masked_image.max()) <= 1
    known = plain_example(item, 0, 2, knows_shading=True).shading
    torch.testing.assert_close(known, plain_example(item, 2, 0).cues[:3])
    assert not torch.allclose(known, cues[:3], rtol=0.1)


def test_estimated_shading_is_near_the_truth_as_often_as_asked(folder: Path) -> None:
    items = load_items(folder, 32)

    def shading_errors(**settings: float) -> torch.Tensor:
        config = AugmentationConfig(mixture_share=0.0, exposure=0.0, turns=False, composited_share=1.0, **settings)
        generators = [torch.Generator().manual_seed(seed) for seed in range(40)]
        batch = make_batch(items, config, generators)
        inside = batch.alpha > 0.9
        known = batch.shading.amax((1, 2, 3)) > 0
        # the discs' colour is one per image, but for gloss: image / shading is nearly flat where shading is right
        ratio = (linear_from_srgb(batch.masked_image[:, :3]) / batch.shading.clamp_min(1e-3) ** 2.2).log()
        spread = [float(row[:, mask[0]].std(1).mean()) for row, mask in zip(ratio, inside, strict=True)]
        return torch.where(known, torch.tensor(spread), torch.nan)

    exact = shading_errors(unknown_shading_share=0.0, shading_error=0.0)
    wrong = shading_errors(unknown_shading_share=0.0, shading_error=2.0)
    assert not exact.isnan().any()
    assert wrong.nanmedian() > exact.nanmedian() + 0.02
    shares = shading_errors(unknown_shading_share=0.5).isnan().float().mean()
    assert 0.25 < float(shares) < 0.75
    assert shading_errors(unknown_shading_share=1.0).isnan().all()


def test_bound_by_true_materials_is_nearly_exact_on_the_discs(folder: Path) -> None:
    item = load_items(folder, 32)[0]
    _, cues, target, alpha, surface, _ = plain_example(item, 0, 1)
    truth, ours = (srgb_from_linear(x).clamp_max(1)[None] * alpha for x in (target, composited(surface, cues)))
    assert float(masked_psnr(rescaled(ours, truth), truth, alpha[None])) > 35
    assert float(masked_psnr(rescaled(truth.roll(5, 2), truth), truth, alpha[None])) < 30


def test_scores_by_hand() -> None:
    truth, alpha = torch.full((1, 3, 16, 16), 0.5), torch.ones(1, 1, 16, 16)
    assert float(masked_psnr(truth + 0.1, truth, alpha)) == pytest.approx(20.0, abs=1e-3)
    textured = 0.2 + 0.6 * torch.rand(1, 3, 16, 16)
    assert float(masked_ssim(textured, textured, alpha)) == pytest.approx(1.0, abs=1e-5)
    assert float(masked_ssim(textured, textured.flip(-1), alpha)) < 0.7
    dim = srgb_from_linear(0.3 * linear_from_srgb(textured) * torch.tensor([1.0, 0.5, 0.8])[:, None, None])
    torch.testing.assert_close(rescaled(dim, textured), textured, atol=1e-4, rtol=0)


def test_held_out_pairs_are_spread_and_never_relight_to_the_same_light(folder: Path) -> None:
    pairs = held_out_pairs(load_items(folder, 32), 12)
    assert len({pair[0].name for pair in pairs}) == 3
    assert all(first != second for _, first, second in pairs)


def test_bad_folders_are_user_errors(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(UserError, match="holds no training items"):
        load_items(tmp_path / "nothing", 32)
    with pytest.raises(UserError, match="multiple of 24"):
        load_items(folder, 24)
    sample = sample_tar("a_0", {"safetensors": save({"targets": torch.zeros(4, 3, 8, 8)}), "json": b"{}"})
    write_shard(Storage(tmp_path / "odd"), "pairs-000000", [sample], {})
    with pytest.raises(UserError, match="lacks"):
        load_items(tmp_path / "odd", 8)
