"""One thread in which the live page does what its browsers ask, one after another."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable


class Turns:
    """Does what is asked in order, and something else regularly.

    What is asked again before its turn replaces what was asked: of a fast drag, the last place counts, and however
    many browsers ask, no more waits than there are controls.

    Args:
        regularly: Done every ``seconds``, and after what was asked.
        seconds: See there [s].
        failed: Told what went wrong.
    """

    def __init__(self, regularly: Callable[[], None], seconds: float, failed: Callable[[Exception], None]) -> None:
        self._regularly, self._seconds, self._failed = regularly, seconds, failed
        self._asked: dict[Hashable, Callable[[], None]] = {}
        self._wake, self._closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._loop, name="turns", daemon=True)
        self._thread.start()

    def ask(self, key: Hashable, what: Callable[[], None]) -> None:
        """Do something soon.

        Args:
            key: What of the same key has not had its turn yet is not done.
            what: What to do.
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
