"""PSNR and SSIM against scikit-image and closed forms."""

import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from illuminerf.evaluation.metrics import LPIPS_ABSENT, PSNR_OF_EQUAL_IMAGES, lpips_vgg, psnr, ssim


def pair(seed: int, height: int = 40, width: int = 33) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    truth = generator.uniform(size=(height, width, 3)).astype(np.float32)
    noise = generator.normal(scale=0.1, size=truth.shape)
    return np.clip(truth + noise, 0, 1).astype(np.float32), truth


def skimage_ssim(prediction: np.ndarray, truth: np.ndarray, sigma: float = 1.5) -> float:
    return structural_similarity(
        prediction, truth, gaussian_weights=True, sigma=sigma, use_sample_covariance=False, data_range=1.0,
        channel_axis=-1,
    )  # fmt: skip


def plain_ssim(prediction: np.ndarray, truth: np.ndarray) -> float:
    """The definition, window by window."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for i in range(prediction.shape[0] - 10):
        for j in range(prediction.shape[1] - 10):
            for channel in range(3):
                x = prediction[i : i + 11, j : j + 11, channel].astype(np.float64)
                y = truth[i : i + 11, j : j + 11, channel].astype(np.float64)
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cxy = (window * (x - mx) * (y - my)).sum()
                top = (2 * mx * my + 1e-4) * (2 * cxy + 9e-4)
                values.append(top / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    return float(np.mean(values))


def test_psnr_of_a_constant_difference() -> None:
    truth = np.full((20, 20, 3), 0.5, np.float32)
    assert psnr(truth + np.float32(0.1), truth) == pytest.approx(20.0, abs=1e-4)
    assert psnr(truth + np.float32(0.11), truth) != pytest.approx(20.0, abs=1e-1)


def test_psnr_of_equal_images_is_finite() -> None:
    image = pair(0)[1]
    assert psnr(image, image) == PSNR_OF_EQUAL_IMAGES


@given(seed=st.integers(0, 2**16))
@settings(max_examples=10, deadline=None)
def test_ssim_agrees_with_scikit_image(seed: int) -> None:
    prediction, truth = pair(seed)
    assert ssim(prediction, truth) == pytest.approx(skimage_ssim(prediction, truth), abs=1e-4)


def test_ssim_agrees_with_its_definition() -> None:
    prediction, truth = pair(1, 14, 15)
    assert ssim(prediction, truth) == pytest.approx(plain_ssim(prediction, truth), abs=1e-9)


def test_the_tolerance_tells_another_window_and_padding_apart() -> None:
    prediction, truth = pair(2)
    assert abs(ssim(prediction, truth) - skimage_ssim(prediction, truth, sigma=1.0)) > 1e-3
    uniform = structural_similarity(prediction, truth, data_range=1.0, channel_axis=-1)
    assert abs(ssim(prediction, truth) - uniform) > 1e-3


def test_ssim_of_equal_images_is_one_and_symmetric() -> None:
    prediction, truth = pair(3)
    assert ssim(truth, truth) == pytest.approx(1.0, abs=1e-12)
    assert ssim(prediction, truth) == pytest.approx(ssim(truth, prediction), abs=1e-12)
    assert ssim(prediction, truth) < 0.99


def test_ssim_is_right_on_white_images() -> None:
    """White backgrounds are where variances cancel worst."""
    white = np.ones((32, 32, 3), np.float32)
    assert ssim(white, white) == pytest.approx(1.0, abs=1e-9)


def test_shapes_must_agree_and_hold_a_window() -> None:
    with pytest.raises(ValueError, match="differ in shape"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="11 x 11"):
        ssim(np.zeros((10, 40, 3)), np.zeros((10, 40, 3)))


def test_lpips_says_what_to_install_where_it_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert lpips_vgg(torch.device("cpu")) is None
    assert "pip install illuminerf[lpips]" in LPIPS_ABSENT
