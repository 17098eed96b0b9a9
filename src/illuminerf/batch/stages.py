"""The method as a table: which stage needs which, and how each is run on a folder. What it makes is what
`pipeline.relight` makes; tests/batch/test_batch.py holds them equal."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from illuminerf.batch.jobs import Job, is_url
from illuminerf.pipeline import mesh_settings
from illuminerf.presets import Preset
from illuminerf.scene.named_lights import light_file
from illuminerf.stages import (
    bake_relit_mesh,
    estimate_geometry,
    estimate_illumination,
    fit_latent_nerf,
    import_capture,
    relight_views,
    render_novel_views,
    render_radiance_cues,
    use_mesh,
)
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.transfer import fetch_file, fetch_folder


@dataclass(frozen=True)
class Place:
    """Where a stage of one job works."""

    job: Job
    run: Path
    """Folder of the job's run on this machine; what the stage needs lies there."""
    light: str = ""
    """Name of the light, for stages that have one."""
    shard: str = ""
    """Share of the views, i/n."""
    inputs: Path = Path()
    """Gets what the job names by URL."""

    def folder(self, stage: str) -> Path:
        """The artefact folder of a stage of this job and light."""
        return self.run / stage_folder(stage, self.light)

    def source(self, place: str) -> Path:
        """What the job names, on this machine."""
        if not is_url(place):
            return Path(place)
        target = self.inputs / Path(place).name
        storage = Storage(place)
        if storage.tree():
            fetch_folder(storage, "", target)
        else:
            fetch_file(place, target)
        return target

    def light_file(self) -> Path:
        """The target light as a file."""
        light = self.source(self.job.light(self.light))
        return light_file(light, self.run / "lights" / self.light, self.job.ldr_peak)

    def illumination(self) -> Path | None:
        return None if self.job.preset.illumination is None else self.folder("illumination")


@dataclass(frozen=True)
class Stage:
    """One row of the table."""

    needs: tuple[str, ...]
    run: Callable[[Place], Any]
    name: str
    """As its config.json has it."""
    config: Callable[[Preset], Any]
    """The config that config.json records."""
    is_sharded: bool = False
    """Whether its views can be spread over workers."""
    uses_gpu: bool = True


STAGES_OF_OBJECT = ("capture", "geometry", "illumination")


def stage_folder(stage: str, light: str) -> str:
    """A stage's folder in a run."""
    return stage if stage in STAGES_OF_OBJECT or not light else f"lights/{light}/{stage}"


def stages_of(job: Job) -> dict[str, Stage]:
    """The stages that a job goes through, in order."""
    preset = job.preset
    stages = {
        "capture": Stage((), _capture, "import_capture", lambda preset: preset.capture, uses_gpu=False),
        "geometry": Stage(("capture",), _geometry, "estimate_geometry", lambda preset: preset.geometry),
    }
    if job.mesh:
        stages["geometry"] = Stage(("capture",), _use_mesh, "use_mesh", mesh_settings)
    own_light: tuple[str, ...] = ()
    if preset.illumination is not None:
        own_light = ("illumination",)
        stages["illumination"] = Stage(
            ("capture", "geometry"), _illumination, "estimate_illumination", lambda preset: preset.illumination
        )
    stages |= {
        "cues": Stage(
            ("capture", "geometry"), _cues, "render_radiance_cues", lambda preset: preset.cues, is_sharded=True
        ),
        "relit": Stage(
            ("capture", "cues", *own_light), _relit, "relight_views", lambda preset: preset.relighting, is_sharded=True
        ),
        "latent_nerf": Stage(
            ("capture", "geometry", "relit"), _latent_nerf, "fit_latent_nerf", lambda preset: preset.latent_nerf
        ),
        "turntable": Stage(("latent_nerf",), _turntable, "render_novel_views", lambda preset: preset.turntable),
    }
    if preset.relit_mesh is not None:
        needs = ("capture", "geometry", "latent_nerf")
        stages["relit_mesh"] = Stage(needs, _relit_mesh, "bake_relit_mesh", lambda preset: preset.relit_mesh)
    return stages


def _capture(place: Place) -> None:
    import_capture.run(place.source(place.job.capture), place.job.preset.capture, place.folder("capture"))


def _geometry(place: Place) -> None:
    estimate_geometry.run(place.folder("capture"), place.job.preset.geometry, place.folder("geometry"))


def _use_mesh(place: Place) -> None:
    mesh, settings = place.source(place.job.mesh), mesh_settings(place.job.preset)
    use_mesh.run(mesh, place.folder("capture"), settings, place.folder("geometry"))


def _illumination(place: Place) -> None:
    settings, out = place.job.preset.illumination, place.folder("illumination")
    assert settings is not None
    estimate_illumination.run(place.folder("geometry"), place.folder("capture"), settings, out)


def _cues(place: Place) -> None:
    settings = replace(place.job.preset.cues, shard=place.shard)
    inputs = place.folder("geometry"), place.folder("capture"), place.light_file()
    render_radiance_cues.run(*inputs, settings, place.folder("cues"))


def _relit(place: Place) -> None:
    preset = place.job.preset
    settings = replace(preset.relighting, shard=place.shard)
    inputs = place.folder("capture"), place.folder("cues"), preset.relighting_model, place.illumination()
    relight_views.run(*inputs, settings, place.folder("relit"))


def _latent_nerf(place: Place) -> None:
    inputs = place.folder("geometry"), place.folder("capture"), place.folder("relit")
    fit_latent_nerf.run(*inputs, place.job.preset.latent_nerf, place.folder("latent_nerf"))


def _turntable(place: Place) -> None:
    render_novel_views.run(place.folder("latent_nerf"), None, place.job.preset.turntable, place.folder("turntable"))


def _relit_mesh(place: Place) -> None:
    settings, out = place.job.preset.relit_mesh, place.folder("relit_mesh")
    assert settings is not None
    bake_relit_mesh.run(place.folder("latent_nerf"), place.folder("geometry"), place.folder("capture"), settings, out)
