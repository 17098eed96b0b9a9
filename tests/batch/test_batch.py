"""Batches of stand-in stages here, and of one real job: order, failures, retries, going on."""

import contextlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from illuminerf import pipeline
from illuminerf.batch import command
from illuminerf.batch.command import run_batch
from illuminerf.batch.driver import Retries, steps_of
from illuminerf.batch.jobs import Job
from illuminerf.batch.stages import stages_of
from illuminerf.batch.steps import Step
from illuminerf.cli import main
from illuminerf.presets import customised
from illuminerf.workflow.artefact import locked
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.config import to_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Crash, Execution
from tests.batch import stand_ins
from tests.fixtures.make_first_release import LIGHT, photographs, preset

HERE = Execution(workers=0)
SOON = Retries(attempts=3, backoff_seconds=0.01)


def run(jobs: list[Job], out: str | Path, execution: Execution = HERE, num_shards: int = 2) -> dict[str, Any]:
    results = run_batch(jobs, out, execution, SOON, num_shards, work=stand_ins.work, stages=stand_ins.stages)
    return {name: result["state"] for name, result in results["jobs"].items()}


def contents(place: str | Path, jobs: tuple[str, ...]) -> dict[str, bytes]:
    """Everything in the jobs' folders that must not depend on where and how often they ran."""
    storage = Storage(place)
    names = [f"{job}/{name}" for job in jobs for name in storage.tree(job)]
    return {
        name: storage.read(name) for name in names if not name.endswith(("provenance.json", "checksums.json", ".lock"))
    }


def cells(out: Path) -> dict[tuple[str, str, str], dict[str, Any]]:
    return {(c["job"], c["light"], c["stage"]): c for c in read_json(out / "status.json")["cells"]}


@pytest.fixture
def two(tmp_path: Path) -> list[Job]:
    return [stand_ins.job(name, tmp_path / "photos", str(tmp_path / "out")) for name in ("mug", "shoe")]


def test_steps_are_in_an_order_that_works() -> None:
    job = Job("mug", "photos", ("studio", "evening"), "out", customised("demo"))
    steps = steps_of(job, stages_of(job), num_shards=3)
    seen: set[Step] = set()
    for step, needs in steps.items():
        assert set(needs) <= seen, f"{step} comes before what it needs"
        seen.add(step)
    assert len(steps) == 3 + 2 * (4 + 4 + 3) + 1
    assert {need.stage for need in steps[Step("mug", "", "report")]} == {"turntable", "relit_mesh"}
    assert len(steps_of(job, stages_of(job), 1)) == 3 + 2 * 5 + 1


