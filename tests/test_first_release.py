"""A run that release 0.1.0 left behind still opens: its keys are today's, its files are read, viewed and rendered."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from illuminerf import films
from illuminerf.batch.jobs import Job
from illuminerf.batch.outcome import present_job
from illuminerf.batch.stages import Stage, stage_folder, stages_of
from illuminerf.run_folder import RunFolder
from illuminerf.scene.cameras import turntable_cameras
from illuminerf.viewer.finished_run import find_run
from illuminerf.viewer.renderer import Look, ViewRenderer
from illuminerf.workflow.artefact import open_artefact, verify
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.config import first_difference, to_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.migrations import SCHEMA, NewField, upgraded
from tests.fixtures.make_first_release import LIGHT, preset

SAVED = Path(__file__).parent / "fixtures" / "first_release"
JOB = Job("first", "photographs", (LIGHT,), "run", preset())
STAGES = stages_of(JOB)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SAVED, tmp_path / "run"))


def todays_key(stage: Stage) -> dict[str, Any]:
    return {"schema": SCHEMA, "stage": stage.name, "config": to_json(stage.config(JOB.preset))}


@pytest.mark.parametrize("name", STAGES)
def test_its_settings_are_todays_for_the_same_behaviour(name: str, run: Path) -> None:
    """Where this fails after a field was added to a config: add a line to `migrations._NEW_FIELDS`."""
    folder = run / stage_folder(name, LIGHT)
    verify(folder)
    saved = read_json(folder / "config.json")
    assert saved["schema"] == 1
    assert first_difference(upgraded(saved, name), todays_key(STAGES[name])) is None


def test_without_its_migration_it_would_be_refused() -> None:
    saved = read_json(SAVED / "lights" / LIGHT / "cues" / "config.json")
    without = upgraded(saved, "cues", fields=())
    assert "config.shard is 'absent' there" in str(first_difference(without, todays_key(STAGES["cues"])))


def test_a_stage_loads_it_and_leaves_it_as_it_is(run: Path) -> None:
    folder = run / "lights" / LIGHT / "cues"
    inputs: dict[str, Path | str] = {"geometry": run / "geometry", "capture": run / "capture"}
    settings = STAGES["cues"].config(JOB.preset)
    with open_artefact(folder, "render_radiance_cues", settings, inputs) as artefact:
        assert artefact.is_done
    assert read_json(folder / "config.json")["schema"] == 1
    changed = {**vars(settings), "exposure_stops": 1.0}
    with (
        pytest.raises(UserError, match="exposure_stops is 0.0 there and 1.0 here"),
        open_artefact(folder, "render_radiance_cues", type(settings)(**changed), inputs),
    ):
        pass


def test_it_is_viewed_rendered_and_reported(run: Path, tmp_path: Path) -> None:
    viewer = ViewRenderer(find_run(run), "cpu")
    cameras = turntable_cameras(1, 3.0, 0.7, 16, 16, 0.5)
    assert viewer.render(cameras, Look(LIGHT)).srgb.min() < 0.9, "something is seen"
    film = films.render(RunFolder(run), tmp_path / "film", size=16, num_views=2, device="cpu")
    assert film.video.stat().st_size > 100 and len(film.frames) == 2
    before = (run / "report.html").read_bytes()
    (run / "report.html").unlink()
    present_job(run, JOB, (LIGHT,), tuple(STAGES))
    page = (run / "report.html").read_bytes()
    assert abs(len(page) - len(before)) < 2000 and b"Radiance cues" in page


def test_later_releases_and_other_files_are_refused_clearly(run: Path) -> None:
    key = read_json(run / "capture" / "config.json")
    for wrong, message in (
        (key | {"schema": SCHEMA + 1}, "made by a later release.*update illuminerf"),
        (key | {"schema": "new"}, "does not say what made the folder"),
        ([1, 2], "does not say what made the folder"),
    ):
        write_json(run / "capture" / "config.json", wrong)
        with (
            pytest.raises(UserError, match=message),
            open_artefact(run / "capture", "import_capture", JOB.preset.capture, {}),
        ):
            pass


def test_fields_are_filled_in_where_they_are_missing_only() -> None:
    key = {"schema": 1, "stage": "toy", "config": {"steps": 3, "inner": {"rate": 1}, "light": None}}
    fields = (
        NewField(2, "toy", "inner.kind", "a"),
        NewField(3, "toy", "steps", 7),
        NewField(3, "toy", "light.sun", 1),
        NewField(3, "other", "size", 1),
        NewField(4, "toy", "late", 1),
    )
    new = upgraded(key, "here", fields, schema=3)
    assert new["config"] == {"steps": 3, "inner": {"rate": 1, "kind": "a"}, "light": None}
    assert new["schema"] == 3 and key["schema"] == 1 and "kind" not in key["config"]["inner"]  # type: ignore[index]


def test_the_fixture_stays_small() -> None:
    assert sum(path.stat().st_size for path in SAVED.rglob("*") if path.is_file()) < 500_000
