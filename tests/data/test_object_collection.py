"""Collections of objects: folders, Objaverse's layout, lists of ids, licences, and what is wrong with them."""

import gzip
import json
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from illuminerf.cues.object_files import OBJECT_SUFFIXES
from illuminerf.data.json_streams import json_entries
from illuminerf.data.objaverse_download import download_objaverse
from illuminerf.data.object_collection import MODEL_SUFFIXES, ObjectChoice, list_objects, object_paths, read_ids
from illuminerf.workflow.errors import UserError


def touch(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"glTF")
    return root


def write_gz(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(json.dumps(content).encode()))
    return path


@pytest.fixture
def objaverse(tmp_path: Path) -> Path:
    """A download of three objects of an index of four."""
    root = tmp_path / "objaverse"
    folder = touch(root / "hf-objaverse-v1", "glbs/000-001/bbb.glb", "glbs/000-000/aaa.glb", "glbs/000-000/ccc.glb")
    touch(folder, "glbs/000-000/ddd.glb.tmp")
    index = {"aaa": "000-000", "bbb": "000-001", "ccc": "000-000", "ddd": "000-000"}
    write_gz(folder / "object-paths.json.gz", {uid: f"glbs/{place}/{uid}.glb" for uid, place in index.items()})
    annotations = {
        "aaa": {"license": "by", "user": {"username": "ann", "displayName": "Ann"}},
        "zzz": {"license": "cc0"},
    }
    write_gz(folder / "metadata" / "000-000.json.gz", annotations)
    return root


def ids(source: Path, **choice: Any) -> list[str]:
    return [found.id for found in list_objects(source, ObjectChoice(**choice))]


def test_both_sides_know_the_same_formats() -> None:
    assert MODEL_SUFFIXES == OBJECT_SUFFIXES


def test_folders_are_walked_in_the_order_of_names(tmp_path: Path) -> None:
    touch(tmp_path, "b.glb", "a.OBJ", "chairs/a.glb", "chairs/old ones/x y.ply", "a.png", "chairs/a.bin", "c.gltf")
    touch(tmp_path, ".hidden/h.glb", "__MACOSX/m.glb", "chairs/._a.glb")
    found = list_objects(tmp_path)
    assert [item.id for item in found] == ["a", "b", "c", "chairs__a", "chairs__old_ones__x_y"]
    assert found[0].path == tmp_path / "a.OBJ" and all(item.path.is_file() for item in found)
    assert all(item.licence == "" for item in found)
    assert ids(tmp_path / "b.glb") == ["b"]


def test_ids_are_unique(tmp_path: Path) -> None:
    touch(tmp_path, "a.glb", "a.obj", "b/c.glb", "b__c.glb", "d e.glb", "d+e.glb")
    found = ids(tmp_path)
    assert len(set(found)) == len(found) == 6
    assert {"a_glb", "a_obj"} < set(found) and found == ids(tmp_path)


def test_links_in_circles_end(tmp_path: Path) -> None:
    touch(tmp_path, "a/b.glb")
    (tmp_path / "a" / "again").symlink_to(tmp_path)
    assert ids(tmp_path) == ["a__b"]


def test_choices(tmp_path: Path) -> None:
    touch(tmp_path, "a.glb", "b.glb", "sub/c.glb")
    assert ids(tmp_path, excluded=("b", "c")) == ["a"]
    keep = tmp_path / "keep.txt"
    keep.write_text("# chosen by eye\nsub__c\nb  # nice\nunknown\n")
    assert ids(tmp_path, keep_ids=keep) == ["b", "sub__c"]
    assert ids(tmp_path, keep_ids=keep, excluded=("b",)) == ["sub__c"]
    with pytest.raises(UserError, match="no object is left"):
        list_objects(tmp_path, ObjectChoice(excluded=("a", "b", "c")))


