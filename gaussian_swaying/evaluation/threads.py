"""The same work for many frames in threads, with its results in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

T = TypeVar("T")

AHEAD = 2  # frames that each thread may be ahead


def in_threads(work: Callable[[int], T], count: int, device: torch.device) -> Iterator[T]:
    """``work(0)`` to ``work(count - 1)`` in order, computed by threads: one for each core, at most eight.

    Reading and writing pictures takes longer than comparing them. On a CPU each thread computes with one core.
    """
    workers = max(1, min(8, os.cpu_count() or 1))
    threads = torch.get_num_threads()
    waiting: deque[Future[T]] = deque()

    def one(number: int) -> T:
        with torch.inference_mode():  # it is set per thread
            return work(number)

    pool = ThreadPoolExecutor(workers, "compare")
    try:
        if device.type == "cpu":
            torch.set_num_threads(1)
        for number in range(count):
            waiting.append(pool.submit(one, number))
            if len(waiting) > AHEAD * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads)


__all__ = ["in_threads"]
