"""Objects before plain backdrops: any colour, uneven light, holes, paint of the same colour; and what is not plain."""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from illuminerf.data.capture import load_capture
from illuminerf.data.plain_background import MIN_TOLERANCE, Backdrop, cut_out
from illuminerf.scene.images import linear_from_srgb, srgb_from_linear
from illuminerf.stages.import_capture import Config, run
from illuminerf.workflow.errors import UserError
from tests.data.synthetic_capture import ball_cameras, write_plain

CAMERAS = ball_cameras(6, 40, 48)
COLOURS = {"white": (1, 1, 1), "black": (0, 0, 0), "green": (0.1, 0.7, 0.2), "grey": (0.5, 0.5, 0.5)}
PLAIN = Config(background="plain", placement="keep")


def ball(size: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Anti-aliased views of a ball: linear colour [views, h, w, 3] premultiplied, and coverage [views, h, w]."""
    from tests.data.synthetic_capture import ball_images

    fine = ball_images(CAMERAS.resized(40 * size, 48 * size)).astype(np.float32) / 255
    linear = np.concatenate([linear_from_srgb(fine[..., :3]) * fine[..., 3:], fine[..., 3:]], -1)
    mean = linear.reshape(len(CAMERAS), 40, size, 48, size, 4).mean((2, 4))
    return mean[..., :3], mean[..., 3]


LINEAR, ALPHA = ball()


def photographs(backdrop: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """uint8 [views, h, w, 3] before a backdrop that broadcasts to [h, w, 3] in sRGB."""
    behind = linear_from_srgb(np.broadcast_to(backdrop, (40, 48, 3)).astype(np.float32))
    srgb = srgb_from_linear(LINEAR + (1 - ALPHA[..., None]) * behind)
    srgb = srgb + np.random.default_rng(0).normal(0, 1, srgb.shape) * noise
    return np.round(np.clip(srgb, 0, 1) * 255).astype(np.uint8)


def imported_alpha(folder: Path, images: np.ndarray, config: Config = PLAIN) -> np.ndarray:
    write_plain(folder / "source", CAMERAS, images)
    capture = load_capture(run(folder / "source", config, folder / "capture"))
    assert capture.background == "masked"
    return np.asarray(capture.views.alpha)


def iou(alpha: np.ndarray) -> float:
    found, truth = alpha > 0.5, ALPHA > 0.5
    return float((found & truth).sum() / (found | truth).sum())


@pytest.mark.parametrize("colour", COLOURS)
def test_masks_are_the_truth_before_any_plain_colour(tmp_path: Path, colour: str) -> None:
    alpha = imported_alpha(tmp_path, photographs(np.array(COLOURS[colour]), noise=1.5 / 255))
    assert iou(alpha) > 0.97
    assert np.abs(alpha - ALPHA).mean() < 0.01  # outlines are soft
    hard = (ALPHA > 0).astype(np.float32)
    assert np.abs(hard - ALPHA).mean() > 0.012  # what a mask of whole pixels would reach


def test_outlines_lose_the_backdrops_colour(tmp_path: Path) -> None:
    write_plain(tmp_path / "source", CAMERAS, photographs(np.array(COLOURS["green"])))
    views = load_capture(run(tmp_path / "source", PLAIN, tmp_path / "capture")).views
    edge = (ALPHA > 0.3) & (ALPHA < 0.7) & (np.asarray(views.alpha) > 0.1)
    truth = srgb_from_linear(LINEAR / np.maximum(ALPHA, 1e-3)[..., None])[edge]
    mixed = photographs(np.array(COLOURS["green"]))[edge] / 255
    error = np.abs(views.srgb[edge] - truth).mean()
    assert error < 0.06 < 2 * error + 0.03 and np.abs(mixed - truth).mean() > 2 * error


def test_a_backdrop_that_is_lit_from_one_side_is_still_plain(tmp_path: Path) -> None:
    slope = np.linspace(-0.08, 0.08, 48)[None, :, None] + np.linspace(-0.03, 0.03, 40)[:, None, None]
    assert iou(imported_alpha(tmp_path, photographs(0.6 + slope * np.ones(3), noise=1.5 / 255))) > 0.97


@pytest.mark.parametrize("kind", ["texture", "stripes"])
def test_a_textured_backdrop_is_refused_and_nothing_is_written(tmp_path: Path, kind: str) -> None:
    generator = np.random.default_rng(1)
    texture = generator.random((40, 48, 3)) if kind == "texture" else np.zeros((40, 48, 3))
    texture[::2] += 0.4 * (kind == "stripes")
    with pytest.raises(UserError, match="not plain.*masks"):
        imported_alpha(tmp_path, photographs(texture))
    assert not (tmp_path / "capture").exists()


def test_a_view_without_the_backdrop_is_named(tmp_path: Path) -> None:
    images = photographs(np.array(COLOURS["grey"]))
    images[3] = np.random.default_rng(0).integers(0, 255, images[3].shape)
    with pytest.raises(UserError, match="view 3 has no plain background"):
        imported_alpha(tmp_path, images)


def disc_with_inner(inner: float | np.ndarray, colour: tuple[float, ...]) -> np.ndarray:
    """A red disc before `colour` with a smaller disc of `inner` in it."""
    row, column = np.mgrid[:60, :60] - 29.5
    radius = np.hypot(row, column)[..., None]
    return np.where(radius < 8, inner, np.where(radius < 20, [0.8, 0.2, 0.1], colour)).astype(np.float32)


def test_holes_are_looked_through_and_highlights_are_not() -> None:
    grey = (0.5, 0.5, 0.5)
    hole = cut_out(disc_with_inner(np.array(grey), grey), Backdrop(np.float32(grey), MIN_TOLERANCE), "0")[..., 3]
    assert hole[30, 30] == 0 and hole[30, 16] == 1 and hole[0, 0] == 0
    paint = cut_out(disc_with_inner(0.5 + 0.025, grey), Backdrop(np.float32(grey), MIN_TOLERANCE), "0")[..., 3]
    assert paint[30, 30] == 1  # alike, but not the same
    white = (1.0, 1.0, 1.0)
    highlight = cut_out(disc_with_inner(np.array(white), white), Backdrop(np.float32(white), MIN_TOLERANCE), "0")
    assert highlight[30, 30, 3] == 1 and highlight[0, 0, 3] == 0


def test_dust_is_not_the_object() -> None:
    grey = (0.5, 0.5, 0.5)
    image = disc_with_inner(0.9, grey)
    image[3:5, 3:5] = 0.9
    alpha = cut_out(image, Backdrop(np.float32(grey), MIN_TOLERANCE), "0")[..., 3]
    assert alpha[:8, :8].max() == 0 and ndimage.label(alpha > 0)[1] == 1


def test_alpha_and_masks_win_over_the_backdrop(tmp_path: Path) -> None:
    rgba = np.concatenate([photographs(np.array(COLOURS["grey"])), np.round(ALPHA[..., None] * 255)], -1)
    alpha = imported_alpha(tmp_path, rgba.astype(np.uint8))
    np.testing.assert_allclose(alpha, ALPHA, atol=1 / 255)
