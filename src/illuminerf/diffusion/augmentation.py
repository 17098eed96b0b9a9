"""From rendered items to training examples: augmentations that are exact for light transport.

Targets and cues are linear in the light, so any non-negative, tinted mixture of an item's lights is again a correct
pair of cues and target. Further: one RGB permutation for everything, mirror images, quarter turns, exposure, and random
materials
composited from the cues (not exact, so only a share of the examples, never for evaluation).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from illuminerf.diffusion.cue_coding import CueCoding, code_cues, encode_cues
from illuminerf.diffusion.materials import composited
from illuminerf.diffusion.objective import Batch
from illuminerf.diffusion.training_items import TrainingItem, diffuse_level
from illuminerf.scene.images import srgb_from_linear

TRAINING_LEVEL = 0.55
"""Mean diffuse cue over an object, that is the mean radiance of a white one, which examples are exposed to."""


class Example(NamedTuple):
    """One relighting; linear and straight."""

    image: Float[Tensor, "3 height width"]
    """Under the input light."""
    cues: Float[Tensor, "12 height width"]
    """Under the target light."""
    target: Float[Tensor, "3 height width"]
    """Under the target light."""
    alpha: Float[Tensor, "1 height width"]
    """Coverage."""
    surface: Float[Tensor, "5 height width"]
    """Base colour, metallicity, roughness."""
    shading: Float[Tensor, "3 height width"]
    """Diffuse cue under the input light, as far as it is known; zeros: not at all."""


@dataclass(frozen=True)
class AugmentationConfig:
    """How examples are varied."""

    composited_share: float = 0.3
    """Share of examples whose material is random and composited from the cues; never where these are dented, since
    the pictures would have the dents too."""
    mixture_share: float = 0.5
    """Share of input and of target lights that are mixtures of two rendered lights rather than one."""
    tint: float = 0.2
    """Standard deviation of the log gain per colour channel of each light in a mixture."""
    exposure: float = 0.4
    """Standard deviation of the log exposure of input and target, independently."""
    unknown_shading_share: float = 0.5
    """Share of examples whose shading under the input light is kept from the model."""
    shading_error: float = 0.25
    """How wrong the others' shading is: another light mixed in, contrast and colours changed; 0: exact."""
    turns: bool = True
    """Turn pictures by quarters: light and view turn together, so cues and target still agree."""
    level: float = TRAINING_LEVEL
    """Median over examples of the mean diffuse cue (a white object's mean radiance)."""

    def __post_init__(self) -> None:
        shares = (self.composited_share, self.mixture_share, self.unknown_shading_share)
        if not all(0 <= share <= 1 for share in shares):
            raise ValueError("shares are between 0 and 1")
        if min(self.tint, self.exposure, self.level, self.shading_error) < 0:
            raise ValueError("tint, exposure, level and shading_error are not negative")


def make_batch(
    items: list[TrainingItem],
    config: AugmentationConfig,
    generators: Sequence[torch.Generator],
    coding: CueCoding = "power",
) -> Batch:
    """Draw one example per generator, each from its own alone."""
    examples = []
    for generator in generators:
        item = items[_integer(len(items), generator)]
        albedo_item = items[_integer(len(items), generator)]
        examples.append(_example(item, albedo_item, config, generator))
    return stack_examples(examples, coding)


def stack_examples(examples: list[Example], coding: CueCoding = "power") -> Batch:
    """Examples to a coded batch in channels-last layout."""
    image, cues, target, alpha, surface, shading = (torch.stack(parts) for parts in zip(*examples, strict=True))
    masked = torch.cat([srgb_from_linear(image).clamp_max(1) * alpha, alpha], 1)
    coded = code_cues(cues, alpha, coding)
    target = srgb_from_linear(target).clamp_max(1) * alpha
    tensors = (masked, coded, target, alpha, surface, encode_cues(shading))
    return Batch(*(tensor.contiguous(memory_format=torch.channels_last) for tensor in tensors))


def plain_example(
    item: TrainingItem,
    input_light: int,
    target_light: int,
    level: float = TRAINING_LEVEL,
    knows_shading: bool = False,
) -> Example:
    """No augmentation: one light to another, both exposed to the same diffuse level. For evaluation.

    Args:
        item: what is relit.
        input_light, target_light: numbers of its lights.
        level: mean diffuse cue.
        knows_shading: whether the model is told the diffuse cue under the input light.
    """
    alpha = item.alpha.float()
    cues = item.cues.float()
    gains = [level / diffuse_level(cues[light], alpha) for light in (input_light, target_light)]
    target = item.targets[target_light].float() * gains[1]
    image = item.targets[input_light].float() * gains[0]
    shading = cues[input_light, :3] * gains[0] * knows_shading
    return Example(image, cues[target_light] * gains[1], target, alpha, surface_of(item), shading)


