"""Objects x views x lights -> the pairs a relighting model learns from (paper, 3.3 and supplement).

`out` is a folder or any fsspec URL. It comes to hold
    pairs-<000000>.tar, .json   WebDataset shards and their indices (see `scene.relighting_pairs`, `workflow.shards`)
    manifest.json               shards, counts, licences, and what was left out with the reason
    config.json, inputs.json, provenance.json, DONE
Work is spread by object. A finished item waits in `staging/` until all items of its shard are there; then they become
a shard, which is never written again. A killed run or worker therefore loses the items it was at and no more, and the
same seed gives the same bytes however many processes or machines made them.
"""

import hashlib
import json
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from illuminerf.cues.light_library import light_names, light_paths, store_light
from illuminerf.cues.object_views import ObjectFile, ViewSettings
from illuminerf.cues.shard_driver import LIGHTS_FOLDER, clear, finished_pairs, nothing_rendered, render_missing
from illuminerf.cues.training_shards import Plan
from illuminerf.data.object_collection import ObjectChoice, list_objects
from illuminerf.workflow.artefact import fingerprint, is_stranger, locked, provenance, refuse_other_key
from illuminerf.workflow.atomic import explained_errors
from illuminerf.workflow.config import to_json
from illuminerf.workflow.device import numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, step_progress
from illuminerf.workflow.shards import ShardIndex, remove_shard
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Execution, open_pool

STAGE = "render_training_pairs"
SCHEMA = 2


@dataclass(frozen=True)
class Config:
    """What is rendered, and how it is stored."""

    views: ViewSettings = field(default_factory=ViewSettings)
    """What is rendered of each object."""
    objects_per_shard: int = 16
    """Objects whose views share one shard."""
    choice: ObjectChoice = field(default_factory=ObjectChoice)
    """Which objects of the collection are taken."""

    def __post_init__(self) -> None:
        if self.objects_per_shard < 1:
            raise UserError("objects_per_shard is too small", got=str(self.objects_per_shard), wanted="1 or more")

    @staticmethod
    def paper() -> "Config":
        """The paper's numbers: 4 views of 512 x 512 at 512 samples, objects as they are."""
        return Config(ViewSettings.paper(), objects_per_shard=8)


def run(objects: Path, lights: Path, config: Config, out: str | Path, execution: Execution | None = None) -> str | Path:
    """Render every view of every object under random lights; broken objects are named in `manifest.json` with the
    reason, and never replaced by others.

    Args:
        objects: a folder of model files, an Objaverse folder, or a list of Objaverse ids (`data.object_collection`).
        lights: a folder of .exr or .hdr environment maps.
        config: the settings.
        out: a folder or an fsspec URL.
        execution: processes or a Ray cluster; the result does not depend on it.

    Raises:
        UserError: there are no objects or too few lights, `out` was made with other settings, or it cannot be written.
    """
    execution = execution or Execution(workers=0)
    renderer = config.views.check_renderer()
    storage = Storage(out)
    storage.check_reachable()
    collection, maps = _objects(objects, config.choice), light_paths(lights)
    order = numpy_generator(config.views.seed, "order of objects").permutation(len(collection))
    in_order = tuple(collection[i] for i in order)
    plan = Plan(in_order, (), config.views, config.objects_per_shard, renderer)
    key = {"schema": SCHEMA, "stage": STAGE, "config": to_json(_keyed(config))}
    made_from = {"objects": _collection_digest(collection), "lights": _lights_digest(maps)}
    start = time.monotonic()
    with _place(storage):
        _check_key(storage, key, made_from)
        storage.remove_leftovers()
        storage.write_json("config.json", key)
        storage.write_json("inputs.json", made_from)
        with open_pool(execution) as pool:
            finished = finished_pairs(storage, plan, pool)
            if len(finished) == len(plan.shards()) and _is_sealed(storage):
                if _left_out(finished) == json.loads(storage.read("manifest.json"))["left_out"]:
                    return out
                say("what was left out is not what the manifest says: the shards that say so are made again")
                for name in [name for name, index in finished.items() if index.left_out]:
                    remove_shard(storage, name)
                    del finished[name]
            storage.remove("DONE")
            usable, unusable = _store_lights(storage, maps, config.views)
            plan = replace(plan, lights=usable)
            finished |= render_missing(storage, plan, set(finished), pool)
        manifest = _manifest(plan, config, finished, unusable)
        if not manifest["num_items"]:
            raise nothing_rendered(storage, *(why["message"] for why in manifest["left_out"].values()))
        clear(storage, plan)
        storage.write_json("manifest.json", manifest)
        rendered = {name: manifest[name] for name in ("num_items", "num_ordered_pairs", "left_out_by_reason")}
        storage.write_json("provenance.json", provenance(time.monotonic() - start, rendered))
        storage.write("DONE", _digest(storage, "manifest.json"))
    return out


