"""Which steps an earlier run finished, and whether it did so with the same settings from the same inputs."""

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from illuminerf.batch.jobs import Job
from illuminerf.batch.outcome import RESULTS
from illuminerf.batch.stages import Stage, stage_folder
from illuminerf.batch.steps import REPORT, Step
from illuminerf.diffusion.pretrained import model_folder
from illuminerf.workflow.artefact import fingerprint, refuse_other_key
from illuminerf.workflow.config import to_json
from illuminerf.workflow.migrations import SCHEMA, upgraded
from illuminerf.workflow.storage import Storage

_ROLES = {"latent_nerf": "field"}
"""Stages that are called otherwise where they are an input."""


@dataclass
class FinishedSteps:
    """Looks at the runs of all jobs; a few requests per step, when it is about to start."""

    storages: dict[str, Storage]
    """By job."""
    _fingerprints: dict[tuple[str, str], str] = field(default_factory=dict)
    """By job and folder, the DONE of finished stages."""

    def is_done(self, step: Step, job: Job, stages: dict[str, Stage], lights: tuple[str, ...]) -> bool:
        """Whether nothing is left to do.

        Args:
            step: a step whose needs are done.
            job: the step's.
            stages: the job's.
            lights: for the report, the lights that it must show.

        Raises:
            UserError: the stage is finished, with other settings or from other inputs.
        """
        storage = self.storages[step.job]
        if step.stage == REPORT:
            results = storage.read_json(RESULTS)
            return isinstance(results, dict) and list(results.get("lights", {})) == sorted(lights)
        fingerprint = _text(storage, f"{step.folder}/DONE")
        if fingerprint is None:
            return bool(step.shard) and storage.path is None and storage.exists(step.marker)
        self._check(step, job, stages, storage)
        self._fingerprints[step.job, step.folder] = fingerprint.strip()
        return True

    def _check(self, step: Step, job: Job, stages: dict[str, Stage], storage: Storage) -> None:
        stage = stages[step.stage]
        where = f"{storage.url}/{step.folder}"
        old_key = storage.read_json(f"{step.folder}/config.json")
        old_inputs = storage.read_json(f"{step.folder}/inputs.json")
        key = {"schema": SCHEMA, "stage": stage.name, "config": to_json(stage.config(job.preset))}
        inputs = {_ROLES.get(need, need): self._fingerprint(storage, step, need) for need in stage.needs}
        if step.stage == "relit":
            inputs["model"] = _model_fingerprint(job.preset.relighting_model)
        if (
            step.stage == "cues"
            and (light := Path(job.light(step.light))).suffix in (".exr", ".hdr")
            and light.is_file()
        ):
            inputs["light"] = fingerprint(light)
        if step.stage == "geometry" and Path(job.mesh).is_file():
            inputs["mesh"] = fingerprint(Path(job.mesh))
        refuse_other_key(where, upgraded(old_key, where), key, old_inputs or {}, inputs)

    def _fingerprint(self, storage: Storage, step: Step, need: str) -> str:
        folder = stage_folder(need, step.light)
        if (step.job, folder) not in self._fingerprints:
            self._fingerprints[step.job, folder] = (_text(storage, f"{folder}/DONE") or "").strip()
        return self._fingerprints[step.job, folder]


@lru_cache
def _model_fingerprint(model: str) -> str:
    return fingerprint(model_folder(model))


def _text(storage: Storage, name: str) -> str | None:
    try:
        return storage.read(name).decode()
    except FileNotFoundError:
        return None
