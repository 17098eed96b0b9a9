"""A model or run folder as a few safetensors files under a size limit, for machines that let only small files go.

`index.json` holds every JSON and text file of the folder and says which piece of which tensor is where;
`NNN.safetensors` hold the pieces. Tensors are cut where a file is full. `unpack` gives the same tensors, bit by bit,
and the same texts.
"""

import hashlib
import json
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load, save, save_file

from illuminerf.workflow.atomic import write_bytes, write_json
from illuminerf.workflow.errors import UserError

LIMIT = 16 * 2**20 - 2**18
"""Bytes of tensors in one file; the rest of 16 MiB is for its header."""
_TEXTS = (".json", ".txt", ".md")
_NAMED_TEXTS = ("DONE",)


def pack(folder: Path, carried: Path, limit: int = LIMIT, left_out: str = "") -> list[Path]:
    """Write the JSON, text and safetensors files of `folder`; pictures, and names that match `left_out`, stay behind.

    Returns:
        The files that were written, the index first.
    """
    texts: dict[str, str] = {}
    headers: dict[str, dict[str, str]] = {}
    pieces: list[dict[str, Any]] = []
    files: list[dict[str, torch.Tensor]] = [{}]
    room = limit
    for path in _carried_files(folder, left_out):
        name = path.relative_to(folder).as_posix()
        if path.suffix != ".safetensors":
            texts[name] = path.read_text()
            continue
        with safe_open(str(path), framework="pt") as stream:
            headers[name] = stream.metadata() or {}
            for key in sorted(stream.keys()):
                tensor = stream.get_tensor(key)
                flat, start = tensor.reshape(-1), 0
                while start < flat.numel() or start == 0:
                    if room < tensor.element_size():
                        files.append({})
                        room = limit
                    part = flat[start : start + room // tensor.element_size()].clone()
                    entry = {"of": name, "tensor": key, "shape": list(tensor.shape)}
                    pieces.append(entry | {"file": f"{len(files) - 1:03d}.safetensors", "name": str(len(files[-1]))})
                    files[-1][str(len(files[-1]))] = part
                    room -= part.numel() * part.element_size()
                    start += max(1, part.numel())
    digests = {}
    for stale in carried.glob("*.safetensors"):
        stale.unlink()
    for number, tensors in enumerate(files):
        content = save(tensors)
        digests[f"{number:03d}.safetensors"] = hashlib.sha256(content).hexdigest()
        write_bytes(carried / f"{number:03d}.safetensors", content)
    write_json(carried / "index.json", {"texts": texts, "headers": headers, "sha256": digests, "pieces": pieces})
    return [carried / "index.json", *(carried / name for name in digests)]


def _carried_files(folder: Path, left_out: str) -> list[Path]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [
        path
        for path in files
        if (path.suffix in (".safetensors", *_TEXTS) or path.name in _NAMED_TEXTS) and not fnmatch(path.name, left_out)
    ]


def unpack(carried: Path, folder: Path) -> None:
    """Make the folder that was packed.

    Raises:
        UserError: a file is missing or not as it was written.
    """
    try:
        index = json.loads((carried / "index.json").read_text())
        contents = {name: (carried / name).read_bytes() for name in index["sha256"]}
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{carried} is not a carried folder", got=str(error), wanted="index.json and its files"
        ) from error
    for name, content in contents.items():
        if hashlib.sha256(content).hexdigest() != index["sha256"][name]:
            raise UserError(
                f"{carried / name} is damaged", got="another sha256 than index.json says", fix="copy it again"
            )
    loaded = {name: load(content) for name, content in contents.items()}
    parts: dict[str, dict[str, list[torch.Tensor]]] = {name: {} for name in index["headers"]}
    shapes = {}
    for entry in index["pieces"]:
        parts[entry["of"]].setdefault(entry["tensor"], []).append(loaded[entry["file"]][entry["name"]])
        shapes[entry["of"], entry["tensor"]] = entry["shape"]
    for name, tensors in parts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = {key: torch.cat(pieces).reshape(shapes[name, key]) for key, pieces in tensors.items()}
        save_file(whole, path, metadata=index["headers"][name] or None)
    for name, text in index["texts"].items():
        write_bytes(folder / name, text.encode())


def differences(folder: Path, other: Path, left_out: str = "") -> list[str]:
    """Names of tensors, headers and texts in which two folders differ; what `pack` leaves behind is not looked at."""
    found = []
    for path in _carried_files(folder, left_out):
        name = path.relative_to(folder).as_posix()
        if path.suffix != ".safetensors":
            found += [name] * (path.read_bytes() != (other / name).read_bytes())
            continue
        with safe_open(str(path), "pt") as a, safe_open(str(other / name), "pt") as b:
            names = set(a.keys())
            if names != set(b.keys()) or (a.metadata() or {}) != (b.metadata() or {}):
                found.append(name)
                continue
            pairs = ((key, a.get_tensor(key), b.get_tensor(key)) for key in sorted(names))
            found += [f"{name}:{key}" for key, x, y in pairs if x.dtype != y.dtype or not torch.equal(x, y)]
    return found
