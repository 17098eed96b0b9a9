"""Images kept as bytes come out as the floats that they were read as."""

from pathlib import Path

import numpy as np
import pytest

from illuminerf.scene.cameras import turntable_cameras
from illuminerf.scene.images import read_png, write_png
from illuminerf.scene.views import EightBitImages, Views
from illuminerf.workflow.errors import UserError

_PIXELS = np.random.default_rng(0).integers(0, 256, (3, 4, 5, 4), dtype=np.uint8)


def test_bytes_are_read_as_floats(tmp_path: Path) -> None:
    images = EightBitImages(_PIXELS)
    assert images.shape == (3, 4, 5, 4) and len(images) == 3
    write_png(tmp_path / "one.png", _PIXELS[1] / 255.0)
    np.testing.assert_array_equal(images[1], read_png(tmp_path / "one.png"))
    assert images[1].dtype == images[1, 2, 3].dtype == np.asarray(images).dtype == np.float32
    np.testing.assert_array_equal(np.asarray(images), np.stack(list(images)))
    np.testing.assert_array_equal(images[[2, 0]], np.asarray(images)[[2, 0]])


def test_views_of_bytes_are_those_of_floats() -> None:
    cameras = turntable_cameras(3, 2.0, 0.6, 4, 5)
    floats = np.asarray(EightBitImages(_PIXELS))
    views = Views(cameras, EightBitImages(_PIXELS[..., :3]), EightBitImages(_PIXELS[..., 3]))
    twin = Views(cameras, floats[..., :3], floats[..., 3])
    for mine, wanted in ((views.premultiplied(), twin.premultiplied()), (views.alphas([2, 1]), twin.alphas([2, 1]))):
        np.testing.assert_array_equal(np.stack(list(mine)), np.stack(list(wanted)))
    np.testing.assert_array_equal(next(views.alphas([2])), floats[2, ..., 3])
    with pytest.raises(UserError, match="do not fit together"):
        Views(cameras, EightBitImages(_PIXELS), EightBitImages(_PIXELS[..., 3]))
