"""What goes to browsers: states of a film, brushes, and the streams that carry both."""

from __future__ import annotations

import asyncio
import gzip
import http
import json
import math
import secrets
import struct
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.parts import ROLES
from gaussian_swaying.rendering.shading import DiffuseShader
from gaussian_swaying.rendering.tints import by_role
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import PAGE, in_steps, message, pack_splats
from gaussian_swaying.viewer.film.recorded import STEPS, film_without_frames, look_of
from gaussian_swaying.viewer.session import Snapshot

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


def drawable(snapshot: Snapshot) -> bool:
    """True if a browser can draw a snapshot: the Gaussians follow nodes, in a light that it knows."""
    shader = snapshot.simulation.painter.shader
    with _turn(snapshot.simulation):
        has_nodes = snapshot.simulation.scene.follow.nodes(snapshot.state) is not None
    return has_nodes and (shader is None or (isinstance(shader, DiffuseShader) and not shader.specular))


@torch.inference_mode()
def scene_message(snapshot: Snapshot, turn: Tensor) -> bytes:
    """The Gaussians at rest and the nodes that move them, as in a film.

    Args:
        snapshot: A snapshot of the scene; see :func:`drawable`.
        turn: Rotation from the scene to the axes of the browser's camera, shape (3, 3), float64.
    """
    simulation = snapshot.simulation
    with _turn(simulation):
        film = film_without_frames(simulation, snapshot.state, "scene")
        world = film_from(simulation.scene, turn)
    moving, still = pack_splats(film, moving=True), pack_splats(film, moving=False)
    sizes = {"moving": len(moving), "still": len(still)}
    head = {"kind": "scene", "head": film.head, **sizes, "world": world.T.flatten().tolist()}
    rest = film.order.astype("<u4").tobytes(), film.stencils.astype("<u4").tobytes()
    return message(head, moving, still, *rest)


def film_from(scene: SimulatedScene, turn: Tensor) -> Tensor:
    """The transformation of places from the axes of the browser's camera to a film, shape (4, 4), float64.

    A film has the object's longest side as its unit, z up and the object's centre as its origin.
    """
    corners = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double()
    size = scene.size * scene.frame.metres_per_unit
    places = scene.frame.point_to_sim(corners @ turn.to(corners)).cpu() / size
    found = torch.eye(4, dtype=torch.float64)
    found[:3, 3] = places[0]
    found[:3, :3] = (places[1:] - places[0]).T
    return found


def look_message(simulation: Simulation) -> bytes:
    """Light and background, where they have changed since the scene."""
    with _turn(simulation):
        return message({"kind": "look", **look_of(simulation.painter)})


@torch.inference_mode()
def colour_message(simulation: Simulation, index: Tensor, roles: Tensor) -> bytes:
    """Other colours of some Gaussians: their indices (uint32), and red, green and blue of each (uint8).

    Args:
        simulation: The simulation.
        index: The Gaussians, shape (M,).
        roles: Their roles, see :func:`~gaussian_swaying.rendering.tints.by_role`, shape (M,).
    """
    with _turn(simulation):
        sh = simulation.scene.model.sh0.detach()
        sh = sh[index.to(sh.device)]
        own = sh_to_color(sh, torch.ones(len(sh), 3, device=sh.device)).clamp(0, 1)
        bytes_of = (by_role(own, roles) * 255).round().to(torch.uint8).numpy(force=True).tobytes()
    return message({"kind": "colours", "count": len(index)}, index.numpy().astype("<u4").tobytes(), bytes_of)


@torch.inference_mode()
def state_message(snapshot: Snapshot, ended: bool) -> bytes:
    """The displacement of the nodes of a state: 6 bytes each, and 16 more for one that moved far.

    Args:
        snapshot: The snapshot.
        ended: Whether no other state follows for now.
    """
    simulation, state = snapshot.simulation, snapshot.state
    scene = simulation.scene
    with _turn(simulation):
        moved = scene.follow.nodal(state)
        assert moved is not None
        values = moved.float().numpy(force=True)
    step = scene.size * scene.frame.metres_per_unit / STEPS
    near, far = in_steps(values, step)
    head = {
        "kind": "state",
        "motion": snapshot.motion,
        "time": snapshot.health.time,
        "nodes": len(near),
        "step": step,
        "ended": ended,
    }
    return message(head, near.astype("<i2").tobytes(), far.astype("<i4").tobytes())


