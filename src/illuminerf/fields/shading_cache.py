"""What a frozen geometry says about every pixel, computed once: shading points, weights and normals.

All samples of a view share these, so that a step of the latent NeRF evaluates appearance only.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from illuminerf.fields import losses
from illuminerf.fields.radiance_field import RadianceField, ShadingPoints
from illuminerf.fields.ray_pool import RayPool
from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.workflow.processes import ALONE, Team
from illuminerf.workflow.progress import track

_CHUNK = 4096
_LEAST_FACING = 0.3  # cosine to the viewer below which a pixel's stretch on the surface grows no more


@dataclass
class ShadingCache:
    """The heaviest samples of each ray.

    Attributes:
        directions: float32 [rays, 3].
        positions: float32 [rays, kept, 3].
        weights: float32 [rays, kept]; scaled so that they sum to the opacity of the whole ray.
        normals: float32 [rays, kept, 3], those that the radiance fields see.
        pixel_sides: float32 [rays], how wide the ray's pixel is at its heaviest sample, in world units.
    """

    directions: Float[Tensor, "rays 3"]
    positions: Float[Tensor, "rays kept 3"]
    weights: Float[Tensor, "rays kept"]
    normals: Float[Tensor, "rays kept 3"]
    pixel_sides: Float[Tensor, " rays"]

    def render(
        self,
        field: RadianceField,
        index: Int[Tensor, " batch"],
        latents: Float[Tensor, "batch latent"] | None = None,
        within_pixels: Float[Tensor, "batch 2"] | None = None,
        slots: ShadingSlots | None = None,
    ) -> Float[Tensor, "batch 3"]:
        """Colours (premultiplied sRGB) of the chosen rays; differentiable in appearance and latents.

        Args:
            within_pixels: where in its pixel each ray passes, from -0.5 to 0.5; None: through the middle. Shading
                points are moved to there along the surface's tangent plane.
        """
        weights, directions = self.weights[index], self.directions[index]
        flat, counts = (slots or ShadingSlots()).choose(weights > field.config.min_weight)
        ray, kept = flat // weights.shape[1], flat % weights.shape[1]
        source, weights = index[ray], weights.reshape(-1)[flat]
        positions, normals = self.positions[source, kept], self.normals[source, kept]
        if within_pixels is not None:
            steps = within_pixels * self.pixel_sides[index, None]
            positions = positions + steps_on_surface(steps[ray], directions[ray], normals)
        points = ShadingPoints(ray, positions, weights if counts is None else weights * counts, normals)
        return field.shade(points, normals, directions, latents)


@torch.no_grad()
def cache_shading(field: RadianceField, pool: RayPool, num_kept: int) -> ShadingCache:
    """Sample the frozen surface along the foreground rays of a pool.

    Deviation: the paper renders all samples at every step. The kept ones hold nearly all weight once beta is small.

    Args:
        num_kept: heaviest samples to keep per ray.
    """
    num_kept = min(num_kept, field.config.num_samples)
    rays, device = pool.num_foreground, pool.view.device
    # filled in place: parts to be joined would take the same room again
    shapes = ((3,), (num_kept, 3), (num_kept,), (num_kept, 3), ())
    focal_lengths = torch.from_numpy(pool.cameras.intrinsics[:, 0]).float().to(device)
    cache = ShadingCache(*(torch.empty(rays, *shape, device=device) for shape in shapes))
    for index in track(
        torch.arange(rays, device=device).split(_CHUNK), "find shading points", math.ceil(rays / _CHUNK)
    ):
        origins, directions, near, far = pool.rays(index)
        samples = field.sample(origins, directions, near, far)
        weights, chosen = samples.weights.topk(num_kept, dim=-1)
        weights = weights * (samples.weights.sum(-1) / weights.sum(-1).clamp_min(1e-8))[:, None]
        spread = chosen[..., None].expand(-1, -1, 3)
        positions = samples.positions.gather(1, spread)
        flat = ShadingPoints(
            chosen.reshape(-1),
            positions.reshape(-1, 3),
            weights.reshape(-1),
            torch.nn.functional.normalize(samples.gradients.gather(1, spread), dim=-1, eps=1e-6).reshape(-1, 3),
        )
        normals = field.shading_normals(flat)
        cache.directions[index], cache.positions[index] = directions, positions
        cache.weights[index], cache.normals[index] = weights, normals.view_as(positions)
        distances = (positions[:, 0] - origins).norm(dim=-1)
        cache.pixel_sides[index] = distances / focal_lengths[pool.view[index].long()]
    return cache


def steps_on_surface(
    steps: Float[Tensor, "points 2"], directions: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"]
) -> Float[Tensor, "points 3"]:
    """How far the point moves on its tangent plane when its ray takes a step across itself, in world units.

    Args:
        steps: in two directions that a ray is normal to, whichever they are.
    """
    steep = directions[:, 2:].abs() > 0.9
    other = torch.cat([steep, torch.zeros_like(steep), ~steep], -1).to(directions.dtype)
    right = torch.nn.functional.normalize(torch.linalg.cross(directions, other), dim=-1)
    across = steps[:, :1] * right + steps[:, 1:] * torch.linalg.cross(right, directions)
    facing = (directions * normals).sum(-1, keepdim=True).clamp_max(-_LEAST_FACING)
    return across - directions * ((across * normals).sum(-1, keepdim=True) / facing)


def latent_loss(
    field: RadianceField,
    cache: ShadingCache,
    index: Int[Tensor, " batch"],
    target_srgb: Float[Tensor, "batch 3"],
    latents: Float[Tensor, "batch latent"] | None,
    latent_penalty: float,
    within_pixels: Float[Tensor, "batch 2"] | None = None,
    team: Team = ALONE,
    batch: int = 0,
    slots: ShadingSlots | None = None,
    is_coded: Bool[Tensor, "batch 1"] | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Equation 7 of the paper on one batch, or on a process's share of it; the PSNR is that of the rays with codes.

    Deviation: rays with the zero code, and a small penalty on the squared latents, keep the zero code, which is
    rendered at test, in their midst.

    Args:
        within_pixels: see `ShadingCache.render`.
        batch: rays of all processes together.
        slots: of the samples that are shaded.
        is_coded: which rays see their latents; the others see the zero code. None: all do.
    """
    if is_coded is None:
        is_coded = torch.ones_like(index[:, None], dtype=torch.bool)
    if latents is not None:
        latents = latents * is_coded
    rendered = cache.render(field, index, latents, within_pixels, slots)
    total = losses.colour_loss(rendered, target_srgb)
    if latents is not None:
        total = total + latent_penalty * latents.square().sum(-1).mean()
    squared = (rendered.detach() - target_srgb).square()
    error, share = team.mean(torch.stack([(squared * is_coded).mean(), is_coded.to(squared.dtype).mean()]), batch)
    return total, {"psnr": losses.psnr(error / share)}
