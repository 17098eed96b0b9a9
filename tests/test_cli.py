"""What a person sees who gets something wrong: one clear line, exit status 2, nothing half-written."""

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from illuminerf.cli import COMMANDS, main
from illuminerf.demo import bundled_capture
from illuminerf.scene.images import write_png, write_rgb_exr

LIGHT = bundled_capture() / "lights" / "evening.exr"


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command line, which must exit with 2 and print one error; returns it on one line."""
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert printed.count("error:") == 1 and "Traceback" not in printed
    return printed.split("error:")[1]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A copy of the bundled photographs, to be damaged."""
    folder = tmp_path / "photos with spaces and ümlauts"
    shutil.copytree(bundled_capture() / "images", folder / "images")
    shutil.copy(bundled_capture() / "cameras.json", folder)
    return folder


def relight(capture: Path, tmp_path: Path, *more: str, light: Path = LIGHT) -> list[str]:
    return ["relight", str(capture), "--light", str(light), "--out", str(tmp_path / "run"), *more]


def test_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "absent" in refused(relight(tmp_path / "absent", tmp_path), capsys)
    assert not (tmp_path / "run").exists()


def test_empty_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    refused(relight(tmp_path / "empty", tmp_path), capsys)
    assert not (tmp_path / "run").exists()


def test_photographs_without_poses(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (capture / "cameras.json").unlink()
    refused(relight(capture, tmp_path), capsys)
    assert not (tmp_path / "run").exists()


def test_truncated_photograph(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = capture / "images" / "004.png"
    image.write_bytes(image.read_bytes()[:900])
    assert "004.png" in refused(relight(capture, tmp_path), capsys)
    assert not (tmp_path / "run").exists()


def test_empty_masks(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for image in (capture / "images").glob("*.png"):
        write_png(image, np.zeros((128, 128, 4)))
    refused(relight(capture, tmp_path), capsys)
    assert not (tmp_path / "run").exists()


def test_impossible_lights_are_found_before_any_work(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    square = tmp_path / "square.exr"
    write_rgb_exr(square, np.ones((8, 8, 3), np.float32))
    assert "twice the height" in refused(relight(capture, tmp_path, light=square), capsys)
    assert "does not exist" in refused(relight(capture, tmp_path, light=tmp_path / "no.exr"), capsys)
    assert not (tmp_path / "run").exists()


def test_a_missing_mesh_is_found_before_any_work(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "mine.ply is missing" in refused(relight(capture, tmp_path, "--mesh", str(tmp_path / "mine.ply")), capsys)
    assert not (tmp_path / "run").exists()


def test_unknown_preset(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refused(relight(capture, tmp_path, "--preset", "supreme"), capsys)
    assert "supreme" in message and "embedded" in message


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_cuda_where_there_is_none(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "CUDA" in refused(relight(capture, tmp_path, "--device", "cuda"), capsys)
    assert not (tmp_path / "run").exists()


def test_another_programs_folder_is_left_alone(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run" / "capture").mkdir(parents=True)
    (tmp_path / "run" / "capture" / "thesis.tex").write_text("years of work")
    assert "not a run of this program" in refused(relight(capture, tmp_path), capsys)


def test_benchmark_asks_for_what_it_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["benchmark", "tensoir", str(tmp_path), "--scenes", "hotdog"]
    assert "--score" in refused(command, capsys)
    both = [*command, "--score", str(tmp_path), "--baseline", "inverse-rendering"]
    assert "a baseline needs a run" in refused(both, capsys)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["benchmark", "tensoir", "--help"],
        ["benchmark", "ablation", "--help"],
        ["benchmark", "geometry", "--help"],
        ["benchmark", "stanford-orb", "--help"],
        ["benchmark", "stanford-orb-illumination", "--help"],
        ["data", "synthetic-orb", "--help"],
        ["data", "tensoir-gallery", "--help"],
        ["benchmark", "report", "--help"],
        ["models", "download", "--help"],
        *([command, "--help"] for command in COMMANDS),
    ],
    ids=" ".join,
)
def test_help(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0
    assert "usage" in capsys.readouterr().out


def test_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    main(["presets"])
    assert "embedded" in capsys.readouterr().err


def test_a_relighting_model_is_scored_on_rendered_pairs_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no training items" in refused(["evaluate-rdm", "embedded", str(tmp_path)], capsys)


def test_missing_weights_are_found_before_the_geometry_is_fitted(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ILLUMINERF_MODELS", str(tmp_path / "models"))
    assert "models download dilightnet" in refused(relight(capture, tmp_path, "--preset", "dilightnet"), capsys)
    assert not (tmp_path / "run").exists()


def test_the_package_runs_as_a_module(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["illuminerf", "presets"])
    runpy.run_module("illuminerf", run_name="__main__")
    assert "dilightnet" in capsys.readouterr().err
