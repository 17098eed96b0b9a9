"""The alternative in the same run: inverse rendering on the method's own geometry, relit by path tracing.

The paper's claim is that generating relit views does better than taking photographs apart into materials and light.
This page is the other side of that comparison, on the shape that `pipeline.relight` has estimated already.
"""

from collections.abc import Sequence
from pathlib import Path

from illuminerf import pipeline
from illuminerf.cues.differentiable_shading import mitsuba_with_gradients
from illuminerf.presets import Preset
from illuminerf.stages import fit_materials, render_materials
from illuminerf.workflow.artefact import read_metrics

NAME = "inverse rendering"
_SHARED = ("capture", "geometry", "illumination")


def check(preset: Preset) -> None:
    """Raise a UserError where this machine cannot do it, before hours are spent on the method's own run."""
    mitsuba_with_gradients(preset.materials.fit.device)


def relight(run: Path, jobs: Sequence[pipeline.LightJob], preset: Preset, out: Path) -> dict[str, Path]:
    """Relight the object of a finished run under the lights of `jobs`, which have been given to it as well.

    Args:
        run: what `pipeline.relight` wrote, with the same preset and jobs.
        jobs: lights, each with test cameras.
        preset: settings of all stages.
        out: folder of the materials and of lights/<light>/test_views.

    Returns:
        By light, the NovelViews.

    Raises:
        UserError: no path tracer with gradients runs here, or `out` was made with other settings.
    """
    illumination = run / "illumination" if preset.illumination is not None else None
    materials = fit_materials.run(run / "geometry", run / "capture", illumination, preset.materials, out / "materials")
    return {
        job.name: render_materials.run(
            materials,
            run / "lights" / job.name / "test_cameras.json",
            job.light,
            preset.material_views,
            out / "lights" / job.name / "test_views",
        )
        for job in jobs
    }


def seconds_by_stage(run: Path, out: Path) -> dict[str, float]:
    """What each stage took, with those that the method's run shares."""
    shared = {stage: read_metrics(run / stage)["seconds"] for stage in _SHARED if (run / stage / "DONE").exists()}
    return shared | pipeline.seconds_by_stage(out)
