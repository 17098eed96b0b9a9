"""Settings of all stages under one name; each preset states its cost and what it is for."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from illuminerf.cues.renderer import CueSampling
from illuminerf.fields.appearance import AppearanceConfig
from illuminerf.fields.hash_grid import HashGridConfig
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.fields.radiance_field import FieldConfig
from illuminerf.fields.surface import SurfaceConfig
from illuminerf.stages import (
    bake_relit_mesh,
    estimate_geometry,
    estimate_illumination,
    evaluate_relighting,
    fit_latent_nerf,
    fit_materials,
    import_capture,
    relight_views,
    render_materials,
    render_novel_views,
    render_radiance_cues,
)
from illuminerf.workflow.device import resolve_device
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say


@dataclass(frozen=True)
class Preset:
    """One config per stage."""

    name: str
    description: str
    """What it is for and what it costs."""
    capture: import_capture.Config = field(default_factory=import_capture.Config)
    geometry: estimate_geometry.Config = field(default_factory=estimate_geometry.Config)
    illumination: estimate_illumination.Config | None = None
    """How the photographs' own light is estimated, for relighting models that take it as a hint; None: it is not."""
    cues: render_radiance_cues.Config = field(default_factory=render_radiance_cues.Config)
    relighting_model: str = "embedded"
    """The weights that ship with the package, or a folder."""
    relighting: relight_views.Config = field(default_factory=relight_views.Config)
    latent_nerf: fit_latent_nerf.Config = field(default_factory=fit_latent_nerf.Config)
    turntable: render_novel_views.Config = field(default_factory=render_novel_views.Config)
    test_views: render_novel_views.Config = field(default_factory=render_novel_views.Config)
    relit_mesh: bake_relit_mesh.Config | None = field(default_factory=bake_relit_mesh.Config)
    """How the mesh gets its relit colours; None: it does not."""
    evaluation: evaluate_relighting.Config = field(default_factory=evaluate_relighting.Config)
    materials: fit_materials.Config = field(default_factory=fit_materials.Config)
    """Of the alternative that benchmarks compare with, as is the next."""
    material_views: render_materials.Config = field(default_factory=render_materials.Config)


EMBEDDED = Preset(
    name="embedded",
    description="The default: for two CPU cores and photographs of about 200 pixels; a GPU makes it faster.",
    capture=import_capture.Config(size=200),
    geometry=estimate_geometry.Config(
        radiance_field=FieldConfig(
            surface=SurfaceConfig(grid=HashGridConfig(log2_entries=18)),
            appearance=AppearanceConfig(grid=HashGridConfig(log2_entries=18)),
        ),
        optimiser=OptimiserConfig(num_steps=3000, rays_per_step=1024, warmup_steps=60),
        mesh_resolution=224,
    ),
    illumination=estimate_illumination.Config(sampling=CueSampling(samples_per_pixel=16)),
    # cheap; noise of the cues reaches the samples, and the distillation averages over views
    cues=render_radiance_cues.Config(sampling=CueSampling(samples_per_pixel=16)),
    latent_nerf=fit_latent_nerf.Config(optimiser=OptimiserConfig(num_steps=2000, rays_per_step=1024, warmup_steps=40)),
    turntable=render_novel_views.Config(turntable=render_novel_views.TurntableConfig(num_views=36)),
)

DEMO = dataclasses.replace(
    EMBEDDED,
    name="demo",
    description="The bundled capture in minutes on two CPU cores: fewer steps and samples than `embedded`.",
    capture=import_capture.Config(),
    geometry=estimate_geometry.Config(optimiser=OptimiserConfig(num_steps=2000)),
    illumination=estimate_illumination.Config(sampling=CueSampling(samples_per_pixel=64)),
    cues=render_radiance_cues.Config(sampling=CueSampling(samples_per_pixel=64)),
    relighting=relight_views.Config(num_samples=4),
    latent_nerf=fit_latent_nerf.Config(optimiser=OptimiserConfig(num_steps=1500, rays_per_step=1024, warmup_steps=30)),
    turntable=render_novel_views.Config(
        turntable=render_novel_views.TurntableConfig(num_views=36, height=160, width=160)
    ),
)

