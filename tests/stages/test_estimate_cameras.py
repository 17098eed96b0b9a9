"""Photographs without poses to a capture; structure from motion is replaced by known poses in a world of its own."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from illuminerf.data.capture import load_capture
from illuminerf.data.capture_warnings import Quality, largest_gap, warnings_of
from illuminerf.data.solved_cameras import Solved, SolvedCamera
from illuminerf.data.structure_from_motion import MatchingImage, SolverConfig
from illuminerf.data.world_alignment import Similarity, pose_errors
from illuminerf.stages import estimate_cameras, import_capture
from illuminerf.stages.estimate_cameras import Config
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.errors import UserError
from tests.data.photographed import ring_cameras, write_photographs

CAMERAS = ring_cameras(12, 64)
WORLD = Similarity(0.3, Rotation.from_rotvec([0.4, 2.0, -1.0]).as_matrix(), np.array([5.0, 1.0, -2.0]))


def known_poses(missing: Sequence[int] = (), still_unless: str = "") -> Any:
    """A stand-in for `solve`: the true cameras in another world, without those `missing`; unless the folder is named
    `still_unless`, all in one place."""

    def solve(images: Sequence[MatchingImage], folder: Path, config: SolverConfig) -> Solved:
        poses = WORLD.poses(CAMERAS.world_from_camera)
        if still_unless and folder.name != still_unless:
            poses = np.tile(poses[:1], (len(poses), 1, 1))
        cameras = {}
        for view, image in enumerate(images):
            assert image.path.is_file() and image.size == (64, 64)
            if view not in missing:
                fx, fy, cx, cy = CAMERAS.intrinsics[view].tolist()
                cameras[view] = SolvedCamera(poses[view], (fx, fy, cx, cy), (0.01, 0.0, 0.0, 0.0, 0.0), 40, 0.6)
        directions = np.random.default_rng(0).normal(size=(300, 3))
        points = WORLD.points(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
        return Solved(cameras, points, np.full((300, 3), 90, np.uint8), "usual features")

    return solve


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(estimate_cameras, "load_pycolmap", lambda: None)
    monkeypatch.setattr(estimate_cameras, "solve", known_poses())
    return monkeypatch


def test_photographs_become_an_upright_capture_in_the_unit_ball(tmp_path: Path, solved: pytest.MonkeyPatch) -> None:
    images = write_photographs(tmp_path / "mug", CAMERAS, with_alpha=False)
    out = estimate_cameras.run(tmp_path / "mug", Config(), tmp_path / "capture")
    capture = load_capture(out)
    assert capture.background == "masked" and capture.names[:2] == ("IMG_1", "IMG_2")
    poses = capture.views.cameras.world_from_camera
    np.testing.assert_allclose(poses[:, 2, 0], 0, atol=1e-6)  # level, so z is up
    assert (poses[:, 2, 1] > 0).all() and abs(poses[0, 0, 3]) < 0.2 and poses[0, 1, 3] < 0
    assert pose_errors(poses, CAMERAS.world_from_camera)[0].max() < 1e-4
    distance = np.linalg.norm(capture.views.cameras.positions, axis=-1).mean()
    true_distance = np.linalg.norm(CAMERAS.positions, axis=-1).mean()
    assert distance / true_distance == pytest.approx(0.9, rel=0.15)  # the ball of radius 1 has become one of 0.9
    away = np.abs(capture.views.alpha - np.stack(images)[..., 3])
    assert away.mean() < 0.03
    page = (out / "check.html").read_text()
    assert "12 of 12 photographs placed" in page and page.count("<figure") == 12 and "http" not in page
    assert read_json(out / "poses.json")["masks"] == "plain"


def test_the_capture_is_imported_and_made_only_once(tmp_path: Path, solved: pytest.MonkeyPatch) -> None:
    write_photographs(tmp_path / "mug", CAMERAS)
    out = estimate_cameras.run(tmp_path / "mug", Config(), tmp_path / "capture")
    again = load_capture(import_capture.run(out, import_capture.Config(size=32), tmp_path / "imported"))
    assert len(again.views) == 12 and again.views.cameras.width == 32
    solved.setattr(estimate_cameras, "solve", None)
    assert estimate_cameras.run(tmp_path / "mug", Config(), tmp_path / "capture") == out
    with pytest.raises(UserError, match="made with other settings: config.size"):
        estimate_cameras.run(tmp_path / "mug", Config(size=500), tmp_path / "capture")


def test_photographs_that_are_not_placed_are_left_out_and_named(tmp_path: Path, solved: pytest.MonkeyPatch) -> None:
    write_photographs(tmp_path / "mug", CAMERAS)
    solved.setattr(estimate_cameras, "solve", known_poses(missing=[0, 7]))
    out = estimate_cameras.run(tmp_path / "mug", Config(), tmp_path / "capture")
    assert len(load_capture(out).views) == 10
    report = read_json(out / "poses.json")
    assert report["not_placed"] == ["IMG_1", "IMG_8"]
    assert "2 of 12 photographs could not be placed and are left out: IMG_1, IMG_8." in report["warnings"]


def test_a_turntable_before_a_room_is_noticed(tmp_path: Path, solved: pytest.MonkeyPatch) -> None:
    """The room says that the camera stands still; the object alone tells."""
    images = write_photographs(tmp_path / "mug" / "images", CAMERAS, with_alpha=False)
    from illuminerf.scene.images import write_png

    for view, image in enumerate(images):
        write_png(tmp_path / "mug" / "masks" / f"IMG_{view + 1}.png", image[..., 3])
    solved.setattr(estimate_cameras, "solve", known_poses(still_unless="object"))
    out = estimate_cameras.run(tmp_path / "mug", Config(), tmp_path / "capture")
    assert read_json(out / "poses.json")["matched"] == "object"
    solved.setattr(estimate_cameras, "solve", known_poses())
    out = estimate_cameras.run(tmp_path / "mug", Config(), tmp_path / "walked")
    assert read_json(out / "poses.json")["matched"] == "everything"


GOOD = Quality(
    num_photographs=60,
    unplaced=(),
    names=tuple(f"{view}" for view in range(60)),
    azimuths=np.linspace(-180, 174, 60),
    elevations=np.linspace(0, 60, 60),
    errors=np.full(60, 0.5),
    num_points=np.full(60, 300),
    sharpness=np.full(60, 100.0),
    object_shares=np.full(60, 0.3),
    border_shares=np.zeros(60),
    exposures=(1.0, 1.1),
    focal=1.2,
    has_masks=True,
)


def _but(**changed: Any) -> Quality:
    return dataclasses.replace(GOOD, **changed)


@pytest.mark.parametrize(
    ("quality", "says"),
    [
        (
            _but(unplaced=("a", "b"), num_photographs=62),
            "2 of 62 photographs could not be placed and are left out: a, b",
        ),
        (_but(azimuths=np.linspace(0, 180, 60)), "No camera over 180 degrees"),
        (_but(elevations=np.full(60, 30.0)), "All cameras look from 30 to 30 degrees"),
        (_but(errors=np.full(60, 3.0)), "off by 3.0 pixels"),
        (_but(sharpness=np.r_[1.0, np.full(59, 100.0)]), "Much less sharp than the others: 0."),
        (_but(exposures=(1.0, 2.0)), "Exposure changes by 1.0 stops"),
        (_but(border_shares=np.r_[0.1, np.zeros(59)]), "runs into the image's border: 0."),
        (_but(object_shares=np.full(60, 0.01)), "fills 1.0% of the images"),
        (_but(object_shares=np.r_[1.0, np.full(59, 0.3)]), "another size than the others: 0."),
        (_but(num_points=np.r_[5, np.full(59, 300)]), "fewer than 20 points: 0."),
        (_but(focal=7.0), "7.00 image widths is unusual"),
        (_but(has_masks=False), "no masks"),
    ],
)
def test_each_fault_has_its_warning_and_a_good_capture_none(quality: Quality, says: str) -> None:
    assert warnings_of(GOOD) == []
    found = warnings_of(quality)
    assert len(found) == 1 and says in found[0]


def test_the_widest_gap_goes_around_the_circle() -> None:
    assert largest_gap(np.array([-170.0, 170.0, 0.0])) == pytest.approx(170)
    assert largest_gap(np.array([90.0])) == 360


def test_settings_that_cannot_be_are_refused() -> None:
    for wrong in ({"size": 8}, {"object_radius": 0.0}, {"masks": "none", "match": "object"}):
        with pytest.raises(UserError):
            Config(**wrong)  # type: ignore[arg-type]
    with pytest.raises(UserError):
        SolverConfig(max_attempts=5)