def _turn(simulation: Simulation) -> AbstractContextManager[None]:
    """On a GPU the turn of the thread that reads it, as another may record a graph; a CPU does not have to wait."""
    return simulation.turn if simulation.device.type == "cuda" else nullcontext()


OFF = message({"kind": "off"})
"""Says that the server draws from now on."""


STATES, PROGRAM = "/states", "/player.js"  # paths
TAGS = f'<script src="{PROGRAM}"></script><script>watchWind();</script>'
AHEAD = 2  # messages that a browser may have before it confirms the first
RECENT = 2.0  # s
ANSWER = struct.Struct("<If")  # messages that a browser has taken in, and the pictures that it draws a second


class Line:
    """A connection to one browser."""

    def __init__(self, connection: Any, loop: asyncio.AbstractEventLoop) -> None:
        self._connection, self._loop = connection, loop
        self._sent = self._taken = 0
        self._first: int | None = None  # number of the message with the first state, since the browser draws
        self._scene: tuple[Any, ...] | None = None  # what it knows
        self._look: tuple[Any, ...] = ()
        self._state: tuple[Any, ...] = ()
        self._roles: Tensor | None = None  # whose tints it shows
        self._rate = (0.0, 0.0)  # pictures a second, and when the browser said so [s]

    @property
    def free(self) -> bool:
        return self._sent - self._taken < AHEAD

    @property
    def draws(self) -> bool:
        return self._first is not None and self._taken >= self._first

    @property
    def rate(self) -> float:
        """Pictures that the browser draws a second, as it said within the last seconds."""
        rate, said = self._rate
        return rate if self.draws and time.monotonic() - said < RECENT else 0.0

    def send(
        self,
        snapshot: Snapshot,
        ended: bool,
        scene: tuple[tuple[Any, ...], bytes],
        roles: Tensor | None = None,
    ) -> bool:
        """Send what the browser lacks of a snapshot; False if it lacks nothing, or has to take in more before.

        Args:
            snapshot: The snapshot.
            ended: Whether no other follows for now.
            scene: The key and the message of its scene.
            roles: Roles whose tints are shown, see :func:`~gaussian_swaying.rendering.tints.by_role`, shape (N,); a
                tensor is not changed once it was given.
        """
        if not self.free:
            return False
        painter = snapshot.simulation.painter
        look = (painter.shader, painter.background)
        key, made = scene
        if self._scene is None or key != self._scene:
            self._scene, self._look, self._state, self._roles = key, look, (), None
            self._put(made)
            return True
        if any(known is not now for known, now in zip(self._look, look, strict=True)):
            self._look = look
            self._put(look_message(snapshot.simulation))
            return True
        if self._tint(snapshot, roles):
            return True
        if self._state == (snapshot.number, ended):
            return False
        self._state = (snapshot.number, ended)
        self._put(state_message(snapshot, ended))
        if self._first is None:
            self._first = self._sent
        return True

    def _tint(self, snapshot: Snapshot, roles: Tensor | None) -> bool:
        """Send the colours of the Gaussians whose role is another one than the browser shows; False if there are none.

        Nothing is tinted at first, as if all were soft.
        """
        if roles is self._roles:
            return False
        count = len(snapshot.simulation.scene.model.means)
        if roles is not None and len(roles) != count:  # those of a scene that was just replaced
            return False
        soft = torch.full((count,), ROLES.index("soft"), dtype=torch.uint8)
        known, now = (soft if each is None else each for each in (self._roles, roles))
        self._roles = roles
        changed = (known != now).nonzero()[:, 0]
        if len(changed):
            self._put(colour_message(snapshot.simulation, changed, now[changed]))
        return len(changed) > 0

    def stop(self) -> None:
        """Tell the browser that the server draws from now on."""
        if self._first is not None:
            self._first = self._scene = None
            self._put(OFF)

    def take(self, answer: bytes) -> None:
        """Take an answer of the browser."""
        self._taken, rate = ANSWER.unpack(answer)
        self._rate = (rate, time.monotonic())

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._connection.close(), self._loop)

    def _put(self, data: bytes) -> None:
        self._sent += 1
        asyncio.run_coroutine_threadsafe(self._connection.send(data), self._loop)


