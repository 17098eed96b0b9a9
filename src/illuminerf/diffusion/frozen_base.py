"""The frozen base: VAE, UNet, noise schedule and the empty string's embedding of a Stable-Diffusion-class folder.

Folder layout is the hub's: `unet/`, `vae/`, `scheduler/`, `text_encoder/` (and, for the padding token, `tokenizer/`),
each with a JSON config and safetensors weights, full or fp16. Nothing of it ever gets a gradient.
"""

import re
from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel
from jaxtyping import Float, Int
from torch import Tensor, nn

from illuminerf.diffusion.empty_text import load_empty_text
from illuminerf.workflow.atomic import read_json
from illuminerf.workflow.checkpoint import load_checkpoint
from illuminerf.workflow.device import full_precision
from illuminerf.workflow.errors import UserError

WEIGHTS = "diffusion_pytorch_model.safetensors"
WEIGHTS_FP16 = "diffusion_pytorch_model.fp16.safetensors"
_OLD_ATTENTION = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}


class FrozenBase(nn.Module):
    """Base UNet and VAE, without gradients and always in evaluation mode."""

    empty_text: Tensor

    def __init__(self, unet: Any, vae: Any, scheduler_config: dict[str, Any], empty_text: Tensor) -> None:
        """Args: unet: a `UNet2DConditionModel`. vae: an `AutoencoderKL`. empty_text: [text_length, width]."""
        super().__init__()
        if unet.config.in_channels != vae.config.latent_channels:
            raise UserError(
                "UNet and VAE of the base do not fit each other",
                got=f"{unet.config.in_channels} and {vae.config.latent_channels} latent channels",
                fix="take both from one base model",
            )
        if empty_text.shape[1] != unet.config.cross_attention_dim:
            raise UserError(
                "the text embedding does not fit the base's UNet",
                got=f"width {empty_text.shape[1]}",
                wanted=str(unet.config.cross_attention_dim),
            )
        self.unet, self.vae, self.scheduler_config = unet, vae, scheduler_config
        self.register_buffer("empty_text", empty_text)
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> "FrozenBase":
        """Frozen: stays in evaluation mode whatever is asked."""
        return super().train(False)

    @property
    def latent_block(self) -> int:
        """Pixels per latent pixel."""
        return 2 ** (len(self.vae.config.block_out_channels) - 1)

    def noise_schedule(self) -> Any:
        """The base's own levels of noise and kind of prediction as a `DDPMScheduler`."""
        keys = ("num_train_timesteps", "beta_start", "beta_end", "beta_schedule", "trained_betas", "prediction_type")
        known = {key: self.scheduler_config[key] for key in keys if key in self.scheduler_config}
        return DDPMScheduler(**known, clip_sample=False)

    @torch.no_grad()
    def encode(
        self, image: Float[Tensor, "batch 3 height width"], noise: Tensor | None = None
    ) -> Float[Tensor, "batch channels rows columns"]:
        """Images in [-1, 1] to scaled latents: the posterior's mean, plus its deviation times `noise` where given."""
        posterior = self.vae.encode(image).latent_dist
        latent = posterior.mean if noise is None else posterior.mean + posterior.std * noise
        return (latent.float() - self._shift) * self.vae.config.scaling_factor

    @torch.no_grad()
    def decode(self, latent: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch 3 height width"]:
        """Scaled latents to images in [-1, 1], unclipped."""
        with full_precision(latent.device):  # eight bits of mantissa would show in smooth shading
            return self.vae.decode(latent / self.vae.config.scaling_factor + self._shift, return_dict=False)[0]

    @property
    def _shift(self) -> float:
        return self.vae.config.shift_factor or 0.0

    def forward(self, noisy_latent: Tensor, timesteps: Int[Tensor, " batch"], down: Any, middle: Any) -> Tensor:
        """The base's prediction with the control's residuals added (None: the base alone)."""
        text = self.empty_text.expand(len(noisy_latent), -1, -1)
        return self.unet(
            noisy_latent,
            timesteps,
            text,
            down_block_additional_residuals=down,
            mid_block_additional_residual=middle,
            return_dict=False,
        )[0]


def load_base(folder: Path) -> FrozenBase:
    """Read a base from its folder, as float32.

    Raises:
        UserError: a file is missing or corrupt, or weights do not fit their configuration.
    """
    unet = load_network(UNet2DConditionModel, folder / "unet")
    vae = load_network(AutoencoderKL, folder / "vae")
    scheduler = read_json(folder / "scheduler" / "scheduler_config.json")
    return FrozenBase(unet, vae, scheduler, load_empty_text(folder))


def load_network(network: Any, folder: Path) -> Any:
    """Read one diffusers network from `config.json` and safetensors weights, strictly, as float32."""
    config = {key: value for key, value in read_json(folder / "config.json").items() if not key.startswith("_")}
    return filled_network(network, config, load_checkpoint(weights_file(folder))[0], folder)


def filled_network(network: Any, config: dict[str, Any], tensors: dict[str, Tensor], folder: Path) -> Any:
    """A diffusers network of `config` with these weights, as float32; `folder` is named in errors."""
    with torch.device("meta"):  # no time is lost on random weights
        model = network.from_config(config)
    try:
        model.load_state_dict(_with_new_names({k: v.float() for k, v in tensors.items()}), assign=True)
    except RuntimeError as error:
        raise UserError(
            f"the weights in {folder} do not fit their config.json",
            got=str(error).splitlines()[-1].strip(),
            fix="download them again",
        ) from error
    return model


def weights_file(folder: Path) -> Path:
    """The full weights of a network's folder, else its fp16 ones.

    Raises:
        UserError: there are none.
    """
    for name in (WEIGHTS, WEIGHTS_FP16):
        if (folder / name).is_file():
            return folder / name
    raise UserError(f"{folder} holds no weights", wanted=f"{WEIGHTS} or {WEIGHTS_FP16}", fix="put the file there")


def _with_new_names(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Attention of VAEs was stored under other names (and as 1x1 convolutions) until 2023."""
    renamed = {}
    for name, value in tensors.items():
        match = re.search(r"(attentions\.\d+)\.(query|key|value|proj_attn)\.", name)
        if match:
            name = name.replace(match[0], f"{match[1]}.{_OLD_ATTENTION[match[2]]}.")
            value = value.flatten(1) if value.ndim == 4 else value
        renamed[name] = value
    return renamed
