"""Spoilt inputs, a few of each kind: a result or a UserError, whatever is in the file.

`benchmarks/fuzz.py` tries hundreds of thousands.
"""

from pathlib import Path

import pytest

from tests.fuzz.readers import READERS
from tests.fuzz.sandbox import inputs_of, read_one


@pytest.mark.parametrize("name", READERS)
def test_good_inputs_are_read(name: str, tmp_path: Path) -> None:
    """Guard: what is spoilt below is good to begin with."""
    reader = READERS[name]
    for content in inputs_of(reader, tmp_path / "input"):
        assert read_one(reader, tmp_path / "input", content) == "result"


@pytest.mark.parametrize("name", READERS)
def test_spoilt_inputs_give_a_result_or_a_user_error(name: str, tmp_path: Path) -> None:
    reader = READERS[name]
    good = inputs_of(reader, tmp_path / "input")

    @given(seed=st.integers(0, 10**9))
    @settings(max_examples=8, deadline=None, derandomize=True, database=None)
    def check(seed: int) -> None:
        assert read_one(reader, tmp_path / "input", spoilt(reader, good, seed)) in ("result", "error")

    check()
