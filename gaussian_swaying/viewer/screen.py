"""A session as browsers see it: drawn by them from its states, or drawn here and sent as pictures."""

from __future__ import annotations

import hmac
import http
import io
import logging
import secrets
import socket
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import torch

from gaussian_swaying._checks import one_line
from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.viewer.pictures import FilmStrip, PictureSize, camera_of, draw, enlarged, pinhole
from gaussian_swaying.viewer.session import Session, Snapshot
from gaussian_swaying.viewer.streams import Brushes, BrushMove, Streams, drawable, with_program

LOCAL = ("127.0.0.1", "localhost", "::1")
ANY = ("0.0.0.0", "::", "")


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
    """Checks requests before the server answers them, and adds headers to its answers.

    A page that other computers can reach has a token in its link. The first answer keeps it as a cookie, as the
    websocket of viser asks without it.

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

    def refusal(self, path: str, headers: Mapping[str, str], address: str = "", port: int = 0) -> str | None:
        """Return the reason why a request is refused, or None.

        Args:
            path: The requested path, with the query.
            headers: Of the request.
            address: Address of this computer at which the request arrived.
            port: Port of the server.
        """
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
        if self.token and not any(
            hmac.compare_digest(given.encode(), self.token.encode()) for given in _tokens(path, headers, port)
        ):
            return "The link lacks its token: open the whole link that the program has printed."
        return None

    def answer(self, process_request: Any, connection: Any, request: Any) -> Any:
        """Return viser's answer to an allowed request, with headers that forbid frames and connections elsewhere."""
        address, port = connection.local_address[:2]
        refused = self.refusal(request.path, request.headers, address, port)
        if refused is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refused}\n")
        try:
            response = process_request(connection, request)
        except OSError:  # such as a name that is too long
            return connection.respond(http.HTTPStatus.NOT_FOUND, "NOT FOUND")
        if response is not None:
            own = request.headers["Host"]
            response.headers["Content-Security-Policy"] = (
                f"frame-ancestors 'none'; connect-src 'self' ws://{own} wss://{own} blob: data:"
            )
            response.headers["X-Frame-Options"] = "DENY"
            response.headers["X-Content-Type-Options"] = "nosniff"
            response.headers["Referrer-Policy"] = "no-referrer"
            if self.token:
                response.headers["Set-Cookie"] = f"wind-{port}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return response


def _tokens(path: str, headers: Mapping[str, str], port: int) -> list[str]:
    found = parse_qs(urlsplit(path).query).get("token", [])
    try:
        cookie = SimpleCookie(headers.get("Cookie") or "").get(f"wind-{port}")
    except CookieError:
        cookie = None
    return [*found, *([] if cookie is None else [cookie.value])]


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


if TYPE_CHECKING:
    import viser

MOST_PER_SECOND = 30  # pictures or states for a browser
JPEG_QUALITY = 75
BACK = 1.35  # the first view is from farther away than that of the configuration, as the controls cover a part of it


def make_server(host: str, port: int, door: Door, streams: Streams) -> viser.ViserServer:
    """A viser server that opens no tunnel to the internet, whoever asks.

    Args:
        host: Address to listen on.
        port: Port; the next free one if it is taken.
        door: Checks who may open the page.
        streams: Has the connections of those that draw themselves.
    """
    try:
        import viser
    except ImportError:
        raise ImportError("The live page needs viser: install gaussian-swaying[viewer].") from None

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    check_address(host, port)
    # a picture may be drawn while its browser goes away
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    warnings.filterwarnings("ignore", message=r"\[viser\] .* does not match annotation", category=UserWarning)
    with redirect_stdout(io.StringIO()), checked_by(door, streams):  # its banner; the caller tells the address
        return Server(host=host, port=port, label="Wind tunnel", verbose=False)


