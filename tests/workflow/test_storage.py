"""Storage: the same calls on a local folder and on an object store in memory."""

import uuid
from pathlib import Path

import pytest

from illuminerf.workflow.errors import UserError
from illuminerf.workflow.storage import Storage


@pytest.fixture(params=["local", "memory"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    return Storage(tmp_path / "store" if request.param == "local" else f"memory://{uuid.uuid4().hex}/store")


def test_written_files_are_read_listed_and_removed(storage: Storage) -> None:
    assert storage.names() == [] and not storage.exists("a.json")
    storage.write("a.bin", b"one")
    storage.write_json("deep/down/b.json", {"z": 1, "a": [2]})
    assert storage.names() == ["a.bin"] and storage.names("deep/down") == ["b.json"]
    assert storage.read("a.bin") == b"one" and b"".join(storage.chunks("a.bin")) == b"one"
    assert storage.read("deep/down/b.json").index(b'"a"') < storage.read("deep/down/b.json").index(b'"z"')
    storage.write("a.bin", b"two")
    assert storage.read("a.bin") == b"two"
    storage.remove("a.bin")
    storage.remove("a.bin")
    assert not storage.exists("a.bin")
    with pytest.raises(FileNotFoundError):
        storage.read("a.bin")


@pytest.mark.parametrize("name", ["../outside", "a/../../b", "/etc/passwd"])
def test_names_stay_below_the_root(storage: Storage, name: str) -> None:
    with pytest.raises(UserError, match="would leave"):
        storage.write(name, b"")


def test_only_a_local_storage_has_a_path(tmp_path: Path) -> None:
    assert Storage(tmp_path).path == tmp_path and Storage(f"file://{tmp_path}").path == tmp_path
    assert Storage("memory://x").path is None


def test_relative_folders_are_made_absolute_for_workers_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    storage = Storage("out/pairs")
    monkeypatch.chdir("/")
    assert storage.url == str(tmp_path / "out/pairs")
    storage.write("a", b"1")
    assert (tmp_path / "out/pairs/a").exists()


def test_an_unknown_protocol_is_explained() -> None:
    with pytest.raises(UserError, match="no place this program can write to"):
        Storage("quantum://bucket")


def test_a_full_disk_is_explained() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(UserError):
        Storage(full).write("a", b"x")
