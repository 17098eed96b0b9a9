"""Drawing relit images: ancestral DDPM (the paper's) and few-step samplers, without guidance."""

from typing import Any, Literal

import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from jaxtyping import Float
from torch import Tensor

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
def sample_relit(
    model: RelightingModel,
    masked_image: Float[Tensor, "batch 4 height width"],
    coded_cues: Float[Tensor, "batch 12 height width"],
    seeds: list[list[int]],
    num_steps: int = 8,
    sampler: Sampler = "ddim",
) -> Float[Tensor, "batch samples 3 height width"]:
    """Draw relit images: sRGB over black in [0, 1].

    Args:
        masked_image: sRGB over black in [0, 1], then the mask; sides are multiples of the latent's block.
        coded_cues: straight cues under the target light, coded by `encode_cues`.
        seeds: one list per image, of equal length: one seed per sample. A seed alone decides a sample's noise,
            whatever else is in the batch.
    """
    num_samples = len(seeds[0])
    if len(seeds) != len(masked_image) or any(len(row) != num_samples for row in seeds):
        raise ValueError("seeds are one list per image, all of one length")
    device = masked_image.device
    generators = [torch_generator(seed, "sample") for row in seeds for seed in row]
    condition = model.condition(masked_image, coded_cues)
    alpha = masked_image[:, 3:]
    anchor = model.anchor(condition, alpha)
    condition = condition.repeated(num_samples)

    block = model.config.latents.block
    shape = (model.config.latents.channels, masked_image.shape[2] // block, masked_image.shape[3] // block)
    latent = torch.stack([torch.randn(shape, generator=generator) for generator in generators]).to(device)
    scheduler = sampling_schedule(sampler, num_steps)
    extra = {"generator": generators} if sampler == "ddpm" else {}
    for timestep in scheduler.timesteps:
        steps = torch.full((len(latent),), int(timestep), device=device)
        predicted = model(latent, steps, condition)
        latent = scheduler.step(predicted, timestep, latent, return_dict=False, **extra)[0]

    relit = model.latents.decode(latent).unflatten(0, (len(masked_image), num_samples))
    if not model.config.latent_is_residual:
        relit = (relit + 1) / 2
    return (relit + anchor[:, None]).clamp(0, 1) * alpha[:, None]
