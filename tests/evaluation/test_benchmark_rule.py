"""The benchmark's rule against a straightforward transcription, and what each part of it does."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from illuminerf.evaluation.benchmark_rule import ViewPair, channel_scale, on_white, score_light, view_pair
from illuminerf.evaluation.rescaling import least_squares_scale, median_ratio, rescaled_inside


def random_views(seed: int, num_views: int = 3, size: int = 24) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """(predictions RGB on white, truths straight RGBA), both of 8-bit values."""
    generator = np.random.default_rng(seed)
    predictions, truths = [], []
    for _ in range(num_views):
        alpha = (generator.uniform(size=(size, size, 1)) < 0.6) * generator.uniform(0.6, 1, (size, size, 1))
        truth = np.concatenate([generator.uniform(0.05, 0.7, (size, size, 3)), alpha], -1)
        factor = np.where(alpha > 0, np.array([0.8, 1.1, 0.6]), 1.0)
        prediction = on_white(truth) * factor * generator.uniform(0.9, 1.1, (size, size, 3))
        highlights = generator.uniform(size=(size, size, 1)) < 0.05
        prediction = np.where(highlights & (alpha > 0), 1.0, prediction)
        predictions.append((np.round(np.clip(prediction, 0, 1) * 255) / 255).astype(np.float32))
        truths.append((np.round(truth * 255) / 255).astype(np.float32))
    return predictions, truths


def compared_images(predictions: list[np.ndarray], truths: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """(prediction as it is scored, truth on white) by the rule of the published script, in plain loops over views and
    channels, from 8-bit files in float64.
    """
    predictions, truths = (
        [np.rint(image * 255.0).astype(np.uint8) / 255.0 for image in images] for images in (predictions, truths)
    )
    ratios: list[list[float]] = [[], [], []]
    for prediction, truth in zip(predictions, truths, strict=True):
        white = truth[..., :3] * truth[..., 3:] + (1 - truth[..., 3:])
        mask = truth[..., 3] > 0.5
        for channel in range(3):
            divided = white[mask][:, channel] / np.clip(prediction[mask][:, channel], 1e-6, 1)
            ratios[channel].extend(divided.tolist())
    factors = [float(np.median(values)) for values in ratios]
    compared = []
    for prediction, truth in zip(predictions, truths, strict=True):
        white = truth[..., :3] * truth[..., 3:] + (1 - truth[..., 3:])
        mask = truth[..., 3] > 0.5
        scored = prediction.astype(np.float64)
        for channel in range(3):
            plane = scored[..., channel]
            plane[mask] = (np.clip(plane[mask] * factors[channel], 0, 1) * 255).astype(np.uint8) / 255
        compared.append((scored, white))
    return compared


def transcription(predictions: list[np.ndarray], truths: list[np.ndarray]) -> list[float]:
    """PSNR per view."""
    pairs = compared_images(predictions, truths)
    return [float(-10 * np.log10(np.mean((scored - white) ** 2))) for scored, white in pairs]


def pairs_of(predictions: list[np.ndarray], truths: list[np.ndarray]) -> list[ViewPair]:
    return [view_pair(prediction, truth) for prediction, truth in zip(predictions, truths, strict=True)]


@given(seed=st.integers(0, 2**16))
@settings(max_examples=40, deadline=None)
def test_scores_agree_with_the_transcription(seed: int) -> None:
    predictions, truths = random_views(seed)
    scores = score_light(pairs_of(predictions, truths))
    np.testing.assert_allclose(scores.psnr, transcription(predictions, truths), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_scores_agree_with_scikit_image_on_the_transcribed_images(seed: int) -> None:
    predictions, truths = random_views(seed)
    scores, raw = (score_light(pairs_of(predictions, truths), rescale) for rescale in ("median", "none"))
    for view, (scored, white) in enumerate(compared_images(predictions, truths)):
        similarity = structural_similarity(
            scored,
            white,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1.0,
            channel_axis=-1,
        )
        assert scores.psnr[view] == pytest.approx(peak_signal_noise_ratio(white, scored, data_range=1.0), abs=1e-4)
        assert scores.ssim[view] == pytest.approx(similarity, abs=1e-4)
        assert abs(raw.psnr[view] - scores.psnr[view]) > 1e-2 and abs(raw.ssim[view] - similarity) > 1e-3


def test_the_tolerance_tells_other_rules_apart() -> None:
    predictions, truths = random_views(0)
    wanted = np.array(transcription(predictions, truths))
    for rescale in ("least_squares", "none"):
        scores = score_light(pairs_of(predictions, truths), rescale)
        assert np.abs(np.array(scores.psnr) - wanted).max() > 0.05
    one_view = score_light(pairs_of(predictions, truths), scale_views=[0])
    assert np.abs(np.array(one_view.psnr) - wanted).max() > 1e-3


def test_the_median_undoes_a_channel_factor_and_ignores_outliers() -> None:
    truth = np.random.default_rng(1).uniform(0.1, 0.5, (999, 3))
    prediction = truth / [1.0, 1.5, 0.6]
    prediction[::10] = 1.0
    np.testing.assert_allclose(median_ratio([(truth, prediction)]), [1.0, 1.5, 0.6], rtol=1e-6)
    assert np.abs(least_squares_scale([(truth, prediction)]) - [1.0, 1.5, 0.6]).max() > 0.05


def test_least_squares_is_the_minimum() -> None:
    generator = np.random.default_rng(2)
    truth, prediction = generator.uniform(size=(2, 500, 3))
    scale = least_squares_scale([(truth[:200], prediction[:200]), (truth[200:], prediction[200:])])
    error = ((truth - scale * prediction) ** 2).sum(0)
    for step in (-1e-3, 1e-3):
        assert (((truth - (scale + step) * prediction) ** 2).sum(0) > error).all()


def test_black_predictions_do_not_break_the_factor() -> None:
    truth = np.full((10, 3), 0.5)
    black = np.zeros((10, 3))
    assert np.isfinite(median_ratio([(truth, black)])).all()
    np.testing.assert_array_equal(least_squares_scale([(truth, black)]), np.ones(3))


def test_empty_masks_leave_the_prediction_alone() -> None:
    prediction = np.full((12, 12, 3), 0.25, np.float32)
    pair = ViewPair(prediction, prediction, np.zeros((12, 12), bool))
    np.testing.assert_array_equal(channel_scale([pair], "median"), np.ones(3))
    assert score_light([pair]).psnr == (100.0,)


def test_truncation_is_to_eight_bits_downward_and_only_inside() -> None:
    prediction = np.full((2, 2, 3), 100.9 / 255, np.float64)
    mask = np.array([[True, False], [False, False]])
    scored = rescaled_inside(prediction, mask, np.ones(3))
    np.testing.assert_allclose(scored[0, 0] * 255, 100)
    np.testing.assert_array_equal(scored[~mask], prediction[~mask])
    np.testing.assert_allclose(prediction, 100.9 / 255)  # the input is not written to


def test_the_whole_image_counts() -> None:
    """A wrong background lowers the score although it lies outside the mask."""
    _, truths = random_views(3)
    good = [on_white(truth) for truth in truths]
    bad = [np.where(truth[..., 3:] == 0, 0.5, on_white(truth)).astype(np.float32) for truth in truths]
    assert np.mean(score_light(pairs_of(good, truths)).psnr) > np.mean(score_light(pairs_of(bad, truths)).psnr) + 10


def test_straight_rgba_predictions_are_put_on_white() -> None:
    _, truths = random_views(4)
    np.testing.assert_allclose(view_pair(truths[0], truths[0]).prediction, on_white(truths[0]), atol=1e-6)
    half = np.array([[[0.2, 0.4, 0.6, 0.5]]], np.float32)
    np.testing.assert_allclose(on_white(half), [[[0.6, 0.7, 0.8]]], atol=1e-6)


def test_lpips_is_given_the_rescaled_image() -> None:
    predictions, truths = random_views(5)
    seen = []

    def metric(prediction: np.ndarray, truth: np.ndarray) -> float:
        seen.append(prediction)
        return 0.25

    scores = score_light(pairs_of(predictions, truths), lpips=metric)
    assert scores.lpips == (0.25,) * 3
    assert np.abs(seen[0] - predictions[0]).max() > 0.01
