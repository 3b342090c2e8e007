"""SIGTERM and SIGHUP end a run as Ctrl-C does: in order, keeping everything recorded so far."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class StoppedBySignal(KeyboardInterrupt):
    """A signal other than Ctrl-C asked the program to end.

    Args:
        number: Number of the signal.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


@contextmanager
def stop_signals() -> Iterator[None]:
    """Inside the block, SIGTERM and SIGHUP raise :class:`StoppedBySignal` in the main thread.

    Only the first signal raises, so that a second one does not interrupt saving (Ctrl-C still does). A signal that is
    ignored or already has a handler, as under nohup, is left alone. Outside the main thread nothing changes.
    """
    changed: list[int] = []
    stopping = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopping
        if not stopping:
            stopping = True
            raise StoppedBySignal(number)

    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) == signal.SIG_DFL:
                signal.signal(number, stop)
                changed.append(number)
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, signal.SIG_DFL)


def exit_code(stop: BaseException) -> int:
    """128 plus the number of the signal: 130 for Ctrl-C."""
    return 128 + (stop.number if isinstance(stop, StoppedBySignal) else int(signal.SIGINT))


def reason(stop: BaseException) -> str:
    """The reason why a run was stopped, for its summary."""
    return f"stopped by {stop}" if isinstance(stop, StoppedBySignal) else "stopped by the user"
