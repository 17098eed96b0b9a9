"""Drawing relit images: ancestral DDPM (the paper's) and few-step samplers, without guidance."""

from typing import Any, Literal

import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from jaxtyping import Float
from torch import Tensor

from illuminerf.diffusion.conditioning import Condition
from illuminerf.diffusion.relighter import Relighter
from illuminerf.diffusion.relighting_model import noise_schedule
from illuminerf.workflow.device import torch_generator

Sampler = Literal["ddpm", "ddim", "dpm_solver"]


def sampling_schedule(sampler: Sampler, num_steps: int, trained: Any = None) -> Any:
    """A diffusers scheduler set to `num_steps`, the first at the noisiest timestep ("trailing" spacing).

    Args:
        sampler: which one.
        num_steps: denoising steps.
        trained: the model's noise schedule; the embedded model's where it is left out.
    """
    config = (trained or noise_schedule()).config
    scheduler: Any
    if sampler == "ddpm":
        scheduler = DDPMScheduler.from_config(config, timestep_spacing="trailing")
    elif sampler == "ddim":
        scheduler = DDIMScheduler.from_config(config, timestep_spacing="trailing", set_alpha_to_one=True)
    else:
        scheduler = DPMSolverMultistepScheduler.from_config(
            config, timestep_spacing="trailing", algorithm_type="dpmsolver++", final_sigmas_type="zero"
        )
    scheduler.set_timesteps(num_steps)
    return scheduler


@torch.inference_mode()
def sample_decoded(
    model: Relighter,
    condition: Condition,
    seeds: list[list[int]],
    num_steps: int,
    sampler: Sampler,
    temperature: float = 1.0,
    samples_at_once: int = 0,
) -> Float[Tensor, "batch samples 3 height width"]:
    """Decoded latents as they are: residuals to the anchor, or images in [-1, 1] (arguments as `sample_relit`)."""
    num_samples = len(seeds[0])
    if len(seeds) != len(condition.products) or any(len(row) != num_samples for row in seeds):
        raise ValueError("seeds are one list per image, all of one length")
    at_once = samples_at_once or num_samples
    drawn = [
        _drawn(model, condition, [row[first : first + at_once] for row in seeds], num_steps, sampler, temperature)
        for first in range(0, num_samples, at_once)
    ]
    return torch.cat(drawn, 1) if len(drawn) > 1 else drawn[0]


def _drawn(
    model: Relighter,
    condition: Condition,
    seeds: list[list[int]],
    num_steps: int,
    sampler: Sampler,
    temperature: float,
) -> Float[Tensor, "batch samples 3 height width"]:
    """All samples of `seeds` in one batch."""
    device = condition.products.device
    generators = [torch_generator(seed, "sample") for row in seeds for seed in row]
    height, width = condition.products.shape[2:]
    shape = model.latent_shape(height, width)
    noise = torch.stack([torch.randn(shape, generator=generator) for generator in generators])
    latent = temperature * noise.to(device)
    repeated = condition.repeated(len(seeds[0]))
    scheduler = sampling_schedule(sampler, num_steps, model.noise_schedule())
    extra = {"generator": generators} if sampler == "ddpm" else {}
    for timestep in scheduler.timesteps:
        steps = torch.full((len(latent),), int(timestep), device=device)
        # Under autocast the network answers in few bits; the latent itself is kept in float32.
        predicted = model(latent, steps, repeated).float()
        latent = scheduler.step(predicted, timestep, latent, return_dict=False, **extra)[0]
    return model.decode(latent).float().unflatten(0, (len(seeds), len(seeds[0])))


@torch.inference_mode()
def sample_relit(
    model: Relighter,
    masked_image: Float[Tensor, "batch 4 height width"],
    coded_cues: Float[Tensor, "batch 12 height width"],
    seeds: list[list[int]],
    num_steps: int = 8,
    sampler: Sampler = "ddim",
    temperature: float = 1.0,
    samples_at_once: int = 0,
    shading: Float[Tensor, "batch 3 height width"] | None = None,
) -> Float[Tensor, "batch samples 3 height width"]:
    """Draw relit images: sRGB over black in [0, 1].

    Args:
        masked_image: sRGB over black in [0, 1], then the mask; sides are multiples of the latent's block.
        coded_cues: straight cues under the target light, coded as the model wants them (`code_cues`).
        seeds: one list per image, of equal length: one seed per sample. A seed alone decides a sample's noise,
            whatever else is in the batch.
        num_steps: denoising steps.
        sampler: the scheduler.
        temperature: factor on the initial noise; below 1 samples stay nearer to their mean (not in the paper).
        samples_at_once: samples per image in one batch, to save memory; 0: all.
        shading: coded diffuse cue under the image's own light; left out or zeros: unknown.
    """
    condition = model.condition(masked_image, coded_cues, shading)
    decoded = sample_decoded(model, condition, seeds, num_steps, sampler, temperature, samples_at_once)
    if model.latent_is_residual:
        relit = decoded + model.anchor(condition, masked_image[:, 3:])[:, None]
    else:
        relit = (decoded + 1) / 2
    # Over black no value exceeds the coverage; multiplying would darken partly covered pixels twice.
    return torch.minimum(relit.clamp_min(0), masked_image[:, None, 3:])
