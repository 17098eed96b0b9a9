"""The relighting diffusion model: base UNet, its controlled copy, the condition networks, the latents.

In diffusers' terms a `ControlNetModel` whose conditioning embedding is replaced by ours (`Conditioning`), computed
outside of it so that it runs once per image and not once per step. Folder layout is the hub's:
`unet/`, `controlnet/`, `conditioning/`, `vae/`, `scheduler/`, each with a JSON config and a safetensors file.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from diffusers import ControlNetModel, DDPMScheduler, UNet2DConditionModel
from jaxtyping import Float, Int
from torch import Tensor, nn

from illuminerf.diffusion.conditioning import (
    Condition,
    Conditioning,
    ConditioningConfig,
    PyramidConfig,
    TextureConfig,
)
from illuminerf.diffusion.cue_coding import CueCoding, composited_srgb, encode_cues
from illuminerf.diffusion.latents import PatchLatentConfig, PatchLatents
from illuminerf.diffusion.relighter import Piece
from illuminerf.diffusion.resizing import resized
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.errors import UserError

NUM_TRAIN_TIMESTEPS = 1000


@dataclass(frozen=True)
class UNetConfig:
    """Widths of the base UNet; the controlled copy has those of its encoder and middle block."""

    block_out_channels: tuple[int, ...] = (48, 96)
    """Channels per resolution, the first at the latent's."""
    attention_blocks: tuple[bool, ...] = (False, True)
    """Which resolutions of the encoder attend to the tokens."""
    decoder_attends: bool = False
    """Whether the base's decoder has attention too, at the mirrored resolutions."""
    layers_per_block: int = 1
    """Residual blocks per resolution."""
    cross_attention_dim: int = 96
    """Width of a token."""
    num_heads: int = 4
    """Attention heads."""
    norm_num_groups: int = 16
    """Group norm."""

    def __post_init__(self) -> None:
        if len(self.block_out_channels) != len(self.attention_blocks):
            raise ValueError("one entry of attention_blocks per entry of block_out_channels")


@dataclass(frozen=True)
class RelightingModelConfig:
    """Sizes of everything; the defaults are the embedded model's."""

    image_size: int = 128
    """Pixels per side that it was trained at."""
    latents: PatchLatentConfig = field(default=PatchLatentConfig(block=8, keep=2))
    """The stand-in for a VAE."""
    unet: UNetConfig = field(default=UNetConfig())
    """The base."""
    conditioning: ConditioningConfig = field(
        default=ConditioningConfig(
            tokens=PyramidConfig(widths=(32, 48, 64), out_channels=96, patch=4),
            texture=TextureConfig(widths=(96, 192, 320), num_blocks=4, patch=4, is_material=True, num_attention=2),
            embedding=PyramidConfig(widths=(32, 48), out_channels=48, patch=4),
        )
    )
    """ConvNets 1 to 3."""
    latent_is_residual: bool = True
    """Deviation: diffuse what the composited products leave over, not the image itself; the products carry full
    detail and the mean, the diffusion the ambiguity and what the products cannot say."""

    def __post_init__(self) -> None:
        if self.conditioning.embedding.out_channels != self.unet.block_out_channels[0]:
            raise ValueError("ConvNet 3's output is added to ConvNet 4's, so their widths are equal")
        if self.conditioning.hears_text:
            raise ValueError("a base of our own knows no text, so ConvNet 1 is needed")
        if self.conditioning.tokens.out_channels != self.unet.cross_attention_dim:
            raise ValueError("ConvNet 1's output width is the cross-attention width")


