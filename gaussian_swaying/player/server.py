"""The server of the live page: states and pictures for browsers, and what they ask of the session."""

from __future__ import annotations

import asyncio
import gzip
import hmac
import io
import json
import logging
import secrets
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import torch
from aiohttp import WSMsgType, web
from PIL import Image
from torch import Tensor

from gaussian_swaying._checks import one_line
from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.formats import FORMATS
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.parts import ROLES
from gaussian_swaying.player.film.page import PAGE, bundled, filled, in_steps, message
from gaussian_swaying.player.film.recorded import STEPS, Film, film_without_frames, first_view, look_of
from gaussian_swaying.player.painting import FILE, TOGETHER, Painting
from gaussian_swaying.player.panel import Panel
from gaussian_swaying.player.pictures import Eye, PictureSize, draw, under_cursor
from gaussian_swaying.player.session import Session, Snapshot, settings_of_splat
from gaussian_swaying.rendering.shading import DiffuseShader
from gaussian_swaying.rendering.tints import by_role
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import Namespace

LOCAL = ("127.0.0.1", "localhost", "::1")
ANY = ("0.0.0.0", "::", "")
PORTS = 100  # that are tried one after the other
MOST_PER_SECOND = 30  # pictures or states for a browser
TOLD_EVERY = 0.2  # s between two figures
AHEAD = 2  # states or pictures that a browser may have before it confirms the first
RECENT = 2.0  # s
SOON = 0.2  # s that a browser waits for a scene before it gets a picture
MOST_SAID, MOST_LOADED = 1 << 20, 1 << 31  # bytes of a message, and of a file, of a browser
JPEG_QUALITY = 75


def check_address(host: str, port: int) -> None:
    """Raise ValueError if nothing can listen at an address."""
    if not 0 < port < 65536:
        raise ValueError(f"Expected `--port` from 1 to 65535, but got {port}.")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise ValueError(
            f"Nothing can listen at `--host` {host} ({error.strerror or error}): give an address of this computer, "
            "such as 127.0.0.1."
        ) from None


class Door:
    """Checks requests before the server answers them.

    A page that other computers can reach has a token in its link. The first answer keeps it as a cookie.

    Args:
        host: Address at which the server listens.
        names: Names of this computer that a browser may ask for, besides those that it has.

    Attributes:
        token: The token that a link needs; None if the server listens on this computer only.
    """

    def __init__(self, host: str, names: Sequence[str] = ()) -> None:
        own = [] if host in LOCAL else [host, socket.gethostname(), f"{socket.gethostname()}.local"]
        self.names = {name.lower() for name in (*LOCAL, *own, *names)} - set(ANY)
        self.token = None if host in LOCAL else secrets.token_urlsafe(16)

    def refusal(self, headers: Mapping[str, str], given: Sequence[str] = (), address: str = "") -> str | None:
        """The reason why a request is refused, or None."""
        asked, origin = headers.get("Host") or "", headers.get("Origin")
        try:
            name = urlsplit(f"//{asked}").hostname or ""
            other = origin is not None and urlsplit(origin).netloc != asked
        except ValueError:
            return "The request is not valid."
        if name not in self.names and not (self.token and name == address):
            return f"This page does not go by the name {name[:100]!r}: start it with `--allow-host` and that name."
        if other:
            return "This is for pages of this program only."
        if self.token and not any(hmac.compare_digest(one.encode(), self.token.encode()) for one in given):
            return "The link lacks its token: open the whole link that the program has printed."
        return None


# ---- what a browser draws from


def drawable(snapshot: Snapshot) -> bool:
    """True if a browser can draw a snapshot itself: its Gaussians follow nodes, and it knows the light."""
    shader = snapshot.simulation.painter.shader
    with turn(snapshot.simulation):
        has_nodes = snapshot.simulation.scene.follow.nodes(snapshot.state) is not None
    return has_nodes and (shader is None or isinstance(shader, DiffuseShader))


