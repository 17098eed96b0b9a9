"""Which level of the signed distance is the surface to the eye: the one whose outlines are the photographs'."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from illuminerf.fields.radiance_field import RadianceField
from illuminerf.fields.ray_pool import RayPool
from illuminerf.fields.surface import SurfaceField
from illuminerf.workflow.progress import track

_MAX_RAYS = 100_000
_CHUNK = 4096
_STEPS, _FINE_STEPS = 128, 16
_HIGHEST, _NUM_LEVELS = 4.0, 33  # in units of beta: beyond, a ray along the surface sees through it


@torch.no_grad()
def outline_level(field: RadianceField, pool: RayPool, has_masks: bool, generator: torch.Generator) -> float:
    """The signed distance, 0 or more, in world units, of the surface whose outlines agree best with those of the rays.

    Deviation: UniSDF takes the mesh at zero. Rays that graze a surface gather density along their whole way past it, so
    a fit to outlines leaves the zero level inside the object by a few beta: too thin all over, and wires not there.
    Two outlines agree where most of what either covers is covered by both (intersection over union).

    Args:
        field: the fitted one.
        pool: rays of some photographs, the covered ones first.
        has_masks: False: what is covered is what the field shows as opaque.
        generator: draws some of the rays where there are many.
    """
    device = pool.view.device
    index = torch.randperm(len(pool), generator=generator, device=device)[:_MAX_RAYS]
    parts = index.split(_CHUNK)
    least, opaque = [], []
    for part in track(parts, "find outlines", math.ceil(len(index) / _CHUNK)):
        least.append(least_distance(field.surface, pool, part))
        if not has_masks:
            opaque.append(field.sample(*pool.rays(part)).depth > math.log(2))
    covered = index < pool.num_foreground if has_masks else torch.cat(opaque)
    levels = torch.linspace(0, _HIGHEST, _NUM_LEVELS, device=device) * field.surface.beta
    meets = torch.cat(least) <= levels[:, None]
    agreement = (meets & covered).sum(-1) / (meets | covered).sum(-1).clamp_min(1)
    return float(levels[agreement.argmax()])


def least_distance(surface: SurfaceField, pool: RayPool, index: Int[Tensor, " batch"]) -> Float[Tensor, " batch"]:
    """The smallest signed distance along rays within their bounds: even steps, then finer ones about the best."""
    origins, directions, near, far = pool.rays(index)

    def along(places: Tensor) -> Tensor:
        positions = origins[:, None] + places[..., None] * directions[:, None]
        return surface.signed_distance(positions.view(-1, 3)).view_as(places)

    step = ((far - near) / _STEPS)[:, None]
    places = near[:, None] + step * torch.arange(_STEPS + 1, device=near.device)
    least, best = along(places).min(-1)
    around = torch.linspace(-1, 1, _FINE_STEPS + 1, device=near.device)
    return torch.minimum(least, along(places.gather(1, best[:, None]) + step * around).amin(-1))
