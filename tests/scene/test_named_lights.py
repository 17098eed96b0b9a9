"""Lights by name or by file, as a user gives them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.named_lights import NAMED_LIGHTS, find_light, light_file
from illuminerf.workflow.errors import UserError


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    """A panorama with a white lamp on grey."""
    pixels = np.full((16, 32, 3), 100, np.uint8)
    pixels[4, 20] = 255
    Image.fromarray(pixels).save(tmp_path / "attic.png")
    return tmp_path / "attic.png"


@pytest.mark.parametrize("name", NAMED_LIGHTS)
def test_a_name_is_a_light_and_becomes_a_file_of_that_name(name: str, tmp_path: Path) -> None:
    file = light_file(Path(name), tmp_path)
    assert file == tmp_path / f"{name}.exr"
    stored, made = EnvironmentMap.load(file), find_light(Path(name))
    np.testing.assert_array_equal(stored.linear_rgb, made.linear_rgb)
    assert stored.name == made.name == name


def test_a_file_goes_before_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    EnvironmentMap(np.ones((4, 8, 3), np.float32)).save(tmp_path / "mine.exr")
    assert light_file(Path("mine.exr"), tmp_path / "run") == Path("mine.exr")
    assert not (tmp_path / "run").exists()


def test_a_low_range_light_is_expanded_where_that_is_asked_for(photograph: Path, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="cut off at 1.*--ldr-peak"):
        assert light_file(photograph, tmp_path / "run") == photograph
        plain = find_light(photograph)
    with pytest.warns(UserWarning, match="reach 30.*guess"):
        stored = EnvironmentMap.load(light_file(photograph, tmp_path / "run", 30.0))
    assert plain.linear_rgb.max() == pytest.approx(1)
    assert stored.linear_rgb.max() == pytest.approx(30) and stored.linear_rgb[4, 20, 0] > 29
    grey = stored.linear_rgb[0, 0, 0] / plain.linear_rgb[0, 0, 0]
    assert 1 < grey < 1.3, "what is far from white hardly changes"


def test_neither_file_nor_name(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist.*evening.*lights list"):
        find_light(tmp_path / "evning")
