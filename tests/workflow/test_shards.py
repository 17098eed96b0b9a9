"""Shards: equal samples give equal bytes, what is damaged is seen, and the public reader can read them."""

from dataclasses import replace
from pathlib import Path

import pytest

from illuminerf.workflow.errors import UserError
from illuminerf.workflow.shards import (
    LeftOut,
    finished_shards,
    is_intact,
    read_index,
    read_samples,
    read_shard,
    remove_shard,
    sample_tar,
    write_shard,
)
from illuminerf.workflow.storage import Storage

LONG = "object_" + "x" * 150


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    return Storage(tmp_path)


def samples() -> list[bytes]:
    return [sample_tar("cat_0", {"json": b"{}", "bin": b"miau"}), sample_tar(LONG, {"bin": bytes(3000)})]


def test_samples_come_back_in_order(storage: Storage) -> None:
    written = write_shard(storage, "pairs-000000", samples(), {"dog_0": LeftOut("broken", "no legs")})
    assert written == read_index(storage, "pairs-000000") and is_intact(storage, written)
    assert written.keys == ("cat_0", LONG) and written.left_out["dog_0"].reason == "broken"
    assert list(read_shard(storage, written)) == [
        ("cat_0", {"json": b"{}", "bin": b"miau"}),
        (LONG, {"bin": bytes(3000)}),
    ]
    assert finished_shards(storage) == [written]


def test_equal_samples_equal_bytes(tmp_path: Path) -> None:
    first = write_shard(Storage(tmp_path / "a"), "pairs-000000", samples(), {})
    second = write_shard(Storage(tmp_path / "b"), "pairs-000000", samples(), {})
    assert first == second
    assert (tmp_path / "a/pairs-000000.tar").read_bytes() == (tmp_path / "b/pairs-000000.tar").read_bytes()
    other = write_shard(Storage(tmp_path / "c"), "pairs-000000", samples()[:1], {})
    assert other.sha256 != first.sha256


def test_damage_is_seen(storage: Storage, tmp_path: Path) -> None:
    index = write_shard(storage, "pairs-000000", samples(), {})
    path = tmp_path / "pairs-000000.tar"
    content = bytearray(path.read_bytes())
    content[600] ^= 1
    path.write_bytes(content)
    assert not is_intact(storage, index)
    with pytest.raises(UserError, match="damaged"):
        list(read_shard(storage, index))
    path.write_bytes(content[:700])
    assert not is_intact(storage, index)
    with pytest.raises(UserError, match="damaged"):
        list(read_samples(bytes(content[:700])))
    path.unlink()
    assert not is_intact(storage, index)
    with pytest.raises(UserError, match="missing"):
        list(read_shard(storage, index))


def test_a_changed_index_is_not_finished(storage: Storage, tmp_path: Path) -> None:
    index = write_shard(storage, "pairs-000000", samples(), {"lost": LeftOut("crash", "it ended")})
    path = tmp_path / "pairs-000000.json"
    content = path.read_bytes()
    assert read_index(storage, "pairs-000000") == index
    for place in range(len(content)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert read_index(storage, "pairs-000000") is None, f"{content[place : place + 1]!r} at {place} is another byte"
    path.write_bytes(content.replace(index.seal.encode(), b""))
    assert read_index(storage, "pairs-000000") == replace(index, seal=""), "indices of before had no seal"


def test_a_shard_without_its_index_is_not_finished(storage: Storage, tmp_path: Path) -> None:
    write_shard(storage, "pairs-000000", samples(), {})
    (tmp_path / "pairs-000000.json").write_text("{")
    assert finished_shards(storage) == [] and read_index(storage, "pairs-000000") is None
    remove_shard(storage, "pairs-000000")
    assert storage.names() == []


@pytest.mark.parametrize("key", ["a.b", "a/b", ""])
def test_keys_that_readers_would_cut_are_refused(key: str) -> None:
    with pytest.raises(ValueError, match="no sample key"):
        sample_tar(key, {"bin": b""})


def test_webdataset_reads_shards(storage: Storage, tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset", reason="the public reader is an extra: pip install webdataset")
    write_shard(storage, "pairs-000000", samples(), {})
    read = list(webdataset.WebDataset(str(tmp_path / "pairs-000000.tar"), shardshuffle=False))
    assert [sample["__key__"] for sample in read] == ["cat_0", LONG]
    assert read[0]["bin"] == b"miau" and read[1]["bin"] == bytes(3000)
