"""Backends that do the jobs of a sweep: a pool of processes or Ray, one protocol, and the loop that keeps it busy."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from gaussian_swaying.sweeps.job import Job
from gaussian_swaying.sweeps.record import failure, read_result

POLL_S = 1.0
KILLED = 3  # times as many retries for a job whose process was killed, as the reason may be outside of it
PACKED = 0.9  # share of a GPU's memory that is given away, as runs differ


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job.

    Attributes:
        results: The result of each of its runs, by name.
        killed: Whether its process was killed, so that the reason may be outside of it.
        share: Share of the memory of its GPU that it took; None on a CPU, or if it is not known.
    """

    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    killed: bool = False
    share: float | None = None

    @property
    def complete(self) -> bool:
        """True if all runs are complete."""
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
    """Do jobs. A failed one is tried again; one that fails too often never stops the rest.

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
    return Outcome(results, killed=True)
