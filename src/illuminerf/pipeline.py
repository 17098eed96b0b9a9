"""The whole method on one page.

    photographs --import--> capture --UniSDF--> geometry            once per object
    capture + geometry --> the photographs' own light               (ours, not the paper's)
    geometry + light --path tracer--> radiance cues                 once per light, from here on
    capture + own light + cues --relighting diffusion model--> S samples of every photograph
    samples + geometry --latent NeRF--> one relit object
    relit object --render--> turntable, unseen views, scores; --bake--> coloured mesh

Every line is one stage: a Config and a run(), which loads what is finished, goes on with what is not, and refuses
what was made with other settings. Started again after a kill, this page continues where it stopped.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from illuminerf.data.capture import load_capture
from illuminerf.diffusion.pretrained import check_model
from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.presets import Preset
from illuminerf.report import write_report
from illuminerf.scene.cameras import Cameras
from illuminerf.scene.images import read_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.named_lights import find_light, light_file
from illuminerf.scene.video import write_mp4
from illuminerf.stages import (
    bake_relit_mesh,
    estimate_geometry,
    estimate_illumination,
    evaluate_relighting,
    fit_latent_nerf,
    import_capture,
    relight_views,
    render_novel_views,
    render_radiance_cues,
    use_mesh,
)
from illuminerf.workflow.artefact import read_metrics
from illuminerf.workflow.atomic import atomic_path, check_writable, read_json, write_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say

_SECONDS_PER_TURN = 4.0


@dataclass(frozen=True)
class LightJob:
    """One target light, and what the caller wants of it beside the turntable."""

    light: Path
    """Environment map, or the name of a bundled light."""
    test_cameras: Path | None = None
    """cameras.json, in the caller's world, of further views to render."""
    truth: Path | None = None
    """Folder with the truth of those views under this light, <000>.png straight RGBA."""
    ldr_peak: float = 1.0
    """Radiance that the white of a PNG or JPEG stands for."""

    @property
    def name(self) -> str:
        return self.light.stem


def relight(
    source: Path, jobs: Sequence[LightJob], preset: Preset, out: Path, mesh: Path | None = None
) -> dict[str, Any]:
    """Relight the capture in `source` under every light of `jobs`; geometry is estimated once, or is that of `mesh`.

    Returns:
        By light, its scores where there is truth ({"psnr": ..., "ssim": ...}).

    Raises:
        UserError: bad input, or `out` was made with other settings.
    """
    _check(jobs)
    check_model(preset.relighting_model)
    if mesh is not None:
        TriangleMesh.load(mesh)  # find a bad one before anything is written
    check_writable(out)
    shared = estimate_object(source, preset, out, mesh)
    capture, geometry, illumination = shared["capture"], shared["geometry"], shared.get("illumination")
    lights: dict[str, dict[str, Path]] = {}
    scores: dict[str, Any] = {}
    for job in jobs:
        say(f"light: {job.name}")
        folder = out / "lights" / job.name
        light = light_file(job.light, folder, job.ldr_peak)
        made = lights[job.name] = relight_under(capture, geometry, illumination, light, preset, folder)
        if preset.relit_mesh is not None:
            made["relit_mesh"] = bake_relit_mesh.run(
                made["latent_nerf"], geometry, capture, preset.relit_mesh, folder / "relit_mesh"
            )
        if job.test_cameras is not None:
            cameras = in_unit_ball(job.test_cameras, capture, folder / "test_cameras.json")
            made["test_views"] = render_novel_views.run(
                made["latent_nerf"], cameras, preset.test_views, folder / "test_views"
            )
        if job.test_cameras is not None and job.truth is not None:
            made["scores"] = evaluate_relighting.run(
                made["test_views"], job.truth, preset.evaluation, folder / "scores"
            )
            scores[job.name] = read_metrics(made["scores"])
    present(out, shared, lights, scores)
    return scores


def present(
    out: Path, shared: dict[str, Path], lights: dict[str, dict[str, Path]], scores: dict[str, Any] | None = None
) -> None:
    """Put what a person looks at first where it is found: the report, and copies of meshes and of the first light's
    film."""
    first = next(iter(lights.values()))
    _copy(shared["geometry"] / "mesh.glb", out / "mesh.glb")
    _copy(first["video"], out / "turntable.mp4")
    if "relit_mesh" in first:
        _copy(first["relit_mesh"] / "relit.glb", out / "relit.glb")
    write_report(out / "report.html", out, shared, lights, scores)


