"""Base of the groups of controls on the live page: the page, its session, and callbacks of controls."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from gaussian_swaying.viewer.screen import Screen


class Panel:
    """The panel of a page.

    Args:
        page: The page.
    """

    def __init__(self, page: Screen) -> None:
        self.page, self.session, self.server = page, page.session, page.server

    def on(self, subscribe: Callable[[Any], Any], what: Callable[..., None], tell_event: bool = False) -> None:
        """Call a function in its turn when a browser uses a control; not when the program sets its value."""
        key = object()

        async def asked(event: Any) -> None:  # awaited, and not in one of viser's threads, so that the order stays
            if event.client is not None:
                self.page.turns.ask(key, partial(what, event) if tell_event else what)

        subscribe(asked)
