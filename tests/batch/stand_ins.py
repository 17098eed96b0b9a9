"""Stages that take no time, for tests of what schedules them: importable by workers on other nodes."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from illuminerf.batch.jobs import Job
from illuminerf.batch.stages import STAGES_OF_OBJECT, Place, Stage
from illuminerf.batch.steps import Outcome, Task, attempt
from illuminerf.presets import customised
from illuminerf.workflow.artefact import fingerprint, open_artefact
from illuminerf.workflow.atomic import write_bytes, write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import shard_of

NUM_VIEWS = 5
SECONDS_PER_VIEW = "ILLUMINERF_TEST_SECONDS_PER_VIEW"
NEEDS: dict[str, tuple[str, ...]] = {
    "capture": (),
    "geometry": ("capture",),
    "cues": ("capture", "geometry"),
    "latent_nerf": ("geometry", "cues"),
    "turntable": ("latent_nerf",),
}


@dataclass(frozen=True)
class Config:
    """Of every stand-in."""

    samples: int = 1


def job(
    name: str,
    folder: Path,
    out: str,
    lights: tuple[str, ...] = ("studio", "evening"),
    samples: int = 1,
    device: str = "cpu",
) -> Job:
    """A job of stand-ins; what lies in its capture folder steers it."""
    (folder / name).mkdir(parents=True, exist_ok=True)
    return Job(name, str(folder / name), lights, f"{out}/{name}", customised("demo", samples=samples, device=device))


def stages(_: Job) -> dict[str, Stage]:
    """The table."""
    return {
        name: Stage(
            needs,
            _runner(name),
            name,
            lambda preset: Config(preset.relighting.num_samples),
            is_sharded=name == "cues",
            uses_gpu=name != "capture",
        )
        for name, needs in NEEDS.items()
    }


def work(task: Task) -> Outcome:
    """A step of the table."""
    return attempt(task, stages(task.job), present)


def _runner(name: str) -> Callable[[Place], None]:
    def run(place: Place) -> None:
        folder, source = place.folder(name), Path(place.job.capture)
        _misbehave(source, name, place.light)
        shard, count = shard_of(place.shard)
        inputs: dict[str, Path | str] = {_ROLE.get(need, need): place.folder(need) for need in NEEDS[name]}
        inputs |= {"name": place.job.name}
        config = Config(place.job.preset.relighting.num_samples)
        with open_artefact(folder, name, config, inputs, is_shared=count > 1) as artefact:
            if artefact.is_done:
                return
            made_from = [fingerprint(source) for _, source in sorted(inputs.items())]
            files = [folder / f"{view}.json" for view in range(NUM_VIEWS if name == "cues" else 1)]
            for file in files[shard::count]:
                if not file.exists():
                    time.sleep(float(os.environ.get(SECONDS_PER_VIEW, "0")))
                    write_json(file, [name, place.light if name not in STAGES_OF_OBJECT else "", file.stem, made_from])
            if all(file.exists() for file in files):
                artefact.finish({"files": len(files)})

    return run


_ROLE = {"latent_nerf": "field"}


def _misbehave(source: Path, stage: str, light: str) -> None:
    """What a file <stage>[.<light>].<kind> in the capture folder asks for; with a number inside: so many times."""
    for kind in ("user", "bug", "disk", "die"):
        for file in (source / f"{stage}.{kind}", source / f"{stage}.{light}.{kind}"):
            if file.is_file() and (left := int(file.read_text() or "1000")):
                file.write_text(str(left - 1))
                _fail(kind)


def _fail(kind: str) -> Any:
    if kind == "user":
        raise UserError("the capture is upside down", fix="turn it")
    if kind == "bug":
        raise ZeroDivisionError("nobody thought of this")
    if kind == "disk":
        raise OSError("the share is away")
    os.kill(os.getpid(), signal.SIGKILL)


def present(run: Path, job: Job, lights: tuple[str, ...], names: tuple[str, ...]) -> list[str]:
    """In place of `outcome.present_job`, which needs real artefacts."""
    write_bytes(run / "report.html", b"report of " + ", ".join(lights).encode())
    write_json(run / "results.json", {"lights": dict.fromkeys(lights, {}), "stages": list(names)})
    return ["report.html", "results.json"]
