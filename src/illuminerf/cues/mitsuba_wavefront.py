"""Pixels of Mitsuba's vectorised variants, summed in one order however many threads there are.

Mitsuba's own film adds every sample to its pixel atomically, in whatever order threads come by, so that the last bits
of a picture differ from run to run. Here the samples of a pixel stay side by side and are summed block by block.
"""

import importlib
from typing import Any

import numpy as np


def rendered_pixels(
    mi: Any, scene: Any, sensor: Any, integrator: Any, seed: int, samples_per_pixel: int
) -> tuple[np.ndarray, int]:
    """One pass of an integrator, with a box filter: what Mitsuba's own `render` gives, but for the last bits.

    Args:
        mi: Mitsuba with a variant that is not scalar.
        scene: what is seen.
        sensor: a pinhole camera with its film and sampler.
        integrator: a sampling integrator.
        seed: of the sampler, in [0, 2^32).
        samples_per_pixel: the sampler may round it up.

    Returns:
        The mean of each pixel's samples, float32 [height, width, channels]: the integrator's AOVs, or if it has none,
        linear premultiplied radiance and coverage; and how many samples were really drawn for each pixel.
    """
    dr: Any = importlib.import_module("drjit")
    width, height = (int(n) for n in sensor.film().size())
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(samples_per_pixel)
    drawn = int(sampler.sample_count())
    sampler.set_samples_per_wavefront(drawn)
    sampler.seed(seed, width * height * drawn)
    num_samples = width * height * drawn
    pixel = dr.arange(mi.UInt32, num_samples) // drawn
    corner = mi.Vector2f(mi.Float(pixel % width), mi.Float(pixel // width))
    position = (corner + sampler.next_2d()) / mi.Vector2f(width, height)
    ray, weight = sensor.sample_ray_differential(0.0, 0.0, position, mi.Point2f(0.5))
    ray.scale_differential(float(drawn**-0.5))
    spectrum, is_hit, aovs = integrator.sample(scene, sampler, ray)
    radiance = spectrum * weight
    channels = aovs or [radiance.x, radiance.y, radiance.z, dr.select(is_hit, mi.Float(1), mi.Float(0))]
    # a path of zero probability can give a NaN in single precision; it carries no light
    channels = [dr.select(dr.isfinite(c), c, 0) + dr.zeros(mi.Float, num_samples) for c in channels]
    dr.eval(*channels)
    means = [np.array(dr.block_sum(c, drawn), np.float32) / np.float32(drawn) for c in channels]
    return np.stack(means, -1).reshape(height, width, len(channels)), drawn