def _example(
    item: TrainingItem, albedo_item: TrainingItem, config: AugmentationConfig, generator: torch.Generator
) -> Example:
    alpha = item.alpha.float()
    order = torch.randperm(len(item.targets), generator=generator).tolist()
    channels = torch.randperm(3, generator=generator)
    mixtures = [_mixture(order, config, generator), _mixture(order[::-1], config, generator)]
    is_composited = _uniform(generator) < config.composited_share and not item.is_dented
    surface = _random_surface(item, albedo_item, generator) if is_composited else surface_of(item)
    images, cue_stacks, gains = [], [], []
    for weights in mixtures:
        cues = _mixed(item.cues, weights.repeat(1, 4))
        target = composited(surface, cues) if is_composited else _mixed(item.targets, weights)
        gain = config.level / diffuse_level(cues, alpha)
        gain = gain * torch.exp(config.exposure * torch.randn((), generator=generator))
        gains.append(gain)
        images.append((target * gain)[channels])
        cue_stacks.append((cues * gain).unflatten(0, (4, 3))[:, channels].flatten(0, 1))
    surface = torch.cat([surface[:3][channels], surface[3:]])
    shading = torch.zeros_like(images[0])
    if _uniform(generator) >= config.unknown_shading_share:
        shading = gains[0] * _estimated_shading(item, mixtures[0], order[-1], alpha, config, generator)[channels]
    example = Example(images[0], cue_stacks[1], images[1], alpha, surface, shading)
    is_mirrored, quarter_turns = _uniform(generator) < 0.5, 0
    if config.turns:
        quarter_turns = _integer(4, generator)
    turned = (torch.rot90(tensor, quarter_turns, (-2, -1)) for tensor in example)
    return Example(*(tensor.flip(-1) if is_mirrored else tensor for tensor in turned))


def _estimated_shading(
    item: TrainingItem,
    mixture: Tensor,
    wrong_light: int,
    alpha: Float[Tensor, "1 height width"],
    config: AugmentationConfig,
    generator: torch.Generator,
) -> Float[Tensor, "3 height width"]:
    """The diffuse cue under an input light as an estimate of that light might give it; linear.

    Wrong in direction (another light mixed in), contrast (a power about the mean), brightness and colour (gains).
    """
    error, mixture = config.shading_error, mixture.clone()
    if _uniform(generator) < 0.7:
        tint = torch.exp(config.tint * torch.randn(3, generator=generator))
        mixture[wrong_light] += 0.6 * error * _uniform(generator) * mixture.sum(0).mean() * tint
    shading = _mixed(item.cues[:, :3], mixture)
    mean = ((shading * alpha).sum((1, 2), keepdim=True) / alpha.sum().clamp_min(1e-3)).clamp_min(1e-4)
    power = 1 + error * (0.45 * _uniform(generator) - 0.3)
    gains = 0.2 * torch.randn((), generator=generator) + 0.15 * torch.randn(3, generator=generator)
    return mean * (shading / mean).clamp_min(1e-4) ** power * torch.exp(error * gains)[:, None, None]


def composited_target(
    item: TrainingItem, albedo_item: TrainingItem, cues: Float[Tensor, "12 height width"], generator: torch.Generator
) -> Float[Tensor, "3 height width"]:
    """What an item would look like in a random material, from its cues alone; linear, straight."""
    return composited(_random_surface(item, albedo_item, generator), cues)


def _mixture(order: list[int], config: AugmentationConfig, generator: torch.Generator) -> Tensor:
    """Weights [lights, 3] of one light, or of two, tinted; the first of `order` dominates."""
    weights = torch.zeros(len(order), 3)
    weights[order[0]] = 1.0
    if _uniform(generator) < config.mixture_share:
        weights[order[0]] = torch.exp(config.tint * torch.randn(3, generator=generator))
        other = torch.exp(config.tint * torch.randn(3, generator=generator))
        weights[order[1 % len(order)]] += _uniform(generator) * other
    return weights


def _mixed(lights: Float[Tensor, "lights channels height width"], weights: Tensor) -> Tensor:
    used = weights.sum(1).nonzero()[:, 0].tolist()
    return sum(  # type: ignore[return-value]
        lights[light].float() * weights[light][:, None, None] for light in used
    )


def _random_surface(
    item: TrainingItem, albedo_item: TrainingItem, generator: torch.Generator
) -> Float[Tensor, "5 height width"]:
    """Own, borrowed or plain base colour with a random tone curve, one metallicity and one roughness."""
    kind = _uniform(generator)
    tint = torch.rand(3, 1, 1, generator=generator)
    if kind < 0.2:
        albedo = tint**2 + 0 * item.albedo.float()
    else:
        source = (item if kind < 0.5 else albedo_item).albedo.float()
        # Outside its own object a borrowed texture is black: mirror-fill is not worth it, grey is.
        covered = (item if kind < 0.5 else albedo_item).alpha.float()
        source = source * covered + 0.2 * (1 - covered)
        albedo = source.clamp(1e-3, 1) ** (0.5 + _uniform(generator)) * (0.4 + 0.6 * tint)
    plane = torch.ones_like(item.roughness, dtype=torch.float32)
    metallic = float(_uniform(generator) < 0.25) * plane
    return torch.cat([albedo.clamp(0.01, 0.95), metallic, (0.03 + 0.77 * _uniform(generator)) * plane])


def surface_of(item: TrainingItem) -> Float[Tensor, "5 height width"]:
    """An item's own linear base colour, metallicity and roughness."""
    return torch.cat([plane.float() for plane in (item.albedo, item.metallic, item.roughness)])


def _integer(limit: int, generator: torch.Generator) -> int:
    return int(torch.randint(limit, (), generator=generator))


def _uniform(generator: torch.Generator) -> float:
    return float(torch.rand((), generator=generator))