_FINE_GRID = HashGridConfig(log2_entries=20, finest=1024)
GPU = Preset(
    name="gpu",
    description=(
        "For one GPU and photographs of about 400 pixels, S = 16, with the model that ships; two fits of geometry "
        "side by side took four minutes on an H200."
    ),
    capture=import_capture.Config(size=400),
    geometry=estimate_geometry.Config(
        radiance_field=FieldConfig(
            surface=SurfaceConfig(grid=_FINE_GRID),
            appearance=AppearanceConfig(grid=_FINE_GRID),
            num_samples=32,
            num_proposal_samples=48,
        ),
        optimiser=OptimiserConfig(num_steps=10_000, rays_per_step=8192, warmup_steps=200, checkpoint_every=2500),
        occupancy_side=96,
        mesh_resolution=320,
    ),
    illumination=estimate_illumination.Config(),
    relighting=relight_views.Config(num_samples=16),
    latent_nerf=fit_latent_nerf.Config(
        optimiser=OptimiserConfig(num_steps=5000, rays_per_step=8192, warmup_steps=100, checkpoint_every=2500),
        num_kept=8,
        max_rays=4_000_000,
    ),
    turntable=render_novel_views.Config(
        turntable=render_novel_views.TurntableConfig(num_views=72, height=400, width=400)
    ),
)

PAPER = Preset(
    name="paper",
    description=(
        "The paper's sizes, steps and S = 16, for a large GPU; give a relighting model of that size with --model."
    ),
    capture=import_capture.Config(),
    geometry=estimate_geometry.Config.paper(),
    relighting=relight_views.Config(
        num_samples=16,
        num_steps=50,  # the paper names the sampler, not the steps
        sampler="ddpm",
        temperature=1.0,
        batch_size=1,
        precision="bfloat16",
    ),
    latent_nerf=fit_latent_nerf.Config.paper(),
    turntable=render_novel_views.Config(
        turntable=render_novel_views.TurntableConfig(num_views=120, height=512, width=512)
    ),
    materials=fit_materials.Config.fine(),
    material_views=render_materials.Config(samples_per_pixel=256),
)

DILIGHTNET = Preset(
    name="dilightnet",
    description=(
        "For a GPU with 16 GB: the published DiLightNet weights, 512x512 inside, S = 16; "
        "fetch them once with 'illuminerf models download dilightnet'."
    ),
    capture=import_capture.Config(size=512),
    relighting_model="dilightnet",
    relighting=relight_views.Config(
        num_samples=16,
        num_steps=20,
        sampler="dpm_solver",
        temperature=1.0,
        batch_size=1,
        samples_at_once=8,
        precision="bfloat16",
    ),
    turntable=render_novel_views.Config(
        turntable=render_novel_views.TurntableConfig(num_views=72, height=512, width=512)
    ),
)

PRESETS = {preset.name: preset for preset in (EMBEDDED, DEMO, GPU, DILIGHTNET, PAPER)}


def customised(
    name: str,
    *,
    samples: int | None = None,
    size: int | None = None,
    seed: int = 0,
    device: str = "auto",
    rotate_degrees: float = 0.0,
    exposure_stops: float = 0.0,
    background: str | None = None,
    model: str | None = None,
) -> Preset:
    """A preset with what a caller wants otherwise; None keeps the preset's own value.

    Raises:
        UserError: no such preset or device, or a value is out of range.
    """
    if name not in PRESETS:
        raise UserError("unknown preset", got=repr(name), wanted=" or ".join(PRESETS))
    preset = PRESETS[name]
    if resolve_device(device).type == "cpu" and preset in (GPU, DILIGHTNET, PAPER):
        say(f"The preset '{name}' is meant for a GPU; on this CPU it takes many hours. 'embedded' is meant for CPUs.")
    capture: dict[str, Any] = {} if size is None else {"size": size}
    if background is not None:
        if background not in ("white", "black", "plain", "none"):
            raise UserError("unknown background", got=repr(background), wanted="plain, white, black or none")
        capture["background"] = background
    drawn: dict[str, Any] = {} if samples is None else {"num_samples": samples}
    common = {"seed": seed, "device": device}
    change = dataclasses.replace
    return change(
        preset,
        capture=change(preset.capture, **capture),
        geometry=change(preset.geometry, **common),
        illumination=preset.illumination
        and change(preset.illumination, seed=seed, sampling=change(preset.illumination.sampling, device=device)),
        cues=change(
            preset.cues,
            seed=seed,
            light_rotation_radians=math.radians(rotate_degrees),
            exposure_stops=exposure_stops,
            sampling=change(preset.cues.sampling, device=device),
        ),
        relighting_model=model or preset.relighting_model,
        relighting=change(preset.relighting, **drawn, **common),
        latent_nerf=change(preset.latent_nerf, **common),
        turntable=change(preset.turntable, device=device),
        test_views=change(preset.test_views, device=device),
        materials=change(preset.materials, seed=seed, fit=change(preset.materials.fit, device=device)),
        material_views=change(preset.material_views, **common),
        relit_mesh=preset.relit_mesh and change(preset.relit_mesh, device=device),
    )
