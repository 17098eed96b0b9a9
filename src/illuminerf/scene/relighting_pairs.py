"""A training item on disk: one object from one camera under several lights, with radiance cues and G-buffer.

Only covered pixels are kept, in row-major order: a third of all, as a rule. `alpha` says where they belong.
A sample of a shard is `<key>.safetensors` with
    alpha        uint8 [height, width]        coverage times 255; a pixel is covered where it is above 0
    targets      float16 [lights, 3, covered]   linear rec.709 radiance, premultiplied, at most 65504
    cues         float16 [lights, 12, covered]  linear, premultiplied: diffuse, GGX 0.05, 0.13, 0.34, each RGB
    albedo       uint8 [3, covered]           base colour, sRGB coded, straight
    roughness, metallic  uint8 [covered]      times 255, straight
    normal       float16 [3, covered]         unit, world frame, towards the camera
and `<key>.json`: object, object_sha256, view, split, variations, lights (name, rotation_radians, is_flipped,
permutation, scale), dent_tilts_degrees (empty: exact cues), camera, coverage, licences.
From k lights come k * (k - 1) ordered pairs: input under one light, cues and target under another.
"""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from illuminerf.scene.images import srgb_from_linear
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.shards import ShardIndex, finished_shards, read_shard
from illuminerf.workflow.storage import Storage

PREFIX = "pairs-"
FIELDS = ("alpha", "targets", "cues", "albedo", "roughness", "metallic", "normal")
_HALF_MAX = 65504.0


def encode_item(
    targets: np.ndarray,
    cues: np.ndarray,
    alpha: np.ndarray,
    base_color: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
    normal: np.ndarray,
    metadata: dict[str, Any],
) -> dict[str, bytes]:
    """Dense arrays to the files of one sample, by extension.

    Args:
        targets: [lights, 3, height, width], linear, premultiplied.
        cues: [lights, 12, height, width], linear, premultiplied.
        alpha: [height, width] in [0, 1].
        base_color: [3, height, width], linear, straight.
        roughness, metallic: [height, width].
        normal: [3, height, width].
        metadata: written as JSON with sorted keys.
    """
    coverage = _byte(alpha)
    covered = coverage > 0
    arrays = {
        "alpha": coverage,
        "targets": _half(targets[..., covered]),
        "cues": _half(cues[..., covered]),
        "albedo": _byte(srgb_from_linear(base_color[..., covered])),
        "roughness": _byte(roughness[covered]),
        "metallic": _byte(metallic[covered]),
        "normal": _half(normal[..., covered]),
    }
    text = json.dumps(metadata, sort_keys=True, allow_nan=False)
    return {"safetensors": save(arrays), "json": text.encode()}


def decode_item(content: bytes, name: str = "item") -> dict[str, np.ndarray]:
    """Dense arrays [..., height, width] of a `.safetensors` sample, 0 off the object; usable as a WebDataset decoder.

    Raises:
        UserError: the content is damaged, or a field is missing or of the wrong size.
    """
    try:
        arrays = load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise UserError(f"{name} is damaged", got=str(error), fix="render the pairs again") from error
    missing = [field for field in FIELDS if field not in arrays]
    if missing:
        raise UserError(f"{name} lacks '{missing[0]}'", got=", ".join(sorted(arrays)), fix="render the pairs again")
    alpha = arrays.pop("alpha")
    covered = alpha > 0
    dense = {"alpha": alpha}
    for field, values in arrays.items():
        if values.shape[-1:] != (int(covered.sum()),):
            raise UserError(f"{name} has a '{field}' of the wrong size", got=str(values.shape))
        dense[field] = np.zeros((*values.shape[:-1], *alpha.shape), values.dtype)
        dense[field][..., covered] = values
    return dense


Item = tuple[str, dict[str, np.ndarray], dict[str, Any]]
"""Key, dense arrays, metadata."""


def iterate_items(out: str | Path) -> Iterator[Item]:
    """(key, dense arrays, metadata) of every item in the finished shards of a folder or fsspec URL, in order.

    Raises:
        UserError: a shard is damaged.
    """
    storage = Storage(out)
    for index in _shards(storage):
        yield from _items(storage, index)


def spread_items(out: str | Path, wanted: int) -> Iterator[Item]:
    """At most `wanted` items, evenly spread; only the shards that hold them are read.

    Raises:
        UserError: one of these shards is damaged.
    """
    storage = Storage(out)
    indices = _shards(storage)
    keys = [key for index in indices for key in index.keys]
    shown = {keys[i] for i in np.linspace(0, len(keys) - 1, min(wanted, len(keys))).round().astype(int)}
    for index in indices:
        if shown & set(index.keys):
            yield from (item for item in _items(storage, index) if item[0] in shown)


def _shards(storage: Storage) -> list[ShardIndex]:
    """All shards; where the run that made them is finished, those of its manifest.

    Raises:
        UserError: the manifest is damaged, or names a shard that is missing or another one.
    """
    found = finished_shards(storage)
    try:
        sealed, content = storage.read("DONE"), storage.read("manifest.json")
    except FileNotFoundError:  # unfinished, or shards from elsewhere
        return found
    fix = "render the pairs again with the same command: it mends what is damaged"
    if sealed.strip() != hashlib.sha256(content).hexdigest().encode():
        raise UserError(f"{storage.url}/manifest.json is damaged", got="another sha256 than DONE says", fix=fix)
    listed = {name: shard["sha256"] for name, shard in json.loads(content)["shards"].items()}
    present = {index.name: index.sha256 for index in found}
    for name in sorted({*listed, *present}):
        if listed.get(name) != present.get(name):
            raise UserError(f"{storage.url}/{name} is damaged or not of this run", got=present.get(name, ""), fix=fix)
    return found


def _items(storage: Storage, index: ShardIndex) -> Iterator[Item]:
    for key, files in read_shard(storage, index):
        yield key, decode_item(files["safetensors"], key), json.loads(files["json"])


def _half(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.clip(array, -_HALF_MAX, _HALF_MAX).astype(np.float16))


def _byte(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.rint(np.clip(array, 0, 1) * 255).astype(np.uint8))
