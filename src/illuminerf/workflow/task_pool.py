"""Many independent tasks: in this process, in many processes, or on many machines with Ray, by the same code.

A worker that dies (a crash in native code, a lost machine, the out-of-memory killer) costs the task it was at: the
task is tried again elsewhere, and reported as `Crash` when it keeps failing. Errors that are raised are not retried.
"""

import faulthandler
import importlib
import multiprocessing
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from illuminerf.workflow.errors import UserError

_CONNECT_SECONDS = 5.0


@dataclass(frozen=True)
class Execution:
    """Where tasks run; it never changes what they make."""

    workers: int = 0
    """Processes; 0 runs everything in this one. With Ray, tasks at once (0: as many as the cluster has cores)."""
    ray_address: str = ""
    """Address of a Ray cluster, "auto" for the one this machine belongs to, "" for no Ray."""
    attempts: int = 3
    """How often a task may take its worker down before it is given up."""
    task_seconds: float = 1800.0
    """A task that takes longer has its worker ended."""
    tasks_per_worker: int = 200
    """A process is replaced after so many tasks, so that leaks of libraries cannot add up."""

    def __post_init__(self) -> None:
        if self.workers < 0 or self.attempts < 1 or self.task_seconds <= 0 or self.tasks_per_worker < 1:
            raise UserError("workers, attempts, task_seconds and tasks_per_worker must be positive")


@dataclass(frozen=True)
class Crash:
    """A task that never came back."""

    message: str


@runtime_checkable
class TaskPool(Protocol):
    """Runs `function(argument)`; both must be picklable by reference (module-level functions, plain data)."""

    capacity: int
    """How many tasks are worth having under way."""

    def submit(self, function: Callable[[Any], Any], argument: Any) -> None:
        """Start a task."""
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
    elif execution.workers:
        yield from _process_pool(execution)
    else:
        yield _InProcessPool()


class _InProcessPool:
    capacity = 1

    def __init__(self) -> None:
        self._waiting: deque[tuple[Callable[[Any], Any], Any]] = deque()

    def submit(self, function: Callable[[Any], Any], argument: Any) -> None:
        self._waiting.append((function, argument))

    def next_done(self) -> tuple[Any, Any]:
        function, argument = self._waiting.popleft()
        return argument, function(argument)

    def num_running(self) -> int:
        return len(self._waiting)


def _guarded(function: Callable[[Any], Any], argument: Any, seconds: float) -> Any:
    """Run a task under a watchdog that ends this worker process when time is up."""
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)
        try:
            return function(argument)
        finally:
            faulthandler.cancel_dump_traceback_later()


def _process_pool(execution: Execution) -> Iterator[TaskPool]:
    from pebble import ProcessPool

    pool = ProcessPool(
        max_workers=execution.workers,
        max_tasks=execution.tasks_per_worker,
        context=multiprocessing.get_context("spawn"),
        initializer=_share_cores,
        initargs=(execution.workers,),
    )
    try:
        yield _Processes(pool, execution)
    finally:
        pool.stop()
        pool.join()


def _share_cores(workers: int) -> None:
    """Give each worker its share of the machine's threads, before numerical libraries read the setting."""
    share = str(max(1, (os.cpu_count() or 1) // workers))
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "ILLUMINERF_RENDER_THREADS"):
        os.environ[name] = share


class _Processes:
    def __init__(self, pool: Any, execution: Execution) -> None:
        self._pool, self._execution = pool, execution
        self.capacity = 2 * execution.workers
        self._running: dict[Future[Any], tuple[Callable[[Any], Any], Any, int]] = {}

    def submit(self, function: Callable[[Any], Any], argument: Any, attempt: int = 1) -> None:
        future = self._pool.schedule(_guarded, args=(function, argument, self._execution.task_seconds))
        self._running[future] = (function, argument, attempt)

    def next_done(self) -> tuple[Any, Any]:
        from pebble import ProcessExpired

        while True:
            done, _ = wait(self._running, return_when=FIRST_COMPLETED)
            future = next(iter(done))
            function, argument, attempt = self._running.pop(future)
            try:
                return argument, future.result()
            except ProcessExpired as error:
                if attempt >= self._execution.attempts:
                    return argument, Crash(f"the worker died {attempt} times (exit code {error.exitcode})")
                self.submit(function, argument, attempt + 1)

    def num_running(self) -> int:
        return len(self._running)


def _ray_pool(execution: Execution) -> Iterator[TaskPool]:
    try:
        ray = importlib.import_module("ray")
    except ImportError as error:
        raise UserError("Ray is not installed", fix="pip install 'illuminerf[cluster]'") from error
    host, _, port = execution.ray_address.rpartition(":")
    try:
        if host and port.isdigit():  # Ray itself would keep trying for minutes
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
        cores = int(ray.cluster_resources().get("CPU", 1))
        self.capacity = 2 * (execution.workers or cores)
        environment = {"env_vars": {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "ILLUMINERF_RENDER_THREADS": "1"}}
        # Ray retries a task whose worker or machine is lost; errors that the task raises are not retried
        self._remote = ray.remote(
            num_cpus=1,
            max_retries=execution.attempts - 1,
            retry_exceptions=False,
            max_calls=execution.tasks_per_worker,
            runtime_env=environment,
        )(_guarded)
        self._running: dict[Any, Any] = {}

    def submit(self, function: Callable[[Any], Any], argument: Any) -> None:
        reference = self._remote.remote(function, argument, self._execution.task_seconds)
        self._running[reference] = argument

    def next_done(self) -> tuple[Any, Any]:
        (reference, *_), _ = self._ray.wait(list(self._running), num_returns=1)
        argument = self._running.pop(reference)
        try:
            return argument, self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            raise error.as_instanceof_cause() from error
        except (self._ray.exceptions.WorkerCrashedError, self._ray.exceptions.NodeDiedError) as error:
            return argument, Crash(f"the worker died {self._execution.attempts} times ({type(error).__name__})")

    def num_running(self) -> int:
        return len(self._running)
