"""The coverage-guided fuzzer finds what a blind one does not; escapes are kept, and turns are even."""

import json
import os
import random
import runpy
import sys
from pathlib import Path

import pytest

from illuminerf.workflow.errors import UserError
from tests.fuzz import guided
from tests.fuzz.guided import fuzz_guided, instrument, need_atheris
from tests.fuzz.readers import READERS, Reader
from tests.fuzz.sandbox import Tally, fuzz, replay

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "fuzz.py"
_NUM_INPUTS = 800


def _reads(folder: Path) -> None:
    """KeyError at "lost", where each letter is a branch of its own."""
    content = (folder / "a").read_bytes()
    if content[:1] != b"l":
        raise UserError("no good")
    if content[1:2] != b"o":
        raise UserError("better")
    if content[2:3] != b"s":
        raise UserError("near")
    if content[3:4] == b"t":
        raise KeyError("lost")


def _ends(folder: Path) -> None:
    if (folder / "a").read_bytes() == b"lost":
        os._exit(3)


def _one_letter(content: bytes, draw: random.Random, other: bytes) -> bytes:
    letters = bytearray(content or other)
    letters[draw.randrange(len(letters))] = draw.choice(b"lost")
    return bytes(letters)


TOY = Reader("toy", "a", _reads, _one_letter, lambda _: [b"...."])


def test_without_the_package_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "atheris", None)
    with pytest.raises(UserError, match="pip install atheris"):
        need_atheris()


def test_what_escapes_is_kept_and_can_be_read_again(tmp_path: Path) -> None:
    def always(content: bytes, draw: random.Random, other: bytes) -> bytes:
        return b"lost"

    reader = Reader("toy", "a", _ends, always, TOY.seeds)
    _, (escape,) = fuzz(reader, tmp_path / "input", 7, 1, 30.0, tmp_path / "escapes")
    assert (escape.kind, escape.seed, Path(escape.file).parent) == ("crash", 7, tmp_path / "escapes" / "toy")
    content = Path(escape.file).read_bytes()
    assert content == b"lost"
    assert [again.kind for again in replay(reader, tmp_path / "input", content)] == ["crash"]
    assert replay(reader, tmp_path / "input", b"....") == [], "guard: a good input is no escape"


def test_coverage_leads_to_what_blind_chance_does_not_find(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("atheris", reason="the package atheris is absent")
    _, blind = fuzz(TOY, tmp_path / "input", 0, _NUM_INPUTS, 60.0)
    assert not blind, "guard: one letter at a time, from a good input, is never four letters"
    monkeypatch.setattr(guided, "_ANEW", 0.0)
    original = _reads.__code__
    try:
        assert instrument((__name__,)) > 0
        assert _reads.__code__ is not original
        corpus, kept = tmp_path / "corpus", tmp_path / "escapes"
        tally, escapes = fuzz_guided(TOY, tmp_path / "input", 0, _NUM_INPUTS, 60.0, corpus, kept)
    finally:
        _reads.__code__ = original
    assert tally.tried == _NUM_INPUTS
    assert tally.errors + tally.results == _NUM_INPUTS - len(escapes)
    assert {escape.kind for escape in escapes} == {"KeyError"}
    assert Path(escapes[0].file).read_bytes()[:4] == b"lost"
    starts = {path.read_bytes()[:3] for path in corpus.iterdir()}
    assert b"los" in starts, "a later run goes on from here"


@pytest.mark.parametrize(("name", "mutations"), [(name, 40) for name in ("png", "glb", "field.json", "checkpoint")])
def test_what_is_spoilt_can_be_spoilt_again(name: str, mutations: int, tmp_path: Path) -> None:
    """A corpus holds broken files: mutations must take them."""
    draw = random.Random(name)
    (content, *_) = READERS[name].seeds(tmp_path)
    for start in (b"", b"\x89PNG\r\n\x1a\n", b"glTF" + bytes(30), b"[" * 5000 + b"]" * 5000, content):
        spoilt = start
        for _ in range(mutations):
            spoilt = READERS[name].mutate(spoilt, draw, content)
            assert isinstance(spoilt, bytes)


def test_readers_take_turns_of_equal_counts() -> None:
    rounds = runpy.run_path(str(SCRIPT))["rounds"]
    turns: list[tuple[str, int, int]] = []

    def turn(reader: Reader, first: int, count: int, seconds: float) -> tuple[Tally, list[object]]:
        turns.append((reader.name, first, count))
        return Tally(count), []

    counts: dict[str, int] = {}
    for name, tally, _ in rounds(turn, ["png", "glb"], 100, 500, float("inf")):
        counts[name] = counts.get(name, 0) + tally.tried
    assert counts == {"png": 500, "glb": 500}
    assert [first for name, first, _ in turns if name == "glb"] == [100, 164, 292, 548]
    assert turns[-1] == ("glb", 548, 52)


def test_inputs_of_strange_folders_are_not_replayed(tmp_path: Path) -> None:
    (tmp_path / "input").write_bytes(b"x")
    script = runpy.run_path(str(SCRIPT))
    with pytest.raises(UserError, match="reader's folder"):
        script["replayed"]([tmp_path / "input"], tmp_path / "work")
    assert json.dumps(script["summary"]({"png": Tally(2, 2, 1, 1, 0.1, 0.5)}, [], 1.0, False)["readers"]["png"])
