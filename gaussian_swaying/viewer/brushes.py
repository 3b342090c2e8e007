"""Connections on which browsers send what their brushes do."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any

from gaussian_swaying.viewer.incoming import LARGEST_STROKE, BrushMove, brush_move

BRUSH = "/brush"  # path


class Brushes:
    """The brushes of all browsers, which are switched on and off together.

    Attributes:
        take: Called with the key of a browser and what its brush did, in the thread of the connections, which it must
            not keep waiting.
    """

    def __init__(self) -> None:
        self.take: Callable[[str, BrushMove], None] = lambda key, move: None
        self._told = json.dumps({"on": False})
        self._open: dict[str, tuple[Any, asyncio.AbstractEventLoop]] = {}

    def tell(self, on: bool, radius: float) -> None:
        """Switch the brushes on or off.

        Args:
            on: Whether they paint.
            radius: Radius of what they paint [pixels].
        """
        self._told = json.dumps({"on": on, "radius": radius})
        for connection, loop in list(self._open.values()):
            asyncio.run_coroutine_threadsafe(connection.send(self._told), loop)

    def forget(self, key: str) -> None:
        known = self._open.pop(key, None)
        if known is not None:
            asyncio.run_coroutine_threadsafe(known[0].close(), known[1])

    async def serve(self, key: str, connection: Any) -> None:
        """Listen to a browser until it is gone; what its program cannot have sent is dropped."""
        from websockets.exceptions import ConnectionClosed

        connection.protocol.max_message_size = LARGEST_STROKE
        self.forget(key)
        self._open[key] = connection, asyncio.get_running_loop()
        try:
            await connection.send(self._told)
            while True:
                move = brush_move(await connection.recv())
                if move is not None:
                    self.take(key, move)
        except ConnectionClosed:
            pass
        finally:
            if self._open.get(key, (None,))[0] is connection:
                del self._open[key]
