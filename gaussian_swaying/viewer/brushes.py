"""Connections on which browsers send what their brushes do."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

BRUSH = "/brush"  # path


@dataclass(frozen=True)
class BrushMove:
    """A message of a browser about its brush.

    Attributes:
        kind: ``stroke`` for a piece of a stroke, ``part`` for a double click.
        first: Whether a stroke begins with this piece.
        path: Corners of its path in the window [pixels].
        size: Width and height of the window [pixels].
        fov: Vertical field of view [rad].
        near: Nearest depth that is drawn, in the units of the scene.
        matrix: From the axes of the browser's camera, y up and z backwards, to those of its scene, row by row.
    """

    kind: str
    first: bool
    path: list[list[float]]
    size: tuple[int, int]
    fov: float
    near: float
    matrix: list[list[float]]


def brush_move(raw: str) -> BrushMove:
    """The message of a browser about its brush, from JSON."""
    told = json.loads(raw)
    matrix = torch.tensor(told["matrix"], dtype=torch.float64).reshape(4, 4).T  # as WebGL has it
    width, height = (round(side) for side in told["size"])
    fov = math.radians(told["fov"])
    return BrushMove(told["kind"], told["first"], told["path"], (width, height), fov, told["near"], matrix.tolist())


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
        """Listen to a browser until it is gone."""
        from websockets.exceptions import ConnectionClosed

        self.forget(key)
        self._open[key] = connection, asyncio.get_running_loop()
        try:
            await connection.send(self._told)
            while True:
                move = brush_move(await connection.recv())
                self.take(key, move)
        except ConnectionClosed:
            pass
        finally:
            if self._open.get(key, (None,))[0] is connection:
                del self._open[key]