@torch.inference_mode()
def colour_message(simulation: Simulation, film: Film, roles: Tensor, known: Tensor) -> bytes | None:
    """New colours of the Gaussians whose role has changed; None if there are none.

    Their places in the film (uint32), and red, green and blue of each (uint8).

    Args:
        roles: Their roles in the splat, see :func:`~gaussian_swaying.rendering.tints.by_role`, shape (N,).
    """
    order = torch.from_numpy(film.order)
    place = (roles != known)[order].nonzero()[:, 0]
    if len(place) == 0:
        return None
    with turn(simulation):
        sh = simulation.scene.model.sh0.detach()
        index = order[place]
        sh = sh[index.to(sh.device)]
        own = sh_to_color(sh, torch.ones(len(sh), 3, device=sh.device)).clamp(0, 1)
        colours = (by_role(own, roles[index]) * 255).round().to(torch.uint8).numpy(force=True).tobytes()
    return message({"kind": "colours", "count": len(place)}, place.numpy().astype("<u4").tobytes(), colours)


@torch.inference_mode()
def state_message(snapshot: Snapshot, ended: bool) -> bytes:
    """Nodal displacements of a state: 6 bytes per node, and 16 more for one that moved far."""
    simulation, scene = snapshot.simulation, snapshot.simulation.scene
    with turn(simulation):
        moved = scene.follow.nodal(snapshot.state)
        assert moved is not None
        values = moved.float().numpy(force=True)
    step = scene.size * scene.frame.metres_per_unit / STEPS
    near, far = in_steps(values, step)
    head = {"kind": "state", "motion": snapshot.motion, "time": snapshot.health.time}
    head |= {"nodes": len(near), "step": step, "ended": ended}
    return message(head, near.astype("<i2").tobytes(), far.astype("<i4").tobytes())


def turn(simulation: Simulation) -> AbstractContextManager[None]:
    """The lock for reading a simulation on a GPU, where another thread may be recording a graph; no lock on a CPU."""
    return simulation.turn if simulation.device.type == "cuda" else nullcontext()


# ---- browsers


class Client:
    """A browser.

    Args:
        connection: Its websocket.
        size: The size of pictures for it.
    """

    def __init__(self, connection: web.WebSocketResponse, size: PictureSize) -> None:
        self.connection, self.size = connection, size
        self.wake = asyncio.Event()  # there may be something for it
        self.eye: Eye | None = None  # how it looks
        self.show, self.server, self.hidden = "color", False, False  # pass; who draws; whether no one looks at it
        self.texts: dict[str, str] = {}  # what it was told last, by kind
        self.scene: Any = None  # what it draws
        self.state: tuple[Any, ...] = ()
        self.look: tuple[Any, ...] = ()
        self.roles: Tensor | None = None  # whose tints it shows
        self.moved = 0.0  # when it last looked from elsewhere [s]
        self._sent = self._taken = 0
        self._rate = (0.0, 0.0)  # pictures a second, and when it said so [s]

    @property
    def free(self) -> bool:
        return self._sent - self._taken < AHEAD

    @property
    def rate(self) -> float:
        rate, said = self._rate
        return rate if time.monotonic() - said < RECENT else 0.0

    def confirm(self, count: int, rate: float) -> None:
        """Note that the browser has taken in ``count`` messages, and its picture rate."""
        self._taken, self._rate = int(count), (min(max(float(rate), 0.0), 1000.0), time.monotonic())

    async def say(self, told: Mapping[str, Any] | bytes) -> None:
        self._sent += isinstance(told, bytes)
        if isinstance(told, bytes):
            await self.connection.send_bytes(told)
        else:
            await self.connection.send_str(json.dumps(told, allow_nan=False))