@contextmanager
def _place(storage: Storage) -> Iterator[None]:
    """Hold the lock of a folder on this machine, and say in one line what is wrong with its disk."""
    lock = locked(storage.path) if storage.path else nullcontext()
    with explained_errors(storage.path or Path(storage.url)), lock:
        yield


def _left_out(shards: dict[str, ShardIndex]) -> dict[str, Any]:
    """By key, why items are missing."""
    left_out = {key: why for index in shards.values() for key, why in index.left_out.items()}
    return {key: to_json(why) for key, why in sorted(left_out.items())}


def _keyed(config: Config) -> Config:
    """The config without what says where things are and changes no result."""
    sampling = replace(config.views.cue_sampling, device="auto")
    return replace(config, views=replace(config.views, blender="", cue_sampling=sampling))


def _objects(source: Path, choice: ObjectChoice) -> list[ObjectFile]:
    """The collection, with absolute paths for workers elsewhere."""
    return [ObjectFile(item.id, str(item.path.absolute()), item.licence) for item in list_objects(source, choice)]


def _collection_digest(collection: list[ObjectFile]) -> str:
    """Names, sizes and licences in order; contents are hashed when they are read, and recorded in each item."""
    lines = (f"{item.id}\0{_size(Path(item.path))}\0{item.licence}\n" for item in collection)
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _size(path: Path) -> int:
    """Of a file; -1 where it cannot be seen, which whoever renders it will explain."""
    try:
        return path.stat().st_size
    except OSError:
        return -1


def _lights_digest(paths: list[Path]) -> str:
    return hashlib.sha256("".join(f"{path.name}\0{fingerprint(path)}\n" for path in paths).encode()).hexdigest()


def _store_lights(
    storage: Storage, paths: list[Path], settings: ViewSettings
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Put maps that can light a scene where workers find them; their names, and what is wrong with the others."""
    usable, unusable = [], {}
    with step_progress("prepare lights", len(paths)) as progress:
        for path in paths:
            try:
                usable.append(store_light(storage, LIGHTS_FOLDER, path, settings.light_height))
            except UserError as error:
                unusable[path.stem] = str(error)
                say(f"the light {path.stem} is left out: {error}")
            progress.advance()
    if len(usable) < settings.num_lights:
        raise UserError(
            "there are too few lights",
            got=f"{len(usable)} usable and {len(unusable)} unusable maps",
            wanted=f"{settings.num_lights} .exr or .hdr maps",
        )
    return tuple(usable), unusable


def _check_key(storage: Storage, key: dict[str, Any], made_from: dict[str, str]) -> None:
    try:
        old_key, old_inputs = (json.loads(storage.read(name)) for name in ("config.json", "inputs.json"))
    except (FileNotFoundError, ValueError):
        strangers = [name for name, _ in storage.entries() if is_stranger(name)]
        if strangers:
            raise UserError(
                f"{storage.url} holds files that are not a run of this program",
                got=strangers[0],
                fix="choose an empty or a new folder with --out",
            ) from None
        return
    refuse_other_key(storage.url, old_key, key, old_inputs, made_from)


def _digest(storage: Storage, name: str) -> bytes:
    return (hashlib.sha256(storage.read(name)).hexdigest() + "\n").encode()


def _is_sealed(storage: Storage) -> bool:
    """Whether the run said that it is finished, and its manifest is what it wrote."""
    try:
        return storage.read("DONE") == _digest(storage, "manifest.json")
    except FileNotFoundError:
        return False


def _manifest(
    plan: Plan, config: Config, shards: dict[str, ShardIndex], unusable_lights: dict[str, str]
) -> dict[str, Any]:
    left_out = _left_out(shards)
    num_items = sum(len(index.keys) for index in shards.values())
    num_lights = plan.views.num_lights
    return {
        "num_objects": len(plan.objects),
        "num_items": num_items,
        "num_ordered_pairs": num_items * num_lights * (num_lights - 1),
        "shards": {
            name: {"sha256": index.sha256, "num_bytes": index.num_bytes, "num_items": len(index.keys)}
            for name, index in sorted(shards.items())
        },
        "excluded": sorted(config.choice.excluded),
        "left_out": left_out,
        "left_out_by_reason": dict(sorted(Counter(why["reason"] for why in left_out.values()).items())),
        "lights": light_names(plan.lights),
        "lights_left_out": dict(sorted(unusable_lights.items())),
        "licences": {item.id: item.licence for item in sorted(plan.objects, key=lambda item: item.id) if item.licence},
    }
