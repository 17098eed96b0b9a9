"""Who does what when: hands the objects of a plan to workers, packs shards that are complete, and looks after the rest.

One driver per run; it holds no more than the plan and what is under way.
"""

from dataclasses import dataclass, field
from typing import Any

from illuminerf.cues.training_shards import (
    ObjectTask,
    PackTask,
    Plan,
    check_shard,
    clear_staging,
    leave_out_next,
    pack_shard,
    render_object,
)
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import StepProgress, say, step_progress
from illuminerf.workflow.shards import LeftOut, ShardIndex, remove_shard
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Crash, TaskPool

LIGHTS_FOLDER = "staging/lights"
"""Where lights wait for workers."""
_MAY_BE_THE_MACHINE = ("unreadable", "not rendered", "crash")
_FIRST_OBJECTS = 20


def finished_pairs(storage: Storage, plan: Plan, pool: TaskPool) -> dict[str, ShardIndex]:
    """Shards whose bytes are as they were written; damaged ones are taken away, to be made again."""
    present = {name.removesuffix(".json") for name in storage.names()} & set(plan.shards())
    if not present:
        return {}
    plan_file, finished = plan.write(storage), {}
    with step_progress("check shards", len(present)) as progress:
        for name in sorted(present):
            pool.submit(check_shard, PackTask(storage.url, plan_file, name))
        for _ in present:
            task, index = pool.next_done()
            if isinstance(index, ShardIndex):
                finished[task.shard] = index
            else:
                say(f"{storage.url}/{task.shard}.tar is damaged or missing, and is made again")
                remove_shard(storage, task.shard)
            progress.advance()
    storage.remove(plan_file)
    return finished


def render_missing(storage: Storage, plan: Plan, finished: set[str], pool: TaskPool) -> dict[str, ShardIndex]:
    """Render and pack all shards that are not finished."""
    shards = {name: members for name, members in plan.shards().items() if name not in finished}
    num_items = len(plan.objects) * plan.views.num_views
    done = num_items - plan.views.num_views * sum(map(len, shards.values()))
    for name in shards:
        storage.remove_leftovers(f"staging/{name}")
    with step_progress("render training pairs", num_items, done) as progress:
        waiting = iter([index for members in shards.values() for index in members])
        missing = {name: set(members) for name, members in shards.items()}
        driver = _Driver(storage, plan, plan.write(storage), pool, progress, missing)
        while True:
            while pool.num_running() < pool.capacity and (index := next(waiting, None)) is not None:
                driver.render(index)
            if not pool.num_running():
                return driver.made
            driver.take(*pool.next_done())


def clear(storage: Storage, plan: Plan) -> None:
    """Remove all that waited."""
    for shard in plan.shards():
        clear_staging(storage, shard)
    for folder in (LIGHTS_FOLDER, "staging"):
        storage.remove_leftovers(folder)
        for name in storage.names(folder):
            storage.remove(f"{folder}/{name}")
        storage.remove_empty(folder)


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
    made: dict[str, ShardIndex] = field(default_factory=dict)
    num_left_out: int = 0
    num_suspicious: int = 0
    """Objects in a row, from the first, of which nothing could be rendered for reasons that may be the machine's."""
    num_taken: int = 0

    def render(self, index: int) -> None:
        """Have what is missing of an object rendered."""
        self.pool.submit(render_object, ObjectTask(self.storage.url, self.plan_file, index))

    def take(self, task: ObjectTask | PackTask, outcome: Any) -> None:
        """Count a finished object or shard; pack a shard when its last object is there."""
        if isinstance(task, PackTask):
            self._packed(task, outcome)
        elif isinstance(outcome, Crash):
            # views are rendered in order: the first that is missing took the workers down, the others may be well
            key = leave_out_next(self.storage, self.plan, task.index, LeftOut("crash", outcome.message))
            say(f"left out {key}: {outcome.message}")
            self.render(task.index)
        else:
            self._rendered(task, outcome)

    def _rendered(self, task: ObjectTask, outcome: dict[str, LeftOut | None]) -> None:
        left_out = [why for why in outcome.values() if why is not None]
        self.num_left_out += len(left_out)
        if left_out:
            say(
                f"left out {len(left_out)} of {len(outcome)} views of {self.plan.objects[task.index].id}: "
                f"{left_out[0].message}"
            )
        self._check_machine(len(left_out) == len(outcome) and left_out[0].reason in _MAY_BE_THE_MACHINE, left_out)
        self.progress.advance(self.plan.views.num_views, left_out=float(self.num_left_out))
        shard = self.plan.shard_name(task.index)
        self.missing[shard].discard(task.index)
        if not self.missing[shard]:
            self.pool.submit(pack_shard, PackTask(self.storage.url, self.plan_file, shard))

    def _check_machine(self, is_suspicious: bool, left_out: list[LeftOut]) -> None:
        """Stop where not one of the first objects can be rendered, before a whole collection is given up."""
        self.num_suspicious += is_suspicious and self.num_suspicious == self.num_taken
        self.num_taken += 1
        if self.num_suspicious == self.num_taken == _FIRST_OBJECTS:
            raise nothing_rendered(self.storage, left_out[0].message)

    def _packed(self, task: PackTask, outcome: Any) -> None:
        if isinstance(outcome, Crash):
            raise UserError(f"packing {task.shard} failed", got=outcome.message, fix="run the same command again")
        if isinstance(outcome, ShardIndex):
            self.made[task.shard] = outcome
            return
        self.missing[task.shard] = set(outcome)
        for index in outcome:  # staged items that are damaged: once more
            say(f"a staged item of {self.plan.objects[index].id} is damaged, and is made again")
            self.progress.advance(-self.plan.views.num_views)
            self.render(index)


def nothing_rendered(storage: Storage, *messages: str) -> UserError:
    """The error where a whole collection gives no item."""
    return UserError(
        "not one object could be rendered",
        got=messages[0] if messages else "no objects",
        fix=f"check that every machine sees the objects and can render, delete {storage.url}, and run again",
    )
