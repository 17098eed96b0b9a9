"""Views scored per second by the TensoIR rule, and what each part of it costs; prints JSON.

python benchmarks/scoring.py [--size 800] [--views 20]
"""

import argparse
import json
import platform
import time
from collections.abc import Callable

import numpy as np

from illuminerf.evaluation.benchmark_rule import ViewPair, channel_scale, rescaled_prediction, score_light
from illuminerf.evaluation.metrics import psnr, ssim
from illuminerf.workflow.artefact import peak_memory_gb


def synthetic_pairs(num_views: int, size: int) -> list[ViewPair]:
    """Noisy discs of 8-bit values on white, a third of the image."""
    generator = np.random.default_rng(0)
    rows, columns = np.mgrid[0:size, 0:size] / size - 0.5
    mask = rows**2 + columns**2 < 1 / (3 * np.pi)
    pairs = []
    for _ in range(num_views):
        truth = generator.integers(20, 230, (size, size, 3)) / 255
        prediction = np.round(np.clip(truth * 0.8 + generator.normal(scale=0.05, size=truth.shape), 0, 1) * 255) / 255
        images = (np.where(mask[..., None], image, 1.0).astype(np.float32) for image in (prediction, truth))
        pairs.append(ViewPair(*images, mask))
    return pairs


def best_seconds(work: Callable[[], object], repeats: int = 3) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--views", type=int, default=20)
    args = parser.parse_args()
    pairs = synthetic_pairs(args.views, args.size)
    scale = channel_scale(pairs, "median")
    seconds = best_seconds(lambda: score_light(pairs), repeats=1)
    first = pairs[0]
    report = {
        "size": args.size,
        "views": args.views,
        "views_per_second": args.views / seconds,
        "seconds_per_view": {
            "factor": best_seconds(lambda: channel_scale(pairs, "median"), repeats=1) / args.views,
            "rescale": best_seconds(lambda: rescaled_prediction(first, scale, "median")),
            "psnr": best_seconds(lambda: psnr(first.prediction, first.truth)),
            "ssim": best_seconds(lambda: ssim(first.prediction, first.truth)),
        },
        "peak_memory_gb": peak_memory_gb(),
        "machine": platform.processor() or platform.machine(),
    }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
