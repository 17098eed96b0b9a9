"""The paper's relighting model: a frozen base under a trainable copy of its encoder, fed by ConvNets 1 to 4.

In diffusers' terms a `ControlNetModel` whose conditioning embedding is replaced by one module of ours (`Conditioning`:
ConvNets 1 to 3), which runs once per image and not once per step; ConvNet 4 is the copy's `conv_in`. The published
DiLightNet weights are the same without ConvNet 1 (see `dilightnet`).

Folder: `relighting_model.json`, `controlnet/`, `conditioning/`, with safetensors weights. The base stays where it is:
named by hub id or folder in the JSON file.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from diffusers import ControlNetModel
from jaxtyping import Float, Int
from torch import Tensor, nn

from illuminerf.diffusion.conditioning import Condition, Conditioning, ConditioningConfig
from illuminerf.diffusion.cue_coding import CueCoding
from illuminerf.diffusion.frozen_base import WEIGHTS, FrozenBase, load_network, weights_file
from illuminerf.diffusion.relighter import Piece
from illuminerf.diffusion.resizing import resized
from illuminerf.workflow.atomic import read_json, write_json
from illuminerf.workflow.checkpoint import load_checkpoint, save_checkpoint
from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class ControlledBaseConfig:
    """The paper's architecture on a base; widths of the base are its own affair."""

    base: str = ""
    """Hub id or folder of a Stable-Diffusion-class model, which stays frozen."""
    revision: str = ""
    """The hub's revision of it, "" for the one that is known or newest."""
    image_size: int = 512
    """Pixels per side that the control is trained at (paper: 512)."""
    cue_coding: CueCoding = "power"
    """How cues enter the networks."""
    conditioning: ConditioningConfig = field(default=ConditioningConfig())
    """ConvNets 1 to 3."""

    def __post_init__(self) -> None:
        if self.image_size < 8:
            raise ValueError("image_size is at least 8 pixels")


