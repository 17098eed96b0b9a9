"""What the relighting model is told: ConvNets 1 to 3 of the paper (supplement, "Relighting Diffusion Model").

    masked image [4] -> ConvNet 1 -> tokens, zero-padded to the text length
    masked image [4] -> ConvNet 2 -> texture [12];  texture * cues [12] -> ConvNet 3 -> additive embedding

ConvNet 4 is the first convolution of the trainable copy of the UNet and lives there.
Vocabulary: *masked image* = sRGB over black and the mask; *cues* = diffuse and three GGX lobes, RGB each, under the
target light, coded (see `cue_coding`); *shading* = the diffuse cue under the photograph's own light, coded, or zeros
where nobody knows that light (Deviation: the paper has none; the embedded model takes it as a hint); *texture* = what
multiplies the cues; *products* = texture * cues.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from illuminerf.diffusion.cue_coding import encode_cues
from illuminerf.scene.images import linear_from_srgb

NUM_CUE_CHANNELS = 12
NUM_IMAGE_CHANNELS = 4
NUM_SHADING_CHANNELS = 3
_USUAL_SHADING = 0.76  # coded: 0.55 in linear light, which training exposes a white object to
_DARKEST_SHADING = 0.17  # coded
_BRIGHTEST_SEEN = 1.02  # coded: what ConvNet 2 looks at
_BRIGHTEST_UNLIT = 1.5  # coded: what products are made of; where shading is too low by half, nothing is lost yet
_LEAST_COVERAGE = 0.05


@dataclass(frozen=True)
class PyramidConfig:
    """Widths of ConvNet 1 or ConvNet 3."""

    widths: tuple[int, ...]
    """Channels after layer 1 and after each stride-2 layer."""
    out_channels: int
    """Channels of the last, zero-initialised layer."""
    patch: int = 1
    """Pixel-unshuffle before layer 1. Deviation: 1 in the paper; small models work on few, fat pixels."""

    def __post_init__(self) -> None:
        if min(self.widths) < 1 or self.out_channels < 1 or self.patch < 1:
            raise ValueError("widths, out_channels and patch are positive")


@dataclass(frozen=True)
class TextureConfig:
    """Widths of ConvNet 2 (DiLightNet, Fig. 4)."""

    widths: tuple[int, ...] = (32, 64, 128)
    """Channels at each resolution, halved between them."""
    num_blocks: int = 4
    """Residual blocks at the lowest resolution."""
    patch: int = 1
    """Pixel-unshuffle before the first layer, undone after the last. Deviation: 1 in DiLightNet."""
    is_material: bool = False
    """Deviation: the network sees the cues beside the image (they show the shape, without which paint and shading are
    hard to tell apart) and the shading, decodes with additive skips and one block per level, and says the
    texture as non-negative offset + gain * (image / shading), so that it can be the albedo of each lobe in full
    detail (embedded model)."""
    num_attention: int = 0
    """Deviation: self-attention layers among the blocks at the lowest resolution (DiLightNet: none)."""

    def __post_init__(self) -> None:
        if not 0 <= self.num_attention <= self.num_blocks:
            raise ValueError("there is at most one attention layer per block")
        if min(self.widths) < 8 or any(width % 8 for width in self.widths):
            raise ValueError("widths are multiples of 8, for the group norms")


PAPER_TOKENS = PyramidConfig(widths=(16, 32, 64, 128, 256, 512, 512), out_channels=1024)
PAPER_EMBEDDING = PyramidConfig(widths=(16, 32, 96, 256), out_channels=320)


@dataclass(frozen=True)
class ConditioningConfig:
    """The three condition networks; the defaults are the paper's two tables and DiLightNet's ConvNet 2."""

    tokens: PyramidConfig = field(default=PAPER_TOKENS)
    """ConvNet 1 (first table); 64 tokens of 1024 at 512x512."""
    texture: TextureConfig = field(default=TextureConfig())
    """ConvNet 2."""
    embedding: PyramidConfig = field(default=PAPER_EMBEDDING)
    """ConvNet 3 (second table)."""
    text_length: int = 77
    """Tokens of the text encoder, to which ConvNet 1's are zero-padded."""
    hears_text: bool = False
    """The control attends to the text in place of ConvNet 1's tokens (DiLightNet; not in the paper)."""


