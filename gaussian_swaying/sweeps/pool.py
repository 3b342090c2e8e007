"""Worker processes: each does one run at a time, and one that dies is replaced."""

from __future__ import annotations

import itertools
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection as connections
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

from gaussian_swaying.sweeps.record import failure, read_result
from gaussian_swaying.sweeps.worker import Explain, Job, first_line, work

POLL_S = 1.0
KILLED = 3  # times as many retries for a run whose process was killed, as the reason may be outside of it
PATIENCE_S = 300.0  # how long a worker may take to write what it has when the sweep is stopped


@dataclass
class _Worker:
    """A process, the way to it, and what it does."""

    process: SpawnProcess
    connection: Connection
    place: int  # among those that run at the same time
    job: Job | None = None


def run_jobs(
    jobs: Sequence[Job],
    workers: int,
    threads: int,
    ended: Callable[[Job, dict[str, Any]], None],
    retries: int = 1,
    explain: Explain = first_line,
    tick: Callable[[int], None] = lambda running: None,
    gpus: Sequence[str] = (),
) -> None:
    """Do runs in worker processes. A failed run is tried again; one that fails too often never stops the rest.

    If this is interrupted (Ctrl-C, or an exception of a callback), the workers end their runs in order, at a frame.

    Args:
        jobs: The runs.
        workers: Processes at a time.
        threads: Threads of torch in each.
        ended: Called with each run and its result, in the order in which they end.
        retries: How often a failed run is tried again; three times as often if its process was killed.
        explain: Makes a sentence of an error; a function of a module, as it is called in the workers.
        tick: Called about once a second with the number of runs that are being done.
        gpus: The GPUs as in ``CUDA_VISIBLE_DEVICES``; the workers take them in turn.
    """
    waiting, pool = deque(jobs), list[_Worker]()
    try:
        while waiting or any(worker.job for worker in pool):
            running = sum(worker.job is not None for worker in pool)
            for worker in _hire(pool, min(workers, running + len(waiting)), threads, explain, gpus):
                if waiting:
                    _give(worker, waiting.popleft())
            busy = [worker for worker in pool if worker.job is not None]
            ready = connections.wait([worker.connection for worker in busy], POLL_S)
            for worker in (worker for worker in busy if worker.connection in ready):
                job, worker.job = worker.job, None
                assert job is not None
                result, after = _receive(worker, job)
                if after != "ready":
                    _dismiss(worker)
                    pool.remove(worker)
                limit = retries * (KILLED if after == "killed" else 1)
                if result["status"] != "complete" and job.attempt <= limit:
                    # from the checkpoint, unless that has been tried
                    waiting.append(job.again(resume=after == "killed" or job.attempt == 1))
                    continue
                ended(job, result)
            tick(sum(worker.job is not None for worker in pool))
    except BaseException:
        _stop(pool)
        raise
    for worker in pool:
        _dismiss(worker)


def _hire(pool: list[_Worker], count: int, threads: int, explain: Explain, gpus: Sequence[str]) -> list[_Worker]:
    """The workers without a job, after starting those that are missing."""
    context = get_context("spawn")  # a fork would copy the threads and the GPU of this process
    while len(pool) < count:
        place = next(place for place in itertools.count() if place not in {worker.place for worker in pool})
        ours, theirs = context.Pipe()
        process = context.Process(target=work, args=(theirs, threads, explain), daemon=True)
        with _environment(**variables(place, threads, gpus)), _without_ctrl_c():
            process.start()
        theirs.close()  # so that the end of the worker closes the connection
        pool.append(_Worker(process, ours, place))
    return [worker for worker in pool if worker.job is None]


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Block Ctrl-C for the processes that are started in the block; here it acts after the block."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # otherwise the first start does, which unblocks Ctrl-C
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def variables(place: int, threads: int, gpus: Sequence[str]) -> dict[str, str]:
    """Variables of the environment of a worker.

    Args:
        place: Its number among the workers that run at the same time.
        threads: Its threads.
        gpus: As in :func:`run_jobs`.

    Example:
        >>> [variables(place, 2, ["0", "3"])["CUDA_VISIBLE_DEVICES"] for place in range(3)]
        ['0', '3', '0']
    """
    found = {"OMP_NUM_THREADS": str(threads), "GOMP_SPINCOUNT": os.environ.get("GOMP_SPINCOUNT", "3000")}
    return found | ({"CUDA_VISIBLE_DEVICES": gpus[place % len(gpus)]} if gpus else {})


@contextmanager
def _environment(**values: str) -> Iterator[None]:
    """Set variables of the environment for the processes that are started in the block."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _give(worker: _Worker, job: Job) -> None:
    worker.job = job
    with suppress(OSError):  # it was killed while it had nothing to do; `_receive` notices
        worker.connection.send(job)


def _receive(worker: _Worker, job: Job) -> tuple[dict[str, Any], str]:
    """The result of a run, and what the worker is then: ``ready``, ``ending`` or ``killed``."""
    try:
        result, ready = worker.connection.recv()
        return result, "ready" if ready else "ending"
    except (EOFError, OSError):
        worker.process.join(PATIENCE_S)
        written = read_result(job.folder, job.name)
        if written is not None and written["status"] == "complete":  # it was killed after its last step
            return written, "killed"
        return failure("failed", _how_it_ended(worker.process.exitcode), job.attempt), "killed"


def _how_it_ended(code: int | None) -> str:
    if code is not None and code < 0:
        with suppress(ValueError):
            name = signal.Signals(-code).name
            return (
                f"Its process was ended by {name}, as the system does if memory runs out: use fewer `--workers`, or "
                "--resume if someone else ended it."
                if name == "SIGKILL"
                else f"Its process was ended by {name}: --resume does the run again."
            )
    return f"Its process ended by itself (exit code {code}): see its file in logs, or --resume does the run again."


def _dismiss(worker: _Worker) -> None:
    """End a worker that has nothing to do."""
    worker.connection.close()
    worker.process.join(PATIENCE_S)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _stop(pool: list[_Worker]) -> None:
    """Let all workers end their runs at a frame; an impatient second Ctrl-C kills them."""
    try:
        for worker in pool:
            worker.process.terminate()
        for worker in pool:
            worker.process.join(PATIENCE_S)
    finally:
        for worker in pool:
            worker.process.kill()


__all__ = ["run_jobs", "variables"]
