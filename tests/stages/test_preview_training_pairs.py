"""The contact sheet shows each item once, and something in every picture."""

from pathlib import Path

import numpy as np
import pytest

from illuminerf.scene.images import read_png
from illuminerf.stages import preview_training_pairs
from illuminerf.stages.preview_training_pairs import Config
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import write_items


@pytest.mark.parametrize(("wanted", "rows"), [(2, 2), (24, 3)])
def test_a_row_per_item(tmp_path: Path, wanted: int, rows: int) -> None:
    pairs = write_items(tmp_path / "pairs")
    sheet = read_png(preview_training_pairs.run(pairs, Config(num_items=wanted, cell=32), tmp_path / "sheet.png"))
    pictures = 4 + 4 + 4 + 1  # lights, cues, surface, composited
    assert sheet.shape == (rows * (32 + 14), pictures * 32, 3)
    cells = [sheet[14 + 46 * row : 46 + 46 * row, 32 * i : 32 * i + 32] for row in range(rows) for i in range(pictures)]
    assert all(np.unique(cell.reshape(-1, 3), axis=0).shape[0] > 1 for cell in cells)
    assert all((cell[0, 0] == 1).all() for cell in cells), "the background is white"


def test_no_pairs_no_picture(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no training items"):
        preview_training_pairs.run(tmp_path, Config(), tmp_path / "sheet.png")
    assert not (tmp_path / "sheet.png").exists()
