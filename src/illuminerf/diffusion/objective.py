"""What training minimises: v-prediction on latents (Salimans and Ho, 2022) plus, for residual latents, the anchor."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from illuminerf.diffusion.conditioning import Condition
from illuminerf.diffusion.cue_coding import GAMMA, composited_srgb, decode_cues
from illuminerf.diffusion.relighting_model import NUM_TRAIN_TIMESTEPS, RelightingModel, noise_schedule
from illuminerf.scene.images import linear_from_srgb


class Batch(NamedTuple):
    """One optimisation step's examples; sRGB over black, coded straight cues."""

    masked_image: Float[Tensor, "batch 4 height width"]
    coded_cues: Float[Tensor, "batch 12 height width"]
    target: Float[Tensor, "batch 3 height width"]
    alpha: Float[Tensor, "batch 1 height width"]


@dataclass(frozen=True)
class LossWeights:
    """How the terms are added."""

    anchor: float = 20.0
    """Squared sRGB error of the composited products, per covered pixel."""
    rescaled_anchor: float = 0.0
    """The same after the least-squares gain per image and channel: a single image cannot tell albedo from exposure,
    and without this term that part of the error outweighs shading and gloss."""
    diffusion: float = 1.0
    """Squared error of v, per covered latent coefficient."""
    outside: float = 0.05
    """Weight of latents without any covered pixel, beside 1 for the others."""

    def __post_init__(self) -> None:
        if min(self.anchor, self.rescaled_anchor, self.diffusion, self.outside) < 0:
            raise ValueError("loss weights are not negative")


def signal_and_noise(timesteps: Int[Tensor, " batch"]) -> tuple[Tensor, Tensor]:
    """alpha_t and sigma_t [batch, 1, 1, 1] of the noise schedule; their squares add up to 1."""
    cumulative = noise_schedule().alphas_cumprod.to(timesteps.device)[timesteps]
    return cumulative.sqrt()[:, None, None, None], (1 - cumulative).sqrt()[:, None, None, None]


def stratified_timesteps(batch: int, generator: torch.Generator) -> Int[Tensor, " batch"]:
    """Uniform timesteps, one from each of `batch` equal strata, shuffled: less variance than independent draws."""
    offsets = (torch.arange(batch) + torch.rand(batch, generator=generator)) / batch
    return (offsets[torch.randperm(batch, generator=generator)] * NUM_TRAIN_TIMESTEPS).long()


def rescaled_products(
    products: Float[Tensor, "batch 12 height width"], batch: Batch
) -> Float[Tensor, "batch 12 height width"]:
    """Products times the gain per image and channel that brings their composite nearest to the target (linear light,
    gain without gradient, within a factor of 4)."""
    ours = decode_cues(products.detach()).unflatten(1, (4, 3)).sum(1)
    truth = linear_from_srgb(batch.target / batch.alpha.clamp_min(1e-3))
    weight = batch.alpha * (batch.target < batch.alpha)
    gain = (ours * truth * weight).sum((2, 3)) / (ours.square() * weight).sum((2, 3)).clamp_min(1e-6)
    coded = gain.clamp(0.25, 4.0) ** (1 / GAMMA)
    return products * coded[:, :, None, None].repeat(1, 4, 1, 1)


def anchor_loss(products: Float[Tensor, "batch 12 height width"], batch: Batch) -> Float[Tensor, ""]:
    """Mean squared sRGB error of the composited products over covered pixels.

    Only where the target is saturated may the products be brighter than 1 for free.
    """
    estimate = composited_srgb(products).clamp_max(2.0) * batch.alpha
    saturated = (batch.target >= batch.alpha) & (estimate > batch.target)
    errors = torch.where(saturated, torch.zeros_like(estimate), estimate - batch.target).square()
    return errors.sum() / (3 * batch.alpha.sum()).clamp_min(1.0)


def training_loss(
    model: RelightingModel,
    batch: Batch,
    generator: torch.Generator,
    weights: LossWeights,
    scale_momentum: float = 0.0,
) -> tuple[Float[Tensor, ""], dict[str, float]]:
    """The loss of one batch and its parts; `scale_momentum` > 0 also lets the latent scales follow the data."""
    condition = model.condition(batch.masked_image, batch.coded_cues)
    loss = torch.zeros((), device=batch.target.device)
    parts: dict[str, float] = {}
    if model.config.latent_is_residual:
        anchor = anchor_loss(condition.products, batch)
        parts["anchor"] = float(anchor.detach())
        loss = loss + weights.anchor * anchor if anchor.requires_grad else loss
        if weights.rescaled_anchor > 0 and anchor.requires_grad:
            rescaled = anchor_loss(rescaled_products(condition.products, batch), batch)
            loss, parts["rescaled"] = loss + weights.rescaled_anchor * rescaled, float(rescaled.detach())
    if weights.diffusion > 0:
        diffusion = _diffusion_loss(model, batch, condition, generator, weights.outside, scale_momentum)
        loss, parts["diffusion"] = loss + weights.diffusion * diffusion, float(diffusion.detach())
    return loss, parts


def _diffusion_loss(
    model: RelightingModel,
    batch: Batch,
    condition: Condition,
    generator: torch.Generator,
    outside: float,
    scale_momentum: float,
) -> Tensor:
    if model.config.latent_is_residual:
        residual = batch.target - model.anchor(condition, batch.alpha).detach()
    else:
        residual = 2 * batch.target - 1
    covered = (functional.max_pool2d(batch.alpha, model.config.latents.block) > 0).float()
    if scale_momentum > 0:
        model.latents.measure(residual, covered, scale_momentum)
    latent = model.latents.encode(residual)
    noise = torch.randn(latent.shape, generator=generator).to(latent)
    timesteps = stratified_timesteps(len(latent), generator).to(latent.device)
    signal, sigma = signal_and_noise(timesteps)
    predicted = model(signal * latent + sigma * noise, timesteps, condition)
    # Whitened coefficients count alike; weighting by their spread keeps the visible, low ones in front.
    importance = model.latents.scale / model.latents.scale.mean()
    errors = (predicted - (signal * noise - sigma * latent)).square() * importance[:, None, None]
    weight = covered + outside * (1 - covered)
    return (errors * weight).sum() / (weight.sum() * errors.shape[1])


class TrainingObjective(torch.nn.Module):
    """`training_loss` as a module, so that gradients are averaged where several processes train together."""

    def __init__(self, model: RelightingModel, weights: LossWeights) -> None:
        super().__init__()
        self.model, self.weights = model, weights

    def forward(
        self, batch: Batch, generator: torch.Generator, with_diffusion: bool, scale_momentum: float
    ) -> tuple[Tensor, dict[str, float]]:
        weights = self.weights if with_diffusion else replace(self.weights, diffusion=0.0)
        return training_loss(self.model, batch, generator, weights, scale_momentum)
