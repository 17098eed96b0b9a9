"""Whole images of a fitted field, in chunks."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from illuminerf.fields.appearance import blend_radiance
from illuminerf.fields.bounds import OccupiedCells
from illuminerf.fields.radiance_field import RadianceField
from illuminerf.fields.ray_pool import pixel_rays
from illuminerf.fields.shell import SurfaceShell
from illuminerf.fields.surface_marching import march, shading_places
from illuminerf.scene.cameras import Cameras

_SHADED = 1 << 13  # points at a time, so that what lies between the layers stays in the cache


@dataclass(frozen=True)
class RenderedImage:
    """One view.

    Attributes:
        srgb: float32 [height, width, 3], premultiplied on black.
        alpha: float32 [height, width].
        normals: float32 [height, width, 3], the normals that the radiance fields see, in the world, weighted (length is
            about alpha).
        depth: float32 [height, width], expected distance along the ray times alpha.
    """

    srgb: np.ndarray
    alpha: np.ndarray
    normals: np.ndarray
    depth: np.ndarray


@torch.no_grad()
def observed_cells(
    field: RadianceField, cells: OccupiedCells, cameras: Cameras, min_weight: float = 0.02
) -> OccupiedCells:
    """Those of `cells` in which some camera sees something, and their neighbours.

    What no photograph shows, such as the space below an object on a table, holds whatever the fit began with; it would
    float about in novel views.

    Args:
        min_weight: rendering weight from which a sample counts as seen.
    """
    device = cells.cells.device
    seen = torch.zeros_like(cells.cells)
    side = seen.shape[0]
    # every second row and column; of large images fewer, about two across a cell
    stride = max(2, min(cameras.height, cameras.width) // (2 * side))
    rows, columns = (torch.arange(0, size, stride, device=device) for size in (cameras.height, cameras.width))
    pixel = (rows[:, None] * cameras.width + columns).view(-1)
    for view in range(len(cameras)):
        origins, directions = pixel_rays(cameras, torch.full_like(pixel, view), pixel)
        near, far = cells.clip(origins, directions)
        hit = far > near
        if not hit.any():
            continue
        samples = field.sample(origins[hit], directions[hit], near[hit], far[hit])
        points = samples.positions[samples.weights > min_weight]
        x, y, z = (points * (side / 2) + side / 2).long().clamp(0, side - 1).unbind(-1)
        seen[x, y, z] = True
    return OccupiedCells(OccupiedCells(seen).dilated(1).cells & cells.cells)


@torch.no_grad()
def render_image(
    field: RadianceField,
    shell: SurfaceShell,
    cameras: Cameras,
    view: int,
    latent: Float[Tensor, " latent"] | None = None,
    chunk: int = 1 << 17,
) -> RenderedImage:
    """Render one view; pixels whose rays miss the shell are transparent.

    Deviation: UniSDF renders images with the samples of training (`render_image_as_trained`). Marching the surface is
    closer to the integral that both stand for, as a test shows.

    Args:
        shell: `surface_shell` of the field's surface.
        latent: latent code; None stands for the zero code.
        chunk: rays at a time.
    """
    device = shell.clearance.device
    result = torch.zeros(cameras.height * cameras.width, 8, device=device)
    for pixel in torch.arange(len(result), device=device).split(chunk):
        origins, directions = pixel_rays(cameras, torch.full_like(pixel, view), pixel)
        near, far = shell.enter(origins, directions)
        hit = near.isfinite().nonzero()[:, 0]
        if len(hit):
            result[pixel[hit]] = _marched(field, shell, origins[hit], directions[hit], near[hit], far[hit], latent)
    return _image(result, cameras)


def _marched(
    field: RadianceField,
    shell: SurfaceShell,
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    latent: Tensor | None,
) -> Tensor:
    """sRGB, alpha, normals, depth: [rays, 8]."""
    samples = march(field.surface, shell, origins, directions, near, far)
    distance = samples.distance[:, None]
    alpha, depth = samples.total(len(near), torch.cat([torch.ones_like(distance), distance], -1)).split(1, -1)
    places = shading_places(samples, field.surface)
    if not len(places.ray):
        return torch.cat([alpha.new_zeros(len(near), 3), alpha, alpha.new_zeros(len(near), 3), depth], -1)
    positions = origins[places.ray] + places.distance[:, None] * directions[places.ray]
    shaded = [
        _shaded(field, *chunk, latent)
        for chunk in zip(positions.split(_SHADED), directions[places.ray].split(_SHADED), strict=True)
    ]
    appearance, normals = places.total(len(near), torch.cat(shaded)).split([7, 3], -1)
    return torch.cat([blend_radiance(appearance), alpha, normals, depth], -1)


def _shaded(field: RadianceField, positions: Tensor, directions: Tensor, latent: Tensor | None) -> Tensor:
    """What the appearance says of points, and the normals that it saw: [points, 10]."""
    normals = field.shading_normals_at(positions)
    latents = None if latent is None else latent.to(positions.device).expand(len(positions), -1)
    return torch.cat([field.appearance(positions, directions, normals, latents), normals], -1)


@torch.no_grad()
def render_image_as_trained(
    field: RadianceField,
    cells: OccupiedCells,
    cameras: Cameras,
    view: int,
    latent: Float[Tensor, " latent"] | None = None,
    chunk: int = 8192,
) -> RenderedImage:
    """`render_image` with the samples of training: proposal, then `num_samples` of the surface.

    The slow twin; with many samples, and `min_weight` 0, it comes to the same image.

    Args:
        cells: where samples may lie.
        latent: latent code; None stands for the zero code.
        chunk: rays at a time.
    """
    device = cells.cells.device
    num_pixels = cameras.height * cameras.width
    result = torch.zeros(num_pixels, 8, device=device)
    for pixel in torch.arange(num_pixels, device=device).split(chunk):
        index = torch.full_like(pixel, view)
        origins, directions = pixel_rays(cameras, index, pixel)
        near, far = cells.clip(origins, directions)
        hit = (far > near).nonzero()[:, 0]
        if not len(hit):
            continue
        origins, directions = origins[hit], directions[hit]
        samples = field.sample(origins, directions, near[hit], far[hit])
        points = field.worth_shading(samples)
        shading = field.shading_normals(points)
        latents = None if latent is None else latent.to(device).expand(len(hit), -1)
        srgb = field.shade(points, shading, directions, latents)
        normals = torch.zeros_like(srgb).index_add(0, points.ray, points.weights[:, None] * shading)
        distance = 0.5 * (samples.edges[:, 1:] + samples.edges[:, :-1])
        alpha = samples.weights.sum(-1, keepdim=True).clamp(0, 1)
        depth = (samples.weights * distance).sum(-1, keepdim=True)
        result[pixel[hit]] = torch.cat([srgb, alpha, normals, depth], -1)
    return _image(result, cameras)


def _image(result: Tensor, cameras: Cameras) -> RenderedImage:
    image = result.view(cameras.height, cameras.width, 8).cpu().numpy()
    return RenderedImage(image[..., :3], image[..., 3].clip(0, 1), image[..., 4:7], image[..., 7])
