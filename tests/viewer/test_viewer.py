"""The viewer as a person meets it: in a browser, and with the wrong folder."""

import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from illuminerf.cli import main
from illuminerf.viewer import server
from illuminerf.viewer.finished_run import find_run
from illuminerf.viewer.renderer import ViewRenderer
from illuminerf.workflow.errors import UserError
from tests.viewer.browser import FOUND, Browser, wait_for

SIZE = 128
LATENT_SLIDER = "[...document.querySelectorAll('[role=slider]')][0].getBoundingClientRect()"


@pytest.fixture
def broken(run_folder: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be damaged."""
    return Path(shutil.copytree(run_folder, tmp_path / "run"))


def test_unfinished_lights_are_left_out(run_folder: Path) -> None:
    run = find_run(run_folder)
    assert list(run.lights) == ["dawn", "dusk"] and run.unfinished == ("noon",)


def test_ctrl_c_is_how_the_viewer_ends(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="needs the extra `viewer`")

    def interrupted(_: float) -> None:
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(server.time, "sleep", interrupted)
    main(["view", str(run_folder), "--port", "8731"])
    said = capsys.readouterr().err
    assert "the viewer has ended" in said and "run the same command again" not in said


def test_a_folder_that_is_no_run(tmp_path: Path, broken: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        find_run(tmp_path / "absent")
    with pytest.raises(UserError, match="is no run; got no capture"):
        find_run(broken / "capture")
    with pytest.raises(UserError, match="got a folder of runs: run.*name .*run"):
        find_run(broken.parent)


def test_an_unfinished_run(broken: Path) -> None:
    for light in ("dawn", "dusk"):
        (broken / "lights" / light / "latent_nerf" / "DONE").unlink()
    with pytest.raises(UserError, match="unfinished; got no light.*same relight command"):
        find_run(broken)
    (broken / "geometry" / "DONE").unlink()
    with pytest.raises(UserError, match="unfinished; got no finished geometry"):
        find_run(broken)


def test_without_viser(run_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SystemExit) as stop:
        main(["view", str(run_folder), "--port", "0"])
    printed = " ".join(capsys.readouterr().err.split())
    assert stop.value.code == 2 and "needs viser" in printed and "illuminerf[viewer]" in printed


@pytest.fixture
def page(run_folder: Path) -> Iterator[Browser]:
    pytest.importorskip("viser", reason="viser is not installed")
    if FOUND is None:
        pytest.skip("there is no Chromium on this machine")
    from illuminerf.viewer.server import Viewer

    renderer = ViewRenderer(find_run(run_folder), "cpu")
    viewer = Viewer(renderer, "127.0.0.1", 0, SIZE)
    browser = Browser()
    try:
        browser.call("Page.navigate", url=f"http://127.0.0.1:{viewer.port}")
        yield browser
    finally:
        browser.close()
        viewer.stop()


def at_rest(page: Browser) -> np.ndarray:
    """The left part of the finest picture, without the controls, once two screenshots half a second apart agree."""
    pictures: list[np.ndarray] = []

    def rests() -> bool:
        time.sleep(0.5)
        if page.finest() == SIZE:
            pictures.append(page.screenshot()[:, :600].astype(int))
        return len(pictures) > 1 and np.abs(pictures[-1] - pictures[-2]).mean() < 0.05

    wait_for(rests, 90)
    return pictures[-1]


@pytest.mark.slow
def test_in_a_browser_pixels_follow_the_mouse_and_the_controls(page: Browser) -> None:
    first = at_rest(page)
    assert np.abs(first - 255).max() > 60, "the sphere is there"
    place = [page.evaluate(f"{LATENT_SLIDER}.{name}") for name in ("x", "y", "width", "height")]
    x, y = place[0] + place[2] / 2, place[1] + place[3] / 2
    page.drag((x, y), (x + 60, y))
    wait_for(lambda: np.abs(at_rest(page) - first).mean() > 0.15, 30)  # the sphere is a twentieth of the picture
    slid = at_rest(page)
    page.drag((200, 450), (330, 450))
    wait_for(lambda: np.abs(at_rest(page) - slid).mean() > 0.2, 30)
    assert not page.errors