def test_a_batch_leaves_runs_and_pages(two: list[Job], tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(two, out) == {"mug": "done", "shoe": "done"}
    assert (out / "shoe/lights/evening/turntable/DONE").is_file()
    assert (out / "mug/report.html").read_text() == "report of studio, evening"
    page = (out / "status.html").read_text()
    assert "12 stages" not in page and "18 done of 18 stages" in page
    assert "http-equiv=refresh" not in page, "a batch that is over needs no new look"
    assert {cell["state"] for cell in cells(out).values()} == {"done"}
    assert json.loads((out / "results.json").read_text())["jobs"]["mug"]["measured"]["lights"].keys() == {
        "studio",
        "evening",
    }
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/**/*") if path.is_file()}
    assert run(two, out) == {"mug": "done", "shoe": "done"}
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/**/*") if path.is_file()} == before


def test_what_fails_costs_only_what_needs_it(two: list[Job], tmp_path: Path) -> None:
    out, shoe = tmp_path / "out", tmp_path / "photos" / "shoe"
    (shoe / "cues.evening.user").write_text("")
    (tmp_path / "photos" / "mug" / "geometry.bug").write_text("")
    assert run(two, out) == {"mug": "failed", "shoe": "failed"}
    found = cells(out)
    assert found["shoe", "evening", "cues"]["error"] == "the capture is upside down. Fix: turn it."
    assert found["shoe", "evening", "cues"]["attempts"] == 0, "a person's error is not tried again"
    assert found["shoe", "evening", "turntable"]["state"] == "blocked"
    assert found["shoe", "studio", "turntable"]["state"] == found["shoe", "", "report"]["state"] == "done"
    assert (out / "shoe/report.html").read_text() == "report of studio"
    assert found["mug", "", "geometry"]["error"] == "ZeroDivisionError: nobody thought of this"
    assert found["mug", "", "report"]["state"] == "blocked" and not (out / "mug/report.html").exists()
    for trouble in (tmp_path / "photos").glob("*/*.*"):
        trouble.unlink()
    assert run(two, out) == {"mug": "done", "shoe": "done"}
    assert (out / "shoe/report.html").read_text() == "report of studio, evening"
    clean = [stand_ins.job(name, tmp_path / "photos", str(tmp_path / "clean")) for name in ("mug", "shoe")]
    run(clean, tmp_path / "clean", num_shards=1)
    assert contents(out, ("mug", "shoe")) == contents(tmp_path / "clean", ("mug", "shoe"))


def test_machines_may_fail_a_few_times(two: list[Job], tmp_path: Path) -> None:
    (tmp_path / "photos/mug/geometry.disk").write_text("2")
    (tmp_path / "photos/shoe/geometry.disk").write_text("3")
    assert run(two, tmp_path / "out") == {"mug": "done", "shoe": "failed"}
    found = cells(tmp_path / "out")
    assert found["mug", "", "geometry"]["attempts"] == 2 and not found["mug", "", "geometry"]["error"]
    assert found["shoe", "", "geometry"]["error"] == "OSError: the share is away"
    assert [Retries(9, 10.0).delay(failures) for failures in (1, 2, 3, 9)] == [10, 20, 40, 600]


def test_other_settings_and_inputs_are_refused(two: list[Job], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(two, out)
    other = [two[0], stand_ins.job("shoe", tmp_path / "photos", str(out), samples=2)]
    assert run(other, out) == {"mug": "done", "shoe": "failed"}
    assert "config.samples is 1 there and 2 here" in cells(out)["shoe", "", "capture"]["error"]
    shutil.rmtree(out / "mug/geometry")
    shutil.copytree(out / "shoe/geometry", out / "mug/geometry")
    assert run(two[:1], out) == {"mug": "failed"}
    assert "its input 'capture' has changed" in cells(out)["mug", "", "geometry"]["error"]


def test_a_new_light_is_added(two: list[Job], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(two, out)
    more = stand_ins.job("mug", tmp_path / "photos", str(out), ("studio", "evening", "lamps"))
    assert run([more], out) == {"mug": "done"}
    assert (out / "mug/report.html").read_text() == "report of studio, evening, lamps"


def test_two_batches_do_not_share_a_place(two: list[Job], tmp_path: Path) -> None:
    with locked(tmp_path / "out"), pytest.raises(UserError, match="another process"):
        run(two, tmp_path / "out")


class MadeUpPool:
    """A pool that does tasks when they are asked for, the last one first; workers die at some stages."""

    def __init__(self, num_workers: int = 1, num_gpus: int = 0, dies_at: str = "") -> None:
        self.capacity = self.num_workers = num_workers
        self.num_gpus, self.dies_at = num_gpus, dies_at
        self.tasks: list[Any] = []
        self.most_gpus = self.most_tasks = 0

    def submit(self, function: Any, argument: Any, *, gpus: int = 0) -> None:
        self.tasks.append((function, argument, gpus))
        self.most_tasks = max(self.most_tasks, len(self.tasks))
        self.most_gpus = max(self.most_gpus, sum(gpus for *_, gpus in self.tasks))

    def is_one_done(self, seconds: float) -> bool:
        return True

    def next_done(self) -> tuple[Any, Any]:
        function, task, _ = self.tasks.pop()
        return task, Crash("the worker died") if task.step.stage == self.dies_at else function(task)

    def num_running(self) -> int:
        return len(self.tasks)


def made_up(monkeypatch: pytest.MonkeyPatch, pool: MadeUpPool) -> MadeUpPool:
    monkeypatch.setattr(command, "open_pool", lambda _: contextlib.nullcontext(pool))
    return pool


def test_workers_that_die_are_told(two: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_up(monkeypatch, MadeUpPool(dies_at="geometry"))
    assert run(two, tmp_path / "out") == {"mug": "failed", "shoe": "failed"}
    cell = cells(tmp_path / "out")["mug", "", "geometry"]
    assert cell["error"] == "the worker died" and cell["attempts"] == 2


@pytest.mark.parametrize(("device", "most_gpus"), [("auto", 2), ("cpu", 0)])
def test_a_gpu_is_one_steps_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, most_gpus: int) -> None:
    pool = made_up(monkeypatch, MadeUpPool(num_workers=4, num_gpus=2))
    names = ("a", "b", "c", "d")
    jobs = [stand_ins.job(name, tmp_path / "photos", str(tmp_path / "out"), device=device) for name in names]
    assert set(run(jobs, tmp_path / "out").values()) == {"done"}
    assert (pool.most_gpus, pool.most_tasks) == (most_gpus, 4)


@pytest.mark.slow
def test_a_process_that_dies_costs_a_try(two: list[Job], tmp_path: Path) -> None:
    run(two[:1], tmp_path / "out")
    other = stand_ins.job("mug", tmp_path / "photos", str(tmp_path / "other"))
    (tmp_path / "photos/mug/cues.studio.die").write_text("1")
    assert run([other], tmp_path / "other", Execution(workers=1), num_shards=3) == {"mug": "done"}
    assert cells(tmp_path / "other")["mug", "studio", "cues"]["attempts"] == 1
    assert contents(tmp_path / "other", ("mug",)) == contents(tmp_path / "out", ("mug",))


@pytest.mark.slow
def test_a_real_job_is_what_relight_would_make(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = preset()
    settings = {
        name: value for name, value in to_json(tiny).items() if name not in ("name", "description", "relighting_model")
    }
    entry = {"capture": "photographs", "name": "tiny", "preset": "demo", "settings": settings}
    (tmp_path / "jobs.yaml").write_text(
        yaml.safe_dump({"out": "out", "defaults": {"lights": [LIGHT]}, "jobs": [entry]})
    )
    photographs(tmp_path / "photographs")
    monkeypatch.chdir(tmp_path)
    main(["batch", "jobs.yaml", "--workers", "0", "--shards", "2"])
    out = tmp_path / "out" / "tiny"
    measured = read_json(tmp_path / "out" / "results.json")["jobs"]["tiny"]["measured"]
    assert measured["lights"][LIGHT]["latent_nerf"]["train_psnr"] > 5 and measured["object"]["geometry"]["seconds"] > 0
    before = {path: path.stat().st_mtime_ns for path in out.rglob("DONE")}
    assert len(before) == 8
    pipeline.relight(tmp_path / "photographs", [pipeline.LightJob(Path(LIGHT))], tiny, out)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("DONE")} == before, "everything was loaded"
    main(["batch", "jobs.yaml", "--status"])
    assert "9 done of 9 stages" in " ".join("".join(capsys.readouterr()).split())
