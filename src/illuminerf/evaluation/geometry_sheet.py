"""A picture of how an estimated surface differs from the true one, view by view."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from illuminerf.evaluation.benchmark_rule import on_white
from illuminerf.evaluation.geometry_scores import FULL_SCALE_DEGREES, angles_degrees
from illuminerf.evaluation.pictures import FULL_SCALE, error_colours

_LABEL_HEIGHT, _TEXT = 16, 11
_TITLES = (
    "photograph",
    "rendered",
    "true normals",
    "estimated normals",
    f"error, white: {FULL_SCALE_DEGREES:.0f} degrees",
)


@dataclass(frozen=True)
class SurfaceView:
    """One unseen view; images [height, width, ...]."""

    photograph: np.ndarray
    """Straight sRGB and alpha."""
    rendered: np.ndarray
    """Straight sRGB and alpha."""
    true_normals: np.ndarray
    """Unit, in the world."""
    true_coverage: np.ndarray
    normals: np.ndarray
    """Unit, of the estimate."""
    coverage: np.ndarray


def covered_by_both(view: SurfaceView) -> np.ndarray:
    """bool [height, width]: pixels whose normals are compared."""
    return (view.true_coverage > 0.5) & (view.coverage > 0.5)


def contact_sheet(views: Sequence[SurfaceView]) -> np.ndarray:
    """float32 [.., .., 3] in [0, 1]: a row per view of photograph, rendering, true normals, estimated normals, error.

    In the error map only one of both surfaces covers what is cyan.
    """
    rows = [np.concatenate(_cells(view), 1) for view in views]
    width = views[0].photograph.shape[1]
    header = np.concatenate([_text(title, width) for title in _TITLES], 1)
    return np.concatenate([header, *rows]).astype(np.float32)


def _cells(view: SurfaceView) -> list[np.ndarray]:
    error = error_colours(angles_degrees(view.true_normals, view.normals) * (FULL_SCALE / FULL_SCALE_DEGREES))
    differs = (view.true_coverage > 0.5) != (view.coverage > 0.5)
    error = np.where(covered_by_both(view)[..., None], error, np.where(differs[..., None], [0, 0.7, 0.7], 0))
    return [
        on_white(view.photograph),
        on_white(view.rendered),
        _drawn(view.true_normals, view.true_coverage),
        _drawn(view.normals, view.coverage),
        error,
    ]


def _drawn(normals: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    return on_white(np.dstack([normals * 0.5 + 0.5, coverage]))


def _text(text: str, width: int) -> np.ndarray:
    strip = Image.new("RGB", (width, _LABEL_HEIGHT), "white")
    ImageDraw.Draw(strip).text((2, 1), text, fill="black", font=ImageFont.load_default(_TEXT))
    return np.asarray(strip, np.float32) / 255
