"""Many independent tasks: in this process, in many processes, or on many machines with Ray, by the same code.

A worker that dies (a crash in native code, a lost machine, the out-of-memory killer) costs the task it was at: the
task is tried again elsewhere, and reported as `Crash` when it keeps failing. So does one that runs out of memory, or
goes on for too long without a sign of life (`heartbeat.alive`). Other errors that are raised are not retried.
"""

import importlib
import multiprocessing
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from pebble import ProcessExpired, ProcessPool

from illuminerf.workflow.errors import UserError
from illuminerf.workflow.heartbeat import watched

_CONNECT_SECONDS = 5.0
_OUT_OF_MEMORY = 137
_THREAD_SETTINGS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "ILLUMINERF_RENDER_THREADS")


@dataclass(frozen=True)
class Execution:
    """Where tasks run; it never changes what they make."""

    workers: int | None = None
    """Processes (with Ray: tasks at once); None: as many as this machine or the cluster has cores; 0, without Ray:
    everything in this process."""
    ray_address: str = ""
    """Address of a Ray cluster, "auto" for the one this machine belongs to, "" for no Ray."""
    attempts: int = 3
    """How often a task may take its worker down before it is given up."""
    task_seconds: float = 1800.0
    """A task without a sign of life for so long has its worker ended."""
    tasks_per_worker: int = 200
    """A process is replaced after so many tasks, so that leaks of libraries cannot add up."""

    def __post_init__(self) -> None:
        if (self.workers or 0) < 0 or self.attempts < 1 or self.task_seconds <= 0 or self.tasks_per_worker < 1:
            raise UserError(
                "a setting of the workers is out of range",
                got=f"workers {self.workers}, attempts {self.attempts}, task_seconds {self.task_seconds:g}, "
                f"tasks_per_worker {self.tasks_per_worker}",
                wanted="workers of 0 or more, the others above 0",
            )


@dataclass(frozen=True)
class Crash:
    """A task that never came back."""

    message: str


@runtime_checkable
class TaskPool(Protocol):
    """Runs `function(argument)`; both must be picklable by reference (module-level functions, plain data)."""

    capacity: int
    """How many tasks are worth having under way."""
    num_workers: int
    """How many run at once."""
    num_gpus: int
    """GPUs that tasks can have for themselves; 0 where the pool hands out none."""

    def submit(self, function: Callable[[Any], Any], argument: Any, *, gpus: int = 0) -> None:
        """Start a task, with so many GPUs of its own; at most `num_gpus`."""
        ...

    def is_one_done(self, seconds: float) -> bool:
        """Wait until `next_done` would return at once, or for so long; tasks in this process only run in the former."""
        ...

    def next_done(self) -> tuple[Any, Any]:
        """(argument, result or Crash) of the next task to finish; exceptions of a task are raised here."""
        ...

    def num_running(self) -> int:
        """Tasks submitted whose result has not been taken."""
        ...


@contextmanager
def open_pool(execution: Execution) -> Iterator[TaskPool]:
    """A pool for `execution`; what still runs when the block ends is stopped.

    Raises:
        UserError: Ray is asked for and absent, or the cluster cannot be reached.
    """
    if execution.ray_address:
        yield from _ray_pool(execution)
    elif execution.workers == 0:
        yield _InProcessPool()
    else:
        yield from _process_pool(execution, execution.workers or num_cores())


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _InProcessPool:
    capacity, num_workers, num_gpus = 1, 1, 0

    def __init__(self) -> None:
        self._waiting: deque[tuple[Callable[[Any], Any], Any]] = deque()

    def submit(self, function: Callable[[Any], Any], argument: Any, *, gpus: int = 0) -> None:
        self._waiting.append((function, argument))

    def is_one_done(self, seconds: float) -> bool:
        return bool(self._waiting)

    def next_done(self) -> tuple[Any, Any]:
        function, argument = self._waiting.popleft()
        return argument, function(argument)

    def num_running(self) -> int:
        return len(self._waiting)


def _guarded(function: Callable[[Any], Any], argument: Any, seconds: float) -> Any:
    """Run a task under a watchdog that ends this worker process when there is no sign of life."""
    os.environ["ILLUMINERF_TASK_SECONDS"] = str(seconds)  # programs that a task starts must end before it is given up
    with watched(seconds):
        try:
            return function(argument)
        except MemoryError:
            os._exit(_OUT_OF_MEMORY)  # another worker, or this task later, may have more


