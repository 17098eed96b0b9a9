"""The Stanford-ORB rule against a plain transcription, scikit-image, and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from illuminerf.evaluation.metrics import SsimWindow, psnr, ssim
from illuminerf.evaluation.orb_rule import WINDOW, eroded, score_image

Images = tuple[np.ndarray, np.ndarray, np.ndarray]


def random_images(seed: int, size: int = 24, margin: int = 0) -> Images:
    """(prediction, truth, mask), linear, with highlights above 1 and a few negative values of noise."""
    generator = np.random.default_rng(seed)
    truth = generator.uniform(0, 0.6, (size, size, 3)) ** 2
    truth[generator.uniform(size=(size, size)) < 0.05] *= 20
    truth[generator.uniform(size=(size, size)) < 0.02] = -0.01
    prediction = np.clip(truth, 0, 1) * [0.5, 1.3, 0.8] * generator.uniform(0.7, 1.2, (size, size, 3))
    mask = np.zeros((size, size), bool)
    mask[margin : size - margin, margin + 1 : size - margin] = True
    return prediction, truth, mask


def coded(value: float) -> float:
    return 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055


CODED = np.vectorize(coded, otypes=[np.float64])


def shrunk_mask(mask: np.ndarray) -> np.ndarray:
    height, width = mask.shape
    out = np.zeros_like(mask)
    for i in range(height):
        for j in range(width):
            out[i, j] = mask[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3].all()
    return out


def transcription(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> tuple[float, float, float]:
    """(PSNR-H, PSNR-L, SSIM) as the public code computes them, channel by channel and pixel by pixel."""
    inner = shrunk_mask(mask)
    black = np.maximum(truth * inner[..., None], 0)
    guess = prediction * inner[..., None]

    def compared(
        guess: np.ndarray, wanted: np.ndarray, top: float, codes: bool
    ) -> tuple[float, np.ndarray, np.ndarray]:
        scaled = np.zeros_like(guess)
        for channel in range(3):
            p, t = guess[..., channel][inner], wanted[..., channel][inner]
            p = np.ones_like(p) if (p**2).sum() <= 1e-6 else p
            scaled[..., channel] = guess[..., channel] * (t * p).sum() / (p**2).sum()
        scaled, clipped = np.clip(scaled, 0, top), np.clip(wanted, 0, top)
        if codes:
            scaled, clipped = CODED(scaled), CODED(clipped)
        score = -10 * np.log10(((scaled - clipped) ** 2).mean())
        floor = -10 * np.log10(((0.5 * inner[..., None] - clipped) ** 2).mean())
        return max(score, floor), scaled, clipped

    shown = np.clip(black, 0, 1)
    bright = CODED(shown).mean() / shown.mean()
    high, _, _ = compared(guess * bright, black * bright, 4, False)
    low, scaled, clipped = compared(guess, black, 1, True)
    return high, low, plain_ssim(scaled, clipped)


def plain_ssim(x: np.ndarray, y: np.ndarray) -> float:
    weights = np.exp(-(np.arange(-1, 2) ** 2) / (2 * 1.5**2))
    weights = np.outer(weights, weights) / np.outer(weights, weights).sum()
    values = []
    for channel in range(3):
        padded = [np.pad(image[..., channel], 1, mode="reflect") for image in (x, y)]
        for i in range(x.shape[0]):
            for j in range(x.shape[1]):
                a, b = (plane[i : i + 3, j : j + 3] for plane in padded)
                ma, mb = (weights * a).sum(), (weights * b).sum()
                va, vb = (weights * (a - ma) ** 2).sum(), (weights * (b - mb) ** 2).sum()
                covariance = (weights * (a - ma) * (b - mb)).sum()
                top = (2 * ma * mb + 1e-4) * (2 * covariance + 9e-4)
                values.append(top / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    return float(np.mean(values))


@given(seed=st.integers(0, 2**16), margin=st.integers(0, 5))
@settings(max_examples=6, deadline=None)
def test_scores_agree_with_the_transcription(seed: int, margin: int) -> None:
    images = random_images(seed, 20, margin)
    scores = score_image(*images)
    np.testing.assert_allclose((scores.psnr_h, scores.psnr_l, scores.ssim), transcription(*images), atol=1e-4)


def test_the_tolerance_tells_other_rules_apart() -> None:
    prediction, truth, mask = random_images(0, margin=2)
    high, low, similarity = transcription(prediction, truth, mask)
    inner = eroded(mask)[..., None]
    shown = np.clip(np.where(inner, truth, 0), 0, 1)
    assert abs(psnr(CODED(np.clip(prediction * inner, 0, 1)), CODED(shown)) - low) > 0.1, "without a factor"
    wider = score_image(prediction, truth, np.ones_like(mask))
    assert abs(wider.psnr_l - low) > 1e-2 and abs(wider.psnr_h - high) > 1e-2, "without a mask"
    scored = score_image(prediction, truth, mask)
    assert abs(scored.psnr_h - scored.psnr_l) > 0.5
    for window in (SsimWindow(), SsimWindow(1, 1.5), SsimWindow(1, 0.8, True)):
        fitted = CODED(np.clip(prediction * 1.1, 0, 1)) * inner
        assert abs(ssim(fitted, CODED(shown), window) - ssim(fitted, CODED(shown), WINDOW)) > 1e-4
    assert abs(plain_ssim(CODED(shown), CODED(shown)) - similarity) > 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_ssim_with_a_window_of_3_agrees_with_scikit_image(seed: int) -> None:
    """Its Gaussian ends after 3.5 sigma, so 0.4 makes it 3 pixels wide; on a black border padding does not matter."""
    generator = np.random.default_rng(seed)
    x, y = (np.pad(generator.uniform(size=(14, 17, 3)), ((3, 3), (3, 3), (0, 0))) for _ in range(2))
    _, full = structural_similarity(
        x, y, gaussian_weights=True, sigma=0.4, use_sample_covariance=False, data_range=1.0, channel_axis=-1, full=True
    )
    assert ssim(x, y, SsimWindow(1, 0.4, True)) == pytest.approx(full.mean(), abs=1e-4)
    assert abs(ssim(x, y, SsimWindow(1, 0.4)) - full.mean()) > 1e-3, "valid positions only"
    assert abs(ssim(x, y, WINDOW) - full.mean()) > 1e-3, "another sigma"


@pytest.mark.parametrize("seed", range(4))
def test_psnr_agrees_with_scikit_image(seed: int) -> None:
    x, y = np.random.default_rng(seed).uniform(size=(2, 20, 21, 3))
    assert psnr(x, y) == pytest.approx(peak_signal_noise_ratio(y, x, data_range=1.0), abs=1e-4)
    assert abs(psnr(x, y) - peak_signal_noise_ratio(y, x, data_range=4.0)) > 1


def test_a_factor_per_channel_costs_nothing() -> None:
    _, truth, mask = random_images(1)
    truth = np.clip(truth, 0, 1)
    scores = score_image(truth * [0.2, 3.0, 1.0], truth, mask)
    assert min(scores.psnr_h, scores.psnr_l) == 100 and scores.ssim == pytest.approx(1)
    uneven = truth * np.linspace(0.5, 1, 24)[:, None, None]
    assert score_image(uneven, truth, mask).psnr_l < 40


def test_only_what_is_inside_the_shrunk_mask_counts() -> None:
    prediction, truth, mask = random_images(2, margin=4)
    wanted = score_image(prediction, truth, mask)
    outside = np.where(eroded(mask)[..., None], prediction, 0.7)
    assert score_image(outside, truth, mask) == wanted
    inside = np.where(mask[..., None], 0.7, prediction)
    assert score_image(inside, truth, mask).psnr_l < wanted.psnr_l - 1


def test_errors_are_averaged_over_the_whole_image() -> None:
    """Black surroundings of twice the size add log10(4) * 10 dB."""
    prediction, truth, mask = random_images(3, margin=3)
    wide = [np.pad(image, ((12, 12), (12, 12), (0, 0))) for image in (prediction, truth)]
    wanted = score_image(prediction, truth, mask).psnr_l + 10 * np.log10(4)
    assert score_image(wide[0], wide[1], np.pad(mask, 12)).psnr_l == pytest.approx(wanted, abs=1e-6)


def test_the_border_of_the_image_is_no_margin() -> None:
    assert eroded(np.ones((9, 9), bool)).all()
    block = np.zeros((9, 9), bool)
    block[2:7, 2:7] = True
    assert eroded(block).sum() == 1


def test_no_score_is_less_than_that_of_grey() -> None:
    """A scaled prediction that is far off still has the PSNR of 0.5 inside the mask."""
    truth = np.full((16, 16, 3), 0.2)
    prediction = np.zeros((16, 16, 3))
    prediction[0, 0] = 1
    grey = -20 * np.log10(coded(0.2) - 0.5) if coded(0.2) > 0.5 else -20 * np.log10(0.5 - coded(0.2))
    assert score_image(prediction, truth, np.ones((16, 16), bool)).psnr_l == pytest.approx(grey, abs=1e-6)


def test_an_almost_black_prediction_is_not_blown_up() -> None:
    _, truth, mask = random_images(4)
    faint = score_image(np.clip(truth, 0, 1) * 1e-5, truth, mask)
    assert faint.psnr_l < 25 < 90 < score_image(np.clip(truth, 0, 1) * 1e-2, np.clip(truth, 0, 1), mask).psnr_l
    assert np.isfinite(faint.psnr_h)


def test_highlights_count_up_to_four_only_in_psnr_h() -> None:
    truth = np.full((16, 16, 3), 0.3)
    truth[5:8, 5:8] = 1.5
    low = truth.copy()
    low[5:8, 5:8] = 1.2
    mask = np.ones((16, 16), bool)
    brighter = truth.copy()
    brighter[5:8, 5:8] = 900
    assert score_image(low, truth, mask).psnr_h < 40
    assert score_image(brighter, brighter * 2, mask).psnr_h == 100


def test_lpips_sees_images_coded_twice() -> None:
    _, truth, mask = random_images(5)
    truth = np.clip(truth, 0, 1)
    seen = []

    def metric(prediction: np.ndarray, wanted: np.ndarray) -> float:
        seen.append(wanted)
        return 0.25

    assert score_image(truth, truth, mask, metric).lpips == 0.25
    inner = eroded(mask)
    np.testing.assert_allclose(seen[0][inner], CODED(CODED(truth))[inner], atol=1e-6)
    assert np.abs(seen[0][inner] - CODED(truth)[inner]).max() > 0.1


def test_a_mask_of_margin_alone_is_refused() -> None:
    prediction, truth, _ = random_images(6)
    with pytest.raises(ValueError, match="margin"):
        score_image(prediction, truth, np.zeros((24, 24), bool))
