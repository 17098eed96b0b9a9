"""What samplers, scores and stages need of a relighting model, whichever kind it is.

Two kinds: `RelightingModel` (the embedded one, small, base of our own) and `ControlledBase` (the paper's: a frozen
Stable-Diffusion-class base under a control, 512x512; the published DiLightNet weights are of this kind).
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from illuminerf.diffusion.conditioning import Condition
from illuminerf.diffusion.cue_coding import CueCoding


class Piece(NamedTuple):
    """A square cut out of a photograph, at full size, with its cues."""

    masked_image: Float[Tensor, "4 side side"]
    """sRGB over black in [0, 1], then alpha."""
    linear_cues: Float[Tensor, "12 side side"]
    """Straight linear radiance under the target light."""
    linear_shading: Float[Tensor, "3 side side"]
    """Straight diffuse cue under the photograph's own light; zeros: unknown."""


@runtime_checkable
class Relighter(Protocol):
    """p(relit image | image, cues) as a denoiser of latents."""

    @property
    def device(self) -> torch.device:
        """Where its weights are."""

    @property
    def image_size(self) -> int:
        """Pixels per side that it works at."""

    @property
    def cue_coding(self) -> CueCoding:
        """How cues enter the networks."""

    @property
    def latent_is_residual(self) -> bool:
        """Whether decoded latents are added to an anchor (embedded model) or are the image."""

    def noise_schedule(self) -> Any:
        """A `DDPMScheduler` with the levels of noise it was trained at and what it predicts."""

    def latent_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """(channels, rows, columns) of the latent of an image."""

    def condition(
        self,
        masked_image: Float[Tensor, "batch 4 height width"],
        coded_cues: Float[Tensor, "batch 12 height width"],
        shading: Float[Tensor, "batch 3 height width"] | None = None,
    ) -> Condition:
        """What is computed once per image; `shading` (see `conditioning`) is a hint that a model need not take."""

    def anchor(
        self, condition: Condition, alpha: Float[Tensor, "batch 1 height width"]
    ) -> Float[Tensor, "batch 3 height width"]:
        """The image that latents are relative to; zeros where they are not."""

    def __call__(
        self, noisy_latent: Tensor, timesteps: Int[Tensor, " batch"], condition: Condition
    ) -> Float[Tensor, "batch channels rows columns"]:
        """What the schedule says is predicted: noise or v."""

    def decode(self, latent: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch 3 height width"]:
        """Latents to residuals of sRGB, or to images in [-1, 1]."""

    def at_full_size(
        self,
        decoded: Float[Tensor, "batch samples 3 height width"],
        condition: Condition,
        pieces: list[Piece],
    ) -> list[Float[Tensor, "samples 3 side side"]]:
        """Decoded latents as sRGB over black (unclipped) at the size of each photograph's piece."""
