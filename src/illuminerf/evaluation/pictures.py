"""Pictures that show where a prediction is wrong."""

from dataclasses import dataclass

import numpy as np

from illuminerf.scene.images import srgb_from_linear

FULL_SCALE = 0.25
"""Absolute error, in sRGB values, that is drawn white."""
_HUES_DEGREES = (300.0, 460.0)
_CHROMA = 0.15
"""Within sRGB at every lightness on the way between the hues."""


@dataclass(frozen=True)
class Rendering:
    """One method's picture of a view, beside what is wrong with it."""

    method: str
    srgb: np.ndarray
    """[height, width, 3] on white, as it is scored."""
    error: np.ndarray
    """[height, width, 3]: see `error_map`."""
    psnr: float
    """Of this view, in dB."""


@dataclass(frozen=True)
class ViewPictures:
    """All there is to see of one test view under one light; arrays [height, width, 3], sRGB on white."""

    name: str
    input_light: np.ndarray | None
    """The true view under the light of the photographs, where the benchmark has it."""
    renderings: tuple[Rendering, ...]
    truth: np.ndarray


@dataclass(frozen=True)
class CellPictures:
    """Some views of one scene under one light."""

    scene: str
    light: str
    views: tuple[ViewPictures, ...]
    notes: tuple[str, ...]
    """What is missing and why, a sentence each."""


def error_map(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """float32 [height, width, 3]: mean absolute error over channels in the colours of `error_colours`."""
    return error_colours(np.abs(np.subtract(prediction, truth, dtype=np.float32)).mean(axis=-1))


def error_colours(error: np.ndarray) -> np.ndarray:
    """float32 [..., 3] in sRGB: from black at 0 through violet, red and ochre to white at FULL_SCALE.

    Perceptual: lightness is proportional to `error` [...], in sRGB values, in the Oklab space (Ottosson 2020).
    """
    level = np.clip(np.asarray(error, np.float64) / FULL_SCALE, 0, 1)
    first, last = np.deg2rad(_HUES_DEGREES)
    hue = first + (last - first) * level
    chroma = _CHROMA * np.sin(np.pi * level)
    a, b = chroma * np.cos(hue), chroma * np.sin(hue)
    long = (level + 0.3963377774 * a + 0.2158037573 * b) ** 3
    middle = (level - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (level - 0.0894841775 * a - 1.2914855480 * b) ** 3
    red = 4.0767416621 * long - 3.3077115913 * middle + 0.2309699292 * short
    green = -1.2684380046 * long + 2.6097574011 * middle - 0.3413193965 * short
    blue = -0.0041960863 * long - 0.7034186147 * middle + 1.7076147010 * short
    return np.clip(srgb_from_linear(np.stack([red, green, blue], axis=-1)), 0, 1).astype(np.float32)


def side_by_side(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """float32 [height, 3 width, 3]: prediction, truth, error map."""
    return np.concatenate([prediction, truth, error_map(prediction, truth)], axis=1).astype(np.float32)
