"""How much of a dielectric's gloss photographs show.

Deviation: not in the paper, whose relighting model has to tell gloss from paint in each photograph alone.

A matt point shows the same colour to every camera; a gloss moves with the eye. A point that view v sees shows

    I_v = a D_v + g 0.04 S_v

with its paint a, the diffuse cue D and the roughest white lobe S under the photographs' own light: g = 1 is a
dielectric of that roughness, g = 0 is matt. The paint of every point and channel is eliminated, by what is left of I
and S beside D; g is the slope that fits all points, robustly, since dents of the mesh move highlights about.
"""

from dataclasses import dataclass

import numpy as np

from illuminerf.cues.renderer import CUE_NAMES, CueSampling, render_cues
from illuminerf.cues.surface_samples import CLIPPED_SRGB, RayCaster, SurfacePoints, bilinear, sightings
from illuminerf.scene.environment import EnvironmentMap
from illuminerf.scene.images import linear_from_srgb
from illuminerf.scene.meshes import TriangleMesh
from illuminerf.scene.views import Views, spread_evenly
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import track

_DIELECTRIC_REFLECTANCE = 0.04
_LOBE = CUE_NAMES.index("ggx_034")
_LEAST_COVERAGE = 0.5
_DARK = 0.02  # linear: noise and stray light matter as much as the colour
_ROUNDS = 15
_WIDTH = 2.0  # of the Cauchy penalty, in medians of the error


@dataclass(frozen=True)
class GlossFit:
    """Which photographs are asked for gloss."""

    num_views: int = 16
    """Photographs, spread evenly over the capture."""
    least_views: int = 4
    """Of them that must show a point."""
    least_points: int = 200
    """Fewer points tell nothing."""

    def __post_init__(self) -> None:
        if not 2 <= self.least_views <= self.num_views or self.least_points < 1:
            raise UserError("gloss shows between two views or more", got=str(self))


def estimated_gloss(
    mesh: TriangleMesh,
    points: SurfacePoints,
    caster: RayCaster,
    views: Views,
    light: EnvironmentMap,
    sampling: CueSampling,
    config: GlossFit,
    seed: int,
) -> float | None:
    """The factor on a dielectric's gloss, 0 (matt) to 1 (as a dielectric, or more); None where photographs do not tell.

    Args:
        mesh: the object in the world of the cameras.
        points: on its surface.
        caster: of the same mesh.
        views: photographs under `light`.
        light: their estimated light.
        sampling: of the cues under it.
        config: the settings.
        seed: of the paths.
    """
    chosen = spread_evenly(len(views), config.num_views)
    shape = (len(chosen), len(points), 3)
    colours, diffuse, lobe = (np.full(shape, np.nan) for _ in range(3))
    rendered = render_cues(mesh, views.cameras, light, sampling, seed, chosen)
    for row, (view, cues) in enumerate(zip(chosen, track(rendered, "gloss", len(chosen)), strict=True)):
        seen = sightings(points, views, view, caster)
        values = bilinear(cues.transpose(1, 2, 0), seen.pixels)
        is_good = (values[:, -1] > _LEAST_COVERAGE) & (seen.srgb < CLIPPED_SRGB).all(-1)
        index, straight = seen.index[is_good], values[is_good, :-1] / values[is_good, -1:]
        colours[row, index] = linear_from_srgb(seen.srgb[is_good])
        diffuse[row, index], lobe[row, index] = straight[:, :3], straight[:, 3 * _LOBE : 3 * _LOBE + 3]
    is_enough = np.isfinite(colours[..., 0]).sum(0) >= config.least_views
    if is_enough.sum() < config.least_points:
        return None
    slope = lobe_slope(*(values[:, is_enough] for values in (colours, diffuse, lobe)))
    return float(np.clip(slope / _DIELECTRIC_REFLECTANCE, 0, 1))


def lobe_slope(colours: np.ndarray, diffuse: np.ndarray, lobe: np.ndarray) -> float:
    """s of colour = paint * diffuse + s * lobe, with paint of each point and channel of its own and one s for all.

    Args:
        colours, diffuse, lobe: linear [views, points, 3]; NaN where a view does not see a point.
    """
    is_seen = np.isfinite(colours)
    colours, diffuse, lobe = (np.where(is_seen, values, 0) for values in (colours, diffuse, lobe))
    level = colours.sum(0).mean(-1) / np.maximum(is_seen.sum(0).mean(-1), 1) + _DARK
    power = np.maximum((diffuse**2).sum(0), 1e-12)

    def beside_diffuse(values: np.ndarray) -> np.ndarray:
        left = values - diffuse * ((diffuse * values).sum(0) / power)
        return (left / level[:, None])[is_seen]

    shown, predicted = beside_diffuse(colours), beside_diffuse(lobe)
    weights, slope = np.ones_like(shown), 0.0
    for _ in range(_ROUNDS):
        slope = float((weights * shown * predicted).sum() / max(float((weights * predicted**2).sum()), 1e-12))
        error = np.abs(shown - slope * predicted)
        weights = 1 / (1 + np.square(error / max(_WIDTH * float(np.median(error)), 1e-6)))
    return slope
