"""The tables say which figures are whose."""

import io

import numpy as np
import pytest
from rich.console import Console

from illuminerf.evaluation.pictures import FULL_SCALE, error_map, side_by_side
from illuminerf.evaluation.published import STANFORD_ORB, TENSOIR, gallery_scores
from illuminerf.evaluation.tables import MeanRow, cell_table, mean_of, published_table


def printed(table: object) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_means_are_over_lights_and_then_scenes() -> None:
    assert mean_of({"a": {"x": 10.0, "y": 20.0}, "b": {"x": 30.0}}) == 22.5


def test_cells_stand_beside_the_gallery() -> None:
    text = printed(cell_table({"hotdog": {"city": 21.5}}, {"hotdog": {"city": 0.91}}))
    assert "21.50" in text and "25.79" in text and "26.66" in text and "0.910" in text


def test_unknown_cells_have_no_gallery_figure() -> None:
    text = printed(cell_table({"mug": {"lamp": 21.5}}, {"mug": {"lamp": 0.91}}, {"mug": {"lamp": 0.1}}))
    assert "-" in text and "0.100" in text
    assert gallery_scores("mug", "lamp") is None


def test_rivals_stand_beside_ours_with_their_time() -> None:
    one = {"hotdog": {"city": 21.5}}
    lines = printed(cell_table(one, one, rivals={"inverse rendering": {"hotdog": {"city": 23.25}}})).splitlines()
    assert sum("23.25" in line for line in lines) == 2 and any("inverse rendering" in line for line in lines)
    rival = MeanRow("inverse rendering, same geometry", 23.25, 0.9, None, 1234.4)
    lines = printed(published_table(27.0, 0.93, None, "hotdog", 2000.2, [rival])).splitlines()
    ours, theirs = (next(line for line in lines if name in line) for name in ("ours", "same geometry"))
    assert "2000 s" in ours and "23.25" in theirs and "1234 s" in theirs and "*" not in theirs


def test_published_rows_are_marked() -> None:
    lines = printed(published_table(27.0, 0.93, None, "hotdog")).splitlines()
    rows = {row.method: next(line for line in lines if f"{row.method} *" in line) for row in TENSOIR}
    assert "29.71" in rows["IllumiNeRF"] and "NeurIPS 2024" in rows["IllumiNeRF"]
    ours = next(line for line in lines if "ours" in line)
    assert "*" not in ours and "27.00" in ours


def test_published_figures_are_sorted_and_plausible() -> None:
    assert [row.psnr for row in TENSOIR] == sorted((row.psnr for row in TENSOIR), reverse=True)
    assert [row.psnr_h for row in STANFORD_ORB] == sorted((row.psnr_h for row in STANFORD_ORB), reverse=True)
    assert all(0.9 < row.ssim < 1 and 0 < row.lpips < 0.2 and row.source for row in (*TENSOIR, *STANFORD_ORB))


def test_error_maps_are_black_where_right_and_white_where_wrong() -> None:
    truth = np.zeros((4, 4, 3), np.float32)
    wrong = truth.copy()
    wrong[0, 0] = FULL_SCALE
    wrong[1, 1] = FULL_SCALE / 3
    drawn = error_map(wrong, truth)
    np.testing.assert_allclose(drawn[0, 0], 1, atol=1e-6)
    assert drawn[1, 1, 0] > 0.3 > 0.1 > drawn[1, 1, 1]
    assert drawn[2:].max() == 0


def test_side_by_side_is_prediction_truth_error() -> None:
    generator = np.random.default_rng(0)
    prediction, truth = generator.uniform(size=(2, 5, 6, 3)).astype(np.float32)
    panel = side_by_side(prediction, truth)
    assert panel.shape == (5, 18, 3)
    np.testing.assert_array_equal(panel[:, :6], prediction)
    np.testing.assert_array_equal(panel[:, 6:12], truth)
    assert panel[:, 12:].max() <= 1 and pytest.approx(0) != panel[:, 12:].max()
