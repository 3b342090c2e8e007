"""Independent pieces of work, side by side in threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

ResultT = TypeVar("ResultT")

AHEAD = 2
"""Pieces that each thread may be ahead of what is taken."""


def in_threads(work: Callable[..., ResultT], *arguments: Iterable[object], threads: int) -> Iterator[ResultT]:
    """As ``map``, with the results in the order of the arguments, for any number of threads.

    Each thread runs the operations of torch alone, with the gradients and the inference mode of the caller.
    """
    if threads <= 1:
        yield from map(work, *arguments)
        return
    count, grad, inference = torch.get_num_threads(), torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def alike(given: tuple[object, ...]) -> ResultT:
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):  # of each thread
            return work(*given)

    waiting: deque[Future[ResultT]] = deque()
    pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
    try:
        for given in zip(*arguments, strict=False):
            waiting.append(pool.submit(alike, given))
            if len(waiting) > AHEAD * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(count)  # for threads that begin later
