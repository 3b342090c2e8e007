"""Writing in the background: asynchronous copies to the host, and threads that write them to disk."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

# compression releases Python's lock, so the threads run in parallel; some cores are left for the simulation
WORKERS = max(2, min(16, 3 * (os.cpu_count() or 1) // 4))
QUEUE_LIMIT = 4 * WORKERS  # jobs waiting or running; a frame has up to five, so memory holds about one frame per thread
_POLL = 0.2  # s; no wait is longer, so that Ctrl-C works on every platform


@cache
def _copy_stream(device: torch.device) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)


class HostCopy:
    """A copy of the tensors of a nested value on the host.

    Later changes of the value do not affect the copy. Tensors on a GPU are cloned there and copied to pinned memory in
    a separate stream, so neither the host nor the other streams wait.

    Args:
        value: A tensor, or dicts, lists and tuples of tensors and immutable values.
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
        """Wait for the copy and return the value with its tensors on the host, with the same shapes and types."""
        for event in self._copied:
            event.synchronize()
        self._clones.clear()
        return self._value

    def _copy(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            clone = value.detach().clone()  # with its strides, as the last bits of a product depend on them
            return self._to_host(clone) if clone.is_cuda else clone.cpu()
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
    """Runs jobs in background threads. The only order is that promised by :meth:`submit`.

    At most ``limit`` jobs wait or run at a time; submitting one more waits. If a job fails, earlier jobs still run,
    later jobs that have not started do not, and no more jobs are accepted. Threads end when there is nothing left to
    do, so an unused writer keeps nothing alive. With unfinished jobs the process stays alive until they are done.

    Args:
        limit: Largest number of jobs that wait or run.
        workers: Largest number of threads.
    """

    def __init__(self, limit: int = QUEUE_LIMIT, workers: int = WORKERS) -> None:
        self.limit, self.workers = limit, workers
        self._jobs: list[_Job] = []  # waiting and running, in the order of submission
        self._threads: set[threading.Thread] = set()
        self._changed = threading.Condition(threading.Lock())
        self._error: BaseException | None = None
        self._told = False

    @property
    def pending(self) -> int:
        """Number of jobs that wait or run."""
        return len(self._jobs)

    def submit(self, name: str, run: Callable[[], None], after_all: bool = False) -> None:
        """Call ``run()`` in a thread; waits while ``limit`` jobs are pending.

        Args:
            name: Name of its file. Jobs with the same name run one after the other, in the order of submission.
            run: The job. It gets no arguments; its data must not change.
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
        with self._changed:
            while self._jobs:
                self._hire()
                self._changed.wait(_POLL)
            if self._error is not None and not self._told:
                self._told = True
                raise self._error

    def _hire(self) -> None:
        """Start a thread if there is work for it. Call it with the lock held."""
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
        """The first job that may start. Call it with the lock held."""
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
                with torch.inference_mode():  # inference mode is set per thread
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
                del job  # frees the frame that it refers to, before whoever waits goes on
                self._changed.notify_all()
