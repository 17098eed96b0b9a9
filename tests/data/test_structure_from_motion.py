"""Poses from pictures alone."""

import builtins
import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from illuminerf.data import structure_from_motion
from illuminerf.data.matching_images import feature_mask, write_matching_images
from illuminerf.data.object_masks import settle_masks
from illuminerf.data.photographs import photographs_of
from illuminerf.data.solved_cameras import Solved, SolvedCamera
from illuminerf.data.structure_from_motion import MatchingImage, SolverConfig, solve
from illuminerf.data.world_alignment import pose_errors, similarity_between, up_axis
from illuminerf.workflow.errors import UserError
from tests.data.photographed import ring_cameras, write_photographs


@pytest.mark.slow
def test_poses_of_a_patterned_ball_are_those_it_was_photographed_from(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap", reason="needs the extra `capture`")
    cameras = ring_cameras(8, 160)
    write_photographs(tmp_path / "photographs", cameras)
    frames = photographs_of(tmp_path / "photographs", "masks", 100, tmp_path)
    masked = settle_masks(frames, "auto", tmp_path)
    images = write_matching_images(masked, "object", 1600, tmp_path / "work")
    solved = solve(images, tmp_path / "work", SolverConfig(threads=1, max_attempts=2))
    assert "bundle_adjustment" not in capfd.readouterr().err, "COLMAP's own log is not for people"
    placed = list(solved.cameras)
    assert len(placed) >= 7
    found = np.stack([solved.cameras[view].world_from_camera for view in placed])
    true = cameras.world_from_camera[placed]
    rotation, position = pose_errors(found, true)
    assert np.median(rotation) < 1.0 and np.median(position) < 0.02
    shuffled = pose_errors(found, true[::-1])[0]
    assert np.median(shuffled) > 10  # what wrong poses would show
    world = similarity_between(found[:, :3, 3], true[:, :3, 3])
    assert (world.rotation @ up_axis(found))[2] > np.cos(np.radians(2))
    radius = np.linalg.norm(world.points(solved.points), axis=-1)
    assert np.median(np.abs(radius - 1)) < 0.03  # the points lie on the ball
    first = solved.cameras[placed[0]]
    assert first.intrinsics[0] == pytest.approx(208, rel=0.1) and np.isfinite(first.error)


def test_what_a_library_logs_is_kept_away(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="kept"), structure_from_motion._silenced():
        os.write(2, b"I20261126 === Global bundle adjustment ===")
        raise ValueError("errors are kept")
    os.write(2, b"heard")
    assert capfd.readouterr().err == "heard"


def test_without_pycolmap_the_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def absent(name: str, *arguments: Any, **named: Any) -> Any:
        if name == "pycolmap":
            raise ImportError("No module named 'pycolmap'")
        return real(name, *arguments, **named)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(UserError, match=r"pip install 'illuminerf\[capture\]'"):
        structure_from_motion.load_pycolmap()


def _solved(num: int, attempt: str) -> Solved:
    camera = SolvedCamera(np.eye(4), (1.0, 1.0, 1.0, 1.0), (0.0,) * 5, 9, 0.5)
    return Solved(dict.fromkeys(range(num), camera), np.zeros((4, 3)), np.zeros((4, 3), np.uint8), attempt)


def _with_attempts(monkeypatch: pytest.MonkeyPatch, placed: list[int]) -> list[str]:
    """Replace the attempts by ones that place so many; returns the names of those that are made, as they are."""
    made: list[str] = []
    methods = ("with_usual_features", "with_lower_thresholds", "with_thorough_features", "all_at_once")
    monkeypatch.setattr(structure_from_motion, "load_pycolmap", lambda: None)
    for method, num in zip(methods, placed, strict=True):

        def attempt(self: Any, name: str, num: int = num, method: str = method) -> Solved | None:
            made.append(method)
            return _solved(num, name) if num else None

        monkeypatch.setattr(structure_from_motion._Solver, method, attempt)
    return made


def _images(folder: Path, num: int) -> list[MatchingImage]:
    return [MatchingImage(folder / "images" / f"{view}.png", None, (8, 8), None) for view in range(num)]


def test_attempts_stop_once_enough_is_placed_and_the_best_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = _with_attempts(monkeypatch, [100, 0, 0, 0])
    assert solve(_images(tmp_path, 100), tmp_path, SolverConfig()).attempt == "usual features"
    assert made == ["with_usual_features"]
    made = _with_attempts(monkeypatch, [50, 90, 70, 0])
    found = solve(_images(tmp_path, 100), tmp_path, SolverConfig())
    assert found.attempt == "lower thresholds" and len(found.cameras) == 90 and len(made) == 4
    made = _with_attempts(monkeypatch, [50, 90, 95, 0])
    assert len(solve(_images(tmp_path, 100), tmp_path, SolverConfig(max_attempts=2)).cameras) == 90
    assert len(made) == 2


def test_photographs_that_do_not_fit_together_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _with_attempts(monkeypatch, [0, 2, 0, 0])
    with pytest.raises(UserError, match="got 2 of 10 placed by 4 attempts"):
        solve(_images(tmp_path, 10), tmp_path, SolverConfig())


def test_no_feature_lies_on_the_outline_or_outside(tmp_path: Path) -> None:
    alpha = np.zeros((20, 20), np.float32)
    alpha[5:15, 5:15] = 1
    mask = feature_mask(alpha)
    assert mask[7:13, 7:13].all() and mask.sum() == 36
    full = np.ones((20, 20), np.float32)
    assert feature_mask(full).all()  # the image's border is no outline


def test_matching_images_hide_the_surroundings_or_keep_them(tmp_path: Path) -> None:
    cameras = ring_cameras(4, 64)
    write_photographs(tmp_path / "photographs", cameras, with_alpha=False)
    masked = settle_masks(photographs_of(tmp_path / "photographs", "masks", 9, tmp_path), "auto", tmp_path)
    assert masked.source == "plain"
    alone = write_matching_images(masked, "object", 48, tmp_path / "alone")
    whole = write_matching_images(masked, "everything", 48, tmp_path / "whole")
    assert alone[0].size == whole[0].size == (48, 48) and whole[0].mask is None
    assert np.ptp(np.asarray(Image.open(alone[0].path))[0, 0].astype(int)) == 0  # grey
    assert np.asarray(Image.open(whole[0].path))[0, 0].tolist() == pytest.approx([26, 178, 51], abs=2)
    assert alone[0].mask is not None and np.asarray(Image.open(alone[0].mask))[0, 0] == 0
