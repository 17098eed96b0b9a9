"""Scoring a folder of Stanford-ORB renderings: who is compared with what, and what is missing."""

import json
from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.stanford_orb import load_mask, load_photograph, novel_views
from illuminerf.evaluation.orb_rule import score_image
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear, write_exr, write_png, write_rgb_exr
from illuminerf.stages.score_orb_predictions import (
    Cell,
    load_prediction,
    relighting_cells,
    score_orb_predictions,
    summary,
    write_predictions,
)
from illuminerf.workflow.errors import UserError
from tests.data.written_orb import NAMES, write_orb

CUPS = ["cup_scene001", "cup_scene002"]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_orb(tmp_path / "orb")


def predict(root: Path, out: Path, capture: str, factor: float = 1.0, noise: float = 0.0, kind: str = "exr") -> None:
    """The truth, off by a factor and by noise."""
    generator = np.random.default_rng(1)
    for target, views in novel_views(root, capture).items():
        for view in views:
            image = load_photograph(root, view, 24) * factor
            image = np.maximum(image + noise * generator.normal(size=image.shape), 0).astype(np.float32)
            path = out / capture / target / f"{view.name}.{kind}"
            if kind == "exr":
                write_rgb_exr(path, image, half=False)
            else:
                write_png(path, srgb_from_linear(np.clip(image, 0, 1)))


def test_the_truth_scores_best_whatever_its_exposure(root: Path, tmp_path: Path) -> None:
    predict(root, tmp_path / "ours", "cup_scene001", factor=0.3)
    predict(root, tmp_path / "ours", "cup_scene002", noise=0.1)
    scores = score_orb_predictions(root, tmp_path / "ours", CUPS)
    assert scores["psnr_l"]["cup_scene001"]["cup_scene002"] > 90
    assert 10 < scores["psnr_l"]["cup_scene002"]["cup_scene001"] < 30
    means = [scores["per_capture"][capture]["psnr_h"] for capture in CUPS]
    assert scores["mean"]["psnr_h"] == pytest.approx(np.mean(means))
    assert scores["images"] == {"cup_scene001": {"cup_scene002": 2}, "cup_scene002": {"cup_scene001": 2}}
    assert scores["size"] == 24 and "lpips" not in scores
    json.dumps(scores, allow_nan=False)


def test_scores_are_those_of_the_rule(root: Path, tmp_path: Path) -> None:
    predict(root, tmp_path / "ours", "cup_scene001", noise=0.2)
    view = novel_views(root, "cup_scene001")["cup_scene002"][1]
    path = tmp_path / "ours" / "cup_scene001" / "cup_scene002" / f"{view.name}.exr"
    (path.parent / f"{NAMES[0]}.exr").unlink()
    wanted = score_image(load_prediction(path, 24), load_photograph(root, view, 24), load_mask(root, view, 24))
    path.rename(path.with_name(f"{NAMES[1]}.exr"))
    scores = score_orb_predictions(root, tmp_path / "ours", ["cup_scene001"])
    white = score_image(
        np.ones((24, 24, 3)),
        load_photograph(root, novel_views(root, "cup_scene001")["cup_scene002"][0], 24),
        load_mask(root, view, 24),
    )
    assert scores["missing"]["cup_scene001"]["cup_scene002"] == 1
    assert scores["mean"]["psnr_h"] == pytest.approx((wanted.psnr_h + white.psnr_h) / 2)
    assert scores["mean"]["ssim"] == pytest.approx((wanted.ssim + white.ssim) / 2)
    assert abs(wanted.psnr_h - white.psnr_h) > 0.1