class Condition(NamedTuple):
    """What is computed once per image, whatever the number of sampling steps."""

    tokens: Float[Tensor, "batch text_length width"]
    embedding: Float[Tensor, "batch channels latent_height latent_width"]
    products: Float[Tensor, "batch 12 height width"]
    maps: Float[Tensor, "batch maps height width"]
    """What ConvNet 2 itself gives: see `TextureNetwork.maps`."""

    def repeated(self, num_samples: int) -> "Condition":
        """Each image's entry `num_samples` times in a row."""
        return Condition(*(part.repeat_interleave(num_samples, 0) for part in self))


def _flax_default(layer: nn.Conv2d) -> nn.Conv2d:
    """LeCun normal, truncated at two standard deviations, and zero bias: Flax's default for convolutions."""
    std = 1 / math.sqrt(layer.weight[0].numel()) / 0.87962566103423978
    nn.init.trunc_normal_(layer.weight, std=std, a=-2 * std, b=2 * std)
    return _zero_bias(layer)


def _zero_bias(layer: nn.Conv2d) -> nn.Conv2d:
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


def _zero_initialised(layer: nn.Conv2d) -> nn.Conv2d:
    nn.init.zeros_(layer.weight)
    return _zero_bias(layer)


class ConvPyramid(nn.Sequential):
    """ConvNet 1 and ConvNet 3: [batch, in, height, width] -> [batch, out, height / 2^k, width / 2^k].

    Layer 1, then per stage one stride-1 and one stride-2 convolution, then a zero-initialised last layer; SiLU
    between layers, none after the last (paper's two tables).
    """

    def __init__(self, in_channels: int, config: PyramidConfig) -> None:
        widths = config.widths
        first = in_channels * config.patch**2
        # Unshuffled pixels already see their neighbours: a 1x1 stem keeps small models cheap.
        stem = nn.Conv2d(first, widths[0], 3, 1, 1) if config.patch == 1 else nn.Conv2d(first, widths[0], 1)
        layers: list[nn.Module] = [nn.PixelUnshuffle(config.patch)] if config.patch > 1 else []
        layers += [_flax_default(stem), nn.SiLU()]
        for width, next_width in zip(widths[:-1], widths[1:], strict=True):
            layers += [_flax_default(nn.Conv2d(width, width, 3, 1, 1)), nn.SiLU()]
            layers += [_flax_default(nn.Conv2d(width, next_width, 3, 2, 1)), nn.SiLU()]
        layers.append(_zero_initialised(nn.Conv2d(widths[-1], config.out_channels, 3, 1, 1)))
        super().__init__(*layers)


class ResidualBlock(nn.Module):
    """x + conv3(SiLU(GroupNorm8(conv3 x))) on [batch, width, height, width]."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(width, width, 3, 1, 1),
            nn.GroupNorm(8, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, 1, 1),
        )

    def forward(self, features: Tensor) -> Tensor:
        return features + self.layers(features)


class SelfAttention(nn.Module):
    """x + attention(GroupNorm8 x) over all places of [batch, width, height, width], in heads of 32 channels."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.num_heads = max(1, width // 32)
        self.norm = nn.GroupNorm(8, width)
        self.project = nn.Conv2d(width, 3 * width, 1)
        self.out = _zero_initialised(nn.Conv2d(width, width, 1))

    def forward(self, features: Tensor) -> Tensor:
        rows, columns = features.shape[-2:]
        heads = self.project(self.norm(features)).flatten(2).unflatten(1, (3, self.num_heads, -1))
        query, key, value = heads.transpose(-1, -2).unbind(1)
        mixed = functional.scaled_dot_product_attention(query, key, value).transpose(-1, -2)
        return features + self.out(mixed.flatten(1, 2).unflatten(-1, (rows, columns)).contiguous())


