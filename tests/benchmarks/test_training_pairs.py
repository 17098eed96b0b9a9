"""The benchmark of the factory renders what the factory renders, and its seconds add up."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "training_pairs.py"


@pytest.mark.slow
def test_steps_add_up_and_more_paths_are_less_noise() -> None:
    command = [
        sys.executable,
        str(SCRIPT),
        *["--objects", "2", "--size", "16", "--samples", "4", "--lights", "2", "--device", "cpu"],
    ]
    reports = []
    for cue_samples in ("4", "64"):
        more = ["--cue-samples", cue_samples, "--reference-samples", "256"]
        done = subprocess.run(command + more, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]
        reports.append(json.loads(done.stdout))
    few, many = reports
    steps = few["seconds_per_item_wall_cpu"]
    assert steps["total"][0] == pytest.approx(sum(v[0] for k, v in steps.items() if k != "total"), rel=0.02)
    assert min(v[0] for k, v in steps.items() if k not in ("bake", "other")) > 0
    assert few["kilobytes_per_item"] == many["kilobytes_per_item"] > 1
    noise = [report["psnr_whole_inside"] for report in reports]
    assert set(noise[0]) == {"diffuse", "ggx_005", "ggx_013", "ggx_034", "target"}
    assert noise[1]["diffuse"][0] > noise[0]["diffuse"][0] + 6, "16 times the paths are up to 12 dB"
    assert noise[1]["target"] == noise[0]["target"], "the targets have the same paths in both"