class Streams:
    """The connections of all browsers that draw.

    A browser that viser knows gets a key, with which its program opens connections of its own.

    Args:
        brushes: Has those for strokes.
    """

    def __init__(self, brushes: Brushes) -> None:
        self._brushes = brushes
        self._lines: dict[str, Line | None] = {}
        self._known: tuple[tuple[Any, ...], bytes] | None = None  # the scene that was asked for last
        self._making = threading.Lock()
        self._maker: threading.Thread | None = None
        self._failure: Exception | None = None

    def expect(self) -> str:
        key = secrets.token_urlsafe(16)
        self._lines[key] = None
        return key

    def forget(self, key: str) -> None:
        line = self._lines.pop(key, None)
        if line is not None:
            line.close()
        self._brushes.forget(key)

    def line(self, key: str) -> Line | None:
        """The connection that was opened with a key, or None."""
        return self._lines.get(key)

    def rate(self) -> float:
        return max((line.rate for line in list(self._lines.values()) if line is not None), default=0.0)

    def scene(self, snapshot: Snapshot, turn: Tensor) -> tuple[tuple[Any, ...], bytes] | None:
        """Key and message of the scene of a snapshot, the same for all browsers. See :func:`.states.scene_message`.

        Returns:
            None while it is being made, in a thread: millions of Gaussians take seconds.

        Raises:
            Exception: What went wrong when it was made.
        """
        key = (snapshot.simulation, snapshot.simulation.scene)

        def make() -> None:
            try:
                self._known = (key, scene_message(snapshot, turn))
            except Exception as error:
                self._failure = error

        with self._making:
            if self._known is not None and self._known[0] == key:
                return self._known
            if self._failure is not None:
                failure, self._failure = self._failure, None
                raise failure
            if self._maker is None or not self._maker.is_alive():
                self._maker = threading.Thread(target=make, name="scene", daemon=True)
                self._maker.start()
        return None

    def beside(self, handler: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """The handler of all connections: those for states and strokes, and those of viser, which gets ``handler``."""
        own = {STATES: self._serve, BRUSH: self._brushes.serve}

        async def handle(connection: Any) -> None:
            asked, _, query = connection.request.path.partition("?")
            if asked not in own:
                await handler(connection)
                return
            key = query.removeprefix("key=")
            if key in self._lines:
                await own[asked](key, connection)
            else:
                await connection.close(1008, "unknown key")

        return handle

    async def _serve(self, key: str, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        before = self._lines[key]
        line = self._lines[key] = Line(connection, asyncio.get_running_loop())
        if before is not None:
            before.close()
        try:
            while True:
                line.take(await connection.recv())
        except ConnectionClosed:
            pass
        finally:
            if self._lines.get(key) is line:
                self._lines[key] = None


def with_program(process_request: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Answers as those of viser, with the program in its page."""

    def process(connection: Any, request: Any) -> Any:
        asked = request.path.partition("?")[0]
        if asked == PROGRAM and request.headers.get("Upgrade") != "websocket":
            zipped = "gzip" in request.headers.get("Accept-Encoding", "")
            response = connection.respond(http.HTTPStatus.OK, "")
            return _filled(response, _program(zipped), "application/javascript", zipped)
        response = process_request(connection, request)
        if response is not None and response.headers.get("Content-Type", "").startswith("text/html"):
            zipped = response.headers.get("Content-Encoding") == "gzip"
            _filled(response, _with_tags(response.body, zipped), "text/html; charset=utf-8", zipped)
        return response

    return process


def _filled(response: Any, body: bytes, kind: str, zipped: bool) -> Any:
    response.body = body
    for name in ("Content-Type", "Content-Length", "Content-Encoding"):
        if name in response.headers:
            del response.headers[name]
    response.headers["Content-Type"] = kind
    response.headers["Content-Length"] = str(len(body))
    response.headers["Content-Encoding"] = "gzip" if zipped else "identity"
    return response


@lru_cache
def _program(zipped: bool) -> bytes:
    code = (PAGE / "film.min.js").read_bytes()
    return gzip.compress(code) if zipped else code


@lru_cache(2)
def _with_tags(body: bytes, zipped: bool) -> bytes:
    text = (gzip.decompress(body) if zipped else body).replace(b"<head>", b"<head>" + TAGS.encode(), 1)
    return gzip.compress(text) if zipped else text
