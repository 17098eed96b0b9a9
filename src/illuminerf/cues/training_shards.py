"""Training pairs as shards: the plan, and the two kinds of task that carry it out on any number of machines.

An item that is rendered waits in `staging/<shard>/<key>.item` (its sha256, then a little tar); where there can be none,
`<key>.json` there says why. When all items of a shard wait, they are joined.
"""

import functools
import hashlib
import json
import platform
from dataclasses import dataclass

from illuminerf.cues.light_library import StoredLights
from illuminerf.cues.object_views import ObjectFile, ViewSettings, item_key, render_views
from illuminerf.scene.relighting_pairs import PREFIX
from illuminerf.workflow.config import from_json, to_json
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.heartbeat import alive
from illuminerf.workflow.shards import LeftOut, ShardIndex, is_intact, read_index, sample_tar, write_shard
from illuminerf.workflow.storage import Storage

_DIGEST_BYTES = 32


@dataclass(frozen=True)
class Plan:
    """Everything a worker needs to know; written once, so that tasks stay small."""

    objects: tuple[ObjectFile, ...]
    """In the order in which they are dealt to shards."""
    lights: tuple[str, ...]
    """Names of usable maps in the storage (`light_library.StoredLights`)."""
    views: ViewSettings
    """What is rendered of each object."""
    objects_per_shard: int
    """Objects whose views share one shard."""
    renderer: str
    """What the driver renders with, see `ViewSettings.check_renderer`."""

    def shard_name(self, index: int) -> str:
        """The shard that an object's items go to."""
        return f"{PREFIX}{index // self.objects_per_shard:06d}"

    def shards(self) -> dict[str, list[int]]:
        """Object indices by shard."""
        result: dict[str, list[int]] = {}
        for index in range(len(self.objects)):
            result.setdefault(self.shard_name(index), []).append(index)
        return result

    def keys(self, index: int) -> list[str]:
        """Item keys of one object."""
        return [item_key(self.objects[index].id, view) for view in range(self.views.num_views)]

    def write(self, storage: Storage) -> str:
        """Store the plan for workers to read; its name."""
        content = to_json(self)
        name = f"staging/plan-{hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]}.json"
        storage.write_json(name, content)
        return name


@dataclass(frozen=True)
class ObjectTask:
    """Render what is missing of one object."""

    out: str
    plan: str
    index: int


@dataclass(frozen=True)
class PackTask:
    """Join the staged items of one shard."""

    out: str
    plan: str
    shard: str


@functools.lru_cache(maxsize=2)
def read_plan(out: str, name: str) -> Plan:
    """What `Plan.write` stored; read once per process."""
    return from_json(Plan, json.loads(Storage(out).read(name)))


def render_object(task: ObjectTask) -> dict[str, LeftOut | None]:
    """Render the views of one object that are not staged yet; by key, None or why there is no item."""
    storage, plan = Storage(task.out), read_plan(task.out, task.plan)
    if (here := plan.views.check_renderer()) != plan.renderer:
        raise UserError(
            f"machines of one run must render alike, and {platform.node()} does not",
            got=here,
            wanted=plan.renderer,
            fix="install the same libraries everywhere (for llvm_ad_rgb: libllvm19)",
        )
    folder, keys = f"staging/{plan.shard_name(task.index)}", plan.keys(task.index)
    views = _missing_views(storage, plan, task.index)
    result: dict[str, LeftOut | None] = {key: None for key in keys}
    lights = StoredLights(storage.url, plan.lights)
    for view, made in render_views(plan.objects, task.index, lights, plan.views, views):
        alive()
        if isinstance(made, LeftOut):
            result[keys[view]] = made
            storage.write_json(f"{folder}/{keys[view]}.json", to_json(made))
        else:
            content = sample_tar(keys[view], made)
            storage.write(f"{folder}/{keys[view]}.item", hashlib.sha256(content).digest() + content)
    return result


def leave_out_next(storage: Storage, plan: Plan, index: int, why: LeftOut) -> str | None:
    """Give up the view that an object's dead workers were at, the first that is not staged; its key."""
    missing = _missing_views(storage, plan, index)
    if not missing:
        return None
    key = plan.keys(index)[missing[0]]
    storage.write_json(f"staging/{plan.shard_name(index)}/{key}.json", to_json(why))
    return key


def _missing_views(storage: Storage, plan: Plan, index: int) -> list[int]:
    """Views of an object that are neither staged nor given up."""
    staged = set(storage.names(f"staging/{plan.shard_name(index)}"))
    return [view for view, key in enumerate(plan.keys(index)) if not staged & {f"{key}.item", f"{key}.json"}]


def pack_shard(task: PackTask) -> ShardIndex | list[int]:
    """Join the staged items of a shard and write it; or the objects whose staged items are damaged or gone.

    Where the shard is there already, because a worker died before it could say so, only its staging is cleared.
    """
    storage, plan = Storage(task.out), read_plan(task.out, task.plan)
    folder = f"staging/{task.shard}"
    if (index := check_shard(task)) is not None:
        clear_staging(storage, task.shard)
        return index
    samples: list[bytes] = []
    left_out: dict[str, LeftOut] = {}
    damaged = []
    for member in plan.shards()[task.shard]:
        for key in plan.keys(member):
            staged = _staged(storage, folder, key)
            if isinstance(staged, LeftOut):
                left_out[key] = staged
            elif staged is not None:
                samples.append(staged)
            elif member not in damaged:
                damaged.append(member)
    if damaged:
        return damaged
    written = write_shard(storage, task.shard, samples, left_out)
    clear_staging(storage, task.shard)
    return written


def check_shard(task: PackTask) -> ShardIndex | None:
    """The index of a shard that is finished, whose bytes are as they were written, and which holds what is planned."""
    storage, plan = Storage(task.out), read_plan(task.out, task.plan)
    index = read_index(storage, task.shard)
    if index is None:
        return None
    planned = {key for member in plan.shards()[task.shard] for key in plan.keys(member)}
    is_as_planned = planned == {*index.keys, *index.left_out}
    return index if is_as_planned and is_intact(storage, index) else None


def clear_staging(storage: Storage, shard: str) -> None:
    """Remove what waits for a shard that is finished."""
    for name in storage.names(f"staging/{shard}"):
        storage.remove(f"staging/{shard}/{name}")
    storage.remove_empty(f"staging/{shard}")


def _staged(storage: Storage, folder: str, key: str) -> bytes | LeftOut | None:
    """A staged item's little tar, why there is none, or None where it must be made again."""
    try:
        content = storage.read(f"{folder}/{key}.item")
        if hashlib.sha256(content[_DIGEST_BYTES:]).digest() == content[:_DIGEST_BYTES]:
            return content[_DIGEST_BYTES:]
        storage.remove(f"{folder}/{key}.item")
    except FileNotFoundError:
        pass
    try:
        return from_json(LeftOut, json.loads(storage.read(f"{folder}/{key}.json")))
    except FileNotFoundError:
        return None
    except (ValueError, UserError):
        storage.remove(f"{folder}/{key}.json")
        return None
