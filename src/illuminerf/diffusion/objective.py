"""What training minimises: v-prediction on latents (Salimans and Ho, 2022) plus, for residual latents, the anchor;
for a control on a frozen base, what the base itself was trained with.

Every loss is a sum over examples divided by totals of the whole step, so that it does not matter into how many parts
or over how many processes the step's examples are spread.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from illuminerf.diffusion.conditioning import Condition
from illuminerf.diffusion.controlled_base import ControlledBase
from illuminerf.diffusion.cue_coding import GAMMA, composited_srgb, decode_cues
from illuminerf.diffusion.materials import true_texture
from illuminerf.diffusion.relighting_model import NUM_TRAIN_TIMESTEPS, RelightingModel, noise_schedule
from illuminerf.scene.images import linear_from_srgb
from illuminerf.workflow.device import torch_generator
from illuminerf.workflow.processes import sum_over_processes

_NEGLIGIBLE_ERROR = 1e-4  # 40 dB


class Batch(NamedTuple):
    """One optimisation step's examples; sRGB over black, coded straight cues."""

    masked_image: Float[Tensor, "batch 4 height width"]
    coded_cues: Float[Tensor, "batch 12 height width"]
    target: Float[Tensor, "batch 3 height width"]
    alpha: Float[Tensor, "batch 1 height width"]
    surface: Float[Tensor, "batch 5 height width"]
    """What the object is made of: linear base colour, metallicity, roughness."""
    shading: Float[Tensor, "batch 3 height width"]
    """Coded diffuse cue under the input light; zeros where it is unknown."""


class Draws(NamedTuple):
    """The randomness of some examples: each has its own, so that it does not matter who computes it."""

    timesteps: Int[Tensor, " batch"]
    """How noisy each latent is."""
    seeds: tuple[int, ...]
    """One per example."""

    def noise(self, shape: tuple[int, ...], name: str = "noise") -> Float[Tensor, "batch *shape"]:
        """Standard normal numbers, by example."""
        return torch.stack([torch.randn(shape, generator=torch_generator(seed, name)) for seed in self.seeds])


class Totals(NamedTuple):
    """What a step's losses are divided by: sums over all its examples, whoever computes them."""

    covered: Float[Tensor, ""]
    """Covered pixels."""
    latents: Float[Tensor, ""]
    """Weights of latent pixels."""
    examples: Float[Tensor, ""]
    """How many."""
    num_processes: int
    """Gradients are averaged over processes where losses are to be added up: each process multiplies by this."""


def step_totals(batches: Sequence[Batch], block: int, outside: float, num_processes: int = 1) -> Totals:
    """Totals of a step whose examples on this process are `batches`; `block` is pixels per latent pixel."""
    alphas = [batch.alpha for batch in batches]
    covered = torch.stack([alpha.sum() for alpha in alphas]).sum()
    latents = torch.stack([latent_weight(alpha, block, outside).sum() for alpha in alphas]).sum()
    examples = torch.tensor(float(sum(map(len, alphas))), device=covered.device)
    covered, latents, examples = sum_over_processes(torch.stack([covered, latents, examples])).unbind()
    return Totals(covered, latents, examples, num_processes)


def latent_weight(alpha: Float[Tensor, "batch 1 height width"], block: int, outside: float) -> Tensor:
    """1 for latent pixels that cover anything of the object, `outside` for the others: [batch, 1, rows, columns]."""
    covered = (functional.max_pool2d(alpha, block) > 0).float()
    return covered + outside * (1 - covered)


@dataclass(frozen=True)
class LossWeights:
    """How the terms are added."""

    anchor: float = 10.0
    """Squared sRGB error of the composited products, per covered pixel."""
    rescaled_anchor: float = 1.0
    """Logarithm of each image's mean squared error after the least-squares gain per image and channel, which is what
    PSNR averages: a single image cannot tell albedo from exposure, and easy images count as much as hard ones."""
    materials: float = 0.5
    """Squared error of ConvNet 2's texture against what the object's true materials say, after the same gain, summed
    over the lobes, per covered pixel and colour. Renders know their materials; the paper's loss does not use them."""
    diffusion: float = 1.0
    """Squared error of v, per covered latent coefficient."""
    outside: float = 0.05
    """Weight of latents without any covered pixel, beside 1 for the others."""

    def __post_init__(self) -> None:
        if min(self.anchor, self.rescaled_anchor, self.materials, self.diffusion, self.outside) < 0:
            raise ValueError("loss weights are not negative")


