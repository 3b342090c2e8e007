"""A browser without a browser: connects to the live page, says where it looks from, and receives pictures."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import connect

from gaussian_swaying.viewer.controls import Page
from gaussian_swaying.viewer.streams import ANSWER


class PageClient:
    """A client of a viser server.

    Args:
        port: Port of the page on this computer.
        width: Width of its window [pixels].
        height: Height of its window [pixels].
        wxyz: Rotation of its camera.
        position: Its eye [scene units].
        look_at: Where it looks [scene units].
        fov: Vertical field of view [rad].
    """

    def __init__(
        self,
        port: int,
        width: int,
        height: int,
        wxyz: list[float],
        position: list[float],
        look_at: list[float],
        fov: float = 0.7,
    ) -> None:
        protocol = f"viser-v{viser.__version__}"
        self._socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None)  # type: ignore[list-item]
        pose = {"wxyz": wxyz, "position": position, "look_at": look_at, "up_direction": [0.0, 0.0, 1.0], "fov": fov}
        window = {"near": 0.01, "far": 1000.0, "image_height": height, "image_width": width}
        self._socket.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage"} | pose | window))

    def pictures(self, seconds: float) -> Iterator[tuple[float, bytes]]:
        """When pictures come, and their JPEG, for some seconds."""
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0:
            try:
                data = self._socket.recv(timeout=left)
            except TimeoutError:
                return
            assert isinstance(data, bytes)
            for message in _messages(data):
                if message.get("type") == "BackgroundImageMessage" and message["rgb_data"] is not None:
                    yield time.perf_counter(), bytes(message["rgb_data"])

    def close(self) -> None:
        """Go away."""
        self._socket.close()


class StateClient:
    """What a browser that draws itself takes in; it belongs to a :class:`PageClient` that is connected already.

    Args:
        page: The page.
    """

    def __init__(self, page: Page) -> None:
        while not page.streams._lines:  # until the page has heard of the client
            time.sleep(0.01)
        key = next(iter(page.streams._lines))
        self._socket = connect(f"{page.url.split('/?')[0].replace('http', 'ws')}/states?key={key}", max_size=None)
        self._taken = 0

    def states(self, seconds: float) -> int:
        """Number of states that come in some seconds; each is confirmed, as a browser does that draws 60 pictures/s."""
        end, count = time.perf_counter() + seconds, 0
        while (left := end - time.perf_counter()) > 0:
            try:
                raw = self._socket.recv(timeout=left)
            except TimeoutError:
                break
            assert isinstance(raw, bytes)
            head = json.loads(raw[4 : 4 + int.from_bytes(raw[:4], "little")])
            count += head["kind"] == "state"
            self._taken += 1
            self._socket.send(ANSWER.pack(self._taken, 60.0))
        return count

    def close(self) -> None:
        """Leave drawing to the server."""
        self._socket.close()


def _messages(data: bytes) -> list[dict[str, Any]]:
    """The messages of a window: sizes, then msgpack compressed with zstd, then arrays, which are not read."""
    _, packed = struct.unpack_from("<QQ", data)
    decoded = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed]))
    found = decoded["messages"] if isinstance(decoded, dict) else decoded
    return [message for message in found if isinstance(message, dict)]
