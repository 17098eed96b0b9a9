"""What objects a training set is rendered from: folders of models, Objaverse, lists of ids.

A source is one of
    a folder of .glb, .gltf, .obj and .ply files, at any depth;
    one such file;
    a folder in Objaverse's layout, `[hf-objaverse-v1/]glbs/000-000/<id>.glb` (what has been downloaded counts);
    a .txt, .csv or .json file of Objaverse ids, together with `objaverse_root`.
Only names are looked at; reading the models is the business of the renderer.
"""

import csv
import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from illuminerf.data.json_streams import json_entries
from illuminerf.data.object_licences import annotated_licences, licence_of, manifest_licences
from illuminerf.workflow.errors import UserError

MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
_LIST_SUFFIXES = (".txt", ".csv", ".json")
_VERSION_FOLDER = "hf-objaverse-v1"
_MAX_LIST_BYTES = 512 * 2**20
_ID_COLUMNS = ("uid", "id", "object_id")
_LONGEST_NAME = 100
_SHARD = re.compile(r"\d{3}-\d{3}")


@dataclass(frozen=True)
class CollectionObject:
    """One model of a collection.

    Attributes:
        id: unique in the collection, made of a hundred or so letters, digits, `-` and `_`: files are named by it.
        path: the model file.
        licence: terms and author, "" where nothing is known.
    """

    id: str
    path: Path
    licence: str


@dataclass(frozen=True)
class ObjectChoice:
    """Which objects of a source are taken."""

    keep_ids: Path | None = None
    """Only ids of this file are taken: a JSON list (or object, by its keys), a CSV with a column `uid`, or one id a
    line. The paper starts from a public list of 156,330 Objaverse ids."""
    excluded: tuple[str, ...] = ()
    """Ids (or names of files without suffix) that are left out."""
    objaverse_root: Path | None = None
    """Where Objaverse lies, for a source that is a list of ids."""


def list_objects(source: Path, choice: ObjectChoice | None = None) -> list[CollectionObject]:
    """The objects of `source` that `choice` leaves, in an order that depends on their names only.

    Raises:
        UserError: the source or a list is missing, unreadable or leaves no object.
    """
    choice = choice or ObjectChoice()
    source = source.expanduser()
    if not source.exists():
        raise UserError("there is no such collection of objects", got=str(source), wanted=f"{_wanted()}")
    root = objaverse_folder(source) if source.is_dir() else None
    if root is not None:
        found = _downloaded(root)
    elif source.is_file() and source.suffix.lower() in _LIST_SUFFIXES:
        root, found = _listed(source, choice)
    else:
        found = _named(source)
        _refuse_unknown(found, choice.excluded)
    if not found:
        raise UserError(f"{source} holds no objects", wanted=_wanted())
    chosen = _chosen(found, choice)
    if not chosen:
        raise UserError(
            "no object is left of the collection",
            got=f"{len(found):,} objects in {source}, none of them in the list of ids to keep, or all excluded",
            fix="check the ids against the names of the files",
        )
    return _with_licences(source, root, chosen)


def _refuse_unknown(found: list[tuple[str, Path]], excluded: tuple[str, ...]) -> None:
    unknown = set(excluded) - {name for name, _ in found} - {path.stem for _, path in found}
    if unknown:
        raise UserError(
            "objects to leave out are not in the collection",
            got=", ".join(sorted(unknown)[:5]),
            wanted="names of files without suffix, or ids as a manifest shows them",
        )


def _wanted() -> str:
    return f"a folder of {', '.join(MODEL_SUFFIXES)} files, an Objaverse folder, or a list of Objaverse ids"


def objaverse_folder(folder: Path) -> Path | None:
    """The folder inside (or equal to) `folder` that has Objaverse's `glbs/000-000`, or None."""
    for root in (folder, folder / _VERSION_FOLDER):
        if (root / "object-paths.json.gz").is_file():
            return root
        if (root / "glbs").is_dir() and any(_SHARD.fullmatch(entry.name) for entry in (root / "glbs").iterdir()):
            return root
    return None


def read_ids(path: Path) -> list[str]:
    """The ids of a .json, .csv or text file, without repetitions, in the file's order.

    Paths count by their last part without suffix, so `glbs/000-000/<id>.glb` is an id too; `#` starts a comment.

    Raises:
        UserError: the file is missing, too large, unreadable or empty.
    """
    try:
        if path.stat().st_size > _MAX_LIST_BYTES:
            raise UserError(f"{path} is too large for a list of ids", wanted=f"at most {_MAX_LIST_BYTES >> 20} MB")
        text = path.read_text("utf-8-sig")
        match path.suffix.lower():
            case ".json":
                content = json.loads(text)
                if not isinstance(content, list | dict) or not all(isinstance(entry, str) for entry in content):
                    raise ValueError("neither a list of strings nor an object")
                names = list(content)
            case ".csv":
                names = list(_csv_column(text))
            case _:
                names = [line.split("#", 1)[0].strip() for line in text.splitlines()]
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        raise UserError(
            f"{path} is not a readable list of ids",
            got=str(error),
            wanted="a JSON list, a CSV with a column uid, or one id a line",
        ) from error
    ids = list(dict.fromkeys(_id_of(name) for name in names if name.strip()))
    if not ids:
        raise UserError(f"{path} lists no ids", wanted="a JSON list, a CSV with a column uid, or one id a line")
    return ids


