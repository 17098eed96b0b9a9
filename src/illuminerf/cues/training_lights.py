"""Random lights for training pairs: shifted, flipped, recoloured, of usable brightness (paper, supplement)."""

from dataclasses import dataclass

import numpy as np

from illuminerf.scene.environment import EnvironmentMap
from illuminerf.workflow.errors import UserError


@dataclass(frozen=True)
class LightVariation:
    """How a map becomes a training light (paper, supplement "Training Data Processing")."""

    shifts: bool = True
    """Turn the map about the vertical axis by a random whole number of its columns."""
    flip_probability: float = 0.5
    """How often a map is turned upside down."""
    shuffle_probability: float = 0.5
    """How often the colour channels of a map change places (each of the six orders equally often).
    Deviation: the paper says that channels are shuffled, not how often."""
    lowest_mean_radiance: float = 0.25
    """Exposure rule, lower end. The scale of a light is the least change that brings its mean radiance over the sphere
    into [lowest, highest], the range in which a photographer's exposure keeps most captures.
    Deviation: the paper states no rule."""
    highest_mean_radiance: float = 1.5
    """Exposure rule, upper end."""

    def __post_init__(self) -> None:
        if not (0 <= self.flip_probability <= 1 and 0 <= self.shuffle_probability <= 1):
            got = f"{self.flip_probability:g} and {self.shuffle_probability:g}"
            raise UserError("probabilities of flips and shuffles are out of range", got=got, wanted="values in [0, 1]")
        if not 0 < self.lowest_mean_radiance <= self.highest_mean_radiance:
            raise UserError(
                "the range of mean radiance is empty or not positive",
                got=f"{self.lowest_mean_radiance:g} to {self.highest_mean_radiance:g}",
                wanted="0 < lowest <= highest",
            )


@dataclass(frozen=True)
class LightDraw:
    """How one training light was made from a map, in this order."""

    name: str
    """The map's name."""
    rotation_radians: float
    """Turn about +z, a whole number of pixel columns."""
    is_flipped: bool
    """Upside down: rows in reverse order."""
    permutation: tuple[int, int, int]
    """Channel i of the light is channel permutation[i] of the map."""
    scale: float
    """Factor on the radiance."""


def draw_light(
    light: EnvironmentMap, generator: np.random.Generator, variation: LightVariation
) -> tuple[EnvironmentMap, LightDraw]:
    """Shift, flip, recolour and scale a light at random."""
    width = light.linear_rgb.shape[1]
    column = int(generator.integers(width)) if variation.shifts else 0
    rotation = column * 2 * np.pi / width
    is_flipped = bool(generator.random() < variation.flip_probability)
    is_shuffled = bool(generator.random() < variation.shuffle_probability)
    order = generator.permutation(3) if is_shuffled else np.arange(3)
    mean = float(light.mean_radiance().mean())
    scale = float(np.clip(mean, variation.lowest_mean_radiance, variation.highest_mean_radiance) / mean)
    turned = light.rotated(rotation).linear_rgb[..., order] * np.float32(scale)
    rows = turned[::-1] if is_flipped else turned
    drawn = EnvironmentMap(np.ascontiguousarray(rows), light.name)
    first, second, third = (int(channel) for channel in order)
    return drawn, LightDraw(light.name, rotation, is_flipped, (first, second, third), scale)
