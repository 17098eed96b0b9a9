"""Shared by all tests: where the benchmark frames are, if anywhere."""

import os
from pathlib import Path

import pytest

import illuminerf  # noqa: F401 - before any test imports torch, so that its threads wait as the package's do


@pytest.fixture
def data_root() -> Path:
    """The folder named by ILLUMINERF_DATA; tests that need it are marked `data` and skip without it."""
    root = os.environ.get("ILLUMINERF_DATA", "")
    if not root or not Path(root).is_dir():
        pytest.skip("benchmark frames are absent: set ILLUMINERF_DATA (see docs/benchmarks.md)")
    return Path(root)
