"""The scaling benchmark's line."""

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "scaling.py"


def test_the_line_goes_through_the_points() -> None:
    line_through = runpy.run_path(str(SCRIPT))["line_through"]
    straight, bent = line_through([1.0, 2.0, 3.0], [3.0, 5.0, 7.0]), line_through([1.0, 2.0, 4.0], [1.0, 4.0, 16.0])
    assert straight["fixed"] == pytest.approx(1) and straight["per_unit"] == pytest.approx(2)
    assert straight["largest_distance"] < 1e-6 < 0.05 < bent["largest_distance"]