def signal_and_noise(timesteps: Int[Tensor, " batch"], schedule: Any = None) -> tuple[Tensor, Tensor]:
    """alpha_t and sigma_t [batch, 1, 1, 1] of the noise schedule (left out: the embedded model's); their squares add
    up to 1."""
    cumulative = (schedule or noise_schedule()).alphas_cumprod.to(timesteps.device)[timesteps]
    return cumulative.sqrt()[:, None, None, None], (1 - cumulative).sqrt()[:, None, None, None]


def stratified_timesteps(batch: int, generator: torch.Generator) -> Int[Tensor, " batch"]:
    """Uniform timesteps, one from each of `batch` equal strata, shuffled: less variance than independent draws."""
    offsets = (torch.arange(batch) + torch.rand(batch, generator=generator)) / batch
    return (offsets[torch.randperm(batch, generator=generator)] * NUM_TRAIN_TIMESTEPS).long()


def best_gain(products: Float[Tensor, "batch 12 height width"], batch: Batch) -> Float[Tensor, "batch 12 1 1"]:
    """The gain per image and channel on coded values that brings the products' composite nearest to the target (least
    squares in linear light, within a factor of 4); without gradient."""
    ours = decode_cues(products.detach()).unflatten(1, (4, 3)).sum(1)
    truth = linear_from_srgb(batch.target / batch.alpha.clamp_min(1e-3))
    weight = batch.alpha * (batch.target < batch.alpha)
    gain = (ours * truth * weight).sum((2, 3)) / (ours.square() * weight).sum((2, 3)).clamp_min(1e-6)
    coded = gain.clamp(0.25, 4.0) ** (1 / GAMMA)
    return coded[:, :, None, None].repeat(1, 4, 1, 1)


def materials_loss(
    texture: Float[Tensor, "batch 12 height width"], batch: Batch, covered: Float[Tensor, ""] | None = None
) -> Float[Tensor, ""]:
    """Squared error of the texture against the true materials', in coded values: summed over the four lobes, mean over
    covered pixels and colours (`covered` as in `anchor_loss`)."""
    errors = (texture - true_texture(batch.surface)).square() * batch.alpha
    covered = batch.alpha.sum() if covered is None else covered
    return errors.sum() / (3 * covered).clamp_min(1.0)


def anchor_loss(
    products: Float[Tensor, "batch 12 height width"], batch: Batch, covered: Float[Tensor, ""] | None = None
) -> Float[Tensor, ""]:
    """Squared sRGB error of the composited products over covered pixels, divided by their number.

    `covered` is that number in the whole step, where `batch` is a part of it. Only where the target is saturated may
    the products be brighter than 1 for free.
    """
    covered = batch.alpha.sum() if covered is None else covered
    return _squared_errors(products, batch).sum() / (3 * covered).clamp_min(1.0)


def _squared_errors(products: Float[Tensor, "batch 12 height width"], batch: Batch) -> Tensor:
    estimate = composited_srgb(products).clamp_max(2.0) * batch.alpha
    saturated = (batch.target >= batch.alpha) & (estimate > batch.target)
    return torch.where(saturated, torch.zeros_like(estimate), estimate - batch.target).square()


def relative_loss(products: Float[Tensor, "batch 12 height width"], batch: Batch) -> Float[Tensor, ""]:
    """Sum over images of the logarithm of the mean squared sRGB error of the composited products, per covered pixel."""
    errors = _squared_errors(products, batch).sum((1, 2, 3)) / (3 * batch.alpha.sum((1, 2, 3))).clamp_min(1.0)
    return (errors + _NEGLIGIBLE_ERROR).log().sum()


