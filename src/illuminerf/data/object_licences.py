"""Who made an object and on what terms it may be used: from a manifest table or from Objaverse's annotations."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from illuminerf.data.json_streams import json_entries
from illuminerf.workflow.errors import UserError

MANIFEST_NAME = "MANIFEST.csv"
_LEVELS_UP = 2
# Objaverse has Sketchfab's short names, which stand for version 4.0
_SHORT_NAMES = {
    "by": "CC-BY-4.0",
    "by-sa": "CC-BY-SA-4.0",
    "by-nd": "CC-BY-ND-4.0",
    "by-nc": "CC-BY-NC-4.0",
    "by-nc-sa": "CC-BY-NC-SA-4.0",
    "by-nc-nd": "CC-BY-NC-ND-4.0",
    "cc0": "CC0-1.0",
}


def manifest_licences(folder: Path) -> dict[Path, str]:
    """Licences by resolved path, from the nearest MANIFEST.csv in `folder` or up to two levels above; {} without one.

    The table has a column `file` (relative to the manifest), `licence` or `license`, and perhaps `author`.

    Raises:
        UserError: the table is not readable.
    """
    folders = [folder.resolve(), *folder.resolve().parents][: _LEVELS_UP + 1]
    path = next((place / MANIFEST_NAME for place in folders if (place / MANIFEST_NAME).is_file()), None)
    if path is None:
        return {}
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is not a readable table", got=str(error), wanted="CSV in UTF-8") from error
    found = {}
    for row in rows:
        name, terms = row.get("file"), row.get("licence") or row.get("license")
        if name and terms:
            found[path.parent / name] = _with_author(terms, row.get("author"))
    return found


def annotated_licences(root: Path, uids_by_folder: dict[str, set[str]]) -> dict[str, str]:
    """Licences by id from Objaverse's `metadata/<folder>.json.gz`, where those files are.

    Args:
        root: the folder that has `glbs` and `metadata`.
        uids_by_folder: the ids that are wanted, by the folder of `glbs` that they lie in.
    """
    found = {}
    for folder, uids in sorted(uids_by_folder.items()):
        path = root / "metadata" / f"{folder}.json.gz"
        if not path.is_file():
            continue
        for uid, annotation in json_entries(path):
            if uid in uids and isinstance(annotation, dict):
                found[uid] = _annotated(annotation)
    return found


def _annotated(annotation: dict[str, Any]) -> str:
    short = str(annotation.get("license") or "")
    user = annotation.get("user")
    author = (user.get("displayName") or user.get("username")) if isinstance(user, dict) else None
    return _with_author(_SHORT_NAMES.get(short, short), author)


def _with_author(terms: str, author: Any) -> str:
    return f"{terms} ({author})" if terms and author else terms


def licence_of(paths: Iterable[Path], licences: dict[Path, str]) -> list[str]:
    """The licence of each path, "" where none is known."""
    return [licences.get(path.resolve(), "") for path in paths]
