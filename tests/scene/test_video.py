"""GIF: as many frames, the same colours, the right speed."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from illuminerf.scene.video import write_gif
from illuminerf.workflow.errors import UserError


def frame(shift: int) -> np.ndarray:
    ramp = np.tile(np.linspace(0.1, 0.9, 32)[:, None, None], (1, 40, 3)) * np.array([1.0, 0.8, 0.5])
    return np.roll(ramp, shift, 0)


def test_frames_speed_and_colours(tmp_path: Path) -> None:
    write_gif(tmp_path / "a.gif", (frame(shift) for shift in range(5)), 10)
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.size, picture.info["duration"], picture.info["loop"]) == (5, (40, 32), 100, 0)
        for number in range(5):
            picture.seek(number)
            shown = np.asarray(picture.convert("RGB")) / 255
            assert np.abs(shown - frame(number)).mean() < 0.02
            assert np.abs(shown - frame(number + 8)).mean() > 0.1


def test_no_frames(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no frames"):
        write_gif(tmp_path / "a.gif", [])
    assert not list(tmp_path.iterdir())
