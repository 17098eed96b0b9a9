"""What a finished job shows: report and films as `illuminerf relight` leaves them, and its numbers in results.json."""

from pathlib import Path
from typing import Any

from illuminerf.batch.jobs import Job
from illuminerf.batch.stages import STAGES_OF_OBJECT, stage_folder
from illuminerf.pipeline import present, turntable_video
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import write_json

RESULTS = "results.json"
_SCHEMA = 1


def present_job(run: Path, job: Job, lights: tuple[str, ...], stages: tuple[str, ...]) -> list[str]:
    """Write a job's report, films, meshes and results.json into its run folder.

    Args:
        run: the folder; the stages' artefacts lie in it.
        job: whose it is.
        lights: names of those that are finished, in the job's order.
        stages: names of the stages that every light went through.

    Returns:
        Names of the files that were written, results.json last.
    """
    shared = {stage: run / stage for stage in stages if stage in STAGES_OF_OBJECT}
    own = [stage for stage in stages if stage not in STAGES_OF_OBJECT]
    made = {light: {stage: run / stage_folder(stage, light) for stage in own} for light in lights}
    names = []
    for light in lights:
        video = turntable_video(made[light]["turntable"], run / "lights" / light / "turntable.mp4")
        made[light]["video"] = video
        names.append(video.relative_to(run).as_posix())
    present(run, shared, made)
    write_json(run / RESULTS, _results(job, shared, made))
    names += [name for name in ("report.html", "mesh.glb", "turntable.mp4", "relit.glb") if (run / name).is_file()]
    return [*names, RESULTS]


def _results(job: Job, shared: dict[str, Path], lights: dict[str, dict[str, Path]]) -> dict[str, Any]:
    return {
        "schema": _SCHEMA,
        "job": job.name,
        "preset": job.preset.name,
        "object": {stage: read_metrics(path) for stage, path in shared.items()},
        "lights": {
            light: {stage: read_metrics(path) for stage, path in made.items() if stage != "video"}
            for light, made in lights.items()
        },
    }