class ControlledBase(nn.Module):
    """p(relit image | image, cues): the frozen base, its controlled copy and the condition networks."""

    def __init__(self, config: ControlledBaseConfig, base: FrozenBase, control: Any = None) -> None:
        """Args: control: a `ControlNetModel`; a fresh copy of the base's encoder where it is left out.

        Raises:
            UserError: the configured ConvNets do not fit the base.
        """
        super().__init__()
        self.config = config
        self.base = base
        self.control = (control or ControlNetModel.from_unet(base.unet)).float()
        self.control.requires_grad_(True)
        self.control.controlnet_cond_embedding = nn.Identity()  # ours is in `conditioning`, once per image
        self.conditioning = Conditioning(config.conditioning)
        self._check()

    def _check(self) -> None:
        unet, conditioning = self.base.unet.config, self.config.conditioning
        wanted = (conditioning.text_length, unet.cross_attention_dim, unet.block_out_channels[0])
        tokens = unet.cross_attention_dim if conditioning.hears_text else conditioning.tokens.out_channels
        got = (len(self.base.empty_text), tokens, conditioning.embedding.out_channels)
        if got != wanted:
            raise UserError(
                "the condition networks do not fit the base",
                got=f"text length, token width and embedding channels {got}",
                wanted=f"{wanted} as in the base",
                fix="set conditioning.tokens.out_channels and conditioning.embedding.out_channels to the base's widths",
            )

    @property
    def frozen_prefixes(self) -> tuple[str, ...]:
        """What is not trained, by the beginning of its name in the state dict."""
        return ("base.",)

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
        return self.config.cue_coding

    @property
    def latent_is_residual(self) -> bool:
        """See `Relighter`."""
        return False

    def noise_schedule(self) -> Any:
        """See `Relighter`."""
        return self.base.noise_schedule()

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """See `Relighter`."""
        block = self.base.latent_block
        return self.base.unet.config.in_channels, height // block, width // block

    def condition(
        self,
        masked_image: Float[Tensor, "batch 4 height width"],
        coded_cues: Float[Tensor, "batch 12 height width"],
        shading: Float[Tensor, "batch 3 height width"] | None = None,
    ) -> Condition:
        """ConvNets 1 to 3, once per image; the paper's ConvNet 2 takes no hint, so `shading` changes nothing."""
        return self.conditioning(masked_image, coded_cues, self.base.empty_text)

    def anchor(
        self, condition: Condition, alpha: Float[Tensor, "batch 1 height width"]
    ) -> Float[Tensor, "batch 3 height width"]:
        """See `Relighter`."""
        return torch.zeros_like(condition.products[:, :3])

    def decode(self, latent: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch 3 height width"]:
        """See `Relighter`; image by image, for the decoder is what needs the most memory."""
        return torch.cat([self.base.decode(one) for one in latent.split(1)])

    def at_full_size(
        self,
        decoded: Float[Tensor, "batch samples 3 height width"],
        condition: Condition,
        pieces: list[Piece],
    ) -> list[Float[Tensor, "samples 3 side side"]]:
        """Enlarged or reduced as they are."""
        sides = [piece.masked_image.shape[-1] for piece in pieces]
        return [resized((images + 1) / 2, side) for images, side in zip(decoded, sides, strict=True)]

    def forward(
        self, noisy_latent: Tensor, timesteps: Int[Tensor, " batch"], condition: Condition
    ) -> Float[Tensor, "batch channels rows columns"]:
        """Predict what the base predicts: noise or v."""
        down, middle = self.control(noisy_latent, timesteps, condition.tokens, condition.embedding, return_dict=False)
        return self.base(noisy_latent, timesteps, down, middle)


def save_controlled(model: ControlledBase, folder: Path) -> None:
    """Write everything but the base."""
    model.control.save_config(folder / "controlnet")
    save_checkpoint(folder / "controlnet" / WEIGHTS, model.control.state_dict(), {})
    save_checkpoint(folder / "conditioning" / WEIGHTS, model.conditioning.state_dict(), {})
    write_json(folder / "relighting_model.json", to_json(model.config))


def read_config(folder: Path) -> ControlledBaseConfig:
    """`relighting_model.json` of a folder that `save_controlled` wrote.

    Raises:
        UserError: it is missing or inconsistent.
    """
    try:
        return from_json(ControlledBaseConfig, read_json(folder / "relighting_model.json"))
    except ValueError as error:
        raise UserError(f"{folder / 'relighting_model.json'} is inconsistent", got=str(error)) from error


def load_controlled(folder: Path, base: FrozenBase) -> ControlledBase:
    """Read what `save_controlled` wrote, in evaluation mode.

    Raises:
        UserError: a file is missing or corrupt, or weights do not fit.
    """
    control = load_network(ControlWithoutEmbedding, folder / "controlnet")
    model = ControlledBase(read_config(folder), base, control)
    tensors, _ = load_checkpoint(weights_file(folder / "conditioning"))
    fill_conditioning(model, tensors, folder)
    return model.eval()


def fill_conditioning(model: ControlledBase, tensors: dict[str, Tensor], folder: Path) -> None:
    """Load the condition networks' weights, strictly; `folder` is named in errors."""
    try:
        model.conditioning.load_state_dict({name: value.float() for name, value in tensors.items()})
    except RuntimeError as error:
        raise UserError(
            f"the condition networks in {folder} do not fit its configuration",
            got=str(error).splitlines()[-1].strip(),
            fix="download or export the folder again",
        ) from error


class ControlWithoutEmbedding:
    """Makes `ControlNetModel`s whose conditioning embedding is gone, as `ControlledBase` has them."""

    @staticmethod
    def from_config(config: dict[str, Any]) -> Any:
        control = ControlNetModel.from_config(config)
        control.controlnet_cond_embedding = nn.Identity()
        return control