def test_a_capture_without_any_prediction_counts_as_white_and_is_told(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predict(root, tmp_path / "ours", "cup_scene001")
    scores = score_orb_predictions(root, tmp_path / "ours", CUPS)
    assert scores["missing"]["cup_scene002"] == {"cup_scene001": 2}
    assert scores["per_capture"]["cup_scene002"]["psnr_l"] < 30 < scores["per_capture"]["cup_scene001"]["psnr_l"]
    assert "2 of 2 missing" in " ".join(capsys.readouterr().err.split())


def test_the_mean_of_a_capture_is_over_its_images_not_its_lights() -> None:
    scored = score_image(np.full((16, 16, 3), 0.4), np.full((16, 16, 3), 0.4), np.ones((16, 16), bool))
    other = score_image(np.eye(16)[..., None].repeat(3, -1), np.full((16, 16, 3), 0.4), np.ones((16, 16), bool))
    cells = {Cell("a", "b", ()): [scored], Cell("a", "c", ()): [other, other, other]}
    found = summary(cells)["per_capture"]["a"]["psnr_l"]
    assert found == pytest.approx((scored.psnr_l + 3 * other.psnr_l) / 4)
    assert abs(found - (scored.psnr_l + other.psnr_l) / 2) > 1


def test_pictures_of_8_bits_score_almost_as_well(root: Path, tmp_path: Path) -> None:
    predict(root, tmp_path / "ours", "cup_scene001", kind="png")
    assert 45 < score_orb_predictions(root, tmp_path / "ours", ["cup_scene001"])["mean"]["psnr_l"] < 80


def test_straight_alpha_is_put_on_black(tmp_path: Path) -> None:
    image = np.full((12, 12, 4), 0.5, np.float32)
    write_png(tmp_path / "a.png", image)
    found = load_prediction(tmp_path / "a.png", 12)
    np.testing.assert_allclose(found, linear_from_srgb(np.full((12, 12, 3), 128 / 255)) * 128 / 255, rtol=1e-5)


def test_larger_predictions_are_averaged_in_linear_light(tmp_path: Path) -> None:
    checker = np.indices((24, 24)).sum(0)[..., None].repeat(3, -1) % 2
    write_png(tmp_path / "a.png", checker.astype(np.float32))
    np.testing.assert_allclose(load_prediction(tmp_path / "a.png", 12), 0.5, atol=1e-6)
    with pytest.raises(UserError, match="24 x 24 pixels.*wanted 48 x 48"):
        load_prediction(tmp_path / "a.png", 48)


def test_renderings_land_on_black_by_name(root: Path, tmp_path: Path) -> None:
    views = novel_views(root, "cup_scene001")["cup_scene002"]
    for index in range(2):
        grey = np.full((6, 6), 0.1 + 0.2 * index, np.float32)
        write_exr(tmp_path / "made" / "linear" / f"{index:03d}.exr", {name: grey for name in "RGBA"})
    write_predictions(tmp_path / "made", views, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"{name}.png" for name in NAMES]
    np.testing.assert_allclose(load_prediction(tmp_path / "out" / f"{NAMES[1]}.png", 6), 0.3, atol=0.003)


def test_another_truth_may_stand_in(root: Path, tmp_path: Path) -> None:
    predict(root, tmp_path / "ours", "cup_scene001")
    against = score_orb_predictions(
        root, tmp_path / "ours", ["cup_scene001"], truth=lambda view: np.full((24, 24, 3), 0.8)
    )
    assert against["mean"]["psnr_l"] < 30


def test_what_is_wrong_is_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cup_scene001/cup_scene002/0003.png, nor any other"):
        score_orb_predictions(root, tmp_path / "nothing", CUPS)
    predict(root, tmp_path / "ours", "cup_scene001")
    path = tmp_path / "ours" / "cup_scene001" / "cup_scene002" / f"{NAMES[0]}.exr"
    write_exr(path, {"R": np.ones((24, 24))})
    with pytest.raises(UserError, match="lacks colour"):
        score_orb_predictions(root, tmp_path / "ours", CUPS)
    write_rgb_exr(path, np.full((24, 24, 3), np.nan), half=False)
    with pytest.raises(UserError, match="not finite"):
        score_orb_predictions(root, tmp_path / "ours", CUPS)
    write_rgb_exr(path, np.ones((24, 24, 3)))
    write_png(root / "blender_HDR" / "cup_scene002" / "test_mask" / f"{NAMES[0]}.png", np.zeros((24, 24)))
    with pytest.raises(UserError, match="shows nothing.*cup_scene002/test_mask/0003.png"):
        score_orb_predictions(root, tmp_path / "ours", CUPS)


def test_a_capture_without_another_light_cannot_be_relit(root: Path) -> None:
    path = root / "blender_HDR" / "cup_scene001" / "transforms_novel.json"
    path.write_text(path.read_text().replace("cup_scene002", "cup_scene001"))
    with pytest.raises(UserError, match="cup_scene001 has no other light"):
        relighting_cells(root, ["cup_scene001"])
