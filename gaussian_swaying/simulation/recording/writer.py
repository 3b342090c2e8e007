"""Writing beside the run: copies on the host that nobody waits for, and threads that put them on disk."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

# compression gives up Python's lock, so the threads work side by side; half of the cores are left to the simulation
WORKERS = max(2, min(8, (os.cpu_count() or 1) // 2))
QUEUE_LIMIT = 4 * WORKERS  # jobs waiting or in work; a frame has up to five, so memory holds about one frame a thread
_POLL = 0.2  # s; no wait is longer, so that Ctrl-C is heard on every platform


@cache
def _copy_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)


class HostCopy:
    """The tensors of a nested value as they are now, on the host.

    Changing the value afterwards changes nothing in the copy. Tensors on a GPU are cloned there and go to pinned memory
    in a stream of their own: neither the host nor the other streams wait.

    Args:
        value: A tensor, or dicts, lists and tuples of tensors and of what cannot be changed.
    """

    def __init__(self, value: Any) -> None:
        self._clones: list[Tensor] = []  # kept until they are copied
        self._value = self._copy(value)
        self._copied = []
        for device in {clone.device for clone in self._clones}:
            event = torch.cuda.Event(blocking=True)
            event.record(_copy_stream(device))
            self._copied.append(event)

    def get(self) -> Any:
        """The value with its tensors on the host, of the same shapes and types; waits until they are there."""
        for event in self._copied:
            event.synchronize()
        self._clones.clear()
        return self._value

    def _copy(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            clone = value.detach().clone()  # with its strides, on which the last bits of a product depend
            return self._to_host(clone) if clone.is_cuda else clone
        if isinstance(value, dict):
            return {key: self._copy(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return type(value)(self._copy(item) for item in value)
        return value

    def _to_host(self, clone: Tensor) -> Tensor:
        stream = _copy_stream(clone.device)
        stream.wait_stream(torch.cuda.current_stream(clone.device))
        host = torch.empty_like(clone, device="cpu", pin_memory=True)
        with torch.cuda.stream(stream):
            host.copy_(clone, non_blocking=True)
        self._clones.append(clone)
        return host


@dataclass(eq=False)
class _Job:
    name: str
    run: Callable[[], None]
    after_all: bool
    running: bool = False


class FrameWriter:
    """Does jobs in background threads, in any order but for the promises of :meth:`submit`.

    At most ``limit`` jobs wait or are in work at a time; whoever submits one more waits. Once a job fails, what was
    submitted before it is still done, what was submitted after it and has not begun is not, and nothing more is taken.
    Threads end when there is nothing left to do, so a writer that is given up keeps nothing alive; one whose jobs are
    not done keeps the process until they are.

    Args:
        limit: Largest number of jobs that wait or are in work.
        workers: Largest number of threads.
    """

    def __init__(self, limit: int = QUEUE_LIMIT, workers: int = WORKERS) -> None:
        self.limit, self.workers = limit, workers
        self._jobs: list[_Job] = []  # waiting and in work, in the order of submission
        self._threads: set[threading.Thread] = set()
        self._changed = threading.Condition(threading.Lock())
        self._error: BaseException | None = None
        self._told = False

    @property
    def pending(self) -> int:
        """Number of jobs that wait or are in work."""
        return len(self._jobs)

    def submit(self, name: str, run: Callable[[], None], after_all: bool = False) -> None:
        """Have ``run()`` called in a thread; waits while ``limit`` jobs are pending.

        Args:
            name: What it writes. Jobs of the same name are done one after the other, as they were submitted.
            run: The job. It gets no arguments; what it holds on to must not change.
            after_all: Begin only once everything submitted before it is done.

        Raises:
            OSError: If an earlier job could not write, with its name; then and from then on this one is not taken.
            BaseException: If an earlier job failed in another way: what it raised.
        """
        with self._changed:
            while len(self._jobs) >= self.limit and self._error is None:
                self._hire()
                self._changed.wait(_POLL)
            if self._error is not None:
                self._told = True
                raise self._error
            self._jobs.append(_Job(name, run, after_all))
            self._hire()

    def wait(self) -> None:
        """Return once no job is pending.

        Raises:
            OSError: If a job could not write, unless a call has raised it before.
            BaseException: If a job failed in another way, likewise.
        """
        with self._changed:
            while self._jobs:
                self._hire()
                self._changed.wait(_POLL)
            if self._error is not None and not self._told:
                self._told = True
                raise self._error

    def _hire(self) -> None:
        """Start a thread if there is work for it. Called with the lock held."""
        if len(self._threads) >= self.workers or self._next() is None:
            return
        thread = threading.Thread(target=self._work, name="frame-writer")
        self._threads.add(thread)
        try:
            thread.start()
        except BaseException:
            self._threads.discard(thread)
            raise

    def _next(self) -> _Job | None:
        """The first job that may begin. Called with the lock held."""
        earlier: set[str] = set()
        for job in self._jobs:
            if not job.running and job.name not in earlier and not (job.after_all and earlier):
                return job
            earlier.add(job.name)
        return None

    def _work(self) -> None:
        while True:
            with self._changed:
                job = self._next()
                if job is None:
                    self._threads.discard(threading.current_thread())
                    return
                job.running = True
            error: BaseException | None = None
            try:
                with torch.inference_mode():  # of which each thread has its own
                    job.run()
            except OSError as failure:
                error = OSError(f"{job.name} could not be written: {failure.strerror or failure}")
                error.__cause__ = failure
            except BaseException as failure:
                error = failure
            with self._changed:
                if error is not None:
                    later = self._jobs.index(job) + 1
                    self._jobs[later:] = [other for other in self._jobs[later:] if other.running]
                    self._error = self._error or error
                self._jobs.remove(job)
                self._changed.notify_all()
            del job  # and with it the frame that it holds


__all__ = ["QUEUE_LIMIT", "WORKERS", "FrameWriter", "HostCopy"]