def test_lists_of_ids_of_every_kind(tmp_path: Path) -> None:
    for name, text in (
        ("a.json", '["one", "glbs/000-000/two.glb", "one"]'),
        ("b.json", '{"one": 1, "two": {}}'),
        ("c.csv", "name,uid\nx,one\ny,two\n"),
        ("d.csv", "one,x\ntwo,y\n"),
        ("e.txt", "\ufeffone\n\n000-000\\two.GLB\n"),
    ):
        (tmp_path / name).write_text(text, encoding="utf-8")
        assert read_ids(tmp_path / name) == ["one", "two"]
    for name, text in (("f.json", "[1, 2]"), ("g.json", "[1"), ("h.txt", "# none\n"), ("i.json", '"one"')):
        (tmp_path / name).write_text(text)
        with pytest.raises(UserError, match="ids"):
            read_ids(tmp_path / name)
    with pytest.raises(UserError, match="absent.txt is not a readable list"):
        read_ids(tmp_path / "absent.txt")


def test_objaverse_folders_hold_what_is_downloaded(objaverse: Path, tmp_path: Path) -> None:
    for source in (objaverse, objaverse / "hf-objaverse-v1"):
        found = list_objects(source)
        assert [item.id for item in found] == ["aaa", "bbb", "ccc"]
        assert [item.licence for item in found] == ["CC-BY-4.0 (Ann)", "", ""]
    (tmp_path / "keep.json").write_text('["bbb", "ddd"]')
    assert ids(objaverse, keep_ids=tmp_path / "keep.json") == ["bbb"]


@pytest.mark.parametrize("has_index", [True, False])
def test_lists_of_objaverse_ids(objaverse: Path, tmp_path: Path, has_index: bool) -> None:
    if not has_index:
        (objaverse / "hf-objaverse-v1" / "object-paths.json.gz").unlink()
    listed = tmp_path / "ids.txt"
    listed.write_text("ccc\naaa\n")
    found = list_objects(listed, ObjectChoice(objaverse_root=objaverse))
    assert [(item.id, item.licence) for item in found] == [("ccc", ""), ("aaa", "CC-BY-4.0 (Ann)")]
    assert ids(listed, objaverse_root=objaverse, excluded=("ccc",)) == ["aaa"]
    with pytest.raises(UserError, match="where the objects are"):
        list_objects(listed)
    with pytest.raises(UserError, match="no Objaverse folder"):
        list_objects(listed, ObjectChoice(objaverse_root=tmp_path / "nowhere"))
    listed.write_text("aaa\nddd\neee\n")
    with pytest.raises(UserError, match=f"2 of 3 absent .{1 if has_index else 2} of them unknown., ddd first"):
        list_objects(listed, ObjectChoice(objaverse_root=objaverse))


def test_an_index_may_not_lead_outside(tmp_path: Path) -> None:
    write_gz(tmp_path / "object-paths.json.gz", {"a": "../../etc/passwd"})
    with pytest.raises(UserError, match="outside"):
        object_paths(tmp_path, {"a"})


@pytest.mark.parametrize("place", ["", "..", "../.."])
def test_licences_of_a_manifest(tmp_path: Path, place: str) -> None:
    models = touch(tmp_path / "x" / "models", "a.glb", "b.glb")
    manifest = (models / place).resolve() / "MANIFEST.csv"
    prefix = models.resolve().relative_to(manifest.parent).as_posix()
    manifest.write_text(f'file,license,author\n{prefix}/a.glb,CC0-1.0,"Ann, of X"\n{prefix}/absent.glb,MIT,\n')
    assert [item.licence for item in list_objects(models)] == ["CC0-1.0 (Ann, of X)", ""]


def test_wrong_sources_are_explained(tmp_path: Path) -> None:
    for source in (tmp_path / "absent", tmp_path):
        with pytest.raises(UserError, match="Objaverse"):
            list_objects(source)
    (tmp_path / "a.fbx").write_bytes(b"")
    with pytest.raises(UserError, match="not a collection"):
        list_objects(tmp_path / "a.fbx")


def test_entries_of_large_objects_are_streamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("illuminerf.data.json_streams._CHUNK", 2**14)
    content = {f"{number:032x}": f"glbs/000-{number % 160:03d}/{number:032x}.glb" for number in range(10_000)}
    path = write_gz(tmp_path / "a.json.gz", content)
    assert dict(json_entries(path)) == content
    del content
    tracemalloc.start()
    found = object_paths_of(path, f"{4_321:032x}")
    peak = tracemalloc.get_traced_memory()[1]
    whole = json.loads(gzip.decompress(path.read_bytes()))
    at_once = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == [whole[f"{4_321:032x}"]]
    assert peak < 5e5 < 2e6 < at_once


