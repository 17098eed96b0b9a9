"""Folders to a storage elsewhere and back: whole, DONE last, errors told apart."""

import uuid
from pathlib import Path
from typing import Any

import pytest

from illuminerf.workflow.storage import Storage
from illuminerf.workflow.transfer import TransferError, fetch_file, fetch_folder, store_folder


@pytest.fixture(params=["local", "memory"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    return Storage(tmp_path / "store" if request.param == "local" else f"memory://{uuid.uuid4().hex}/store")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "made" / "images").mkdir(parents=True)
    for name in ("DONE", "config.json", "images/000.png", "zebra.json", ".lock"):
        (tmp_path / "made" / name).write_text(name)
    return tmp_path / "made"


def test_a_folder_goes_and_comes_back(storage: Storage, folder: Path, tmp_path: Path) -> None:
    store_folder(folder, storage, "run/stage")
    assert storage.tree("run/stage") == ["DONE", "config.json", "images/000.png", "zebra.json"]
    assert storage.tree("run") == [f"stage/{name}" for name in storage.tree("run/stage")] and storage.tree("no") == []
    names = fetch_folder(storage, "run/stage", tmp_path / "back", lambda name: name != "zebra.json")
    assert names == {"DONE", "config.json", "images/000.png"}
    assert (tmp_path / "back/images/000.png").read_text() == "images/000.png"
    fetch_file(f"{storage.url}/run/stage/zebra.json", tmp_path / "z")
    assert (tmp_path / "z").read_text() == "zebra.json"


def test_done_goes_last_and_what_is_there_is_not_sent_again(
    storage: Storage, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[str] = []
    monkeypatch.setattr(storage, "upload", lambda source, name: sent.append(name))
    store_folder(folder, storage, "s", there={"config.json"})
    assert sent == ["s/images/000.png", "s/zebra.json", "s/DONE"]


def test_errors_of_the_place_are_told_as_such(storage: Storage, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise ConnectionError("the cable is out\nand more")

    monkeypatch.setattr(storage, "upload", broken)
    with pytest.raises(TransferError, match=r"cannot be written \(ConnectionError: the cable is out\)"):
        store_folder(folder, storage, "s")
    with pytest.raises(TransferError, match="absent cannot be fetched"):
        fetch_file(f"{storage.url}/absent", folder / "x")
