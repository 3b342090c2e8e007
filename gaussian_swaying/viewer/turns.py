"""One thread in which the live page handles the requests of its browsers, one after another."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable


class Turns:
    """Calls requested functions in order, and another function regularly.

    A request replaces an earlier one with the same key that still waits: of a fast drag, the last place counts, and no
    more requests wait than there are controls, however many browsers send them.

    Args:
        regularly: Called every ``seconds``, after the requests that wait then.
        seconds: See there [s].
        failed: Called with the error of a request.
    """

    def __init__(self, regularly: Callable[[], None], seconds: float, failed: Callable[[Exception], None]) -> None:
        self._regularly, self._seconds, self._failed = regularly, seconds, failed
        self._asked: dict[Hashable, Callable[[], None]] = {}
        self._wake, self._closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._loop, name="turns", daemon=True)
        self._thread.start()

    def ask(self, key: Hashable, what: Callable[[], None]) -> None:
        """Queue a request.

        Args:
            key: A request with the same key that still waits is dropped.
            what: The function to call.
        """
        with self._wake:
            self._asked[key] = what
            self._wake.notify()

    def close(self) -> None:
        """End the thread; returns when it has ended, or after 10 s."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        self._thread.join(10.0)

    def _loop(self) -> None:
        due = time.monotonic()
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or self._asked, max(due - time.monotonic(), 0.0))
                if self._closed:
                    return
                asked, self._asked = self._asked, {}
            for what in (*asked.values(), *([self._regularly] if time.monotonic() >= due else [])):
                try:
                    what()
                except Exception as error:  # one of them; the page goes on
                    self._failed(error)
            if time.monotonic() >= due:
                due = time.monotonic() + self._seconds
