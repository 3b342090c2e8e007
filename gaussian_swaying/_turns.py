"""A lock for objects that keep buffers between calls, so that only one thread at a time uses them."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Turn:
    """A lock that its thread may take again. A copy of the object that owns it gets a lock of its own."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[Turn], tuple[()]]:
        return Turn, ()


class _HasTurn(Protocol):
    @property
    def turn(self) -> Turn: ...


S = TypeVar("S", bound=_HasTurn)


def in_turn(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """Decorate a method so that other threads wait until it is done; its object has the lock as ``turn``."""

    @functools.wraps(method)
    def one_at_a_time(self: S, *args: Any, **kwargs: Any) -> R:
        with self.turn:
            return method(self, *args, **kwargs)

    return one_at_a_time
