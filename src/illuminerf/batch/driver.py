"""Who does what when: steps are handed to workers as soon as what they need is done, in the order of the jobs.

One driver per batch. It keeps nothing that a driver started later could not find out: finished stages are seen in the
jobs' folders, and the rest is done.
"""

import heapq
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from illuminerf.batch.board import Board
from illuminerf.batch.finished import FinishedSteps
from illuminerf.batch.jobs import Job
from illuminerf.batch.stages import STAGES_OF_OBJECT, Stage
from illuminerf.batch.steps import REPORT, Outcome, Step, Task
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, step_progress
from illuminerf.workflow.task_pool import Crash, TaskPool

Stages = dict[str, Stage]
_LOOK_EVERY_SECONDS = 2.0
_MOST_BACKOFF_SECONDS = 600.0


@dataclass(frozen=True)
class Retries:
    """How often a step is tried where the machine, the network or the storage failed it."""

    attempts: int = 3
    backoff_seconds: float = 10.0
    """Before the second try; twice as long before each further one, ten minutes at most."""

    def delay(self, num_failures: int) -> float:
        """Seconds to wait after so many failures."""
        return min(self.backoff_seconds * 2 ** (num_failures - 1), _MOST_BACKOFF_SECONDS)


def steps_of(job: Job, stages: Stages, num_shards: int) -> dict[Step, tuple[Step, ...]]:
    """All steps of a job with those that they need, in an order in which they could be done."""
    steps: dict[Step, tuple[Step, ...]] = {}
    last: list[Step] = []

    def add(name: str, light: str) -> None:
        stage = stages[name]
        needs = tuple(Step(job.name, "" if need in STAGES_OF_OBJECT else light, need) for need in stage.needs)
        whole = Step(job.name, light, name)
        if stage.is_sharded and num_shards > 1:
            shares = tuple(Step(job.name, light, name, f"{i}/{num_shards}") for i in range(num_shards))
            steps.update(dict.fromkeys(shares, needs))
            needs = shares
        steps[whole] = needs
        if light and not any(name in other.needs for other in stages.values()):
            last.append(whole)

    for name in stages:
        if name in STAGES_OF_OBJECT:
            add(name, "")
    for light in job.light_names:
        for name in stages:
            if name not in STAGES_OF_OBJECT:
                add(name, light)
    steps[Step(job.name, "", REPORT)] = tuple(last)
    return steps


