"""Independent pieces of work, side by side in threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

ResultT = TypeVar("ResultT")


def in_threads(work: Callable[..., ResultT], *arguments: Iterable[object], most: int) -> Iterator[ResultT]:
    """As ``map``, with the results in the order of the arguments, for any number of threads.

    Each thread runs the operations of torch alone, so no more threads are at work than torch has.

    Args:
        work: The function.
        arguments: Its arguments, one iterable for each.
        most: Largest number of threads.
    """
    count, grad = torch.get_num_threads(), torch.is_grad_enabled()
    if min(count, most) <= 1:
        yield from map(work, *arguments)
        return

    def with_grad(*given: object) -> ResultT:
        with torch.set_grad_enabled(grad):  # a thread begins with gradients
            return work(*given)

    with ThreadPoolExecutor(min(count, most), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            yield from pool.map(with_grad, *arguments)
        finally:
            torch.set_num_threads(count)  # for threads that begin later