def _csv_column(text: str) -> Iterator[str]:
    """The column that is named as ids are, else the first one of a table without header."""
    rows = csv.reader(text.splitlines())
    first = next(rows, [])
    names = [cell.strip().lower() for cell in first]
    column = next((names.index(name) for name in _ID_COLUMNS if name in names), None)
    if column is None:
        yield from first[:1]
    for row in rows:
        yield from row[column or 0 : (column or 0) + 1]


def _id_of(name: str) -> str:
    name = name.strip().replace("\\", "/").rsplit("/", 1)[-1]
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and f".{suffix.lower()}" in MODEL_SUFFIXES else name


def _named(source: Path) -> list[tuple[str, Path]]:
    """Ids and paths of all models under a folder, or of one file; ids are relative paths, with `__` for `/`."""
    if source.is_file():
        if source.suffix.lower() not in MODEL_SUFFIXES:
            raise UserError("not a collection of objects", got=str(source), wanted=_wanted())
        return [(_safe(source.stem), source)]
    relative = sorted(_models_under(source), key=lambda path: path.as_posix())
    plain = [_safe("__".join(path.with_suffix("").parts)) for path in relative]
    counts = Counter(plain)
    found: dict[str, Path] = {}
    for path, name in zip(relative, plain, strict=True):
        if counts[name] > 1:  # a.glb beside a.obj
            name = f"{name}_{path.suffix[1:].lower()}"
        unique, number = name, 2
        while unique in found:
            unique, number = f"{name}_{number}", number + 1
        found[unique] = source / path
    return list(found.items())


def _models_under(folder: Path) -> Iterator[Path]:
    """Relative paths of models; links are followed once, hidden files and folders left out."""
    seen = set()
    for place, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__MACOSX")))
        for name in files:
            if Path(name).suffix.lower() in MODEL_SUFFIXES and not name.startswith("."):
                yield Path(place, name).relative_to(folder)


def _safe(name: str) -> str:
    safe = re.sub(r"[^\w\-]", "_", name, flags=re.ASCII)
    if len(safe) <= _LONGEST_NAME:
        return safe
    return f"{safe[:_LONGEST_NAME]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"


def _downloaded(root: Path) -> list[tuple[str, Path]]:
    """Ids and paths of what lies in `glbs`; what is still being downloaded ends otherwise."""
    shards = sorted(path for path in (root / "glbs").glob("*") if path.is_dir())
    return sorted((path.stem, path) for shard in shards for path in shard.iterdir() if path.suffix == ".glb")


def _listed(source: Path, choice: ObjectChoice) -> tuple[Path, list[tuple[str, Path]]]:
    """The Objaverse folder, and ids and paths of a list, in the list's order."""
    if choice.objaverse_root is None:
        raise UserError(
            f"{source} is a list of ids, but nothing says where the objects are",
            fix="name the folder that has hf-objaverse-v1 as objaverse_root",
        )
    root = objaverse_folder(choice.objaverse_root.expanduser())
    if root is None:
        raise UserError(
            "no Objaverse folder", got=str(choice.objaverse_root), wanted=f"{_VERSION_FOLDER}/glbs/000-000/<id>.glb"
        )
    ids = read_ids(source)
    if choice.keep_ids is not None:
        keep = set(read_ids(choice.keep_ids))
        ids = [uid for uid in ids if uid in keep]
    excluded = set(choice.excluded)
    ids = [uid for uid in ids if uid not in excluded]
    paths = object_paths(root, set(ids))
    absent = [uid for uid in ids if uid not in paths or not paths[uid].is_file()]
    if absent:
        unknown = sum(uid not in paths for uid in absent)
        raise UserError(
            "objects of the list are not on this disk",
            got=f"{len(absent):,} of {len(ids):,} absent ({unknown:,} of them unknown), {absent[0]} first",
            wanted=f"{root}/glbs/000-000/<id>.glb",
            fix="download them first, or list only what is there",
        )
    return root, [(uid, paths[uid]) for uid in ids]


def object_paths(root: Path, wanted: set[str]) -> dict[str, Path]:
    """Where the wanted ids lie (or will lie, once downloaded), by `object-paths.json.gz` or else by what is there."""
    index = root / "object-paths.json.gz"
    if not index.is_file():
        return {uid: path for uid, path in _downloaded(root) if uid in wanted}
    found = {}
    for uid, relative in json_entries(index):
        if uid in wanted:
            path = Path(str(relative))
            if path.is_absolute() or ".." in path.parts:
                raise UserError(f"{index} names a file outside its own folder", got=repr(relative))
            found[uid] = root / path
    return found


def _chosen(found: list[tuple[str, Path]], choice: ObjectChoice) -> list[tuple[str, Path]]:
    keep = None if choice.keep_ids is None else set(read_ids(choice.keep_ids))
    excluded = set(choice.excluded)
    return [
        (name, path)
        for name, path in found
        if not excluded & {name, path.stem} and (keep is None or keep & {name, path.stem})
    ]


def _with_licences(source: Path, root: Path | None, chosen: list[tuple[str, Path]]) -> list[CollectionObject]:
    paths = [path for _, path in chosen]
    terms = licence_of(paths, manifest_licences(root or (source if source.is_dir() else source.parent)))
    annotated: dict[str, str] = {}
    if root is not None:
        by_folder: dict[str, set[str]] = {}
        for name, path in chosen:
            by_folder.setdefault(path.parent.name, set()).add(name)
        annotated = annotated_licences(root, by_folder)
    return [
        CollectionObject(name, path, known or annotated.get(name, ""))
        for (name, path), known in zip(chosen, terms, strict=True)
    ]