class Server:
    """Serves the live page: at first how far a scene is loaded, and from :meth:`show` on a session.

    The simulation never waits for a browser. Each browser gets the newest state, to be drawn there, and no others
    while it is slow. If it cannot draw, or shows what it cannot draw, it gets pictures from its camera.

    Args:
        host: Address to listen on.
        port: Port; the next free one if it is taken.
        largest: Most pixels of the longer side of a picture.
        names: Names of this computer that a browser may ask for, besides those that it has.

    Attributes:
        session: The session; None before :meth:`show`.
        scratch: A folder for files that go away with the page.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 8080, largest: int = 1920, names: Sequence[str] = ()
    ) -> None:
        check_address(host, port)
        self.host, self.largest, self.door = host, largest, Door(host, names)
        self.session: Session | None = None
        self.panel: Panel
        self.painting: Painting
        self._scratch = tempfile.TemporaryDirectory()
        self.scratch = Path(self._scratch.name)
        self.clients: list[Client] = []
        self._progress: dict[str, Any] | None = {"share": 0.0, "what": "Loading the scene"}
        self._notice = ("", 0.0)
        self._first: tuple[Any, dict[str, Any]] = (None, {})  # the first view of a simulation
        self._state: tuple[Any, bytes] = (None, b"")  # the message of the newest state
        self._film: tuple[Any, Film, bytes] | None = None  # the scene that browsers draw, and what it is that of
        self._making: asyncio.Future[Any] | None = None  # another one, for all browsers
        self._upload: tempfile.TemporaryDirectory[str] | None = None  # where the splat lies that was loaded
        self._loading = False
        self._texts: tuple[float, Any, dict[str, Any]] = (-1.0, None, {})  # when, the settings, and what was told
        self._work, self._draw = ThreadPoolExecutor(1, "work"), ThreadPoolExecutor(1, "draw")
        self._closing = threading.Event()
        self._loop = asyncio.new_event_loop()
        bound: list[Any] = []
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(port, bound, ready), name="server", daemon=True)
        self._thread.start()
        ready.wait()
        if isinstance(bound[0], BaseException):
            raise bound[0]
        self.port: int = bound[0]

    # ---- from any thread

    def show(self, session: Session) -> Server:
        self.panel, self.painting = Panel(session), Painting(session, self.scratch)
        self.session = session
        self.progress(None)
        threading.Thread(target=self._follow, name="follow", daemon=True).start()
        return self

    def progress(self, share: float | None, what: str = "") -> None:
        """Show a progress bar from 0 to 1; None removes it."""
        self._progress = None if share is None else {"share": share, "what": what}

    def tell(self, notice: str, seconds: float = 15.0) -> None:
        self._notice = (notice, time.monotonic() + seconds)

    @property
    def url(self) -> str:
        """Address of the page on this computer, with its token if it has one."""
        return self._link({"0.0.0.0": "127.0.0.1", "::": "::1", "": "127.0.0.1"}.get(self.host, self.host))

    @property
    def url_elsewhere(self) -> str | None:
        """Address of the page for other computers; None if they cannot reach it."""
        return self._link(socket.gethostname() if self.host in ANY else self.host) if self.door.token else None

    def _link(self, host: str) -> str:
        token = f"/?token={self.door.token}" if self.door.token else ""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}{token}"

    def close(self) -> None:
        self._closing.set()
        self._thread.join(10.0)
        self._work.shutdown()
        self._draw.shutdown()
        self._scratch.cleanup()

    # ---- the server's thread

    def _run(self, port: int, bound: list[Any], ready: threading.Event) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve(port, bound, ready))
        except Exception as error:
            bound.append(error)
        finally:
            ready.set()
            self._loop.close()

    async def _serve(self, port: int, bound: list[Any], ready: threading.Event) -> None:
        app = web.Application(middlewares=[self._guard])
        app.on_response_prepare.append(self._head)
        app.add_routes([
            web.get("/", self._page),
            web.get("/player.js", self._program),
            web.get("/socket", self._connect),
            web.get("/scene.sway", self._scene),
            web.get("/save/{name}", self._save),
            web.post("/load", self._load),
        ])  # fmt: skip
        quiet = logging.getLogger(f"{__name__}.noise")  # what is no HTTP is no error of ours
        quiet.setLevel(logging.CRITICAL + 1)
        runner = web.AppRunner(app, access_log=None, logger=quiet, shutdown_timeout=1.0)
        await runner.setup()
        try:
            for one in range(port, min(port + PORTS, 65536)):
                try:
                    await web.TCPSite(runner, self.host, one).start()
                    break
                except OSError:
                    if one in (port + PORTS - 1, 65535):
                        raise
            bound.append(one)
            ready.set()
            while not self._closing.is_set():
                await asyncio.sleep(0.1)
            for client in self.clients:
                await client.connection.close()
        finally:
            await runner.cleanup()

    def _follow(self) -> None:
        assert self.session is not None
        number = -1
        while not self._closing.is_set():
            found = self.session.wait(number, 0.1).number
            if found != number:
                number = found
                with suppress(RuntimeError):  # the loop is closed
                    self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for client in self.clients:
            client.wake.set()

    # ---- requests

    @web.middleware
    async def _guard(self, request: web.Request, handler: Callable[[web.Request], Any]) -> web.StreamResponse:
        address = request.transport.get_extra_info("sockname")[0] if request.transport is not None else ""
        given = [*request.query.getall("token", []), *[request.cookies.get(f"wind-{self.port}", "")]]
        refused = self.door.refusal(request.headers, given, address)
        if refused is not None:
            return web.Response(status=403, text=f"{refused}\n")
        try:
            answer: web.StreamResponse = await handler(request)
        except web.HTTPException:
            raise
        except Exception as error:
            return web.Response(status=400, text=one_line(error))
        return answer

    async def _head(self, request: web.Request, response: web.StreamResponse) -> None:
        own = request.headers.get("Host", "")
        response.headers["Content-Security-Policy"] = (
            f"frame-ancestors 'none'; connect-src 'self' ws://{own} wss://{own} blob: data:"
        )
        response.headers["X-Frame-Options"] = "DENY"
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        if self.door.token and response.status != 403:
            cookie = f"wind-{self.port}={self.door.token}; Path=/; HttpOnly; SameSite=Strict"
            response.headers["Set-Cookie"] = cookie

    async def _page(self, request: web.Request) -> web.Response:
        return web.Response(text=_live_page(), content_type="text/html")

    async def _program(self, request: web.Request) -> web.Response:
        zipped = "gzip" in request.headers.get("Accept-Encoding", "")
        headers = {"Content-Encoding": "gzip"} if zipped else {}
        return web.Response(body=_player(zipped), content_type="text/javascript", headers=headers)

    async def _scene(self, request: web.Request) -> web.Response:
        if self._film is None:
            raise web.HTTPNotFound
        return web.Response(body=self._film[2], content_type="application/vnd.gaussian-swaying")

    async def _save(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        made = {"live.yaml": self._configuration, FILE: self._parts}.get(name)
        if made is None or self.session is None:
            raise web.HTTPNotFound
        content = await self._loop.run_in_executor(self._work, made)
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return web.Response(body=content, content_type="application/octet-stream", headers=headers)

    def _configuration(self) -> bytes:
        assert self.session is not None
        text = self.painting.as_saved(self.session.yaml())
        if self._upload is not None and self._upload.name in text:  # it goes away with the program
            text = "# Give the splat that you loaded: --scene.ply PATH\n" + text.replace(self._upload.name + "/", "")
        return text.encode()

    def _parts(self) -> bytes:
        return self.painting.saved(self.scratch / FILE)

    async def _load(self, request: web.Request) -> web.Response:
        ending = Path(request.query.get("name", "")).suffix.lower()
        kinds = [own for format in FORMATS.values() if format.read for own in format.endings]
        configured = ending in (".yaml", ".yml")
        if configured and self.door.token is not None:  # it can name files of this computer
            raise ValueError("A configuration can be loaded only on a page that other computers cannot open.")
        if self.session is None or self._loading:
            raise ValueError("Another file is being loaded: wait for it.")
        self._loading = True
        folder = tempfile.TemporaryDirectory()
        try:
            path, size = Path(folder.name) / f"scene{ending if ending in kinds else '.ply'}", 0
            with path.open("wb") as file:
                async for chunk in request.content.iter_chunked(1 << 20):
                    size += len(chunk)
                    if size > MOST_LOADED:
                        raise ValueError(
                            f"The file is larger than {MOST_LOADED / 1e9:.1f} GB: give it on the command line."
                        )
                    file.write(chunk)
            read = self._read_configuration if configured else self._read_splat
            settings = await self._loop.run_in_executor(self._work, read, path)
            self.progress(0.8, "Making the simulation")
            ended, loaded = asyncio.Event(), []
            self.session.load(settings, lambda: loaded.append(True), lambda: _soon(self._loop, ended.set))
            await ended.wait()
            if not loaded:
                raise ValueError(self.session.problem or "The scene could not be made.")
            if not configured:
                self._upload, folder = folder, self._upload or tempfile.TemporaryDirectory()
            self.painting.forget()
            return web.Response(text="")
        finally:
            self._loading = False
            self.progress(None)
            folder.cleanup()

    def _read_splat(self, path: Path) -> Namespace:
        assert self.session is not None
        device = self.session.simulation.device
        quick = device.type == "cpu"  # no trial looks for a grid
        return settings_of_splat(self.session.parser, path, device, path.parent, tell=self.progress, quick=quick)

    def _read_configuration(self, path: Path) -> Namespace:
        assert self.session is not None
        self.progress(0.1, "Reading the configuration")
        try:
            text = path.read_bytes().decode()
        except UnicodeDecodeError:
            raise ValueError("The configuration is not UTF-8 text: save it as UTF-8.") from None
        settings = parse_text(self.session.parser, text, ["--device", self.session.simulation.device.type])
        splat = self.session.settings.scene.ply
        if settings.scene.ply is not None and not Path(settings.scene.ply).exists():
            if splat is None:
                raise ValueError(f"The configuration is for {settings.scene.ply}, which is not here: load it first.")
            settings.scene.ply = splat
        return settings

    # ---- a browser

    async def _connect(self, request: web.Request) -> web.WebSocketResponse:
        connection = web.WebSocketResponse(max_msg_size=MOST_SAID, heartbeat=20.0)
        await connection.prepare(request)
        on_cpu = self.session is not None and self.session.simulation.device.type == "cpu"
        size = PictureSize(0.14 if on_cpu else 0.05, self.largest, 2 if on_cpu else 0)
        client = Client(connection, size)
        self.clients.append(client)
        feeding = self._loop.create_task(self._feed(client))
        try:
            async for said in connection:
                if said.type is not WSMsgType.TEXT:
                    continue
                try:
                    await self._hear(client, json.loads(said.data))
                except Exception as error:
                    self.tell(one_line(error) if isinstance(error, ValueError) else "A message was not understood.")
        finally:
            feeding.cancel()
            self.clients.remove(client)
        return connection

    async def _hear(self, client: Client, said: dict[str, Any]) -> None:
        kind, session = said["kind"], self.session
        if kind == "ack":
            client.confirm(said["count"], said["rate"])
        elif kind == "view":
            client.eye, client.moved = Eye.told(said), time.monotonic()
        elif kind == "shown":
            client.show, client.server, client.hidden = str(said["show"]), bool(said["server"]), bool(said["hidden"])
            client.state = ()
        elif session is None:
            return
        elif kind == "set":
            await self._aside(self.panel.set, said["name"], said["value"])
        elif kind == "run":
            session.pause(not said["on"])
            session.pace(min(max(float(said["speed"]), 0.01), 1.0))
        elif kind in ("step", "reset", "undo", "restore"):
            getattr(session, kind)()
        elif kind == "grab":
            await self._grab(client, session, said)
        elif kind == "aim":
            session.drag(self._place(said["target"]))
        elif kind == "release":
            session.let_go()
        elif kind == "paint":
            await self._aside(self.painting.begin if said["on"] else self.painting.stop)
        elif kind == "brush":
            await self._aside(self.painting.paint, str(id(client)), said)
        elif kind in ("take_back", "apply"):
            await self._aside(getattr(self.painting, kind))
        client.wake.set()

    async def _aside(self, what: Callable[..., Any], *given: Any) -> Any:
        return await self._loop.run_in_executor(self._work, partial(what, *given))

    def _place(self, metres: Sequence[float]) -> list[float]:
        assert self.session is not None
        place = torch.tensor(metres, dtype=torch.float64)
        if place.shape != (3,) or not bool(place.isfinite().all()):
            raise ValueError("A place is three finite numbers.")
        found: list[float] = self.session.simulation.scene.frame.point_to_scene(place).tolist()
        return found

    async def _grab(self, client: Client, session: Session, said: Mapping[str, Any]) -> None:
        frame = session.simulation.scene.frame
        origin = self._place(said["eye"])
        end = self._place([sum(x) for x in zip(said["eye"], said["ray"], strict=True)])
        ray = [b - a for a, b in zip(origin, end, strict=True)]

        def find() -> list[float] | None:
            with session.lock:
                return under_cursor(session.snapshot, origin, ray)

        place = await self._aside(find)
        if place is not None:
            session.grab(place)
            place = frame.point_to_sim(torch.tensor(place, dtype=torch.float64)).tolist()
        await client.say({"kind": "grabbed", "token": int(said["token"]), "place": place})

    # ---- what it gets

    async def _feed(self, client: Client) -> None:
        while True:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(client.wake.wait(), TOLD_EVERY)
            client.wake.clear()
            began = self._loop.time()
            try:
                for kind, told in self._news().items():
                    text = json.dumps(told)
                    if client.texts.get(kind) != text:
                        client.texts[kind] = text
                        await client.say({"kind": kind, **told})
                if self.session is not None and client.eye is not None and not client.hidden:
                    await self._send(client, self.session)
            except (ConnectionError, RuntimeError) as error:
                if client.connection.closed:
                    return
                self.tell(one_line(error))
            except Exception as error:  # one picture; the page goes on
                self.tell(f"A picture could not be drawn: {one_line(error)}")
                await asyncio.sleep(0.5)
            await asyncio.sleep(max(1 / MOST_PER_SECOND - (self._loop.time() - began), 0))

    def _news(self) -> dict[str, Any]:
        now = time.monotonic()
        settings = None if self.session is None else self.session.settings
        if now - self._texts[0] < TOLD_EVERY and settings is self._texts[1]:
            return self._texts[2]
        notice = self._notice[0] if now < self._notice[1] else ""
        figures: dict[str, Any] = {"loading": self._progress, "notice": notice}
        found: dict[str, Any] = {"figures": figures}
        session = self.session
        if session is not None:
            with suppress(Exception):  # a moment in which a scene is replaced
                health = session.snapshot.health
                elsewhere = self.door.token is not None
                found["panel"] = {"groups": self.panel.groups(), "legends": self.panel.legends()}
                found["panel"] |= {"together": list(TOGETHER), "elsewhere": elsewhere}
                found["panel"] |= {"revision": session.revision}  # so that a refused value goes back
                if self._first[0] is not session.simulation:  # which waits for the step that is under way
                    self._first = session.simulation, first_view(session.simulation)
                found["panel"] |= self._first[1]
                found["painting"] = self.painting.shown()
                figures |= {"paused": session.paused, "speed": session.speed, "broken": session.broken}
                figures |= {"problem": session.problem, "undo": session.changes, "rate": session.rate()}
                figures |= {"pictures": round(max((one.rate for one in self.clients), default=0.0))}
                figures |= {"time": health.time, "substeps": health.substeps, "step": session.simulation.frame_dt}
                figures |= {"stretch": [health.stretch_min, health.stretch_max], "held": session.pulls}
        self._texts = (now, settings, found)
        return found

    async def _send(self, client: Client, session: Session) -> None:
        snapshot, still = session.snapshot, session.paused or session.broken
        if client.show != "color" or client.server or not drawable(snapshot):
            await self._send_picture(client, session, snapshot, still)
            return
        key = (snapshot.simulation, snapshot.simulation.scene)
        if self._film is None or self._film[0] != key:
            if self._making is None:
                self._making = self._loop.run_in_executor(None, self._make_film, key, snapshot)
            making = self._making
            await asyncio.wait([making], timeout=SOON)
            if not making.done():  # millions of Gaussians take seconds
                await self._send_picture(client, session, snapshot, still)
                return
            if self._making is making:
                self._making = None
                self._film = making.result()
            if self._film is None or self._film[0] != key:
                return
        film = self._film[1]
        painter, roles = snapshot.simulation.painter, self.painting.roles
        look = (painter.shader, painter.background)
        if client.scene != key:
            client.scene, client.look, client.roles, client.state = key, look, None, ()
            await client.say({"kind": "scene", "fresh": snapshot.motion})
        if any(known is not now for known, now in zip(client.look, look, strict=True)):
            client.look = look
            with turn(snapshot.simulation):
                await client.say({"kind": "look", **look_of(painter)})
        if roles is not client.roles and (roles is None or len(roles) == len(film.order)):
            soft = torch.full((len(film.order),), ROLES.index("soft"), dtype=torch.uint8)
            now, before = (soft if each is None else each for each in (roles, client.roles))
            client.roles = roles
            colours = colour_message(snapshot.simulation, film, now, before)
            if colours is not None:
                await client.say(colours)
        if client.free and client.state != (snapshot.number, still):
            client.state = (snapshot.number, still)
            if self._state[0] != client.state:
                with session.lock:
                    self._state = client.state, state_message(snapshot, still)
            await client.say(self._state[1])

    def _make_film(self, key: Any, snapshot: Snapshot) -> tuple[Any, Film, bytes]:
        with turn(snapshot.simulation):
            film = film_without_frames(snapshot.simulation, snapshot.state, "the scene")
        return key, film, bundled(film, level=1)

    async def _send_picture(self, client: Client, session: Session, snapshot: Snapshot, still: bool) -> None:
        eye = client.eye
        state = ("picture", snapshot.number, still, client.show, client.moved, id(self.painting.roles))
        if eye is None or not client.free or client.state == state:
            return
        client.state, client.scene = state, None
        jpeg = await self._loop.run_in_executor(self._draw, self._picture, client, eye, session, snapshot, still)
        await client.say(message({"kind": "picture", "time": snapshot.health.time}, jpeg))

    def _picture(self, client: Client, eye: Eye, session: Session, snapshot: Snapshot, still: bool) -> bytes:
        width, height = client.size.fit(*eye.size, still)
        camera = eye.camera(snapshot.simulation.scene, width, height)
        with session.lock:
            began = time.perf_counter()
            picture = draw(
                snapshot, camera, client.show, snapshot.simulation.stepper.force_scale(), self.painting.roles
            )
        if not still:
            client.size.took(time.perf_counter() - began)
        stream = io.BytesIO()
        Image.fromarray(picture).save(stream, "JPEG", quality=JPEG_QUALITY)
        return stream.getvalue()


def _soon(loop: asyncio.AbstractEventLoop, what: Callable[[], None]) -> None:
    with suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(what)


@lru_cache
def _player(zipped: bool) -> bytes:
    code = (PAGE / "film.min.js").read_bytes()
    return gzip.compress(code) if zipped else code


@lru_cache
def _live_page() -> str:
    head = {"title": "Wind tunnel", "background": [1.0, 1.0, 1.0]}
    return filled("live", head, {})
