"""`illuminerf batch`: all jobs of a file, here or on a cluster, again and again until nothing is left to do."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from illuminerf.batch.board import Board, read_status
from illuminerf.batch.driver import Driver, Retries, shares_for
from illuminerf.batch.finished import FinishedSteps
from illuminerf.batch.jobs import Job, read_jobs
from illuminerf.batch.outcome import RESULTS
from illuminerf.batch.stages import Stage, stages_of
from illuminerf.batch.status_page import failures, status_table
from illuminerf.batch.steps import Outcome, Task, run_step
from illuminerf.workflow.artefact import locked
from illuminerf.workflow.errors import UserError
from illuminerf.workflow.progress import say, show_table
from illuminerf.workflow.storage import Storage
from illuminerf.workflow.task_pool import Execution, open_pool

_ONE_AFTER_ANOTHER = Execution(workers=1)


def batch_command(
    jobs: Annotated[Path, tyro.conf.Positional],
    status: bool = False,
    shards: int = 0,
    backoff_seconds: float = 10.0,
    scratch: Path | None = None,
    execution: Annotated[Execution, tyro.conf.arg(name="")] = _ONE_AFTER_ANOTHER,
) -> None:
    """Relight many captures under many lights; run the same command again to go on after anything.

    Args:
        jobs: JOBS.yaml (docs/batch.md).
        status: Only print how far the batch is, and stop.
        shards: Shares into which the views of cues and samples are cut, for several workers; 0: by their number.
        backoff_seconds: Wait before the second of --attempts where a machine, the network or the storage failed;
            twice as long before each further one.
        scratch: Where workers keep what they fetch meanwhile, if `out` is not a folder; the system's folder for
            temporary files by default.
        execution: Where.
    """
    file = read_jobs(jobs)
    if status:
        content = read_status(Storage(file.out))
        show_table(status_table(content))
        for line in failures(content):
            say(line)
        return
    retries = Retries(execution.attempts, backoff_seconds)
    results = run_batch(file.jobs, file.out, execution, retries, shards, scratch=str(scratch or ""))
    unfinished = [name for name, result in results["jobs"].items() if result["state"] != "done"]
    if unfinished:
        raise UserError(
            f"{len(unfinished)} of {len(file.jobs)} jobs are not finished",
            got=", ".join(unfinished),
            fix=f"see {file.out}/status.html, mend what it says, and run the same command again",
        )
    say(f"done: {file.out}/status.html, {file.out}/{RESULTS}")


def run_batch(
    jobs: Sequence[Job],
    out: str | Path,
    execution: Execution,
    retries: Retries | None = None,
    num_shards: int = 0,
    scratch: str = "",
    work: Callable[[Task], Outcome] = run_step,
    stages: Callable[[Job], dict[str, Stage]] = stages_of,
) -> dict[str, Any]:
    """Do all jobs; what fails costs only what needs it.

    Args:
        jobs: what is to be done.
        out: folder or fsspec URL that gets status.json, status.html and results.json.
        execution: processes or a Ray cluster; the result does not depend on it. Its attempts are not used.
        retries: how often and when steps are tried again.
        num_shards: shares of the views of stages that can be shared; 0: by the number of workers.
        scratch: folder on every worker for what it fetches.
        work: what a worker does with a step.
        stages: the table of stages of a job.

    Returns:
        What results.json holds.

    Raises:
        UserError: a place cannot be reached, or another batch works in `out`.
    """
    storage = Storage(out)
    storages = {job.name: Storage(job.out) for job in jobs}
    for place in (storage, *storages.values()):
        place.check_reachable()
    with locked(storage.path) if storage.path else nullcontext(), open_pool(replace(execution, attempts=1)) as pool:
        board = Board(storage)
        shares = num_shards or shares_for(pool, jobs)
        driver = Driver(
            {job.name: job for job in jobs},
            {job.name: stages(job) for job in jobs},
            pool,
            board,
            FinishedSteps(storages),
            retries or Retries(),
            shares,
            work,
            scratch,
        )
        try:
            driver.run()
        finally:
            board.stop()
            board.write(is_last=True)
    results = {"schema": 1, "jobs": {job.name: _result(job, board, storages[job.name]) for job in jobs}}
    storage.write_json(RESULTS, results)
    return results


def _result(job: Job, board: Board, storage: Storage) -> dict[str, Any]:
    states = board.states(job.name)
    state = "failed" if "failed" in states else "done" if states == {"done"} else "unfinished"
    result: dict[str, Any] = {"state": state, "out": storage.url}
    errors = {
        f"{cell.light or 'all lights'} / {cell.stage}": cell.error
        for cell in board.cells.values()
        if cell.job == job.name and cell.state == "failed"
    }
    result |= {"errors": errors} if errors else {}
    measured = storage.read_json(RESULTS)
    return result | ({} if measured is None else {"report": f"{storage.url}/report.html", "measured": measured})
