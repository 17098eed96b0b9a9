"""Spoilt inputs, a few of each kind: a result or a UserError, whatever is in the file.

`benchmarks/fuzz.py` tries as many as there is time for.
"""

import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from illuminerf.workflow.errors import UserError
from tests.fuzz.readers import READERS, Reader
from tests.fuzz.sandbox import fuzz, inputs_of, read_one, spoilt


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
    @settings(max_examples=6, deadline=None, derandomize=True, database=None)
    def check(seed: int) -> None:
        assert read_one(reader, tmp_path / "input", spoilt(reader, good, seed)) in ("result", "error")

    check()


def test_what_escapes_is_counted(tmp_path: Path) -> None:
    """Guard: an error that is no UserError, and a process that ends, are told from the rest."""

    def reads(folder: Path) -> None:
        match (folder / "a").read_bytes():
            case b"0":
                raise UserError("no good")
            case b"1":
                raise KeyError("escaped")
            case b"2":
                os._exit(3)

    def by_number(good: bytes, draw: object, other: bytes) -> bytes:
        return good

    for content, tried, kinds in ((b"0", 3, []), (b"1", 2, ["KeyError"] * 2), (b"2", 2, ["crash"] * 2)):
        reader = Reader("toy", "a", reads, by_number, lambda _, content=content: [content])  # type: ignore[misc]
        tally, escapes = fuzz(reader, tmp_path / "input", 0, tried, 30.0)
        assert (tally.tried, [escape.kind for escape in escapes]) == (tried, kinds)
        assert tally.errors == (tried if not kinds else 0)
