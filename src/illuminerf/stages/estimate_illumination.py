"""Geometry + capture -> the unknown light of the photographs, and the diffuse shading that it casts in them.

light.exr, light.json  the estimated light (its gain per channel is a guess), how well it explains the photographs, and
                       "gloss": 0 matt, 1 as glossy as a dielectric or more, null where photographs do not tell
shading/<000>.exr      the diffuse radiance cue of every captured view under it: half R, G, B, linear and premultiplied,
                       and A, the mesh's coverage
preview.png            the light, and a few photographs beside shading and albedo

Deviation: not in the paper; `cues.illumination` and `cues.gloss` say how it is done.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from illuminerf.cues.gloss import GlossFit, estimated_gloss
from illuminerf.cues.illumination import LightFit, fit_light, uniform_light
from illuminerf.cues.renderer import CueSampling, render_cues
from illuminerf.cues.surface_samples import ColorGathering, RayCaster, interreflection, light_transport, seen_points
from illuminerf.data.capture import load_capture
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import linear_from_srgb, read_exr, srgb_from_linear, write_exr, write_png
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import Views, spread_evenly
from illuminerf.workflow.artefact import open_artefact
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.device import numpy_generator
from illuminerf.workflow.progress import say, step_progress

STAGE = "estimate_illumination"
_LEAST_POINTS = 64
_PREVIEW_VIEWS = 4


@dataclass(frozen=True)
class Config:
    """How the light of the photographs is estimated and its shading path traced."""

    gathering: ColorGathering = field(default_factory=ColorGathering)
    """Points on the surface, and their colours."""
    fit: LightFit = field(default_factory=LightFit)
    """The light that explains these colours."""
    gloss: GlossFit = field(default_factory=GlossFit)
    """Photographs that are asked for gloss."""
    sampling: CueSampling = CueSampling()
    """Paths and bounces of the shading; those of the radiance cues."""
    seed: int = 0
    """Of points, pairs and paths."""


def run(geometry: Path, capture: Path, config: Config, out: Path) -> Path:
    """Estimate the light of `capture` and render its shading in all views into `out`; what exists is kept.

    Where photographs show too little of the mesh, the light is taken to be uniform, and the metrics say so.

    Args:
        geometry: a Geometry artefact; its `mesh.glb` lies in the capture's unit ball.
        capture: a Capture artefact.
        config: the settings.
        out: the artefact's folder.

    Raises:
        UserError: an input is missing or unusable, or `out` was made with other settings.
    """
    with open_artefact(out, STAGE, config, {"geometry": geometry, "capture": capture}) as artefact:
        if artefact.is_done:
            return out
        views = load_capture(capture).views
        mesh = TriangleMesh.load_glb(geometry / "mesh.glb")
        if not ((out / "light.json").exists() and (out / "light.exr").exists()):
            light, metrics = estimated_light(mesh, views, config)
            light.save(out / "light.exr")
            write_json(out / "light.json", metrics)
        light = EnvironmentMap.load(out / "light.exr")
        missing = [view for view in range(len(views)) if not shading_path(out, view).exists()]
        with step_progress("shading", len(views), len(views) - len(missing)) as progress:
            rendered = render_cues(mesh, views.cameras, light, config.sampling, config.seed, missing, only_diffuse=True)
            for view, image in zip(missing, rendered, strict=True):
                write_exr(shading_path(out, view), dict(zip("RGBA", image, strict=True)))
                progress.advance()
        write_png(out / "preview.png", _preview(light, views, out))
        artefact.finish({"num_views": len(views), **read_json(out / "light.json")})
    return out


def shading_path(illumination: Path, view: int) -> Path:
    """shading/<000>.exr of the artefact in `illumination`."""
    return illumination / "shading" / f"{view:03d}.exr"


def estimated_light(mesh: TriangleMesh, views: Views, config: Config) -> tuple[EnvironmentMap, dict[str, Any]]:
    """The light of photographs, and what the artefact's metrics say of it.

    Args:
        mesh: the object in the world of the cameras.
        views: photographs under one light.
        config: the settings; `sampling.device` finds shadows.
    """
    caster = RayCaster(mesh, config.sampling.device)
    generator = numpy_generator(config.seed, "points")
    points, colors = seen_points(mesh, views, caster, config.gathering, generator)
    metrics: dict[str, Any] = {"num_points": len(points), "is_fallback": len(points) < _LEAST_POINTS}
    if metrics["is_fallback"]:
        say(
            f"illumination: photographs show only {len(points)} points of the mesh well ({_LEAST_POINTS} are needed), "
            "so their light is taken to be uniform. Check masks, exposure, and that geometry and capture belong "
            "together."
        )
        return uniform_light(config.fit.map_height), {**metrics, "residual": 1.0, "explained": 0.0, "gloss": None}
    transport = light_transport(points, caster, config.fit.map_height)
    bounces = interreflection(points, caster, config.fit.bounce_rays, numpy_generator(config.seed, "bounces"))
    fitted = fit_light(points, colors, transport, bounces, config.fit, numpy_generator(config.seed, "pairs"))
    say(f"illumination: shading explains {fitted.explained:.0%} of the variance of log colour at {len(points)} points")
    gloss = estimated_gloss(mesh, points, caster, views, fitted.light, config.sampling, config.gloss, config.seed)
    say("illumination: gloss " + ("cannot be told" if gloss is None else f"{gloss:.0%} of a dielectric's"))
    return fitted.light, {**metrics, "residual": fitted.residual, "explained": fitted.explained, "gloss": gloss}


def _preview(light: EnvironmentMap, views: Views, out: Path) -> np.ndarray:
    """sRGB [height, width, 3]: the light, then rows of photograph, shading, albedo."""
    rows = []
    for view in spread_evenly(len(views), _PREVIEW_VIEWS):
        channels = read_exr(shading_path(out, view))
        alpha = channels["A"][..., None]
        shading = np.stack([channels[name] for name in "RGB"], -1) / np.maximum(alpha, 1e-3)
        photograph, mask = views.srgb[view], views.alpha[view][..., None]
        albedo = srgb_from_linear(linear_from_srgb(photograph) / np.maximum(shading, 1e-2))
        bright = np.quantile(shading[alpha[..., 0] > 0.5], 0.95) if (alpha > 0.5).any() else 1.0
        shown = [photograph * mask, srgb_from_linear(shading / max(bright, 1e-3)) * alpha, albedo * mask * alpha]
        rows.append(np.concatenate([np.clip(image, 0, 1) for image in shown], 1))
    width = rows[0].shape[1]
    wide = np.zeros((width // 2, 2 * (width // 2), 3), np.float32)
    panorama = light.radiance(EnvironmentMap(wide + 1).directions())
    panorama = np.clip(srgb_from_linear(panorama / np.quantile(panorama, 0.95)), 0, 1)
    padded = np.pad(panorama, ((0, 0), (0, width - panorama.shape[1]), (0, 0)))
    return np.concatenate([padded, *rows], 0).astype(np.float32)