def training_loss(
    model: RelightingModel,
    batch: Batch,
    draws: Draws,
    totals: Totals,
    weights: LossWeights,
    scale_momentum: float = 0.0,
) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
    """What these examples add to the step's loss, and to its parts; `scale_momentum` > 0 also lets the latent scales
    follow the data."""
    condition = model.condition(batch.masked_image, batch.coded_cues, batch.shading)
    loss = torch.zeros((), device=batch.target.device)
    parts: dict[str, Tensor] = {}
    if model.config.latent_is_residual:
        anchor = anchor_loss(condition.products, batch, totals.covered)
        parts["anchor"] = anchor.detach()
        loss = loss + weights.anchor * anchor if anchor.requires_grad else loss
        if anchor.requires_grad and (weights.rescaled_anchor > 0 or weights.materials > 0):
            gain = best_gain(condition.products, batch)
            rescaled = relative_loss(condition.products * gain, batch) / totals.examples
            loss, parts["rescaled"] = loss + weights.rescaled_anchor * rescaled, rescaled.detach()
            texture = model.conditioning.texture.texture(condition.maps, batch.masked_image, batch.shading)
            materials = materials_loss(texture * gain, batch, totals.covered)
            loss, parts["materials"] = loss + weights.materials * materials, materials.detach()
    if weights.diffusion > 0:
        diffusion = _diffusion_loss(model, batch, condition, draws, totals, weights.outside, scale_momentum)
        loss, parts["diffusion"] = loss + weights.diffusion * diffusion, diffusion.detach()
    return loss, parts


def _diffusion_loss(
    model: RelightingModel,
    batch: Batch,
    condition: Condition,
    draws: Draws,
    totals: Totals,
    outside: float,
    scale_momentum: float,
) -> Tensor:
    if model.config.latent_is_residual:
        residual = batch.target - model.anchor(condition, batch.alpha).detach()
    else:
        residual = 2 * batch.target - 1
    block = model.config.latents.block
    if scale_momentum > 0:
        model.latents.measure(residual, latent_weight(batch.alpha, block, 0.0), scale_momentum)
    latent = model.latents.encode(residual)
    noise = draws.noise(tuple(latent.shape[1:])).to(latent)
    timesteps = draws.timesteps.to(latent.device)
    signal, sigma = signal_and_noise(timesteps)
    predicted = model(signal * latent + sigma * noise, timesteps, condition)
    # Whitened coefficients count alike; weighting by their spread keeps the visible, low ones in front.
    importance = model.latents.scale / model.latents.scale.mean()
    errors = (predicted - (signal * noise - sigma * latent)).square() * importance[:, None, None]
    return (errors * latent_weight(batch.alpha, block, outside)).sum() / (totals.latents * errors.shape[1])


def control_loss(model: ControlledBase, batch: Batch, draws: Draws, totals: Totals) -> Float[Tensor, ""]:
    """Mean squared error of the noise (or of v, where the base predicts it), as the base was trained."""
    image = 2 * batch.target - 1
    shape = model.latent_shape(image.shape[2], image.shape[3])
    latent = model.base.encode(image, draws.noise(shape, "encoder").to(image))
    noise = draws.noise(shape).to(latent)
    timesteps = draws.timesteps.to(latent.device)
    schedule = model.noise_schedule()
    signal, sigma = signal_and_noise(timesteps, schedule)
    condition = model.condition(batch.masked_image, batch.coded_cues, batch.shading)
    predicted = model(signal * latent + sigma * noise, timesteps, condition).float()
    predicts_noise = schedule.config.prediction_type == "epsilon"
    wanted = noise if predicts_noise else signal * noise - sigma * latent
    return (predicted - wanted).square().sum() / (totals.examples * wanted[0].numel())


class TrainingObjective(torch.nn.Module):
    """The loss as a module, so that gradients are averaged where several processes train together."""

    def __init__(self, model: RelightingModel | ControlledBase, weights: LossWeights) -> None:
        super().__init__()
        self.model, self.weights = model, weights

    @property
    def latent_block(self) -> int:
        """Pixels per latent pixel."""
        model = self.model
        return model.base.latent_block if isinstance(model, ControlledBase) else model.config.latents.block

    def forward(
        self, batch: Batch, draws: Draws, totals: Totals, with_diffusion: bool, scale_momentum: float
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """(what to call backward on, what these examples add to the step's loss and its parts)."""
        if isinstance(self.model, ControlledBase):
            loss = control_loss(self.model, batch, draws, totals)
            parts: dict[str, Tensor] = {}
        else:
            weights = self.weights if with_diffusion else replace(self.weights, diffusion=0.0)
            loss, parts = training_loss(self.model, batch, draws, totals, weights, scale_momentum)
        return loss * totals.num_processes, {"loss": loss.detach(), **parts}
