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
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from illuminerf.cues.light_library import light_paths, load_light
from illuminerf.cues.object_views import ObjectFile, ViewSettings
from illuminerf.cues.training_shards import (
    ObjectTask,
    PackTask,
    Plan,
    leave_out_missing,
    pack_shard,
    render_object,
)
from illuminerf.data.object_collection import ObjectChoice, list_objects
from illuminerf.workflow.artefact import fingerprint, locked, provenance, refuse_other_key
from illuminerf.workflow.config import to_json
from illuminerf.workflow.device import numpy_generator
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import StepProgress, say, step_progress
from illuminerf.workflow.shards import LeftOut, ShardIndex, is_intact, read_index, remove_shard
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Crash, Execution, TaskPool, open_pool

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
            raise UserError("objects_per_shard must be at least 1")

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
    execution = execution or Execution()
    config.views.check_renderer()
    storage = Storage(out)
    collection = _objects(objects, config.choice)
    usable, unusable_lights = _usable_lights(lights, config.views)
    order = numpy_generator(config.views.seed, "order of objects").permutation(len(collection))
    plan = Plan(
        tuple(collection[i] for i in order), tuple(str(path) for path in usable), config.views, config.objects_per_shard
    )
    key = {"schema": SCHEMA, "stage": STAGE, "config": to_json(config)}
    made_from = {"objects": _collection_digest(collection), "lights": fingerprint(lights)}
    start = time.monotonic()
    with locked(storage.path) if storage.path else nullcontext():
        _check_key(storage, key, made_from)
        storage.remove_leftovers()
        storage.write_json("config.json", key)
        storage.write_json("inputs.json", made_from)
        finished = _finished(storage, plan)
        if len(finished) < len(plan.shards()) or not storage.exists("DONE"):
            storage.remove("DONE")
            finished |= _render_missing(storage, plan, set(finished), execution)
            manifest = _manifest(plan, config, finished, unusable_lights)
            storage.write_json("manifest.json", manifest)
            rendered = {name: manifest[name] for name in ("num_items", "num_ordered_pairs", "left_out_by_reason")}
            storage.write_json("provenance.json", provenance(time.monotonic() - start, rendered))
            storage.write("DONE", (hashlib.sha256(storage.read("manifest.json")).hexdigest() + "\n").encode())
    return out


def _objects(source: Path, choice: ObjectChoice) -> list[ObjectFile]:
    """The collection, with ids that may be keys of samples: a dot would end a key."""
    found, taken = [], set()
    for item in list_objects(source, choice):
        identity = item.id.replace(".", "-")
        while identity in taken:
            identity += "-"
        taken.add(identity)
        found.append(ObjectFile(identity, str(item.path), item.licence))
    return found


def _collection_digest(collection: list[ObjectFile]) -> str:
    """Names and sizes; contents are hashed when they are read, and recorded in each item."""
    lines = (f"{item.id}\0{Path(item.path).stat().st_size}\n" for item in collection)
    return hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()


def _usable_lights(folder: Path, settings: ViewSettings) -> tuple[list[Path], dict[str, str]]:
    """Maps that can light a scene, and what is wrong with the others by name."""
    paths = light_paths(folder)
    usable, unusable = [], {}
    with step_progress("check lights", len(paths)) as progress:
        for path in paths:
            try:
                load_light(path, settings.light_height)
                usable.append(path)
            except UserError as error:
                unusable[path.stem] = str(error)
                say(f"the light {path.stem} is left out: {error}")
            progress.advance()
    if len(usable) < settings.num_lights:
        raise UserError(
            f"{folder} holds too few lights",
            got=f"{len(usable)} usable and {len(unusable)} unusable maps",
            wanted=f"{settings.num_lights} .exr or .hdr maps",
        )
    return usable, unusable


def _check_key(storage: Storage, key: dict[str, Any], made_from: dict[str, str]) -> None:
    try:
        old_key, old_inputs = (json.loads(storage.read(name)) for name in ("config.json", "inputs.json"))
    except (FileNotFoundError, ValueError):
        strangers = [name for name in storage.names() if name not in ("config.json", "inputs.json", ".lock")]
        if strangers:
            raise UserError(
                f"{storage.url} holds files that are not a run of this program",
                got=strangers[0],
                fix="choose an empty or a new folder with --out",
            ) from None
        return
    refuse_other_key(storage.url, old_key, key, old_inputs, made_from)


