"""Task pools: results, errors and deaths, in this process and in others."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from illuminerf.workflow.errors import UserError
from illuminerf.workflow.task_pool import Crash, Execution, num_cores, open_pool
from tests.workflow import pool_tasks

TWO = Execution(workers=2, attempts=2)


def results(execution: Execution, function: Callable[[Any], Any], arguments: list[Any]) -> dict[Any, Any]:
    with open_pool(execution) as pool:
        for argument in arguments:
            pool.submit(function, argument)
        found = dict(pool.next_done() for _ in arguments)
        assert pool.num_running() == 0
    return found


@pytest.mark.parametrize("execution", [Execution(workers=0), TWO], ids=["here", "processes"])
def test_every_task_comes_back_once(execution: Execution) -> None:
    assert results(execution, pool_tasks.square, [1, 2, 3]) == {1: 1, 2: 4, 3: 9}
    with pytest.raises(ValueError, match="no 5"):
        results(execution, pool_tasks.fail, [5])


def test_a_dying_worker_costs_its_own_task_only(tmp_path: Path) -> None:
    with open_pool(TWO) as pool:
        pool.submit(pool_tasks.die, 7)
        pool.submit(pool_tasks.die_once, str(tmp_path / "marker"))
        for value in (1, 2, 3):
            pool.submit(pool_tasks.square, value)
        found = dict(pool.next_done() for _ in range(5))
    assert isinstance(found[7], Crash) and "died 2 times" in found[7].message
    assert found[str(tmp_path / "marker")] == "alive"
    assert [found[value] for value in (1, 2, 3)] == [1, 4, 9]


def test_a_task_that_hangs_is_ended() -> None:
    execution = Execution(workers=1, attempts=1, task_seconds=1.0)
    found = results(execution, pool_tasks.sleep, [60.0, 0.0])
    assert isinstance(found[60.0], Crash) and found[0.0] == 0.0


def test_workers_share_the_cores() -> None:
    assert results(TWO, pool_tasks.threads, [0])[0] == max(1, num_cores() // 2)
    assert num_cores() >= 1 and "ILLUMINERF_RENDER_THREADS" not in os.environ


def test_workers_that_cannot_start_are_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent / "breaks_start_up"))
    with pytest.raises(UserError, match="do not start.*__main__"):
        results(TWO, pool_tasks.square, [1, 2])


def test_a_task_that_says_it_is_alive_may_take_longer() -> None:
    execution = Execution(workers=1, attempts=1, task_seconds=1.0)
    assert results(execution, pool_tasks.sleep_alive, [2.5]) == {2.5: 2.5}


def test_running_out_of_memory_counts_as_a_death() -> None:
    found = results(Execution(workers=1, attempts=2), pool_tasks.run_out_of_memory, [0])
    assert isinstance(found[0], Crash)


def test_wrong_settings_are_explained() -> None:
    with pytest.raises(UserError, match="out of range"):
        Execution(workers=-1)
    with pytest.raises(UserError, match="out of range"):
        Execution(attempts=0)
