"""The bundled capture, relit and scored: what `make demo` shows."""

from importlib import resources
from pathlib import Path
from typing import Any

from illuminerf import pipeline
from illuminerf.data.capture import load_capture
from illuminerf.evaluation.benchmark_rule import score_light, view_pair
from illuminerf.presets import Preset
from illuminerf.scene.images import read_png
from illuminerf.workflow.atomic import write_json
from illuminerf.workflow.progress import say

INPUT_LIGHT, TARGET_LIGHT = "studio", "evening"


def bundled_capture() -> Path:
    """The folder of the capture that ships with the package."""
    return Path(str(resources.files("illuminerf") / "bundled" / "demo_capture"))


def run(out: Path, preset: Preset) -> dict[str, Any]:
    """Relight the bundled capture into `out` and compare with the truth.

    Returns:
        What scores.json holds: psnr and ssim of our views under the target light by the TensoIR rule,
        input_light_psnr (the truth under the input light scored in our place: what doing nothing reaches with
        perfect geometry), seconds by stage, peak_memory_gb.
    """
    source = bundled_capture()
    truth = source / "test" / TARGET_LIGHT
    job = pipeline.LightJob(source / "lights" / f"{TARGET_LIGHT}.exr", truth / "cameras.json", truth)
    ours = pipeline.relight(source, [job], preset, out)[job.name]
    seconds = pipeline.seconds_by_stage(out)
    scores = {
        "psnr": ours["psnr"],
        "ssim": ours["ssim"],
        "input_light_psnr": input_light_psnr(source),
        "seconds": {**seconds, "all": round(sum(seconds.values()), 1)},
        "peak_memory_gb": pipeline.peak_memory_gb(out),
    }
    write_json(out / "scores.json", scores)
    say(
        f"ours {scores['psnr']:.2f} dB, input light alone {scores['input_light_psnr']:.2f} dB "
        f"on {len(load_capture(truth).views)} unseen views; {scores['seconds']['all']:.0f} s, "
        f"{scores['peak_memory_gb']:.1f} GB. Open {out / 'report.html'}"
    )
    return scores


def input_light_psnr(source: Path) -> float:
    """PSNR, in dB, of the unseen views under the input light against those under the target light, rescaled."""
    folders = [source / "test" / light / "images" for light in (INPUT_LIGHT, TARGET_LIGHT)]
    names = sorted(path.name for path in folders[1].glob("*.png"))
    pairs = [view_pair(read_png(folders[0] / name), read_png(folders[1] / name)) for name in names]
    scores = score_light(pairs)
    return sum(scores.psnr) / len(scores.psnr)
