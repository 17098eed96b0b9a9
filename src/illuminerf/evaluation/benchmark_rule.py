"""The TensoIR benchmark's scoring rule (conventions: the paper's authors' script).

Truth on white in sRGB. One factor per channel for all views of a light: the median ratio of truth to
prediction over the masked pixels. It is applied inside the mask; PSNR and SSIM are over the whole image and
averaged over views.
"""

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from illuminerf.evaluation.metrics import ImageMetric, psnr, ssim
from illuminerf.evaluation.rescaling import least_squares_scale, median_ratio, rescaled_inside

Rescale = Literal["median", "least_squares", "none"]
MASK_THRESHOLD = 0.5
MAX_THREADS = 8
"""Each thread holds one view, some 100 MB at 800 x 800."""


@dataclass(frozen=True)
class ViewPair:
    """A prediction and the truth of one view; arrays in sRGB, [0, 1], on white."""

    prediction: np.ndarray
    """float64 [height, width, 3]."""
    truth: np.ndarray
    """float64 [height, width, 3]."""
    mask: np.ndarray
    """bool [height, width]: the truth's alpha above MASK_THRESHOLD."""


@dataclass(frozen=True)
class LightScores:
    """Scores of one scene under one light."""

    psnr: tuple[float, ...]
    """Per view, in dB."""
    ssim: tuple[float, ...]
    lpips: tuple[float, ...]
    """Per view; empty where LPIPS is not computed."""
    scale: tuple[float, float, float]
    """The factor that each channel of the prediction was multiplied by."""


@runtime_checkable
class ViewPairs(Protocol):
    """Views that may be read from disk when they are indexed; a list of ViewPair is one."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> ViewPair: ...


def on_white(rgba: np.ndarray) -> np.ndarray:
    """[height, width, 3]: straight sRGB over white, mixed in sRGB values as the benchmark does."""
    if rgba.shape[-1] == 3:
        return rgba
    alpha = rgba[..., 3:]
    return rgba[..., :3] * alpha + (1 - alpha)


def view_pair(prediction: np.ndarray, truth_rgba: np.ndarray) -> ViewPair:
    """The pair of a prediction (RGB on white, or straight RGBA) and a straight RGBA truth, as 8-bit files.

    Both are taken to the nearest of 256 levels in float64: factors are quotients of such levels, and whether
    their products fall on a level or just below it decides what the rule's cut to 8 bits leaves.
    """
    prediction, truth = (np.round(image.astype(np.float64) * 255) / 255 for image in (prediction, truth_rgba))
    return ViewPair(on_white(prediction), on_white(truth), truth[..., 3] > MASK_THRESHOLD)


def channel_scale(pairs: Iterable[ViewPair], rescale: Rescale) -> np.ndarray:
    """float64 [3]: the factor under the rule `rescale`, over the masked pixels of all `pairs`."""
    if rescale == "none":
        return np.ones(3)
    masked = ((pair.truth[pair.mask], pair.prediction[pair.mask]) for pair in pairs)
    return median_ratio(masked) if rescale == "median" else least_squares_scale(masked)


def rescaled_prediction(pair: ViewPair, scale: np.ndarray, rescale: Rescale) -> np.ndarray:
    """The prediction that is scored: rescaled and cut to 8 bits inside the mask, or untouched under
    "none".
    """
    return pair.prediction if rescale == "none" else rescaled_inside(pair.prediction, pair.mask, scale)


def score_light(
    pairs: ViewPairs,
    rescale: Rescale = "median",
    scale_views: Sequence[int] | None = None,
    lpips: ImageMetric | None = None,
) -> LightScores:
    """Score all views of one scene under one light.

    `pairs` may load each view when it is indexed: each is asked for at most twice. `scale_views` are the
    positions that the factor is taken from (the benchmark: every 10th of its 200), by default all.
    """
    chosen = range(len(pairs)) if scale_views is None else scale_views
    scale = channel_scale((pairs[index] for index in chosen), rescale)

    def score_view(index: int) -> tuple[float, float, float | None]:
        pair = pairs[index]
        scored = rescaled_prediction(pair, scale, rescale)
        distance = lpips(scored, pair.truth) if lpips is not None else None
        return psnr(scored, pair.truth), ssim(scored, pair.truth), distance

    # Decoding and filtering leave the interpreter's lock, so threads are enough.
    with ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1)) as pool:
        scores = list(pool.map(score_view, range(len(pairs))))
    red, green, blue = map(float, scale)
    distances = tuple(distance for *_, distance in scores if distance is not None)
    return LightScores(
        tuple(score[0] for score in scores), tuple(score[1] for score in scores), distances, (red, green, blue)
    )
