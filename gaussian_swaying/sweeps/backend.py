"""Jobs of a sweep, the protocol of backends (a pool of processes, or Ray), and the loop that keeps a backend busy."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from gaussian_swaying.runs.lock import FolderLocked
from gaussian_swaying.sweeps.record import failure, read_result

POLL_S = 1.0
KILLED = 3  # times as many retries for a job whose process was killed, as the reason may be outside of it
LOCKED_S = 60.0  # how long to wait for a folder: the worker of a driver that was killed ends at its frame
PACKED = 0.9  # share of a GPU's memory that is given away, as runs differ

T = TypeVar("T")


@dataclass(frozen=True)
class Job:
    """A run to do, or several of equal shape that are simulated together.

    Args:
        folder: Folder of the sweep.
        names: Names of the runs.
        config: Configuration that all runs share, as YAML.
        frames: Frames.
        runs: The value of every axis in each run.
        device: Device of the simulation.
        attempt: 1 for the first time.
        resume: Continue from the checkpoint of an earlier attempt, if there is one; not if there are several runs.
        complete: Names of runs that are done already, and only simulated along with the others.
    """

    folder: Path
    names: tuple[str, ...]
    config: str
    frames: int
    runs: tuple[dict[str, Any], ...]
    device: str = "auto"
    attempt: int = 1
    resume: bool = True
    complete: frozenset[str] = frozenset()

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the runs without the complete ones."""
        return tuple(name for name in self.names if name not in self.complete)

    def again(self, resume: bool) -> Job:
        return replace(self, attempt=self.attempt + 1, resume=resume)

    def apart(self) -> list[Job]:
        pairs = zip(self.names, self.runs, strict=True)
        return [replace(self, names=(n,), runs=(r,), attempt=1) for n, r in pairs if n not in self.complete]


def unlocked(work: Callable[[], T]) -> T:
    """Do what needs a folder, once it is free."""
    begin = time.monotonic()
    while True:
        try:
            return work()
        except FolderLocked:
            if time.monotonic() - begin > LOCKED_S:
                raise
            time.sleep(0.5)


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job.

    Attributes:
        results: The result of each of its runs, by name.
        killed: Whether its process was killed, so that the reason may be outside of it.
        share: Share of the memory of its GPU that it took; None on a CPU, or if it is not known.
        ready: Whether its process can do another job. It should not after lack of memory, a bug or a signal.
    """

    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    killed: bool = False
    share: float | None = None
    ready: bool = True

    @property
    def complete(self) -> bool:
        return all(result["status"] == "complete" for result in self.results.values())


class Backend(Protocol):
    """Does jobs, several at a time. It knows nothing of plans, retries and tables."""

    def free(self) -> bool:
        """True if another job can be given."""

    def submit(self, job: Job) -> None:
        """Begin a job."""

    def wait(self, seconds: float) -> list[tuple[Job, Outcome]]:
        """Return the jobs that have ended; wait for one, at most so many seconds."""

    def pack(self, share: float) -> None:
        """Learn the share of a GPU's memory that a job needs."""

    def stop(self) -> None:
        """Let all jobs end in order, at a frame."""

    def close(self) -> None:
        """Release all resources; no more jobs follow."""


def drive(
    jobs: Sequence[Job],
    backend: Backend,
    ended: Callable[[str, dict[str, Any]], None],
    retries: int = 1,
    tick: Callable[[int], None] = lambda running: None,
) -> None:
    """Run jobs: a failed one is tried again, and one that fails too often does not stop the rest.

    A job of several runs that fails is done again run by run. If this is interrupted (Ctrl-C, or an exception of a
    callback), the runs are ended in order.

    Args:
        jobs: The jobs.
        backend: Does them.
        ended: Called with the name and the result of each run, in the order in which they end.
        retries: Number of times that a failed job is tried again; three times as often if its process was killed.
        tick: Called about once a second with the number of runs that are being done.
    """
    waiting, running = deque(jobs), 0
    try:
        while waiting or running:
            while waiting and backend.free():
                job = waiting.popleft()
                backend.submit(job)
                running += len(job.names)
            for job, outcome in backend.wait(POLL_S):
                running -= len(job.names)
                if outcome.share is not None:
                    backend.pack(outcome.share)
                several = len(job.names) > 1
                limit = retries * (KILLED if outcome.killed else 0 if several else 1)
                if not outcome.complete and job.attempt <= limit:
                    # from the checkpoint, unless that has been tried
                    waiting.append(job.again(resume=outcome.killed or job.attempt == 1))
                elif not outcome.complete and several:
                    waiting.extend(job.apart())
                else:
                    for name in job.wanted:
                        ended(name, outcome.results[name])
            tick(running)
    except BaseException:
        backend.stop()
        raise
    backend.close()


def lost(job: Job, reason: str) -> Outcome:
    """The outcome of a job whose process was killed.

    Args:
        job: The job.
        reason: One sentence.
    """
    written = {name: read_result(job.folder, name) for name in job.wanted}
    results = {  # it may have been killed after its last step
        name: result if result and result["status"] == "complete" else failure("failed", reason, job.attempt)
        for name, result in written.items()
    }
    return Outcome(results, killed=True, ready=False)