def _process_pool(execution: Execution, workers: int) -> Iterator[TaskPool]:
    # numerical libraries read these when they are imported, so they must be set before a process starts
    share = str(max(1, num_cores() // workers))
    before = {name: os.environ.get(name) for name in _THREAD_SETTINGS}
    os.environ.update(dict.fromkeys(_THREAD_SETTINGS, share))
    processes = _Processes(execution, workers)
    try:
        yield processes
    finally:
        processes.stop()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class _Processes:
    num_gpus = 0

    def __init__(self, execution: Execution, workers: int) -> None:
        self._execution, self.num_workers = execution, workers
        self.capacity = 2 * workers
        self._num_starts = 0
        self._running: dict[Future[Any], tuple[Callable[[Any], Any], Any, int]] = {}
        self._start()

    def _start(self) -> None:
        self._num_starts += 1
        self._pool = ProcessPool(
            max_workers=self.num_workers,
            max_tasks=self._execution.tasks_per_worker,
            context=multiprocessing.get_context("spawn"),
        )

    def stop(self) -> None:
        self._pool.stop()
        self._pool.join()

    def submit(self, function: Callable[[Any], Any], argument: Any, *, gpus: int = 0) -> None:
        self._submit(function, argument, 1)

    def _submit(self, function: Callable[[Any], Any], argument: Any, attempt: int) -> None:
        future = self._pool.schedule(_guarded, args=(function, argument, self._execution.task_seconds))
        self._running[future] = (function, argument, attempt)

    def is_one_done(self, seconds: float) -> bool:
        return bool(wait(self._running, seconds, FIRST_COMPLETED).done)

    def next_done(self) -> tuple[Any, Any]:
        while True:
            done, _ = wait(self._running, return_when=FIRST_COMPLETED)
            future = next(iter(done))
            function, argument, attempt = self._running[future]
            try:
                result = future.result()
            except BrokenProcessPool as error:
                self._restart(error)
                continue
            except ProcessExpired as error:
                del self._running[future]
                if attempt >= self._execution.attempts:
                    return argument, Crash(f"the worker died {attempt} times (exit code {error.exitcode})")
                self._submit(function, argument, attempt + 1)
                continue
            except BaseException:
                del self._running[future]
                raise
            del self._running[future]
            return argument, result

    def _restart(self, error: BrokenProcessPool) -> None:
        """All processes are gone, before they could take a task: start others."""
        if self._num_starts >= self._execution.attempts:
            raise UserError(
                "worker processes do not start",
                got=str(error),
                fix='in a script of your own, guard the call with `if __name__ == "__main__":`; else use --workers 0',
            ) from error
        self.stop()
        waiting, self._running = list(self._running.values()), {}
        self._start()
        for function, argument, attempt in waiting:
            self._submit(function, argument, attempt)

    def num_running(self) -> int:
        return len(self._running)


def _ray_pool(execution: Execution) -> Iterator[TaskPool]:
    try:
        ray = importlib.import_module("ray")
    except ImportError as error:
        raise UserError("Ray is not installed", fix="pip install 'illuminerf[cluster]'") from error
    host, _, port = execution.ray_address.rpartition(":")
    try:
        if host and "/" not in host and port.isdigit():  # Ray itself would keep trying for minutes
            socket.create_connection((host, int(port)), _CONNECT_SECONDS).close()
        ray.init(address=execution.ray_address, log_to_driver=False, ignore_reinit_error=True)
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(
            f"no Ray cluster answers at '{execution.ray_address}'",
            got=str(error).splitlines()[0],
            fix="start one with `ray start --head` and join machines with `ray start --address HOST:PORT`",
        ) from error
    try:
        yield _RayTasks(ray, execution)
    finally:
        ray.shutdown()


class _RayTasks:
    def __init__(self, ray: Any, execution: Execution) -> None:
        self._ray, self._execution = ray, execution
        resources = ray.cluster_resources()
        self.num_workers = execution.workers or int(resources.get("CPU", 1))
        self.num_gpus = int(resources.get("GPU", 0))
        self.capacity = 2 * self.num_workers
        environment = {"env_vars": dict.fromkeys(_THREAD_SETTINGS, "1")}
        # Ray retries a task whose worker or machine is lost; errors that the task raises are not retried
        self._remote = ray.remote(
            num_cpus=1,
            max_retries=execution.attempts - 1,
            retry_exceptions=False,
            max_calls=execution.tasks_per_worker,
            runtime_env=environment,
        )(_guarded)
        self._running: dict[Any, Any] = {}

    def submit(self, function: Callable[[Any], Any], argument: Any, *, gpus: int = 0) -> None:
        remote = self._remote.options(num_gpus=gpus) if gpus else self._remote
        self._running[remote.remote(function, argument, self._execution.task_seconds)] = argument

    def is_one_done(self, seconds: float) -> bool:
        return bool(self._ray.wait(list(self._running), num_returns=1, timeout=seconds)[0])

    def next_done(self) -> tuple[Any, Any]:
        (reference, *_), _ = self._ray.wait(list(self._running), num_returns=1)
        argument = self._running.pop(reference)
        try:
            return argument, self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except self._ray.exceptions.RayError as error:
            return argument, Crash(f"the worker died {self._execution.attempts} times ({type(error).__name__})")

    def num_running(self) -> int:
        return len(self._running)
