"""Worker processes of this machine: each does one job at a time, and one that dies is replaced."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection as connections
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from gaussian_swaying._checks import first_line
from gaussian_swaying.sweeps.backend import PACKED, Job, Outcome, lost
from gaussian_swaying.sweeps.worker import Explain, work

PATIENCE_S = 300.0  # how long a worker may take to write what it has when the sweep is stopped


@dataclass
class _Worker:
    process: SpawnProcess
    connection: Connection
    place: int  # among those that run at the same time
    job: Job | None = None


class Pool:
    """A :class:`~gaussian_swaying.sweeps.backend.Backend` of processes, which are started when they are needed.

    Args:
        workers: Processes at a time.
        threads: Threads of torch in each.
        explain: Makes a sentence of an error; a function of a module, as it is called in the workers.
        gpus: The GPUs as in ``CUDA_VISIBLE_DEVICES``; the workers take them in turn.
        most: Processes at a time once the memory of a job on a GPU is known; ``workers`` if None.
    """

    def __init__(
        self,
        workers: int,
        threads: int,
        explain: Explain = first_line,
        gpus: Sequence[str] = (),
        most: int | None = None,
    ) -> None:
        self.workers, self.threads, self.explain, self.gpus, self.most = workers, threads, explain, gpus, most
        self._workers: list[_Worker] = []
        self._share = 0.0

    def free(self) -> bool:
        """See ``Backend.free``."""
        return sum(worker.job is not None for worker in self._workers) < self.workers

    def submit(self, job: Job) -> None:
        """See ``Backend.submit``."""
        idle = next((worker for worker in self._workers if worker.job is None), None) or self._hire()
        idle.job = job
        with suppress(OSError):  # it was killed while it had nothing to do; `_receive` notices
            idle.connection.send(job)

    def wait(self, seconds: float) -> list[tuple[Job, Outcome]]:
        """See ``Backend.wait``."""
        busy = [worker for worker in self._workers if worker.job is not None]
        ready = connections.wait([worker.connection for worker in busy], seconds)
        ended = []
        for worker in (worker for worker in busy if worker.connection in ready):
            job, worker.job = worker.job, None
            assert job is not None
            outcome = _receive(worker, job)
            if not outcome.ready:
                _dismiss(worker)
                self._workers.remove(worker)
            ended.append((job, outcome))
        return ended

    def pack(self, share: float) -> None:
        """See ``Backend.pack``: as many processes to a GPU as fit into its memory, by the largest job so far."""
        if self.most is not None and self.gpus and share > self._share:
            self._share = share
            self.workers = min(self.most, len(self.gpus) * max(1, int(PACKED / share)))

    def close(self) -> None:
        """See ``Backend.close``."""
        for worker in self._workers:
            _dismiss(worker)

    def stop(self) -> None:
        """Let all workers end their runs at a frame; an impatient second Ctrl-C kills them."""
        try:
            for worker in self._workers:
                worker.process.terminate()
            for worker in self._workers:
                worker.process.join(PATIENCE_S)
        finally:
            for worker in self._workers:
                worker.process.kill()

    def _hire(self) -> _Worker:
        context = get_context("spawn")  # a fork would copy the threads and the GPU of this process
        taken = {worker.place for worker in self._workers}
        place = next(place for place in itertools.count() if place not in taken)
        ours, theirs = context.Pipe()
        process = context.Process(target=work, args=(theirs, self.threads, self.explain), daemon=True)
        with _environment(**variables(place, self.threads, self.gpus)), _without_ctrl_c():
            process.start()
        theirs.close()  # so that the end of the worker closes the connection
        self._workers.append(_Worker(process, ours, place))
        return self._workers[-1]


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
        gpus: As in :class:`Pool`.

    Example:
        >>> [variables(place, 2, ["0", "3"])["CUDA_VISIBLE_DEVICES"] for place in range(3)]
        ['0', '3', '0']
    """
    environment = {"OMP_NUM_THREADS": str(threads), "GOMP_SPINCOUNT": os.environ.get("GOMP_SPINCOUNT", "3000")}
    return environment | ({"CUDA_VISIBLE_DEVICES": gpus[place % len(gpus)]} if gpus else {})


@contextmanager
def _environment(**values: str) -> Iterator[None]:
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


def _receive(worker: _Worker, job: Job) -> Outcome:
    try:
        outcome: Outcome = worker.connection.recv()
        return outcome
    except (EOFError, OSError):
        worker.process.join(PATIENCE_S)
        return lost(job, _how_it_ended(worker.process.exitcode))


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
    worker.connection.close()
    worker.process.join(PATIENCE_S)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
