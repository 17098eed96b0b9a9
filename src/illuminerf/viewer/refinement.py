"""Coarse at once, finer while the camera stands still: which sizes are rendered, and when to give up."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from illuminerf.scene.cameras import Cameras
from illuminerf.viewer.renderer import Look, Picture, ViewRenderer

_FIRST_SECONDS = 0.12  # about what the first picture may take
_BAND_SECONDS = 0.15  # and how long a change may wait for an old one
_STEP = 2.0  # in side length, from one picture to the next
_LEAST_SIDE = 48


@dataclass
class Speed:
    """Pixels a second, by mode, as measured so far."""

    pixels_per_second: dict[str, float]

    @classmethod
    def unknown(cls) -> "Speed":
        """Nothing measured yet: a cautious start."""
        return cls({})

    def of(self, mode: str) -> float:
        """The estimate for a mode."""
        return self.pixels_per_second.get(mode, 2e4)

    def measured(self, mode: str, pixels: int, seconds: float) -> None:
        """Count a picture; recent ones weigh more."""
        now = pixels / max(seconds, 1e-4)
        self.pixels_per_second[mode] = now if mode not in self.pixels_per_second else (self.of(mode) * now) ** 0.5


def sizes(full: int, pixels_per_second: float, aspect: float) -> list[int]:
    """Longest sides from a first one that is quick to `full`; aspect is longer over shorter side."""
    first = int((pixels_per_second * _FIRST_SECONDS * aspect) ** 0.5)
    side = min(max(first, _LEAST_SIDE), full)
    found = [side]
    while side * _STEP < full * 0.75:
        side = int(side * _STEP)
        found.append(side)
    return found if found[-1] == full else [*found, full]


def refined(
    renderer: ViewRenderer,
    camera: Callable[[int], Cameras],
    look: Look,
    full: int,
    speed: Speed,
    is_stale: Callable[[], bool],
) -> Iterator[tuple[Picture, float]]:
    """Pictures of growing size with the seconds each took; ends early once `is_stale` says so.

    Args:
        camera: the camera with so many pixels along its longest side.
    """
    probe = camera(full)
    aspect = max(probe.width, probe.height) / min(probe.width, probe.height)
    for side in sizes(full, speed.of(look.mode), aspect):
        view = camera(side)
        rows = max(4, int(speed.of(look.mode) * _BAND_SECONDS / view.width))
        start, bands = time.monotonic(), []
        for band in renderer.bands(view, look, rows):
            bands.append(band)
            if is_stale():
                return
        seconds = time.monotonic() - start
        speed.measured(look.mode, view.width * view.height, seconds)
        yield (
            Picture(np.concatenate([band.srgb for band in bands]), np.concatenate([band.depth for band in bands])),
            seconds,
        )
