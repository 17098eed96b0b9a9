"""The notebook's code runs from top to bottom, at sizes that take seconds, and is kept without outputs."""

import contextlib
import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

import illuminerf as il
from illuminerf import presets

NOTEBOOK = Path(__file__).parents[1] / "examples" / "relight.ipynb"
CELLS = json.loads(NOTEBOOK.read_text())["cells"]


def code_cells() -> list[str]:
    return ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]


def test_outputs_are_not_kept() -> None:
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in CELLS)
    assert NOTEBOOK.stat().st_size < 20_000


def tiny_preset() -> Any:
    """The sizes of the pipeline's own tests."""
    spec = importlib.util.spec_from_file_location("pipeline_tests", Path(__file__).parent / "test_pipeline.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tests = tiny_preset()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(presets, "customised", lambda *_, **__: tests.tiny(samples=2))
    (tmp_path / "photographs").mkdir()
    photographs = tests.few_photographs(tmp_path / "photographs")
    names: dict[str, Any] = {}
    for source in code_cells():
        if "IPython" in source:
            with contextlib.suppress(ImportError):  # an optional extra
                exec(source, names)
            continue
        exec(source, names)
        if "PHOTOS =" in source:
            names["PHOTOS"] = photographs
    run = names["run"]
    assert run.report.is_file() and run.photographs and run.mesh.is_file() and run.video.is_file()
    relit = names["relit"]
    assert all(path.is_file() for path in (relit.video, relit.mesh, relit.ply))
    assert relit.frames and relit.radiance and relit.cues and len(relit.samples) == 2 * tests.NUM_VIEWS
    film = il.render(run, tmp_path / "path", cameras=photographs / "cameras.json", size=16, gif=True, device="cpu")
    assert film.video.is_file() and film.gif is not None and film.gif.is_file()
    assert len(film.frames) == len(film.radiance) == tests.NUM_VIEWS
