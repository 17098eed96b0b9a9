"""Drawing relit images: ancestral DDPM (the paper's) and few-step samplers, without guidance."""

from typing import Any, Literal

import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from jaxtyping import Float
from torch import Tensor

from illuminerf.diffusion.conditioning import Condition
from illuminerf.diffusion.relighting_model import RelightingModel, noise_schedule
from illuminerf.workflow.device import torch_generator

Sampler = Literal["ddpm", "ddim", "dpm_solver"]


def sampling_schedule(sampler: Sampler, num_steps: int) -> Any:
    """A diffusers scheduler set to `num_steps`, the first at the noisiest timestep ("trailing" spacing)."""
    config = noise_schedule().config
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
    model: RelightingModel,
    condition: Condition,
    seeds: list[list[int]],
    num_steps: int,
    sampler: Sampler,
    temperature: float = 1.0,
) -> Float[Tensor, "batch samples 3 height width"]:
    """Decoded latents as they are: residuals to the anchor, or images in [-1, 1] (arguments as `sample_relit`)."""
    num_samples = len(seeds[0])
    if len(seeds) != len(condition.products) or any(len(row) != num_samples for row in seeds):
        raise ValueError("seeds are one list per image, all of one length")
    device = condition.products.device
    generators = [torch_generator(seed, "sample") for row in seeds for seed in row]
    block = model.config.latents.block
    height, width = condition.products.shape[2:]
    shape = (model.config.latents.channels, height // block, width // block)
    noise = torch.stack([torch.randn(shape, generator=generator) for generator in generators])
    latent = temperature * noise.to(device)
    repeated = condition.repeated(num_samples)
    scheduler = sampling_schedule(sampler, num_steps)
    extra = {"generator": generators} if sampler == "ddpm" else {}
    for timestep in scheduler.timesteps:
        steps = torch.full((len(latent),), int(timestep), device=device)
        predicted = model(latent, steps, repeated)
        latent = scheduler.step(predicted, timestep, latent, return_dict=False, **extra)[0]
    return model.latents.decode(latent).unflatten(0, (len(seeds), num_samples))


@torch.inference_mode()
def sample_relit(
    model: RelightingModel,
    masked_image: Float[Tensor, "batch 4 height width"],
    coded_cues: Float[Tensor, "batch 12 height width"],
    seeds: list[list[int]],
    num_steps: int = 8,
    sampler: Sampler = "ddim",
    temperature: float = 1.0,
) -> Float[Tensor, "batch samples 3 height width"]:
    """Draw relit images: sRGB over black in [0, 1].

    Args:
        masked_image: sRGB over black in [0, 1], then the mask; sides are multiples of the latent's block.
        coded_cues: straight cues under the target light, coded by `encode_cues`.
        seeds: one list per image, of equal length: one seed per sample. A seed alone decides a sample's noise,
            whatever else is in the batch.
        num_steps: denoising steps.
        sampler: the scheduler.
        temperature: factor on the initial noise; below 1 samples stay nearer to their mean (not in the paper).
    """
    condition = model.condition(masked_image, coded_cues)
    decoded = sample_decoded(model, condition, seeds, num_steps, sampler, temperature)
    if model.config.latent_is_residual:
        relit = decoded + model.anchor(condition, masked_image[:, 3:])[:, None]
    else:
        relit = (decoded + 1) / 2
    # Over black no value exceeds the coverage; multiplying would darken partly covered pixels twice.
    return torch.minimum(relit.clamp_min(0), masked_image[:, None, 3:])