class TextureNetwork(nn.Module):
    """ConvNet 2: masked image [batch, 4, height, width] (and cues) -> texture [batch, 12, height, width]."""

    def __init__(self, config: TextureConfig) -> None:
        super().__init__()
        self.config = config
        widths, patch = config.widths, config.patch
        seen = NUM_CUE_CHANNELS + 2 * NUM_SHADING_CHANNELS if config.is_material else 0
        first = (NUM_IMAGE_CHANNELS + seen) * patch**2
        self.stem = nn.Conv2d(first, widths[0], 3, 1, 1) if patch == 1 else nn.Conv2d(first, widths[0], 1)
        self.downs = nn.ModuleList(
            nn.Sequential(nn.Conv2d(fine, coarse, 3, 2, 1), nn.GroupNorm(8, coarse), nn.SiLU())
            for fine, coarse in zip(widths[:-1], widths[1:], strict=True)
        )
        self.blocks = nn.Sequential(*(ResidualBlock(widths[-1]) for _ in range(config.num_blocks)))
        self.attentions = nn.ModuleList(SelfAttention(widths[-1]) for _ in range(config.num_attention))
        self.ups = nn.ModuleList(
            nn.Sequential(nn.ConvTranspose2d(coarse, fine, 4, 2, 1), nn.GroupNorm(8, fine), nn.SiLU())
            for coarse, fine in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        # A material needs two maps per channel: an offset and a gain on the image.
        num_maps = NUM_CUE_CHANNELS * (2 if config.is_material else 1)
        self.refines = nn.ModuleList(ResidualBlock(width) for width in widths[-2::-1] if config.is_material)
        last = (widths[0], num_maps * patch**2, 3 if patch == 1 else 1, 1, int(patch == 1))
        self.out = nn.Conv2d(*last)
        if config.is_material:
            # What is certain with the shading is a guess without it: each case has a last layer of its own.
            self.lit_out = nn.Conv2d(*last)
            _start_as_unlit_image(self.out, patch)
            _start_as_unlit_image(self.lit_out, patch)

    def maps(
        self,
        masked_image: Float[Tensor, "batch 4 height width"],
        coded_cues: Float[Tensor, "batch 12 height width"],
        shading: Float[Tensor, "batch 3 height width"],
    ) -> Float[Tensor, "batch maps height width"]:
        """What the network itself gives: the texture, or a material's offsets and gains (24 maps)."""
        patch, seen = self.config.patch, masked_image
        if self.config.is_material:
            albedo = unlit(masked_image, shading).clamp_max(_BRIGHTEST_SEEN)
            seen = torch.cat([masked_image, coded_cues, shading, albedo], 1)
        features = functional.silu(self.stem(functional.pixel_unshuffle(seen, patch)))
        skips = []
        for down in self.downs:
            skips.append(features)
            features = down(features)
        for index, block in enumerate(self.blocks):
            features = block(features)
            if index < len(self.attentions):
                features = self.attentions[index](features)
        for level, up in enumerate(self.ups):
            features = up(features)
            if self.config.is_material:
                features = self.refines[level](features + skips.pop())
        maps = self.out(features)
        if self.config.is_material:
            maps = torch.where(_is_known(shading), self.lit_out(features), maps)
        return functional.pixel_shuffle(maps, patch)

    def texture(
        self,
        maps: Float[Tensor, "batch maps height width"],
        masked_image: Float[Tensor, "batch 4 height width"],
        shading: Float[Tensor, "batch 3 height width"],
    ) -> Float[Tensor, "batch 12 height width"]:
        """The texture from the maps, the image and its shading; all may be larger than the network's own input."""
        if not self.config.is_material:
            return maps
        albedo = unlit(masked_image, shading)
        offset, gain = maps.float().chunk(2, 1)
        diffuse = offset[:, :3] + gain[:, :3].clamp(-3, 3).exp() * albedo
        specular = offset[:, 3:] + gain[:, 3:] * albedo.repeat(1, NUM_CUE_CHANNELS // 3 - 1, 1, 1)
        return torch.cat([functional.softplus(diffuse, beta=16.0), functional.softplus(specular, beta=8.0)], 1)

    def forward(
        self,
        masked_image: Float[Tensor, "batch 4 height width"],
        coded_cues: Float[Tensor, "batch 12 height width"],
        shading: Float[Tensor, "batch 3 height width"],
    ) -> Float[Tensor, "batch 12 height width"]:
        return self.texture(self.maps(masked_image, coded_cues, shading), masked_image, shading)


def unlit(
    masked_image: Float[Tensor, "batch 4 height width"], shading: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch 3 height width"]:
    """The straight image divided by its shading, which is the albedo of a matt object, coded as cues are; where the
    shading is unknown (all zeros), divided by the usual one."""
    straight = (masked_image[:, :3] / masked_image[:, 3:].clamp_min(_LEAST_COVERAGE)).clamp(0, 1)
    divisor = shading.clamp_min(_DARKEST_SHADING).where(_is_known(shading), _USUAL_SHADING)
    return (encode_cues(linear_from_srgb(straight)) / divisor).clamp_max(_BRIGHTEST_UNLIT)


def _is_known(shading: Float[Tensor, "batch 3 height width"]) -> Bool[Tensor, "batch 1 1 1"]:
    return shading.amax((1, 2, 3), keepdim=True) > 0


def _start_as_unlit_image(last: nn.Conv2d, patch: int) -> None:
    """Before training: a rough dielectric, diffuse texture = image / shading and 0.04 of the roughest lobe."""
    start = torch.zeros(2, NUM_CUE_CHANNELS)
    start[0, 3:9], start[0, 9:] = -0.3, 0.208
    with torch.no_grad():
        nn.init.zeros_(last.weight)
        assert last.bias is not None
        last.bias.copy_(start.reshape(-1).repeat_interleave(patch**2))


class Conditioning(nn.Module):
    """ConvNets 1 to 3 together."""

    def __init__(self, config: ConditioningConfig) -> None:
        super().__init__()
        self.config = config
        self.tokens = None if config.hears_text else ConvPyramid(NUM_IMAGE_CHANNELS, config.tokens)
        self.texture = TextureNetwork(config.texture)
        self.embedding = ConvPyramid(NUM_CUE_CHANNELS, config.embedding)

    def forward(
        self,
        masked_image: Float[Tensor, "batch 4 height width"],
        coded_cues: Float[Tensor, "batch 12 height width"],
        text: Float[Tensor, "text_length channels"] | None = None,
        shading: Float[Tensor, "batch 3 height width"] | None = None,
    ) -> Condition:
        """Run ConvNets 1 to 3.

        Args:
            masked_image: sRGB over black in [0, 1], then the mask.
            coded_cues: as the model's cue coding gives them.
            text: what the control hears where there is no ConvNet 1.
            shading: the coded diffuse cue under the photograph's own light; left out or zeros: unknown.
        """
        if shading is None:
            shading = torch.zeros_like(masked_image[:, :NUM_SHADING_CHANNELS])
        maps = self.texture.maps(masked_image, coded_cues, shading)
        products = self.texture.texture(maps, masked_image, shading) * coded_cues
        if self.tokens is not None:
            tokens = padded_tokens(self.tokens(masked_image), self.config.text_length)
        elif text is not None:
            tokens = text.expand(len(masked_image), -1, -1)
        else:
            raise ValueError("without ConvNet 1 a text embedding is needed")
        return Condition(tokens, self.embedding(products), products, maps)


def padded_tokens(
    features: Float[Tensor, "batch width rows columns"], text_length: int
) -> Float[Tensor, "batch text_length width"]:
    """Flatten to tokens and append zeros up to `text_length` (64 to 77 in the paper)."""
    tokens = features.flatten(2).transpose(1, 2)
    if tokens.shape[1] > text_length:
        raise ValueError(f"{tokens.shape[1]} tokens do not fit into a text of {text_length}")
    return functional.pad(tokens, (0, 0, 0, text_length - tokens.shape[1]))
