"""Shares of the work; artefacts that several processes make together."""

from pathlib import Path

import pytest
import torch

from illuminerf.workflow.artefact import open_artefact, verify
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.processes import shard_of, sum_over_processes


def test_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RANK", raising=False)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert shard_of("") == (0, 1) and shard_of("2/7") == (2, 7)
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert shard_of("") == (3, 4) and shard_of("0/2") == (0, 2)
    for wrong in ("2/2", "1", "a/b", "-1/2", "0/0"):
        with pytest.raises(UserError, match="not a share"):
            shard_of(wrong)


def test_alone_a_sum_is_the_thing_itself() -> None:
    tensor = torch.randn(3)
    assert sum_over_processes(tensor) is tensor


def test_shared_artefacts_are_open_to_many_and_closed_to_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with open_artefact(out, "stage", {}, {}, is_shared=True) as first:
        (out / ".mine.partial.png").write_text("just being written")
        with open_artefact(out, "stage", {}, {}, is_shared=True) as second:
            assert (out / ".mine.partial.png").exists()
            (out / "unit").write_text("1")
            assert not second.is_done
        assert not (out / "DONE").exists()
        with (
            pytest.raises(UserError, match="another process"),
            open_artefact(out, "stage", {}, {}),
        ):
            pass
        first.finish()
    assert (out / "DONE").exists() and not (out / ".mine.partial.png").exists()
    verify(out)
    with open_artefact(out, "stage", {}, {}, is_shared=True) as third:
        assert third.is_done
