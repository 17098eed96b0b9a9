"""Scoring a folder of renderings: closed cases on tiny folders, golden numbers on the benchmark's frames."""

import json
from pathlib import Path

import numpy as np
import pytest

from illuminerf.data.tensoir import find_views, load_test_image
from illuminerf.evaluation.benchmark_rule import ViewPair, on_white, score_light
from illuminerf.evaluation.published import GALLERY
from illuminerf.scene.images import linear_from_srgb, read_png, srgb_from_linear, write_png
from illuminerf.stages.score_predictions import score_input_light, score_predictions
from illuminerf.workflow.errors import UserError

NUMBERS = (0, 10, 20, 25)


def make_benchmark(root: Path, size: int = 16) -> None:
    generator = np.random.default_rng(0)
    alpha = np.zeros((size, size, 1))
    alpha[3:-3, 3:-3] = 1
    for number in NUMBERS:
        folder = root / "mug" / f"test_{number:03d}"
        for light, tint in (("sunset", 1.0), ("lamp", 0.5), ("noon", 0.25)):
            shade = generator.uniform(0.2, 0.9, (size, size, 3)) * tint
            write_png(folder / f"rgba_{light}.png", np.concatenate([shade, alpha], -1))
        pose = np.eye(4)
        pose[:3, 3] = [number, 0, 4]
        content = {"cam_transform_mat": ",".join(map(str, pose.ravel())), "cam_angle_x": 0.7, "imw": size, "imh": size}
        (folder / "metadata.json").write_text(json.dumps(content))


def predict(root: Path, out: Path, light: str, factor: float = 1.0, numbers: tuple[int, ...] = NUMBERS) -> None:
    for number in numbers:
        truth = load_test_image(root / "mug", f"test_{number:03d}", light)
        dimmed = np.concatenate([truth[..., :3] * factor, truth[..., 3:]], -1)
        write_png(out / "mug" / light / f"test_{number:03d}.png", on_white(dimmed))


@pytest.fixture
def benchmark(tmp_path: Path) -> Path:
    make_benchmark(tmp_path / "truth")
    return tmp_path / "truth"


def test_the_truth_scores_best_and_the_factor_is_found(benchmark: Path, tmp_path: Path) -> None:
    predict(benchmark, tmp_path / "ours", "lamp", factor=0.5)
    predict(benchmark, tmp_path / "ours", "noon")
    scores = score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp", "noon"])
    assert scores["psnr"]["mug"]["noon"] == 100.0
    assert scores["psnr"]["mug"]["lamp"] > 45
    np.testing.assert_allclose(scores["scale"]["mug"]["lamp"], [2, 2, 2], rtol=0.02)
    assert scores["views"]["mug"] == {"lamp": 4, "noon": 4}
    expected = (scores["psnr"]["mug"]["lamp"] + 100.0) / 2
    assert scores["mean"]["psnr"] == pytest.approx(expected)
    json.dumps(scores)


def test_without_rescaling_a_dim_prediction_is_punished(benchmark: Path, tmp_path: Path) -> None:
    predict(benchmark, tmp_path / "ours", "lamp", factor=0.5)
    raw = score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"], rescale="none")
    assert raw["psnr"]["mug"]["lamp"] < 25
    assert raw["scale"]["mug"]["lamp"] == [1, 1, 1]


def test_only_views_of_both_are_scored(benchmark: Path, tmp_path: Path) -> None:
    predict(benchmark, tmp_path / "ours", "lamp", numbers=(10, 25))
    write_png(tmp_path / "ours" / "mug" / "lamp" / "test_199.png", np.zeros((16, 16, 3)))
    scores = score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"])
    assert scores["views"]["mug"]["lamp"] == 2
    assert score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"], every=10)["views"]["mug"]["lamp"] == 1


def test_the_factor_comes_from_every_tenth_view(benchmark: Path, tmp_path: Path) -> None:
    predict(benchmark, tmp_path / "ours", "lamp", numbers=(0, 10, 20))
    predict(benchmark, tmp_path / "ours", "lamp", factor=0.25, numbers=(25,))
    scores = score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"])
    assert scores["scale"]["mug"]["lamp"] == [1, 1, 1]


def test_the_input_light_stands_in_for_a_prediction(benchmark: Path) -> None:
    assert score_input_light(benchmark, ["mug"], ["sunset"])["psnr"]["mug"]["sunset"] == 100.0
    assert score_input_light(benchmark, ["mug"], ["lamp"])["psnr"]["mug"]["lamp"] < 30


