"""Sharp frames of a video."""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from illuminerf.data.video_frames import sharpest_of_windows, sharpness, write_sharp_frames
from illuminerf.scene.images import read_png
from illuminerf.scene.video import write_mp4
from illuminerf.workflow.errors import UserError

SCENE = ndimage.gaussian_filter(np.random.default_rng(0).uniform(0, 1, (64, 96, 3)), (1, 1, 0))
SCENE = (SCENE - SCENE.min()) / np.ptp(SCENE)


def test_sharpness_of_a_wave_is_its_closed_form() -> None:
    """The discrete Laplacian of 100 sin(k x) has the variance 100^2 / 2 * (2 - 2 cos k)^2."""
    k = 2 * np.pi / 8
    wave = np.broadcast_to(100 * np.sin(k * np.arange(64)), (64, 64))
    assert sharpness(wave[:, 1:-1]) == pytest.approx(5000 * (2 - 2 * np.cos(k)) ** 2, rel=0.05)
    assert sharpness(ndimage.gaussian_filter(wave, 2)) < 0.2 * sharpness(wave)


def test_each_window_gives_its_sharpest_frame() -> None:
    values = np.ones(40)
    values[[4, 14, 26, 35]] = [9, 2, 5, 7]
    assert sharpest_of_windows(values.tolist(), 4) == [4, 14, 26, 35]
    assert sharpest_of_windows(values.tolist(), 100) == list(range(40))
    assert len(set(sharpest_of_windows(np.random.default_rng(0).uniform(size=37).tolist(), 30))) == 30


def test_frames_of_a_video_are_the_sharp_ones_in_full_size(tmp_path: Path) -> None:
    sharp = {3, 9, 14, 20}
    frames = [SCENE if n in sharp else ndimage.gaussian_filter(SCENE, (2, 2, 0)) for n in range(24)]
    write_mp4(tmp_path / "walk.mp4", frames)
    paths = write_sharp_frames(tmp_path / "walk.mp4", 4, tmp_path / "frames")
    assert {int(path.stem.removeprefix("frame_")) for path in paths} == sharp
    shown = read_png(paths[0])
    assert shown.shape == (64, 96, 3)
    assert np.abs(shown - SCENE).mean() < 0.05 < np.abs(frames[0] - SCENE).mean()


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"nothing")
    with pytest.raises(UserError, match="not a readable video"):
        write_sharp_frames(tmp_path / "a.mp4", 4, tmp_path / "frames")