@dataclass
class Driver:
    """The state of a batch under way."""

    jobs: dict[str, Job]
    stages: dict[str, Stages]
    """By job."""
    pool: TaskPool
    board: Board
    finished: FinishedSteps
    retries: Retries
    num_shards: int
    work: Callable[[Task], Outcome]
    """What a worker does: `steps.run_step`."""
    scratch: str = ""
    _needs: dict[Step, tuple[Step, ...]] = field(default_factory=dict)
    _needed_by: dict[Step, list[Step]] = field(default_factory=dict)
    _order: dict[Step, int] = field(default_factory=dict)
    _num_missing: Counter[Step] = field(default_factory=Counter)
    _settled: dict[Step, bool] = field(default_factory=dict)
    """Steps that are over, and whether they are done."""
    _ready: dict[bool, list[tuple[int, Step]]] = field(default_factory=lambda: {False: [], True: []})
    """Heaps by whether a GPU is needed."""
    _later: list[tuple[float, int, Step]] = field(default_factory=list)
    """Heap of steps that wait for another try."""
    _num_failures: Counter[Step] = field(default_factory=Counter)
    _num_gpus_used: int = 0
    _was_worked_on: set[str] = field(default_factory=set)
    """Jobs of which something was made now."""

    def __post_init__(self) -> None:
        for name, job in self.jobs.items():
            self._needs |= steps_of(job, self.stages[name], self.num_shards)
        for number, (step, needs) in enumerate(self._needs.items()):
            self._order[step] = number
            self._num_missing[step] = len(needs)
            for need in needs:
                self._needed_by.setdefault(need, []).append(step)
        self.board.expect(self._needs)
        for step, needs in self._needs.items():
            if not needs:
                self._is_ready(step)

    def run(self) -> None:
        """Do everything that can be done."""
        with step_progress("batch", len(self._needs)) as progress:
            while len(self._settled) < len(self._needs):
                self._hand_out()
                self.board.write()
                if self.pool.num_running():
                    if self.pool.is_one_done(_LOOK_EVERY_SECONDS):
                        task, result = self.pool.next_done()
                        self._take(task, result)
                elif self._later:
                    time.sleep(min(max(self._later[0][0] - time.monotonic(), 0), _LOOK_EVERY_SECONDS))
                progress.advance(len(self._settled) - progress.completed)

    def _hand_out(self) -> None:
        while self._later and self._later[0][0] <= time.monotonic():
            self._is_ready(heapq.heappop(self._later)[2])
        while self.pool.num_running() < self.pool.num_workers:
            may_use_gpu = not self.pool.num_gpus or self._num_gpus_used < self.pool.num_gpus
            heaps = [heap for uses_gpu, heap in self._ready.items() if heap and (may_use_gpu or not uses_gpu)]
            if not heaps:
                return
            _, step = heapq.heappop(min(heaps))
            self._begin(step)

    def _begin(self, step: Step) -> None:
        job, stages = self.jobs[step.job], self.stages[step.job]
        lights = self._finished_lights(step) if step.stage == REPORT else ()
        try:
            must_renew = step.stage == REPORT and step.job in self._was_worked_on
            if not must_renew and self.finished.is_done(step, job, stages, lights):
                self.board.was_done(step)
                self._settle(step, is_done=True)
                return
        except UserError as error:
            self._fail(step, Outcome(0.0, str(error)))
            return
        except Exception as error:  # every file system has errors of its own
            self._fail(step, Outcome(0.0, f"{type(error).__name__}: {error}", may_pass=True))
            return
        is_shared = self.num_shards > 1 and step.stage != REPORT and stages[step.stage].is_sharded
        gpus = self._gpus(step)
        self._num_gpus_used += gpus
        self._was_worked_on.add(step.job)
        self.board.start(step)
        self.pool.submit(self.work, Task(step, job, is_shared, lights, self.scratch), gpus=gpus)

    def _take(self, task: Task, result: Any) -> None:
        self._num_gpus_used -= self._gpus(task.step)
        outcome = Outcome(0.0, result.message, may_pass=True) if isinstance(result, Crash) else result
        if outcome.error:
            self._fail(task.step, outcome, was_running=True)
        else:
            self.board.end(task.step, outcome)
            self._settle(task.step, is_done=True)

    def _fail(self, step: Step, outcome: Outcome, was_running: bool = False) -> None:
        self._num_failures[step] += 1
        failures = self._num_failures[step]
        again = outcome.may_pass and failures < self.retries.attempts
        if not was_running:
            self.board.start(step)
        self.board.end(step, outcome, again)
        say(f"{step} {'is tried again' if again else 'failed'}: {outcome.error}")
        if outcome.details:
            say(outcome.details)
        if again:
            delay = self.retries.delay(failures)
            heapq.heappush(self._later, (time.monotonic() + delay, self._order[step], step))
        else:
            self._settle(step, is_done=False)

    def _settle(self, step: Step, is_done: bool) -> None:
        self._settled[step] = is_done
        for other in self._needed_by.get(step, ()):
            if other in self._settled:
                continue
            self._num_missing[other] -= 1
            if other.stage != REPORT and not is_done:
                self.board.block(other)
                self._settle(other, is_done=False)
            elif not self._num_missing[other]:
                if other.stage == REPORT and not self._finished_lights(other):
                    self.board.block(other)
                    self._settle(other, is_done=False)
                else:
                    self._is_ready(other)

    def _is_ready(self, step: Step) -> None:
        heapq.heappush(self._ready[bool(self._gpus(step))], (self._order[step], step))

    def _gpus(self, step: Step) -> int:
        """GPUs that a step takes for itself, where the pool has any."""
        job = self.jobs[step.job]
        wants = step.stage != REPORT and self.stages[step.job][step.stage].uses_gpu
        return int(wants and self.pool.num_gpus > 0 and job.preset.geometry.device != "cpu")

    def _finished_lights(self, report: Step) -> tuple[str, ...]:
        lost = {step.light for step in self._needs[report] if not self._settled.get(step, False)}
        return tuple(light for light in self.jobs[report.job].light_names if light not in lost)


def shares_for(pool: TaskPool, jobs: Sequence[Job]) -> int:
    """Into how many shares the views of a stage are cut, so that all workers have something to do."""
    num_runs = sum(len(job.lights) for job in jobs)
    wanted = pool.num_gpus or pool.num_workers
    return max(1, -(-wanted // num_runs))
