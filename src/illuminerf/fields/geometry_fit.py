"""Geometry estimation: the loss of one step, and the start from the visual hull."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from illuminerf.fields import losses
from illuminerf.fields.bounds import OccupiedCells, signed_distance_of_cells
from illuminerf.fields.hash_grid import coarse_to_fine_weights
from illuminerf.fields.optimisation import OptimiserConfig
from illuminerf.fields.proposal_sampling import interlevel_loss
from illuminerf.fields.radiance_field import RadianceField
from illuminerf.fields.ray_guide import RayGuide
from illuminerf.fields.ray_pool import RayPool
from illuminerf.fields.recorded_steps import RecordableLoss
from illuminerf.fields.shading_slots import ShadingSlots
from illuminerf.fields.step_draws import StepDraws
from illuminerf.workflow.device import derived_seed, torch_generator
from illuminerf.workflow.processes import ALONE, Team

_HULL_MARGIN_CELLS = 1.9
_GUIDED_FROM = 0.1  # share of the fit; before, errors are everywhere


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


class LevelWeights(NamedTuple):
    """Weights of hash levels, coarse to fine."""

    distance: Float[Tensor, " levels"]
    normals: Float[Tensor, " normal_levels"]


def level_weights(field: RadianceField, config: GeometryLossConfig, progress: Float[Tensor, ""]) -> LevelWeights:
    """Those of the share of the fit that is over (float64)."""
    phase, first = progress / max(config.coarse_to_fine_share, 1e-6), config.first_levels
    levels = field.config.surface.grid.num_levels, field.surface.num_normal_levels
    return LevelWeights(*(coarse_to_fine_weights(count, phase, first) for count in levels))


def geometry_loss(
    field: RadianceField,
    config: GeometryLossConfig,
    pool: RayPool,
    target_srgb: Float[Tensor, "pool 3"],
    target_alpha: Float[Tensor, " pool"] | None,
    index: Tensor,
    levels: LevelWeights,
    generator: torch.Generator,
    team: Team = ALONE,
    guide: RayGuide | None = None,
    slots: ShadingSlots | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of one batch of rays, or of the share of it that is this process's, with numbers to show.

    Args:
        target_srgb: premultiplied on black, of every ray of the pool.
        target_alpha: coverage; None where the capture has no masks.
        index: the rays of this batch, all processes' together.
        levels: see `level_weights`.
        guide: takes in the rays' errors.
        slots: of the samples that are shaded.
    """
    draws = StepDraws(generator, len(index), team)
    batch, all_rays, index = len(index), index, index[draws.own]
    origins, directions, near, far = pool.rays(index)

    slots = slots or ShadingSlots()
    samples = field.sample(origins, directions, near, far, draws, levels.distance)
    points = field.worth_shading(samples, slots)
    # at once, so that the gradient of the table is made once
    noise = draws.normal(len(points.positions), 3) * config.smoothness_sigma
    both = torch.cat([points.positions, points.positions + noise])
    predicted, perturbed = field.surface.predicted_normals(both, levels.normals).chunk(2)
    seen = points.density_normals if field.config.radiance_normals == "density" else predicted
    srgb = field.shade(points, seen, directions)

    anywhere = draws.uniform(3) * 1.6 - 0.8
    gradients = torch.cat([samples.end_gradients.view(-1, 3), field.surface(anywhere, levels.distance).gradient])

    wanted = target_srgb[index]
    if target_alpha is not None and config.random_background:
        # Deviation: over black a haze about a dark object costs no colour loss, and outlines stay soft
        behind = draws.uniform(3)
        srgb = srgb + torch.exp(-samples.depth)[:, None] * behind
        wanted = wanted + (1 - target_alpha[index])[:, None] * behind
    # Charbonnier as in camp_zipnerf: against the squared error's ever smaller gradient the smoothness terms win
    squared = losses.colour_loss(srgb.detach(), wanted)
    if guide is not None:
        guide.update(all_rays, (srgb.detach() - wanted).abs().mean(-1), team, slots.overflow)
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
    return total, {"psnr": losses.psnr(team.mean(squared, batch)), "beta": field.surface.beta.detach()}


def geometry_steps(
    field: RadianceField,
    config: GeometryLossConfig,
    optimiser: OptimiserConfig,
    pool: RayPool,
    target_srgb: Float[Tensor, "pool 3"],
    target_alpha: Float[Tensor, " pool"] | None,
    guide: RayGuide | None,
    seed: int,
    team: Team = ALONE,
) -> RecordableLoss:
    """The loss of every step of a fit.

    Args:
        target_srgb: as of `geometry_loss`, with the next.
        guide: says where the share of `config` is drawn; None: rays are drawn evenly.
    """
    device, rays = pool.view.device, optimiser.rays_per_step
    generator = torch.Generator(device)
    slots, progress, num_guided = ShadingSlots(), torch.zeros((), dtype=torch.float64, device=device), 0

    def prepare(step: int) -> int:
        nonlocal num_guided
        generator.manual_seed(derived_seed(seed, "geometry", step))
        progress.fill_(step / optimiser.num_steps)
        num_guided = (
            0 if guide is None or step < _GUIDED_FROM * optimiser.num_steps else round(rays * config.guided_share)
        )
        return num_guided

    def loss() -> tuple[Tensor, dict[str, Tensor]]:
        index = pool.draw(rays - num_guided, generator)
        if guide is not None and num_guided:
            index = torch.cat([index, guide.draw(num_guided, generator)])
        levels = level_weights(field, config, progress)
        return geometry_loss(
            field, config, pool, target_srgb, target_alpha, index, levels, generator, team, guide, slots
        )

    return RecordableLoss(prepare, loss, generator, rays * field.config.num_samples, slots)


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
    levels = coarse_to_fine_weights(surface.config.grid.num_levels, torch.zeros((), device=close.device), first_levels)
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