@contextmanager
def checked_by(door: Door, streams: Streams) -> Iterator[None]:
    """Within the block, make new servers check requests first, and serve the states, too."""
    import websockets.asyncio.server as websockets

    serve = websockets.serve
    logger = logging.getLogger(__name__)
    logger.addFilter(lambda record: "handshake" not in record.getMessage())  # what is no HTTP is no error of ours

    def checked(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        process = partial(door.answer, with_program(process_request))
        return serve(streams.beside(handler), *arguments, process_request=process, logger=logger, **options)

    websockets.serve = checked  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.serve = serve  # type: ignore[misc]


def turn_of(up: Sequence[float], otherwise: torch.Tensor) -> torch.Tensor:
    """The rotation from the scene to the axes of viser's camera, which have y up, shape (3, 3), float64.

    Args:
        up: Up in the scene.
        otherwise: Returned if viser keeps what it had.
    """
    import viser

    told: Any = SimpleNamespace(messages=[])
    told._queue_scene_message = told.messages.append
    viser.SceneApi.set_up_direction(told, tuple(up))  # type: ignore[arg-type]
    if not told.messages:
        return otherwise
    return quat_to_rotation(torch.tensor(told.messages[0].wxyz, dtype=torch.float64))


class Screen:
    """A page without controls: it says how far a scene is loaded, and serves its session from :meth:`show` on.

    The simulation never waits for a browser. Each browser has a thread that sends it the newest state, to be drawn
    there, and leaves states out for a slow one. If the browser cannot draw, or shows what it cannot draw, the thread
    draws the newest snapshot from its camera; viser replaces a picture that is not sent yet.

    Args:
        host: Address to listen on.
        port: Port; the next free one if it is taken.
        largest: Most pixels of the longer side of a picture.
        names: Names of this computer that a browser may ask for, besides those that it has.

    Attributes:
        shown: The name of the pass that is shown.
        by_browser: Whether browsers draw, where they can.
        roles: Roles whose tints are shown (see :func:`.tints.by_role`), shape (N,), or None; redraw after a change.
        recording: The video that is being recorded, or None.
        force_end: End of the colour scale of the force of the wind [Pa].
        scratch: A folder for files that go away with the page.
        drawn_size: Width and height at which the last picture was drawn [pixels].
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        largest: int = 1920,
        names: Sequence[str] = (),
    ) -> None:
        self.largest = largest
        self.session: Session
        self.shown = "color"
        self.by_browser = True
        self.roles: torch.Tensor | None = None
        self.force_end = 1.0
        self.recording: FilmStrip | None = None
        self._scratch = tempfile.TemporaryDirectory()
        self.scratch = Path(self._scratch.name)
        self.drawn_size = (0, 0)
        self.recorder: int | None = None  # the browser from whose camera is recorded
        self._closed = threading.Event()
        self._gone: dict[int, threading.Event] = {}
        self._drawn: dict[int, deque[float]] = {}
        self._shown = threading.Event()  # whether there is a session
        self._threads: list[threading.Thread] = []
        self._drawing = threading.Lock()  # of many browsers one waits for the session, which gets its turn so
        self._notice = ("", 0.0)
        self._version = 0  # of what is drawn besides snapshot and camera
        self._turn = torch.eye(3, dtype=torch.float64)  # from the scene to the axes of viser's camera
        self.door, self.brushes = Door(host, names), Brushes()
        self.streams = Streams(self.brushes)
        self.server = make_server(host, port, self.door, self.streams)
        self.server.gui.configure_theme(
            control_layout="floating", control_width="medium", show_logo=False, show_share_button=False
        )
        self._text = self.server.gui.add_markdown("")
        self._bar = self.server.gui.add_progress_bar(0.0, animated=True)
        self.progress(0.0, "Loading the scene")
        self.turns = Turns(self._keep_telling, 0.4, lambda error: self.tell(one_line(error)))
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    def show(self, session: Session) -> Screen:
        """Show a session; returns the screen."""
        self.session = session
        self.look_from_start()
        self.progress(None)
        self._shown.set()
        return self

    def progress(self, share: float | None, what: str = "") -> None:
        """Show how much of something is done, from 0 to 1; None if there is nothing to wait for."""
        self._loading = "" if share is None else f"{what} ..."
        self._bar.visible = share is not None
        self._bar.value = 100 * (share or 0.0)  # type: ignore[misc]
        if not self._shown.is_set():
            self.write([])

    def write(self, lines: Sequence[str]) -> None:
        """Write lines in the corner, with what is being loaded and the notice."""
        further = [f"**{self._loading}**" if self._loading else "", f"_{self.notice}_" if self.notice else ""]
        self._text.content = "\n\n".join(line for line in (*lines, *further) if line)

    @property
    def url(self) -> str:
        """Address of the page on this computer, with its token if it has one."""
        host = self.server.get_host()
        return self._link({"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host))

    @property
    def url_elsewhere(self) -> str | None:
        """Address of the page for other computers; None if they cannot reach it."""
        host = self.server.get_host()
        return self._link(socket.gethostname() if host in ANY else host) if self.door.token else None

    def _link(self, host: str) -> str:
        token = f"/?token={self.door.token}" if self.door.token else ""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}{token}"

    def close(self) -> None:
        self._closed.set()
        self.turns.close()
        for thread in self._threads:
            thread.join(10.0)
        self.server.stop()
        self._scratch.cleanup()

    def tell(self, notice: str, seconds: float = 15.0) -> None:
        self._notice = (notice, time.monotonic() + seconds)

    @property
    def notice(self) -> str | None:
        return self._notice[0] if time.monotonic() < self._notice[1] else None

    def redraw(self) -> None:
        """Draw again, after a change of something else than the simulation."""
        self._version += 1

    def look_from_start(self) -> None:
        """Set where a browser looks from at first, from the camera of the configuration."""
        simulation = self.session.simulation
        camera = simulation.painter.camera_at(0)
        scene = simulation.scene
        up = scene.frame.rotation[2].tolist()
        self.server.scene.set_up_direction(tuple(up))
        self._turn = turn_of(up, self._turn)
        first = self.server.initial_camera
        eye, forward = in_double(camera.position), in_double(camera.world_to_camera[2, :3])
        distance = float((scene.center.to(eye) - eye).norm())
        first.position = tuple((eye - (BACK - 1) * distance * forward).tolist())
        first.look_at = tuple((eye + distance * forward).tolist())
        first.up = tuple(up)
        first.fov = float(2 * torch.atan(0.5 * camera.height / camera.intrinsics[1, 1]))
        first.near = 0.001 * scene.size
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = tuple(up)
                client.camera.position, client.camera.look_at = first.position, first.look_at

    def camera_of(self, move: BrushMove) -> Camera:
        """The camera with which a browser saw what its brush did, in scene units."""
        matrix = torch.tensor(move.matrix, dtype=torch.float64)
        turn = self._turn.mT  # from the axes of viser's camera to the scene
        rotation = turn @ matrix[:3, :3] @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
        return pinhole(rotation, turn @ matrix[:3, 3], move.fov, *move.size, move.near)

    def pictures_per_second(self) -> float:
        now = time.perf_counter()
        sent = max((sum(now - t < 2.0 for t in list(times)) / 2.0 for times in self._drawn.values()), default=0.0)
        return max(sent, self.streams.rate())

    # ---- browsers

    def _connected(self, client: viser.ClientHandle) -> None:
        gone = self._gone[client.client_id] = threading.Event()
        self._drawn[client.client_id] = deque(maxlen=120)
        name = f"pictures {client.client_id}"
        thread = threading.Thread(target=self._serve, args=(client, gone), name=name, daemon=True)
        self._threads = [known for known in self._threads if known.is_alive()] + [thread]
        thread.start()

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self._gone.pop(client.client_id, threading.Event()).set()
        self._drawn.pop(client.client_id, None)
        if self.recorder == client.client_id:
            self.turns.ask("stop recording", lambda: self.stop_recording(None))

    def _serve(self, client: viser.ClientHandle, gone: threading.Event) -> None:
        while not self._shown.wait(0.1):
            if gone.is_set() or self._closed.is_set():
                return
        key = self.streams.expect()
        try:
            self._keep_sending(client, gone, key)
        finally:
            self.streams.forget(key)

    def _keep_sending(self, client: viser.ClientHandle, gone: threading.Event, key: str) -> None:
        """Send a browser states or pictures until it is gone."""
        from viser._messages import RunJavascriptMessage

        join = RunJavascriptMessage(f"window.wind?.join({key!r})")
        client.gui._websock_interface.queue_message(join)
        on_cpu = self.session.simulation.device.type == "cpu"
        size = PictureSize(0.14 if on_cpu else 0.05, self.largest, 2 if on_cpu else 0)
        seen: tuple[Any, ...] = ()
        number, pictured = -1, False
        while not (gone.is_set() or self._closed.is_set()):
            began = time.perf_counter()
            snapshot = self.session.wait(number, 0.02)
            line, still = self.streams.line(key), self.session.paused or self.session.broken
            camera = client.camera
            try:
                scene = None
                if line is not None and self._drawn_there(client, snapshot):
                    scene = self.streams.scene(snapshot, self._turn)
                drawn_there = scene is not None
                now = (snapshot.number, self._version, self.shown, still, drawn_there or camera.update_timestamp)
                if now == seen and not drawn_there:
                    continue
                if line is not None and scene is not None:
                    if not line.free:
                        gone.wait(0.005)
                        continue
                    with self.session.lock:
                        sent = line.send(snapshot, still, scene, self.roles)
                    if pictured and line.draws:
                        client.scene.set_background_image(None)
                        pictured = False
                    number = snapshot.number
                    if not sent:
                        continue
                else:
                    seen, number, pictured = now, snapshot.number, True
                    self._send(client, snapshot, size)
                    if line is not None:
                        line.stop()
            except Exception as error:  # one picture; the page goes on
                self.tell(f"A picture could not be drawn: {one_line(error)}")
                gone.wait(0.5)
            left = 1 / MOST_PER_SECOND - (time.perf_counter() - began)
            if left > 0:
                gone.wait(left)

    def _drawn_there(self, client: viser.ClientHandle, snapshot: Snapshot) -> bool:
        recorded = self.recording is not None and self.recorder == client.client_id
        plain = self.by_browser and self.shown == "color"
        return plain and not recorded and drawable(snapshot)

    def _send(self, client: viser.ClientHandle, snapshot: Snapshot, size: PictureSize) -> None:
        pose, began = client.camera, time.perf_counter()
        still = self.session.paused or self.session.broken
        width, height = size.fit(pose.image_width, pose.image_height, still)
        near = max(float(pose.near), 1e-6)
        camera = camera_of(pose.wxyz.tolist(), pose.position.tolist(), float(pose.fov), width, height, near)
        with self._drawing, self.session.lock:
            waited = time.perf_counter()
            picture = draw(snapshot, camera, self.shown, self.force_end, self.roles)
        if not still:
            size.took(time.perf_counter() - waited)
        self.drawn_size = (width, height)
        picture = enlarged(picture, *size.fit(pose.image_width, pose.image_height, still=True))
        client.scene.set_background_image(picture, format="jpeg", jpeg_quality=JPEG_QUALITY)
        times = self._drawn.get(client.client_id)
        if times is not None:
            times.append(began)
        film = self.recording
        if film is not None and self.recorder == client.client_id:
            film.add(snapshot.health.time, np.ascontiguousarray(picture))
            if film.full:
                self.turns.ask("stop recording", lambda: self.stop_recording(client))

    def stop_recording(self, client: viser.ClientHandle | None) -> None:
        """Stop the video that is being recorded, and send it to a browser."""
        self.recording = None

    def tell_figures(self) -> None:
        """Write the figures in the corner, and whatever else follows the session."""

    def _keep_telling(self) -> None:
        if not self._shown.is_set():
            return
        with suppress(Exception):  # the figures of a moment, while a scene is replaced
            self.tell_figures()


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
