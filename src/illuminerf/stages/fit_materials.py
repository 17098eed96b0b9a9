"""Geometry + capture -> Materials: principled materials and the photographs' light, by inverse rendering.

mesh.glb, materials.safetensors, light.exr  see `cues.fitted_materials`
preview.png                                 photographs beside their rendering, base colour, roughness and metallic

Not of the method: the alternative that it is compared with, on the same geometry. `render_materials` relights it.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from illuminerf.cues.differentiable_shading import DifferentiableShading
from illuminerf.cues.fitted_materials import save_materials
from illuminerf.cues.illumination import uniform_light
from illuminerf.cues.material_fit import FittedMaterials, MaterialFit, Photographs, photometric_loss
from illuminerf.cues.materials import Material
from illuminerf.cues.shading import ShadedScene
from illuminerf.data.capture import load_capture
from illuminerf.fields.optimisation import OptimiserConfig, fit
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import srgb_from_linear, write_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import Views, spread_evenly
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.device import derived_seed, torch_generator

STAGE = "fit_materials"
_PREVIEW_VIEWS = 3
_PREVIEW_SAMPLES = 32
_RECENT_SHARE = 0.98


@dataclass(frozen=True)
class Config:
    """How materials and light are fitted."""

    optimiser: OptimiserConfig = field(
        default_factory=lambda: OptimiserConfig(
            num_steps=400,
            rays_per_step=4096,
            first_learning_rate=2e-2,
            last_learning_rate=2e-3,
            warmup_steps=20,
            checkpoint_every=100,
        )
    )
    """Steps, pixels in each, and learning rates, of logits and log radiance."""
    fit: MaterialFit = field(default_factory=MaterialFit)
    """Grids, paths and priors."""
    seed: int = 0
    """Of pixels and paths."""

    @classmethod
    def fine(cls) -> "Config":
        """For large photographs and a GPU."""
        steps = OptimiserConfig(
            num_steps=3000,
            rays_per_step=65_536,
            first_learning_rate=2e-2,
            last_learning_rate=1e-3,
            warmup_steps=60,
        )
        sides = (8, 16, 32, 64, 128, 256, 512)
        return cls(steps, MaterialFit(map_height=32, color_sides=sides, samples_per_ray=16))


def run(geometry: Path, capture: Path, illumination: Path | None, config: Config, out: Path) -> Path:
    """Fit materials and light to the photographs of `capture`; goes on from the last checkpoint.

    Gradients are added up by as many threads as there are, in any order: two runs agree to the rounding of single
    precision, and to the byte with ILLUMINERF_RENDER_THREADS=1.

    Args:
        geometry: a Geometry artefact; its `mesh.glb` lies in the capture's unit ball.
        capture: a Capture artefact.
        illumination: the estimated light (see `estimate_illumination`) to start from; None is a uniform light.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: an input is missing or unusable, no path tracer with gradients runs here, or `out` was made with
            other settings.
    """
    inputs: dict[str, Path | str] = {"geometry": geometry, "capture": capture}
    if illumination is not None:
        inputs["illumination"] = illumination
    with open_artefact(out, STAGE, config, inputs) as artefact:
        if artefact.is_done:
            return out
        views = load_capture(capture).views
        mesh = TriangleMesh.load_glb(geometry / "mesh.glb")
        start = uniform_light(config.fit.map_height)
        if illumination is not None:
            start = EnvironmentMap.load(illumination / "light.exr")
        found = FittedMaterials(mesh, start, config.fit)
        psnr = _fit(found, mesh, views, config, out / "checkpoint.safetensors")
        save_materials(out, mesh, found.material(), found.light())
        write_png(out / "preview.png", _preview(mesh, found.material(), found.light(), views, config))
        (out / "checkpoint.safetensors").unlink(missing_ok=True)
        artefact.finish({"num_vertices": len(mesh.vertices), "train_psnr": psnr})
    return out


def _fit(found: FittedMaterials, mesh: TriangleMesh, views: Views, config: Config, checkpoint: Path) -> float:
    """Optimise; returns the PSNR over the last steps."""
    pixels = Photographs(views)
    shading = DifferentiableShading(mesh, config.fit.map_height, config.fit.max_depth, config.fit.device)
    recent = [0.0]

    def step_loss(step: int) -> tuple[Tensor, dict[str, Tensor]]:
        generator = torch_generator(config.seed, "pixels", step)
        rays, srgb = pixels.drawn(config.optimiser.rays_per_step, generator)
        seed = derived_seed(config.seed, STAGE, step)
        loss, psnr = photometric_loss(found, shading, rays, srgb, config.fit, seed)
        share = _RECENT_SHARE if recent[0] else 0.0
        recent[0] = share * recent[0] + (1 - share) * psnr
        return loss + found.prior(), {"psnr": torch.tensor(recent[0])}

    fit(found, config.optimiser, step_loss, checkpoint, "fit materials")
    return recent[0]


def _preview(mesh: TriangleMesh, material: Material, light: EnvironmentMap, views: Views, config: Config) -> np.ndarray:
    """sRGB [height, width, 3]: rows of photograph, rendering, base colour, roughness, metallic."""
    scene, rows = ShadedScene([(mesh, material)], light, config.fit.device), []
    for view in spread_evenly(len(views), _PREVIEW_VIEWS):
        seed = derived_seed(config.seed, "preview", view)
        rendered = scene.render(views.cameras, view, light, _PREVIEW_SAMPLES, seed)
        stuff = scene.properties(views.cameras, view)
        grey = [np.repeat(stuff[name][..., None], 3, -1) for name in ("roughness", "metallic")]
        shown = [views.srgb[view] * views.alpha[view][..., None]]
        shown += [srgb_from_linear(rendered[..., :3]), srgb_from_linear(stuff["base_color"]), *grey]
        rows.append(np.concatenate([np.clip(image, 0, 1) for image in shown], 1))
    return np.concatenate(rows, 0).astype(np.float32)
