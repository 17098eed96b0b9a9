"""The memory benchmark, tiny: stages end and their peaks are above what their imports take."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "memory.py"


@pytest.mark.slow
def test_stages_are_run_and_their_peaks_told(tmp_path: Path) -> None:
    stages = ["import_capture", "estimate_geometry", "fit_latent_nerf"]
    sizes = ["--views", "4", "--size", "32", "--samples", "2"]
    command = [sys.executable, str(SCRIPT), "--out", str(tmp_path), *sizes, "--stages", *stages]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads(done.stdout)
    assert list(report["stages"]) == stages
    peaks = report["stages"].values()
    assert all(0 < stage["imports_gb"] <= stage["peak_gb"] <= report["largest_gb"] for stage in peaks)
    assert len(list((tmp_path / "relit" / "samples").iterdir())) == 8
    assert (tmp_path / "fit_latent_nerf" / "DONE").exists()