@pytest.mark.parametrize(
    ("scenes", "lights", "message"),
    [
        (["vase"], ["lamp"], "no scene 'vase'"),
        (["mug"], ["noon"], "no predictions for mug under noon"),
        (["mug"], ["disco"], "no truth for mug under disco"),
        ([], ["lamp"], "nothing to score"),
    ],
)
def test_what_is_missing_is_named(
    benchmark: Path, tmp_path: Path, scenes: list[str], lights: list[str], message: str
) -> None:
    predict(benchmark, tmp_path / "ours", "lamp")
    with pytest.raises(UserError, match=message):
        score_predictions(benchmark, tmp_path / "ours", scenes, lights)


def test_predictions_without_a_matching_name(benchmark: Path, tmp_path: Path) -> None:
    write_png(tmp_path / "ours" / "mug" / "lamp" / "000.png", np.zeros((16, 16, 3)))
    with pytest.raises(UserError, match="test_<number>.png"):
        score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"])


def test_sizes_must_agree(benchmark: Path, tmp_path: Path) -> None:
    write_png(tmp_path / "ours" / "mug" / "lamp" / "test_000.png", np.zeros((8, 8, 3)))
    with pytest.raises(UserError, match="8 x 8 pixels.*wanted 16 x 16"):
        score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"])


def test_larger_images_are_averaged_down(benchmark: Path, tmp_path: Path) -> None:
    predict(benchmark, tmp_path / "ours", "lamp")
    for number in NUMBERS:  # a checker whose mean is the truth's, in linear light
        path = tmp_path / "ours" / "mug" / "lamp" / f"test_{number:03d}.png"
        linear = linear_from_srgb(read_png(path)).repeat(2, 0).repeat(2, 1)
        sign = np.indices(linear.shape[:2]).sum(0)[..., None] % 2 * 2 - 1
        swing = 0.5 * np.minimum(linear, 1 - linear)
        write_png(path, srgb_from_linear(linear + sign * swing))
    assert score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"], size=16)["mean"]["psnr"] > 48
    with pytest.raises(UserError, match="32 x 32"):
        score_predictions(benchmark, tmp_path / "ours", ["mug"], ["lamp"])


def frames_at_800(data_root: Path) -> Path:
    for name in ("tensoir800", "tensoir"):
        root = data_root / name
        if not all((root / scene).is_dir() and (root / "published").is_dir() for scene in ("hotdog", "lego")):
            continue
        view = find_views(root / "hotdog", "test")[0]
        if load_test_image(root / "hotdog", view.name, "city").shape[0] == 800:
            return root
    pytest.skip("no 800 x 800 frames of hotdog and lego in tensoir800/ or tensoir/ under ILLUMINERF_DATA")


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("scene", ["hotdog", "lego"])
def test_published_renderings_get_the_published_scores(data_root: Path, scene: str) -> None:
    """Every 20th view at 800 x 800; the videos show renderings after rescaling, so both rules must agree."""
    root = frames_at_800(data_root)
    rows = [row for row in GALLERY if row.scene == scene]
    lights = [row.light for row in rows]
    for method, wanted in (("illuminerf", "paper"), ("tensoir", "tensoir")):
        predictions = root / "published" / method
        raw = score_predictions(root, predictions, [scene], lights, rescale="none", every=20)
        for row in rows:
            assert raw["psnr"][scene][row.light] == pytest.approx(getattr(row, wanted), abs=0.05)
    rescaled = score_predictions(root, root / "published" / "illuminerf", [scene], lights, every=20)
    for row in rows:
        assert rescaled["psnr"][scene][row.light] == pytest.approx(row.paper, abs=0.3)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("scene", ["hotdog", "lego"])
def test_the_median_rule_gives_the_published_score_of_the_input_light(data_root: Path, scene: str) -> None:
    """The published column took the object to be what is not white in the truth, which the outermost pixels
    decide.
    """
    root = frames_at_800(data_root)
    names = [view.name for view in find_views(root / scene, "test", 20)]
    inputs = [on_white(load_test_image(root / scene, name, "sunset")) for name in names]
    for row in (row for row in GALLERY if row.scene == scene):
        truths = [on_white(load_test_image(root / scene, name, row.light)) for name in names]
        pairs = [
            ViewPair(prediction, truth, truth.min(-1) < 248 / 255)
            for prediction, truth in zip(inputs, truths, strict=True)
        ]
        assert np.mean(score_light(pairs).psnr) == pytest.approx(row.input_light, abs=0.15)
        raw = np.mean(score_light(pairs, "none").psnr)
        assert abs(raw - row.input_light) > 0.1 or row.light == "bridge"
