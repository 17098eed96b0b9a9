"""The contact sheet shows each item once, and something in every picture."""

from pathlib import Path

import numpy as np
import pytest

from illuminerf.scene.images import read_png
from illuminerf.stages import preview_training_pairs
from illuminerf.stages.preview_training_pairs import GAP, LABEL_HEIGHT, Config, column_starts
from illuminerf.workflow.errors import UserError
from tests.diffusion.tiny import write_items


@pytest.mark.parametrize(("wanted", "rows"), [(2, 2), (24, 3)])
def test_a_row_per_item(tmp_path: Path, wanted: int, rows: int) -> None:
    pairs = write_items(tmp_path / "pairs")
    sheet = read_png(preview_training_pairs.run(pairs, Config(num_items=wanted, cell=32), tmp_path / "sheet.png"))
    starts = column_starts(num_lights=4, cell=32)
    assert len(starts) == 4 + 4 + 4 + 1  # lights, cues, surface, composited
    height = LABEL_HEIGHT + 32 + GAP
    assert sheet.shape == (LABEL_HEIGHT + rows * height, starts[-1] + 32, 3)
    assert sheet[:LABEL_HEIGHT, :32].min() < 0.5, "the first column has a heading"
    tops = [LABEL_HEIGHT + row * height + LABEL_HEIGHT for row in range(rows)]
    cells = [sheet[top : top + 32, x : x + 32] for top in tops for x in starts]
    assert all(np.unique(cell.reshape(-1, 3), axis=0).shape[0] > 1 for cell in cells)
    assert all((sheet[top : top + 32, starts[4] - GAP : starts[4]] == 1).all() for top in tops), "groups stand apart"
    is_material = [x in starts[9:11] for _ in tops for x in starts]
    corners = np.array([cell[0, 0] for cell in cells])
    assert (corners[~np.array(is_material)] == 1).all(), "the background is white"
    assert (corners[is_material] < 1).any(-1).all(), "except where white is a value: a metal must be seen"


def test_no_pairs_no_picture(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no training items"):
        preview_training_pairs.run(tmp_path, Config(), tmp_path / "sheet.png")
    assert not (tmp_path / "sheet.png").exists()