class RelightingModel(nn.Module):
    """p(relit image | image, cues): all networks together."""

    empty_text: Tensor

    def __init__(self, config: RelightingModelConfig) -> None:
        super().__init__()
        self.config = config
        self.base = build_base(config)
        self.control = ControlNetModel.from_unet(self.base)
        self.control.controlnet_cond_embedding = nn.Identity()  # ours is in `conditioning`, once per image
        self.conditioning = Conditioning(config.conditioning)
        self.latents = PatchLatents(config.latents)
        # The base hears the empty string only (paper); a base of our own has no text encoder, so zeros.
        empty = torch.zeros(config.conditioning.text_length, config.unet.cross_attention_dim)
        self.register_buffer("empty_text", empty)

    @property
    def frozen_prefixes(self) -> tuple[str, ...]:
        """What is not trained, by the beginning of its name in the state dict: nothing."""
        return ()

    @property
    def device(self) -> torch.device:
        """See `Relighter`."""
        return self.control.conv_in.weight.device

    @property
    def image_size(self) -> int:
        """See `Relighter`."""
        return self.config.image_size

    @property
    def cue_coding(self) -> CueCoding:
        """See `Relighter`."""
        return "power"

    @property
    def latent_is_residual(self) -> bool:
        """See `Relighter`."""
        return self.config.latent_is_residual

    def noise_schedule(self) -> Any:
        """See `Relighter`."""
        return noise_schedule()

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """See `Relighter`."""
        block = self.config.latents.block
        return self.config.latents.channels, height // block, width // block

    def condition(
        self,
        masked_image: Float[Tensor, "batch 4 height width"],
        coded_cues: Float[Tensor, "batch 12 height width"],
        shading: Float[Tensor, "batch 3 height width"] | None = None,
    ) -> Condition:
        """ConvNets 1 to 3, once per image."""
        return self.conditioning(masked_image, coded_cues, shading=shading)

    def anchor(
        self, condition: Condition, alpha: Float[Tensor, "batch 1 height width"]
    ) -> Float[Tensor, "batch 3 height width"]:
        """The image that latents are relative to: sRGB over black, in [0, 1]; zeros where the latent is the image."""
        if not self.config.latent_is_residual:
            return torch.zeros_like(condition.products[:, :3])
        return composited_srgb(condition.products).clamp_max(1.0) * alpha

    def decode(self, latent: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch 3 height width"]:
        """See `Relighter`."""
        return self.latents.decode(latent)

    def at_full_size(
        self,
        decoded: Float[Tensor, "batch samples 3 height width"],
        condition: Condition,
        pieces: list[Piece],
    ) -> list[Float[Tensor, "samples 3 side side"]]:
        """Detail comes back the way it went in: the material maps (offsets and gains on the image) and the sampled
        residual are smooth and are enlarged; photograph, cues and shading, which carry the detail, are used at full
        size."""
        results = []
        for index, piece in enumerate(pieces):
            image, side = piece.masked_image[None], piece.masked_image.shape[-1]
            relit = resized(decoded[index], side)
            if self.config.latent_is_residual:
                maps = resized(condition.maps[index : index + 1], side)
                shading = encode_cues(piece.linear_shading[None])
                texture = self.conditioning.texture.texture(maps, image, shading)
                products = texture * encode_cues(piece.linear_cues[None])
                composite = composited_srgb(products)
                relit = relit + composite.clamp_max(1) * image[:, 3:]
                # What is saturated keeps how bright it is, for whoever exposes it differently.
                relit = relit + (relit >= image[:, 3:]) * (composite - 1).clamp_min(0) * image[:, 3:]
            else:
                relit = (relit + 1) / 2
            results.append(relit)
        return results

    def forward(
        self, noisy_latent: Tensor, timesteps: Int[Tensor, " batch"], condition: Condition
    ) -> Float[Tensor, "batch channels rows columns"]:
        """Predict v = alpha_t noise - sigma_t latent (Salimans and Ho, 2022)."""
        down, middle = self.control(noisy_latent, timesteps, condition.tokens, condition.embedding, return_dict=False)
        text = self.empty_text.expand(len(noisy_latent), -1, -1)
        return self.base(
            noisy_latent,
            timesteps,
            text,
            down_block_additional_residuals=down,
            mid_block_additional_residual=middle,
            return_dict=False,
        )[0]


def build_base(config: RelightingModelConfig) -> Any:
    """The base, a `UNet2DConditionModel` (diffusers leaves it partly untyped), with fresh weights."""
    unet = config.unet
    down = tuple("CrossAttnDownBlock2D" if attends else "DownBlock2D" for attends in unet.attention_blocks)
    up = tuple(
        "CrossAttnUpBlock2D" if attends and unet.decoder_attends else "UpBlock2D"
        for attends in reversed(unet.attention_blocks)
    )
    return UNet2DConditionModel(
        sample_size=config.image_size // config.latents.block,
        in_channels=config.latents.channels,
        out_channels=config.latents.channels,
        down_block_types=down,
        up_block_types=up,
        block_out_channels=unet.block_out_channels,
        layers_per_block=unet.layers_per_block,
        cross_attention_dim=unet.cross_attention_dim,
        attention_head_dim=unet.num_heads,  # diffusers' name for the number of heads
        norm_num_groups=unet.norm_num_groups,
        use_linear_projection=True,
    )


def noise_schedule() -> Any:
    """A `DDPMScheduler` with cosine schedule and v-prediction.

    Its last timestep is noise alone up to 5e-5 of signal, as few-step sampling needs.
    """
    return DDPMScheduler(
        num_train_timesteps=NUM_TRAIN_TIMESTEPS,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="v_prediction",
        clip_sample=False,
    )


_PARTS = {"unet": "base.", "controlnet": "control.", "conditioning": "conditioning.", "vae": "latents."}
_WEIGHTS = "diffusion_pytorch_model.safetensors"


def save_model(model: RelightingModel, folder: Path, half: bool = False) -> None:
    """Write the model in the hub's folder layout; `half` stores weights as float16."""
    model.base.save_config(folder / "unet")
    model.control.save_config(folder / "controlnet")
    noise_schedule().save_config(folder / "scheduler")
    state = model.state_dict()
    for part, prefix in _PARTS.items():
        tensors = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        save_checkpoint(folder / part / _WEIGHTS, {k: v.half() if half else v for k, v in tensors.items()}, {})
    write_json(folder / "relighting_model.json", to_json(model.config))


def load_model(folder: Path, device: torch.device | str = "cpu") -> RelightingModel:
    """Read what `save_model` wrote, as float32, in evaluation mode.

    Raises:
        UserError: a file is missing or corrupt, or the weights do not fit the configuration.
    """
    folder = Path(folder)
    try:
        config = from_json(RelightingModelConfig, read_json(folder / "relighting_model.json"))
    except ValueError as error:
        raise UserError(f"{folder / 'relighting_model.json'} is inconsistent", got=str(error)) from error
    model = RelightingModel(config)
    state = {"empty_text": model.empty_text}
    for part, prefix in _PARTS.items():
        tensors, _ = load_checkpoint(folder / part / _WEIGHTS)
        state |= {prefix + name: tensor.float() for name, tensor in tensors.items()}
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise UserError(
            f"the weights in {folder} do not fit its configuration",
            got=str(error).splitlines()[-1].strip(),
            fix="download or export the folder again",
        ) from error
    return model.to(device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
