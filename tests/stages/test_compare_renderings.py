"""Pictures beside the truth, and the command that puts them on a page."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from illuminerf.cli import main
from illuminerf.data.tensoir import load_test_image
from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.scene.images import write_png
from illuminerf.stages.compare_renderings import RenderedMethod, compare_renderings
from illuminerf.stages.score_predictions import score_predictions
from illuminerf.workflow.errors import UserError
from tests.stages.test_score_predictions import NUMBERS, make_benchmark, predict

SCALED = {"mug": {"lamp": (2.0, 2.0, 2.0)}}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    make_benchmark(tmp_path / "truth")
    return tmp_path / "truth"


def test_renderings_are_shown_as_they_are_scored(root: Path, tmp_path: Path) -> None:
    predict(root, tmp_path / "dim", "lamp", factor=0.5)
    predict(root, tmp_path / "exact", "lamp")
    methods = [
        RenderedMethod("dim", tmp_path / "dim", "median", SCALED),
        RenderedMethod("raw", tmp_path / "dim"),
        RenderedMethod("exact", tmp_path / "exact"),
    ]
    (cell,) = compare_renderings(root, methods, [("mug", "lamp")], 2)
    assert [view.name for view in cell.views] == ["test_000", "test_025"] and not cell.notes
    first = cell.views[0]
    truth = on_white(load_test_image(root / "mug", "test_000", "lamp"))
    np.testing.assert_array_equal(first.truth, truth)
    assert first.input_light is not None and np.abs(first.input_light - truth).max() > 0.2
    rescaled, raw, exact = first.renderings
    np.testing.assert_allclose(rescaled.srgb, truth, atol=1.5 / 255 + 1e-6)
    assert rescaled.psnr > 45 > 25 > raw.psnr and np.abs(raw.srgb - truth).max() > 0.1
    assert exact.psnr == 100.0 and exact.error.max() == 0 < raw.error.max()


def test_missing_pictures_are_left_out_and_noted(root: Path, tmp_path: Path) -> None:
    predict(root, tmp_path / "few", "lamp", numbers=(10, 25))
    predict(root, tmp_path / "all", "lamp")
    methods = [RenderedMethod(name, tmp_path / name) for name in ("few", "all", "none")]
    methods += [RenderedMethod("unscored", tmp_path / "all", "median"), RenderedMethod("nowhere", None)]
    lamp, noon, absent = compare_renderings(root, methods, [("mug", "lamp"), ("mug", "noon"), ("vase", "lamp")])
    assert [view.name for view in lamp.views] == ["test_010", "test_025"]  # those that both show
    assert [note.split(" has no pictures")[0] for note in lamp.notes] == ["none", "unscored", "nowhere"]
    assert not noon.views and len(noon.notes) == 5
    assert not absent.views and "no truth" in absent.notes[0]


def test_views_that_nobody_shares_are_shown_all_the_same(root: Path, tmp_path: Path) -> None:
    predict(root, tmp_path / "a", "lamp", numbers=(0,))
    predict(root, tmp_path / "b", "lamp", numbers=(10,))
    methods = [RenderedMethod(name, tmp_path / name) for name in "ab"]
    (cell,) = compare_renderings(root, methods, [("mug", "lamp")])
    assert [[shown.method for shown in view.renderings] for view in cell.views] == [["a"], ["b"]]
    assert cell.notes == ("b has no picture of test_000.", "a has no picture of test_010.")


def test_smaller_renderings_meet_a_smaller_truth_and_odd_ones_are_noted(root: Path, tmp_path: Path) -> None:
    write_png(tmp_path / "a" / "mug" / "lamp" / "test_000.png", np.ones((8, 8, 3)))
    write_png(tmp_path / "a" / "mug" / "lamp" / "test_010.png", np.ones((8, 4, 3)))
    (cell,) = compare_renderings(root, [RenderedMethod("a", tmp_path / "a")], [("mug", "lamp")])
    assert cell.views[0].renderings[0].error.shape == (8, 8, 3) and cell.views[0].truth.shape == (16, 16, 3)
    assert not cell.views[1].renderings and "another shape" in cell.notes[0]


def test_no_benchmark_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="the benchmark is missing"):
        list(compare_renderings(tmp_path / "absent", [], [("mug", "lamp")]))


def run(root: Path, tmp_path: Path) -> Path:
    """The folder of a scored method."""
    folder = tmp_path / "ours"
    predict(root, folder / "predictions", "lamp", factor=0.5)
    scores = score_predictions(root, folder / "predictions", ["mug"], ["lamp"])
    (folder / "scores.json").write_text(json.dumps(scores))
    return folder


def test_the_command_writes_page_and_tables(root: Path, tmp_path: Path) -> None:
    folder = run(root, tmp_path)
    predict(root, tmp_path / "published" / "x", "lamp")
    out = tmp_path / "made" / "report.html"
    arguments = ["benchmark", "report", str(folder), "--out", str(out)]
    main(arguments)
    assert b"<img" not in out.read_bytes() and "ours & " in out.with_suffix(".tex").read_text()
    further = ["--root", str(root), "--views", "2", "--renderings", f"gallery={tmp_path / 'published' / 'x'}"]
    main([*arguments, *further])
    page = out.read_bytes()
    assert page.count(b"<img") == 1 + 2 * (1 + 2 + 2 + 1)  # scale; input, two renderings with errors, truth
    assert b"gallery: 100.00 dB" in page
    main([*arguments, *further])
    assert out.read_bytes() == page
    assert len(NUMBERS) == 4 and page.count(b"class=strip") == 2


def test_a_score_file_alone_may_be_told_where_its_pictures_are(root: Path, tmp_path: Path) -> None:
    folder = run(root, tmp_path)
    (folder / "scores.json").rename(tmp_path / "dim.json")
    out = tmp_path / "report.html"
    arguments = ["benchmark", "report", str(tmp_path / "dim.json"), "--out", str(out), "--root", str(root)]
    main(arguments)
    assert b"dim has no pictures" in out.read_bytes()
    main([*arguments, "--renderings", f"dim={folder / 'predictions'}"])
    shown = [float(psnr) for psnr in re.findall(r"dim: ([0-9.]+) dB", out.read_text())]
    assert len(shown) == 3 and min(shown) > 45  # rescaled as its score says


@pytest.mark.parametrize(
    ("further", "message"),
    [
        (["--out", "report.pdf"], "HTML file"),
        (["--out", "r.html", "--views", "0"], "no view to show"),
        (["--out", "r.html", "--renderings", "a=."], "--root"),
        (["--out", "r.html", "--root", ".", "--renderings", "a"], "NAME=FOLDER"),
        (["--out", "r.html", "--root", ".", "--renderings", "a=absent"], "NAME=FOLDER"),
        (["--out", "r.html", "--root", ".", "--renderings", "a=.", "a=."], "NAME=FOLDER"),
    ],
)
def test_mistakes_are_told(
    root: Path, tmp_path: Path, further: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["benchmark", "report", str(run(root, tmp_path)), *further])
    assert stop.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())
