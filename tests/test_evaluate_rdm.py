"""`illuminerf evaluate-rdm`: the keys of its JSON, for either kind of model; different pairs only."""

import json
from pathlib import Path

import pytest

from illuminerf.cli import main
from illuminerf.diffusion.pretrained import save_relighter
from illuminerf.diffusion.relighting_scores import held_out_pairs
from illuminerf.diffusion.training_items import load_items
from tests.diffusion.tiny import tiny_model, with_noise_in_every_weight, write_items
from tests.diffusion.tiny_base import tiny_controlled, write_base

ESTIMATES = ("", "_mean_of_samples", "_best_of_samples", "_input", "_albedo_cue", "_upper_bound")


@pytest.mark.parametrize("kind", ["embedded", "on a base"])
def test_scores_by_key(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    model = tiny_model() if kind == "embedded" else tiny_controlled(write_base(tmp_path / "base"))
    save_relighter(with_noise_in_every_weight(model), tmp_path / "model")  # type: ignore[arg-type]
    pairs = write_items(tmp_path / "pairs")
    written = tmp_path / "scores.json"
    main(["evaluate-rdm", str(tmp_path / "model"), str(pairs), "--json", str(written), "--steps", "2"])
    scores = json.loads(written.read_text())
    assert {f"{metric}{name}" for metric in ("psnr", "ssim") for name in ESTIMATES} <= set(scores)
    assert ("psnr_products" in scores) == (kind == "embedded")
    assert scores["pairs"] == 36  # 3 discs, 4 x 3 orders of lights
    assert scores["psnr_upper_bound"] > 30 > scores["psnr_input"] and scores["ssim_upper_bound"] > 0.9
    assert scores["psnr"] <= scores["psnr_best_of_samples"]
    assert scores["sampler"] == ("ddim" if kind == "embedded" else "dpm_solver")
    assert "upper bound" in capsys.readouterr().err


@pytest.mark.parametrize("count", [1, 2, 3, 7, 36, 100])
def test_pairs_are_different_and_spread(tmp_path: Path, count: int) -> None:
    items = load_items(write_items(tmp_path), 32)
    pairs = [(item.name, first, second) for item, first, second in held_out_pairs(items, count)]
    assert len(pairs) == min(count, 36) == len(set(pairs))
    assert all(first != second and {first, second} <= {0, 1, 2, 3} for _, first, second in pairs)
    by_item = [sum(name == item.name for name, _, _ in pairs) for item in items]
    assert max(by_item) - min(by_item) <= 1
    if count >= 7:
        assert {first for _, first, _ in pairs} == {0, 1, 2, 3}