def estimate_object(source: Path, preset: Preset, out: Path, mesh: Path | None = None) -> dict[str, Path]:
    """The half of the method that no target light changes: capture, geometry and, where the preset has it, the
    photographs' own illumination. A mesh in the world of `source` takes the place of the estimated geometry."""
    capture = import_capture.run(source, preset.capture, out / "capture")
    if mesh is None:
        geometry = estimate_geometry.run(capture, preset.geometry, out / "geometry")
    else:
        geometry = use_mesh.run(mesh, capture, mesh_settings(preset), out / "geometry")
    shared = {"capture": capture, "geometry": geometry}
    if preset.illumination is not None:
        shared["illumination"] = estimate_illumination.run(geometry, capture, preset.illumination, out / "illumination")
    return shared


def mesh_settings(preset: Preset) -> use_mesh.Config:
    """How a mesh is used in place of the preset's geometry: a field of the same sizes, fitted for a fifth of the steps,
    since the surface is known."""
    of_preset = preset.geometry
    steps = max(1, of_preset.optimiser.num_steps // 5)
    optimiser = replace(of_preset.optimiser, num_steps=steps, warmup_steps=of_preset.optimiser.warmup_steps // 5)
    return use_mesh.Config(
        # these follow the mesh's smooth normals, where gradients have its facets
        radiance_field=replace(of_preset.radiance_field, radiance_normals="predicted"),
        optimiser=optimiser,
        occupancy_side=of_preset.occupancy_side,
        num_previews=of_preset.num_previews,
        seed=of_preset.seed,
        device=of_preset.device,
    )


def relight_under(
    capture: Path, geometry: Path, illumination: Path | None, light: Path, preset: Preset, out: Path
) -> dict[str, Path]:
    """The per-light half of the method; returns its artefacts by name."""
    cues = render_radiance_cues.run(geometry, capture, light, preset.cues, out / "cues")
    relit = relight_views.run(capture, cues, preset.relighting_model, illumination, preset.relighting, out / "relit")
    latent_nerf = fit_latent_nerf.run(geometry, capture, relit, preset.latent_nerf, out / "latent_nerf")
    turntable = render_novel_views.run(latent_nerf, None, preset.turntable, out / "turntable")
    video = turntable_video(turntable, out / "turntable.mp4")
    return {"cues": cues, "relit": relit, "latent_nerf": latent_nerf, "turntable": turntable, "video": video}


def turntable_video(turntable: Path, video: Path) -> Path:
    """One turn in a few seconds, on white, from the frames of a turntable; an existing film is kept."""
    if not video.exists():
        frames = sorted((turntable / "images").glob("*.png"))
        write_mp4(
            video,
            (on_white(read_png(frame)) for frame in frames),
            frames_per_second=max(1, round(len(frames) / _SECONDS_PER_TURN)),
        )
    return video


def seconds_by_stage(run: Path) -> dict[str, float]:
    """What each stage of a run took, from the artefacts' own records; stages of several lights are added up."""
    seconds: dict[str, float] = {}
    for provenance in sorted(run.rglob("provenance.json")):
        stage = provenance.parent.name
        seconds[stage] = seconds.get(stage, 0.0) + read_metrics(provenance.parent)["seconds"]
    return seconds


def peak_memory_gb(run: Path) -> float:
    """The largest peak of any stage of a run."""
    return max(float(read_metrics(p.parent)["peak_memory_gb"]) for p in run.rglob("provenance.json"))


def _check(jobs: Sequence[LightJob]) -> None:
    """Find bad lights before hours are spent on the geometry."""
    if not jobs:
        raise UserError(
            "no light was given",
            wanted="a file, or a name of 'illuminerf lights list'",
            fix="add one, such as --light evening",
        )
    names = [job.name for job in jobs]
    if len(set(names)) < len(names):
        raise UserError("two lights have the same name", got=", ".join(names), fix="rename one of the files")
    for job in jobs:
        find_light(job.light, job.ldr_peak)


def in_unit_ball(cameras: Path, capture: Path, out: Path) -> Path:
    """Write cameras of the caller's world as cameras of the capture's unit ball."""
    moved = load_capture(capture).unit_ball_cameras(Cameras.from_dict(read_json(cameras)))
    write_json(out, moved.to_dict())
    return out


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
