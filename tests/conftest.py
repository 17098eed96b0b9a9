"""Shared by all tests: where the benchmark frames are, if anywhere."""

import os
from pathlib import Path

import pytest

import illuminerf  # noqa: F401 - before any test imports torch, so that its threads wait as the package's do

_LONGEST = {
    "test_ablation.py", "test_batch.py", "test_elsewhere.py", "test_estimate_geometry.py", "test_gpu_scripts.py",
    "test_memory.py", "test_pairs_on_ray.py", "test_pipeline.py", "test_render_training_pairs.py",
    "test_shared_fits.py", "test_stanford_orb.py", "test_train_control.py",
}  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first, so that no process is left with one at the end while the other waits."""
    items.sort(key=lambda item: item.path.name not in _LONGEST)


@pytest.fixture
def data_root() -> Path:
    """The folder named by ILLUMINERF_DATA; tests that need it are marked `data` and skip without it."""
    root = os.environ.get("ILLUMINERF_DATA", "")
    if not root or not Path(root).is_dir():
        pytest.skip("benchmark frames are absent: set ILLUMINERF_DATA (see docs/benchmarks.md)")
    return Path(root)
