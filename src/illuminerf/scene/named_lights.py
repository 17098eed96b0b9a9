"""Lights made from formulas, known by name wherever a light's file can be given."""

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from illuminerf.scene.environment import EnvironmentMap, is_low_range
from illuminerf.scene.procedural import evening_light, studio_light
from illuminerf.workflow.errors import UserError

_HEIGHT = 128


@dataclass(frozen=True)
class NamedLight:
    """What a light is like, and its formula."""

    description: str
    make: Callable[[int], EnvironmentMap]
    """From the number of rows."""


def lamps_light(height: int = _HEIGHT) -> EnvironmentMap:
    """Three small bright lamps of different tints in a dim room."""
    directions = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32), "lamps").directions()
    image = np.full(directions.shape, 0.05)
    for azimuth, elevation, tint in ((-1.9, 0.8, (1, 0.9, 0.8)), (0.5, 0.5, (0.8, 0.9, 1)), (1.9, -0.2, (1, 1, 1))):
        flat = np.cos(elevation)
        centre = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])
        image[directions @ centre > np.cos(0.1)] = 60 * np.array(tint)
    return EnvironmentMap(image.astype(np.float32), "lamps")


def overcast_light(height: int = _HEIGHT) -> EnvironmentMap:
    """A grey sky, brightest at the zenith, over darker green ground."""
    up = EnvironmentMap(np.ones((height, 2 * height, 3), np.float32), "overcast").directions()[..., 2:]
    sky = np.array([0.85, 0.92, 1.0]) * (1 + 2 * np.maximum(up, 0)) / 2.2
    return EnvironmentMap(np.where(up > 0, sky, np.array([0.10, 0.14, 0.07])).astype(np.float32), "overcast")


NAMED_LIGHTS = {
    "studio": NamedLight("grey room, a large soft box in front and a small warm one behind at the side", studio_light),
    "evening": NamedLight("low orange sun from behind, blue sky: long shadows", evening_light),
    "lamps": NamedLight("three small tinted lamps in a dim room: hard shadows, sharp highlights", lamps_light),
    "overcast": NamedLight("bright grey sky over dark ground: hardly a shadow", overcast_light),
}


def find_light(light: Path, ldr_peak: float = 1.0) -> EnvironmentMap:
    """The light in a file, or the one of that name where there is no such file.

    Args:
        ldr_peak: radiance that the white of a PNG or JPEG stands for.

    Raises:
        UserError: there is neither, or the file holds no light.
    """
    if Path(light).is_file():
        return EnvironmentMap.load(light, ldr_peak)
    if str(light) not in NAMED_LIGHTS:
        close = difflib.get_close_matches(str(light).lower(), NAMED_LIGHTS, n=1)
        raise UserError(
            f"the light {light} is a folder" if Path(light).is_dir() else f"the light {light} does not exist",
            wanted=f"an .exr, .hdr, .png or .jpg file, or one of {', '.join(NAMED_LIGHTS)}",
            fix=f"did you mean {close[0]}?" if close else "check the path, or see 'illuminerf lights list'",
        )
    return NAMED_LIGHTS[str(light)].make(_HEIGHT)


def light_file(light: Path, folder: Path, ldr_peak: float = 1.0) -> Path:
    """A file that holds the light as it is meant: its own, or <folder>/<name>.exr for a name and for an expanded PNG or
    JPEG."""
    if Path(light).is_file() and (ldr_peak == 1 or not is_low_range(light)):
        return light
    path = folder / f"{Path(light).stem}.exr"
    if not path.exists():
        find_light(light, ldr_peak).save(path)
    return path
