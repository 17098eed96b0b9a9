"""Geometry estimation: the loss of one step, and the start from the visual hull."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from illuminerf.fields import losses
from illuminerf.fields.bounds import OccupiedCells, signed_distance_of_cells
from illuminerf.fields.hash_grid import coarse_to_fine_weights
from illuminerf.fields.proposal_sampling import interlevel_loss
from illuminerf.fields.radiance_field import RadianceField
from illuminerf.fields.ray_guide import RayGuide
from illuminerf.fields.ray_pool import RayPool
from illuminerf.fields.step_draws import StepDraws
from illuminerf.workflow.device import torch_generator
from illuminerf.workflow.processes import ALONE, Team

_HULL_MARGIN_CELLS = 1.9


@dataclass(frozen=True)
class GeometryLossConfig:
    """Weights of the losses; colour has weight 1."""

    eikonal: float = 0.03
    """(|gradient| - 1)^2 at the samples and at random points of the ball."""
    mask: float = 0.1
    """Opacity against alpha."""
    orientation: float = 0.01
    """Visible normals must face the camera."""
    predicted_normals: tuple[float, float, float] = (1e-3, 1e-3, 1e-2)
    """lambda_1, lambda_2, lambda_3 of the asymmetric loss (supplement A.1)."""
    normal_smoothness: float = 0.1
    """lambda_4 (supplement A.1)."""
    random_background: bool = True
    """Where there are masks, each ray and its pixel are laid over one colour, drawn anew at every step. False: over
    black, for comparison."""
    guided_share: float = 0.5
    """Share of each batch that is drawn where the error is (see `RayGuide`), once a tenth of the fit is over; 0 for
    comparison."""
    smoothness_sigma: float = 0.01
    """Standard deviation of the perturbed positions (supplement A.1)."""
    first_levels: int = 4
    """Hash levels that are on from the start."""
    coarse_to_fine_share: float = 0.5
    """Share of the fit after which all levels are on; 0: from the second step on, for comparison."""
    starts_from_hull: bool = True
    """The signed distance starts as that of the visual hull (see `start_from_cells`), or as UniSDF's sphere (supplement
    A.1), for comparison."""


def geometry_loss(
    field: RadianceField,
    config: GeometryLossConfig,
    pool: RayPool,
    target_srgb: Float[Tensor, "pool 3"],
    target_alpha: Float[Tensor, " pool"] | None,
    index: Tensor,
    progress: float,
    generator: torch.Generator,
    team: Team = ALONE,
    guide: RayGuide | None = None,
) -> tuple[Tensor, dict[str, float]]:
    """Loss of one batch of rays, or of the share of it that is this process's, with numbers to show.

    Args:
        target_srgb: premultiplied on black, of every ray of the pool.
        target_alpha: coverage; None where the capture has no masks.
        index: the rays of this batch, all processes' together.
        progress: share of the fit that is over.
        guide: takes in the rays' errors.
    """
    draws = StepDraws(generator, len(index), team)
    batch, all_rays, index = len(index), index, index[draws.own]
    device = index.device
    origins, directions, near, far = pool.rays(index)
    phase = progress / max(config.coarse_to_fine_share, 1e-6)
    grids = field.config.surface
    levels = coarse_to_fine_weights(grids.grid.num_levels, phase, config.first_levels, device)
    normal_levels = coarse_to_fine_weights(field.surface.num_normal_levels, phase, config.first_levels, device)

    samples = field.sample(origins, directions, near, far, draws, levels)
    points = field.worth_shading(samples)
    predicted, shading = field.shading_normals(points, normal_levels)
    srgb = field.shade(points, shading, directions)

    noise = draws.normal(len(points.positions), 3) * config.smoothness_sigma
    perturbed = field.surface.predicted_normals(points.positions + noise, normal_levels)
    anywhere = draws.uniform(3) * 1.6 - 0.8
    gradients = torch.cat([samples.end_gradients.view(-1, 3), field.surface(anywhere, levels).gradient])

    wanted = target_srgb[index]
    if target_alpha is not None and config.random_background:
        # Deviation: over black a haze about a dark object costs no colour loss, and outlines stay soft
        behind = draws.uniform(3)
        srgb = srgb + torch.exp(-samples.depth)[:, None] * behind
        wanted = wanted + (1 - target_alpha[index])[:, None] * behind
    # Charbonnier as in camp_zipnerf: against the squared error's ever smaller gradient the smoothness terms win
    squared = losses.colour_loss(srgb.detach(), wanted)
    if guide is not None:
        guide.update(all_rays, (srgb.detach() - wanted).abs().mean(-1), team)
    total = losses.robust_colour_loss(srgb, wanted) + config.eikonal * losses.eikonal_loss(gradients)
    total = total + interlevel_loss(samples.edges, samples.weights, samples.proposal_edges, samples.proposal_weights)
    rays = len(index)
    total = total + config.orientation * losses.orientation_loss(
        points.weights, points.density_normals, directions[points.ray], rays
    )
    total = total + losses.predicted_normal_loss(
        points.weights, points.density_normals, predicted, rays, config.predicted_normals
    )
    total = total + config.normal_smoothness * losses.normal_smoothness_loss(points.weights, predicted, perturbed, rays)
    if target_alpha is not None:
        total = total + config.mask * losses.mask_loss(samples.depth, target_alpha[index])
    numbers = {"psnr": losses.psnr(team.mean(squared, batch)), "beta": float(field.surface.beta.detach())}
    return total, numbers


def start_from_cells(
    field: RadianceField, cells: OccupiedCells, first_levels: int, seed: int, num_steps: int = 150
) -> None:
    """Fit the signed distance to that of the visual hull.

    Deviation: UniSDF starts from a sphere. The hull starts closer, which a fit of some thousand steps needs; its
    first levels only, so that the fine ones still start from nothing.
    """
    if bool(cells.cells.all()):
        return
    side = cells.cells.shape[0]
    # the hull takes in every cell that a mask touches, and a margin of one cell
    target = signed_distance_of_cells(cells.cells).to(cells.cells.device) + _HULL_MARGIN_CELLS * 2 / side
    close = (target.abs() < 0.15).view(-1).nonzero()[:, 0]
    surface = field.surface
    levels = coarse_to_fine_weights(surface.config.grid.num_levels, 0.0, first_levels, close.device)
    parameters = [*surface.grid.parameters(), *surface.hidden.parameters(), *surface.head.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=5e-3, betas=(0.9, 0.99), eps=1e-15, fused=True)
    generator = torch_generator(seed, "start from cells", device=close.device)
    for _ in range(num_steps):
        near_surface = close[torch.randint(len(close), (3072,), generator=generator, device=close.device)]
        everywhere = torch.randint(side**3, (1024,), generator=generator, device=close.device)
        cell = torch.cat([near_surface, everywhere])
        index = torch.stack([cell // side**2, cell // side % side, cell % side], -1)
        point = surface((index + 0.5) * (2 / side) - 1, levels)
        loss = (point.signed_distance - target.view(-1)[cell]).abs().mean()
        loss = loss + 0.01 * losses.eikonal_loss(point.gradient)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    for parameter in parameters:
        parameter.grad = None
