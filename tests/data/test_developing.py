"""Averages, padding, undistortion and quantising of linear premultiplied images."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_erosion

from illuminerf.data.developing import plain_background_mask, shrunk, straight_srgb_uint8
from illuminerf.data.distortion import distorted, undistorted_image
from illuminerf.data.resampling import area_downsampled, area_weights, padded, padding_to
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear

GENERATOR = np.random.default_rng(0)


@given(num_in=st.integers(1, 40), share=st.floats(0.01, 1))
@settings(max_examples=100, deadline=None)
def test_area_weights_are_the_overlap(num_in: int, share: float) -> None:
    num_out = max(1, int(num_in * share))
    weights = area_weights(num_in, num_out).toarray()
    edges = np.linspace(0, num_in, num_out + 1)
    low = np.maximum(np.arange(num_in)[None], edges[:-1, None])
    high = np.minimum(np.arange(1, num_in + 1)[None], edges[1:, None])
    overlap = np.maximum(high - low, 0)
    np.testing.assert_allclose(weights, overlap / overlap.sum(1, keepdims=True), atol=1e-6)


def test_whole_cells_are_plain_means_and_the_mean_is_kept() -> None:
    image = GENERATOR.uniform(size=(12, 20, 4)).astype(np.float32)
    small = area_downsampled(image, 3, 5)
    np.testing.assert_allclose(small, image.reshape(3, 4, 5, 4, 4).mean((1, 3)), atol=1e-6)
    odd = area_downsampled(image, 7, 11)
    np.testing.assert_allclose(odd.mean((0, 1)), image.mean((0, 1)), atol=1e-6)
    assert area_downsampled(image, 12, 20) is image
    with pytest.raises(ValueError, match="enlarge"):
        area_downsampled(image, 13, 20)


def test_edges_do_not_darken_and_light_adds_linearly() -> None:
    """Half a white object over nothing: straight colour stays white. Black and white in equal parts: linear
    0.5.
    """
    edge = np.zeros((2, 2, 4), np.float32)
    edge[:, :1] = 1
    np.testing.assert_array_equal(straight_srgb_uint8(area_downsampled(edge, 1, 1)), [[[255, 255, 255, 128]]])
    checker = np.ones((2, 2, 4), np.float32)
    checker[0, 0, :3] = checker[1, 1, :3] = 0
    wanted = round(255 * float(srgb_from_linear(np.array(0.5))))
    np.testing.assert_array_equal(straight_srgb_uint8(area_downsampled(checker, 1, 1)), [[[wanted] * 3 + [255]]])
    assert wanted != 128  # guard: averaging sRGB values would give this


def test_every_straight_eight_bit_value_survives() -> None:
    alpha, value = np.meshgrid(np.arange(256), np.arange(256), indexing="ij")
    straight = np.stack([value, value, value, alpha], -1) / 255
    linear = linear_from_srgb(straight[..., :3]) * straight[..., 3:]
    back = straight_srgb_uint8(np.concatenate([linear, straight[..., 3:]], -1).astype(np.float32))
    np.testing.assert_array_equal(back[..., 3], alpha)
    np.testing.assert_array_equal(back[1:, :, 0], value[1:])
    assert (back[0] == 0).all()


def test_padding_centres() -> None:
    image = np.ones((3, 5, 4), np.float32)
    out = padded(image, (8, 7))
    left, top = padding_to((5, 3), (8, 7))
    assert out.shape == (7, 8, 4) and out.sum() == image.sum()
    np.testing.assert_array_equal(out[top : top + 3, left : left + 5], image)


COEFFICIENTS = (0.08, -0.03, 0.004, -0.003, 0.01)


def test_distortion_of_known_points() -> None:
    np.testing.assert_array_equal(distorted(np.zeros((1, 2)), COEFFICIENTS), [[0, 0]])
    np.testing.assert_allclose(distorted(np.array([[1.0, 0.0]]), (0.1, 0.02, 0.0, 0.0, 0.0)), [[1.12, 0]])
    np.testing.assert_allclose(distorted(np.array([[0.0, 1.0]]), (0.0, 0.0, 0.01, 0.02, 0.0)), [[0.02, 1.03]])


def test_an_undistorted_image_is_what_a_pinhole_sees() -> None:
    """A smooth pattern is rendered through the lens, by inverting it point by point, and then recovered."""
    height, width, focal = 80, 100, 90.0
    intrinsics = (focal, focal * 1.02, 52.0, 38.5)

    def pattern(points: np.ndarray) -> np.ndarray:
        x, y = points[..., 0], points[..., 1]
        colours = [0.5 + 0.4 * np.sin(6 * x + phase) * np.cos(5 * y) for phase in (0, 1, 2)]
        return np.stack([*colours, np.ones_like(x)], -1).astype(np.float32)

    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    grid = np.stack([(columns - 52.0) / focal, (rows - 38.5) / (focal * 1.02)], -1)
    ideal = grid.copy()
    for _ in range(60):  # fixed-point inverse of the lens
        ideal -= distorted(ideal, COEFFICIENTS) - grid
    recovered = undistorted_image(pattern(ideal), intrinsics, COEFFICIENTS)
    seen = binary_erosion(recovered[..., 3] > 0.99)  # half a pixel of the border is extrapolated
    assert seen.mean() > 0.8
    np.testing.assert_allclose(recovered[seen], pattern(grid)[seen], atol=5e-3)
    assert np.abs(pattern(ideal)[seen] - pattern(grid)[seen]).max() > 0.03


def test_no_distortion_changes_nothing_and_the_unseen_is_transparent() -> None:
    image = np.ones((20, 20, 4), np.float32)
    assert undistorted_image(image, (20.0, 20.0, 10.0, 10.0), (0.0,) * 5) is image
    pincushion = undistorted_image(image, (20.0, 20.0, 10.0, 10.0), (0.8, 0.0, 0.0, 0.0, 0.0))
    assert pincushion[0, 0].max() == 0 and pincushion[10, 10, 3] == 1


def test_plain_backgrounds_are_those_connected_to_the_border() -> None:
    srgb = np.ones((20, 20, 3), np.float32)
    srgb[5:15, 5:15] = 0.4
    srgb[9:11, 9:11] = 1.0  # a highlight
    mask = plain_background_mask(srgb, "white")
    wanted = np.zeros((20, 20), bool)
    wanted[5:15, 5:15] = True
    np.testing.assert_array_equal(mask, wanted)
    np.testing.assert_array_equal(plain_background_mask(1 - srgb, "black"), wanted)
    assert plain_background_mask(srgb, "black").all()


def test_shrinking_is_that_of_the_importer_and_never_enlarges() -> None:
    straight = np.round(GENERATOR.uniform(size=(8, 12, 4)) * 255).astype(np.float32) / 255
    linear = np.concatenate([linear_from_srgb(straight[..., :3]) * straight[..., 3:], straight[..., 3:]], -1)
    np.testing.assert_array_equal(
        np.round(shrunk(straight, 6) * 255), straight_srgb_uint8(area_downsampled(linear, 4, 6))
    )
    assert shrunk(straight, 12) is straight
