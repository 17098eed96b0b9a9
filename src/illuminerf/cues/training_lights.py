"""Random lights for training pairs: shifted, flipped and brought to a usable brightness (paper, supplement)."""

from dataclasses import dataclass

import numpy as np

from illuminerf.scene.environment import EnvironmentMap

# Mean radiance of training lights: a photographer's exposure keeps most captures within this range of brightness.
MEAN_RADIANCE_RANGE = (0.25, 1.5)


@dataclass(frozen=True)
class LightDraw:
    """How one training light was made from a map, in this order."""

    name: str
    """The map's name."""
    rotation_radians: float
    """Turn about +z, a whole number of pixel columns."""
    is_flipped: bool
    """Upside down: rows in reverse order."""
    scale: float
    """Factor on the radiance."""


def mean_radiance(light: EnvironmentMap) -> float:
    """Radiance averaged over the sphere and the channels."""
    height = light.linear_rgb.shape[0]
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    weights = (edges[:-1] - edges[1:]) / 2
    return float((light.linear_rgb.mean((1, 2)) * weights).sum())


def draw_light(
    light: EnvironmentMap, generator: np.random.Generator, flip_probability: float
) -> tuple[EnvironmentMap, LightDraw]:
    """Shift, flip and scale a light at random.

    Deviation: the paper states no exposure rule. The scale is the least change that brings the mean radiance into
    `MEAN_RADIANCE_RANGE`.
    """
    width = light.linear_rgb.shape[1]
    rotation = float(generator.integers(width)) * 2 * np.pi / width
    is_flipped = bool(generator.random() < flip_probability)
    mean = mean_radiance(light)
    scale = float(np.clip(mean, *MEAN_RADIANCE_RANGE) / mean)
    turned = light.rotated(rotation).linear_rgb * np.float32(scale)
    rows = turned[::-1] if is_flipped else turned
    drawn = EnvironmentMap(np.ascontiguousarray(rows), light.name)
    return drawn, LightDraw(light.name, rotation, is_flipped, scale)
