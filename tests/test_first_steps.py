"""What a newcomer stumbles over: odd folders, narrow terminals, missing permissions, wrong files."""

import os
import shutil
import stat
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from illuminerf.cli import main
from illuminerf.demo import bundled_capture
from illuminerf.films import render
from illuminerf.run_folder import RunFolder
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import write_png
from illuminerf.workflow import atomic, progress
from illuminerf.workflow.errors import UserError

LIGHT = bundled_capture() / "lights" / "evening.exr"


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert printed.count("error:") == 1 and "Traceback" not in printed
    return printed.split("error:")[1]


def photographs(folder: Path, count: int = 5) -> Path:
    shutil.copytree(bundled_capture() / "images", folder / "images")
    shutil.copy(bundled_capture() / "cameras.json", folder)
    return folder


def test_photographs_without_poses_are_told_where_poses_come_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(4):
        write_png(tmp_path / "photos" / f"IMG_{number}.png", np.ones((8, 8, 3)))
    said = refused(["relight", str(tmp_path / "photos"), "--light", str(LIGHT), "--out", str(tmp_path / "run")], capsys)
    assert "illuminerf capture" in said


def test_a_folder_with_spaces_and_umlauts_that_may_only_be_read(tmp_path: Path) -> None:
    folder = photographs(tmp_path / "Möbel und Öfen, 2. Versuch")
    everything = [folder, *folder.rglob("*")]
    for path in everything:
        path.chmod(path.stat().st_mode & ~(stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH))
    before = {path: path.stat().st_mtime_ns for path in everything}
    try:
        main(["import-capture", str(folder), "--size", "16", "--out", str(tmp_path / "Ergebnis é")])
        assert (tmp_path / "Ergebnis é" / "DONE").is_file()
        assert {path: path.stat().st_mtime_ns for path in [folder, *folder.rglob("*")]} == before
    finally:
        for path in everything:
            path.chmod(path.stat().st_mode | stat.S_IWUSR)


def test_no_permission_to_write(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make = Path.mkdir

    def denied(path: Path, *arguments: Any, **named: Any) -> None:
        if path.is_relative_to("/locked"):
            raise PermissionError(13, "Permission denied")
        make(path, *arguments, **named)

    folder = photographs(tmp_path / "photos")
    monkeypatch.setattr(Path, "mkdir", denied)  # root may write everywhere
    said = refused(["import-capture", str(folder), "--size", "16", "--out", "/locked/run"], capsys)
    assert "/locked/run cannot be written" in said and "--out" in said
    with pytest.raises(UserError, match="cannot be written"), atomic.atomic_path(Path("/locked/a.json")):
        pass


def test_an_out_that_cannot_be_is_found_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("years of work")
    folder = photographs(tmp_path / "photos")
    for name in ("file", "file/run"):
        out = ["--out", str(tmp_path / name)]
        with pytest.raises(SystemExit):
            main(["relight", str(folder), "--light", str(LIGHT), *out])
        said = capsys.readouterr().err
        assert "which is a file" in said and "read images" not in said
    atomic.check_writable(tmp_path / "new" / "run")
    assert not (tmp_path / "new").exists() and (tmp_path / "file").read_text() == "years of work"


def test_what_may_not_be_read_is_not_said_to_be_unwritable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    denied = PermissionError(13, "Permission denied")
    path = tmp_path / "photos" / "transforms.json"
    assert "cannot be written" in str(atomic.explained(denied, path))
    monkeypatch.setattr(os, "access", lambda place, mode: not (mode & os.R_OK and place == tmp_path))  # root may all
    said = str(atomic.explained(denied, path))
    assert "cannot be read" in said and f"permissions of {tmp_path}" in said
    monkeypatch.setattr(os, "access", lambda place, mode: not mode & os.W_OK)
    assert "cannot be written" in str(atomic.explained(denied, path))
    with pytest.raises(UserError, match="no permission to write"):
        atomic.check_writable(tmp_path / "run")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_locked_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "locked").mkdir(mode=0o555)
    folder = photographs(tmp_path / "photos")
    assert "cannot be written" in refused(
        ["import-capture", str(folder), "--size", "16", "--out", str(tmp_path / "locked" / "run")], capsys
    )


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_narrow_terminal_loses_nothing(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        progress, "console", Console(stderr=True, width=60, force_terminal=is_terminal, soft_wrap=True, no_color=True)
    )
    path = "/a/very/long/folder/" * 6 + "report.html"
    progress.say(f"done: {path}")
    assert path in capsys.readouterr().err, "a path must be left in one piece, to be copied"
    for _ in progress.track(range(3), "render novel views"):
        pass
    assert "3/3" in capsys.readouterr().err


