"""Every stage of the method at sizes that take less than a second, each fed by the ones before."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from illuminerf.cues.illumination import LightFit
from illuminerf.cues.object_views import ViewSettings
from illuminerf.cues.renderer import CueSampling
from illuminerf.cues.surface_samples import ColorGathering
from illuminerf.diffusion.relighting_model import save_model
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.stages import (
    bake_relit_mesh,
    estimate_geometry,
    estimate_illumination,
    fit_latent_nerf,
    import_capture,
    relight_views,
    render_novel_views,
    render_radiance_cues,
    render_training_pairs,
    train_relighting_model,
)
from illuminerf.workflow.task_pool import Execution
from tests.diffusion.tiny import TINY, tiny_model
from tests.stages.conftest import TINY_GEOMETRY, write_sphere_capture

_OPTIMISER = OptimiserConfig(num_steps=6, rays_per_step=16, warmup_steps=2, checkpoint_every=2)
_GEOMETRY = replace(TINY_GEOMETRY, optimiser=_OPTIMISER, occupancy_side=12, mesh_resolution=16, num_previews=1)
_ILLUMINATION = estimate_illumination.Config(
    gathering=ColorGathering(num_points=64), fit=LightFit(map_height=4), sampling=CueSampling(4)
)
_TURNTABLE = render_novel_views.TurntableConfig(num_views=2, height=10, width=10)
_VIEWS = ViewSettings(
    num_views=2, num_lights=2, size=16, samples_per_pixel=2, cue_sampling=CueSampling(2), light_height=8
)
_TRAINING = train_relighting_model.Config(
    model=TINY,
    phases=(train_relighting_model.Phase(2, 16, "products"), train_relighting_model.Phase(2, 16)),
    batch_size=1,
    checkpoint_seconds=0.0,
    monitoring=train_relighting_model.MonitoringConfig(
        log_steps=1, validation_steps=2, validation_pairs=1, final_pairs=1
    ),
    device="cpu",
)


@dataclass(frozen=True)
class Stage:
    """One stage as the harness knows it."""

    name: str
    inputs: tuple[str, ...]
    """Names of stages, or of files that `write_inputs` writes."""
    make: Callable[..., object]
    """From the paths of the inputs and of the output."""


STAGES = {
    stage.name: stage
    for stage in (
        Stage("capture", ("photographs",), lambda photographs, out: import_capture.run(photographs, _IMPORT, out)),
        Stage("geometry", ("capture",), lambda capture, out: estimate_geometry.run(capture, _GEOMETRY, out)),
        Stage(
            "illumination",
            ("geometry", "capture"),
            lambda geometry, capture, out: estimate_illumination.run(geometry, capture, _ILLUMINATION, out),
        ),
        Stage(
            "cues",
            ("geometry", "capture", "light.exr"),
            lambda geometry, capture, light, out: render_radiance_cues.run(geometry, capture, light, _CUES, out),
        ),
        Stage(
            "relit",
            ("capture", "cues", "untrained", "illumination"),
            lambda capture, cues, model, light, out: relight_views.run(capture, cues, model, light, _RELIGHTING, out),
        ),
        Stage(
            "latent_nerf",
            ("geometry", "capture", "relit"),
            lambda geometry, capture, relit, out: fit_latent_nerf.run(geometry, capture, relit, _LATENT_NERF, out),
        ),
        Stage("views", ("latent_nerf",), lambda field, out: render_novel_views.run(field, None, _NOVEL, out)),
        Stage(
            "relit_mesh",
            ("latent_nerf", "geometry", "capture"),
            lambda field, geometry, capture, out: bake_relit_mesh.run(field, geometry, capture, _BAKING, out),
        ),
        Stage(
            "pairs",
            ("models", "lights"),
            lambda models, lights, out: render_training_pairs.run(models, lights, _PAIRS, out, Execution(workers=0)),
        ),
        Stage("model", ("pairs",), lambda pairs, out: train_relighting_model.run(pairs, pairs, _TRAINING, out)),
    )
}
_IMPORT = import_capture.Config(placement="keep")
_CUES = render_radiance_cues.Config(sampling=CueSampling(2), max_light_height=8)
_RELIGHTING = relight_views.Config(num_samples=1, num_steps=1, batch_size=2, device="cpu")
_LATENT_NERF = fit_latent_nerf.Config(optimiser=_OPTIMISER, device="cpu")
_NOVEL = render_novel_views.Config(turntable=_TURNTABLE, device="cpu")
_BAKING = bake_relit_mesh.Config(num_directions=1, num_samples=2, max_viewpoints=2, device="cpu")
_PAIRS = render_training_pairs.Config(_VIEWS, objects_per_shard=1)


def write_inputs(world: Path) -> None:
    """What stages start from: photographs, a light, a model, objects and lights to train on."""
    write_sphere_capture(world / "photographs", num_views=4, size=16)
    (world / "photographs" / "capture.json").unlink()
    generator = np.random.default_rng(0)
    for name in ("light.exr", "lights/noon.exr", "lights/dusk.exr"):
        EnvironmentMap(generator.random((8, 16, 3)).astype(np.float32)).save(world / name)
    save_model(tiny_model(), world / "untrained")
    (world / "models").mkdir()
    for name, mesh in (("ball", trimesh.creation.icosphere(1)), ("cube", trimesh.creation.box())):
        (world / "models" / f"{name}.glb").write_bytes(mesh.export(file_type="glb"))
    (world / "models" / "broken.glb").write_bytes(b"nothing")


def consumers(name: str) -> list[Stage]:
    """Stages that read what `name` makes."""
    return [stage for stage in STAGES.values() if name in stage.inputs]