def _finished(storage: Storage, plan: Plan) -> dict[str, ShardIndex]:
    """Shards whose bytes are as they were written; damaged ones are taken away, to be made again."""
    finished = {}
    names = plan.shards()
    with step_progress("check shards", len(names)) as progress:
        for name in names:
            index = read_index(storage, name)
            if index is not None and is_intact(storage, index):
                finished[name] = index
            elif index is not None:
                say(f"{storage.url}/{name}.tar is damaged or missing, and is made again")
                remove_shard(storage, name)
            progress.advance()
    return finished


def _render_missing(storage: Storage, plan: Plan, finished: set[str], execution: Execution) -> dict[str, ShardIndex]:
    """Render and pack all shards that are not finished."""
    plan_file = plan.write(storage)
    made: dict[str, ShardIndex] = {}
    shards = {name: members for name, members in plan.shards().items() if name not in finished}
    per_object = plan.views.num_views
    num_items = len(plan.objects) * per_object
    done = num_items - per_object * sum(map(len, shards.values()))
    with step_progress("render training pairs", num_items, done) as progress, open_pool(execution) as pool:
        waiting = iter([index for members in shards.values() for index in members])
        driver = _Driver(storage, plan, plan_file, pool, progress, {name: set(m) for name, m in shards.items()}, made)
        while True:
            while pool.num_running() < pool.capacity and (index := next(waiting, None)) is not None:
                pool.submit(render_object, ObjectTask(storage.url, plan_file, index))
            if not pool.num_running():
                break
            driver.take(*pool.next_done())
    storage.remove(plan_file)
    for folder in (*(f"staging/{name}" for name in shards), "staging"):
        storage.remove_empty(folder)
    return made


@dataclass
class _Driver:
    """What to do when a task is done."""

    storage: Storage
    plan: Plan
    plan_file: str
    pool: TaskPool
    progress: StepProgress
    missing: dict[str, set[int]]
    """Objects by shard that are still to come."""
    made: dict[str, ShardIndex]
    num_left_out: int = 0

    def take(self, task: ObjectTask | PackTask, outcome: Any) -> None:
        """Count a finished object or shard; pack a shard when its last object is there."""
        if isinstance(task, PackTask):
            self._packed(task, outcome)
            return
        shard = self.plan.shard_name(task.index)
        if isinstance(outcome, Crash):
            outcome = leave_out_missing(self.storage, self.plan, task.index, LeftOut("crash", outcome.message))
        for key, left_out in outcome.items():
            self.num_left_out += left_out is not None
            if left_out is not None and key.endswith("_0"):
                say(f"left out {key}: {left_out.message}")
        self.progress.advance(self.plan.views.num_views, left_out=float(self.num_left_out))
        self.missing[shard].discard(task.index)
        if not self.missing[shard]:
            self.pool.submit(pack_shard, PackTask(self.storage.url, self.plan_file, shard))

    def _packed(self, task: PackTask, outcome: Any) -> None:
        if isinstance(outcome, Crash):
            raise UserError(f"packing {task.shard} failed", got=outcome.message, fix="run the same command again")
        if isinstance(outcome, ShardIndex):
            self.made[task.shard] = outcome
            return
        self.missing[task.shard] = set(outcome)
        for index in outcome:  # staged items that are damaged: once more
            say(f"a staged item of {self.plan.objects[index].id} is damaged, and is made again")
            self.pool.submit(render_object, ObjectTask(self.storage.url, self.plan_file, index))


def _manifest(
    plan: Plan, config: Config, shards: dict[str, ShardIndex], unusable_lights: dict[str, str]
) -> dict[str, Any]:
    left_out = {key: why for index in shards.values() for key, why in index.left_out.items()}
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
        "left_out": {key: to_json(why) for key, why in sorted(left_out.items())},
        "left_out_by_reason": dict(sorted(Counter(why.reason for why in left_out.values()).items())),
        "lights": sorted(Path(path).stem for path in plan.lights),
        "lights_left_out": dict(sorted(unusable_lights.items())),
        "licences": {item.id: item.licence for item in sorted(plan.objects, key=lambda item: item.id) if item.licence},
    }