@pytest.mark.parametrize("width", [60, 80, 120])
def test_counts_and_time_left_are_never_cut_off(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "console", Console(stderr=True, width=width, force_terminal=True, no_color=True))
    numbers = {"loss": 0.029462, "psnr": 23.066, "beta": 0.030512}
    with progress.step_progress("fit latent NeRF", 3000) as steps:
        steps.advance(1234, **numbers)
    said = capsys.readouterr().err
    assert "1234/3000" in said and "\N{HORIZONTAL ELLIPSIS}" not in said
    assert ("beta 0.03051" in said) == (width == 120) and ("psnr" in said) == (width > 60)
    monkeypatch.setattr(progress.StepProgress, "_room", property(lambda _: 99, lambda *_: None), raising=False)
    with progress.step_progress("fit latent NeRF", 3000) as steps:
        steps.advance(1234, **numbers)
    assert ("\N{HORIZONTAL ELLIPSIS}" in capsys.readouterr().err) == (width == 60), "too much would be cut off"


def test_a_picture_is_no_light(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "light.exr").write_text("not an EXR")
    folder = photographs(tmp_path / "photos")
    said = refused(
        ["relight", str(folder), "--light", str(tmp_path / "light.exr"), "--out", str(tmp_path / "run")], capsys
    )
    assert "light.exr" in said and not (tmp_path / "run").exists()


def test_a_photograph_is_no_light(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_png(tmp_path / "photo.png", np.ones((60, 80, 3)))
    said = refused(["lights", "preview", str(tmp_path / "photo.png")], capsys)
    assert "80 x 60" in said and "panorama" in said
    with pytest.raises(UserError, match="not an equirectangular map"), warnings.catch_warnings():
        warnings.simplefilter("error")  # that it is of low range is no matter then
        EnvironmentMap.load(tmp_path / "photo.png")
    write_png(tmp_path / "panorama.png", np.ones((4, 8, 3)))
    with pytest.warns(UserWarning, match="low dynamic range"):
        EnvironmentMap.load(tmp_path / "panorama.png")


def test_a_mistyped_light_is_told_which_was_meant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for given, meant in (("Evening", "evening"), ("evning", "evening"), ("studo", "studio")):
        assert f"did you mean {meant}" in refused(["lights", "preview", given], capsys)
    assert "lights list" in refused(["lights", "preview", "my_light.exr"], capsys)
    assert "is a folder" in refused(["lights", "preview", str(tmp_path)], capsys)


def test_a_film_is_sent_to_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mug.mp4").write_bytes(b"frames")
    said = refused(["relight", str(tmp_path / "mug.mp4"), "--light", "evening", "--out", str(tmp_path / "run")], capsys)
    assert "illuminerf capture" in said


def test_the_wrong_run_or_light(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a run"):
        render(RunFolder(tmp_path), tmp_path / "out")
    for name in ("city", "night"):
        (tmp_path / "lights" / name).mkdir(parents=True)
    with pytest.raises(UserError, match="city or night"):
        RunFolder(tmp_path).light()
    with pytest.raises(UserError, match="no such light"):
        RunFolder(tmp_path).light("dawn")
    assert RunFolder(tmp_path).light("city").video.name == "turntable.mp4"
    assert Path(RunFolder(tmp_path)) == tmp_path