def object_paths_of(path: Path, uid: str) -> list[str]:
    return [value for key, value in json_entries(path) if key == uid]


@pytest.mark.parametrize("chunk", [1, 2, 7])
def test_streams_do_not_depend_on_where_they_are_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    monkeypatch.setattr("illuminerf.data.json_streams._CHUNK", chunk)
    content = {"a": 12345, 'b"}': [1, {"c": None}], "d": "}{", "e": -1.5e-3, "": {}}
    (tmp_path / "a.json").write_text(json.dumps(content, indent=3))
    assert dict(json_entries(tmp_path / "a.json")) == content
    (tmp_path / "a.json").write_text(" { } ")
    assert dict(json_entries(tmp_path / "a.json")) == {}


def test_broken_streams_are_explained(tmp_path: Path) -> None:
    path = tmp_path / "a.json.gz"
    whole = gzip.compress(json.dumps({"a": 1, "b": 2}).encode())
    broken = [
        whole[:-9],
        b"noise",
        *(gzip.compress(text) for text in (b"", b"[1]", b'{"a" 1}', b'{"a": 1', b"{1: 2}", b'{"a": \xff}')),
    ]
    for content in broken:
        path.write_bytes(content)
        with pytest.raises(UserError, match="not a readable JSON object"):
            list(json_entries(path))
    with pytest.raises(UserError, match="not a readable"):
        list(json_entries(tmp_path / "absent.json"))


def fake_objaverse(arrives: dict[str, bytes], error: Exception | None = None) -> Any:
    """A stand-in for the package: writes what `arrives` into the folder that it was told."""
    fake = SimpleNamespace(BASE_PATH="/home", _VERSIONED_PATH="/home/hf-objaverse-v1", asked=[])

    def load_objects(uids: list[str], download_processes: int) -> dict[str, str]:
        fake.asked.append((uids, download_processes))
        if error is not None:
            raise error
        found = {}
        for uid in uids:
            if uid in arrives:
                path = Path(fake._VERSIONED_PATH) / "glbs" / "000-000" / f"{uid}.glb"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(arrives[uid])
                found[uid] = str(path)
        return found

    fake.load_objects = load_objects
    return fake


def test_downloads_land_where_they_are_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = fake_objaverse({"aaa": b"glTF...", "bbb": b"glTF..."})
    monkeypatch.setitem(sys.modules, "objaverse", fake)
    found = download_objaverse(["aaa", "bbb"], tmp_path, num_processes=3)
    assert fake.asked == [(["aaa", "bbb"], 3)] and fake.BASE_PATH == "/home"
    assert found["aaa"] == tmp_path.resolve() / "hf-objaverse-v1/glbs/000-000/aaa.glb"
    assert ids(tmp_path) == ["aaa", "bbb"]
    assert download_objaverse([], tmp_path) == {} and len(fake.asked) == 1


def test_failed_downloads_are_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "objaverse", fake_objaverse({"aaa": b"glTF...", "bbb": b"<html>"}))
    with pytest.raises(UserError, match="2 of 3 are absent or no GLB files, bbb first"):
        download_objaverse(["aaa", "bbb", "ccc"], tmp_path)
    monkeypatch.setitem(sys.modules, "objaverse", fake_objaverse({}, ConnectionResetError("gone")))
    with pytest.raises(UserError, match="ConnectionResetError: gone"):
        download_objaverse(["aaa"], tmp_path)
    monkeypatch.setitem(sys.modules, "objaverse", SimpleNamespace(__version__="7"))
    with pytest.raises(UserError, match="version"):
        download_objaverse(["aaa"], tmp_path)
    monkeypatch.setitem(sys.modules, "objaverse", None)
    with pytest.raises(UserError, match="pip install"):
        download_objaverse(["aaa"], tmp_path)
