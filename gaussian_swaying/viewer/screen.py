"""Pictures of a session, drawn here and sent to every browser behind the camera of viser."""

from __future__ import annotations

import io
import logging
import socket
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gaussian_swaying._checks import one_line
from gaussian_swaying.viewer.door import ANY, Door, check_address
from gaussian_swaying.viewer.film_strip import FilmStrip
from gaussian_swaying.viewer.incoming import Incoming
from gaussian_swaying.viewer.pictures import PictureSize, camera_of, draw, enlarged
from gaussian_swaying.viewer.session import Session, Snapshot
from gaussian_swaying.viewer.turns import Turns

if TYPE_CHECKING:
    import viser

MOST_PER_SECOND = 30  # pictures for a browser
JPEG_QUALITY = 75
FAR = 100.0  # longest sides of the object that a handle may be away from it
BACK = 1.35  # the first view is from farther away than that of the configuration, as the controls cover a part of it


def make_server(host: str, port: int, door: Door, incoming: Incoming) -> viser.ViserServer:
    """A viser server that opens no tunnel to the internet, whoever asks.

    Args:
        host: Address to listen on.
        port: Port; the next free one if it is taken.
        door: Checks who may open the page.
        incoming: Checks the messages of browsers.

    Raises:
        ImportError: If viser is not installed.
        ValueError: If nothing can listen there.
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
    with redirect_stdout(io.StringIO()), checked_by(door, incoming):  # its banner; the caller tells the address
        incoming.server = Server(host=host, port=port, label="Wind tunnel", verbose=False)
    return incoming.server


@contextmanager
def checked_by(door: Door, incoming: Incoming) -> Iterator[None]:
    """Within the block, make new servers check requests and messages first."""
    import websockets.asyncio.server as websockets

    serve = websockets.serve
    logger = logging.getLogger(__name__)
    logger.addFilter(lambda record: "handshake" not in record.getMessage())  # what is no HTTP is no error of ours

    def checked(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        process = partial(door.answer, process_request)
        return serve(incoming.guarded(handler), *arguments, process_request=process, logger=logger, **options)

    websockets.serve = checked  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.serve = serve  # type: ignore[misc]


class Screen:
    """A page without controls: it says how far a scene is loaded, and serves its session from :meth:`show` on.

    The simulation never waits for a browser. Each browser has a thread that draws the newest snapshot from its camera;
    a slow one gets fewer pictures, as viser replaces a picture that is not sent yet.

    Args:
        host: Address to listen on.
        port: Port; the next free one if it is taken.
        largest: Most pixels of the longer side of a picture.
        names: Names of this computer that a browser may ask for, besides those that it has.

    Attributes:
        shown: The kind of picture, one of :data:`.pictures.SHOWN`.
        streaks: Whether streaks of air are drawn over it.
        recording: The video that is being recorded, or None.
        force_end: End of the colour scale of the force of the wind [Pa].
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
        self.shown = "colour"
        self.streaks = False
        self.force_end = 1.0
        self.recording: FilmStrip | None = None
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
        self.door, self.incoming = Door(host, names), Incoming(self.tell)
        self.server = make_server(host, port, self.door, self.incoming)
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
        """Stop serving."""
        self._closed.set()
        self.turns.close()
        for thread in self._threads:
            thread.join(10.0)
        self.server.stop()

    def tell(self, notice: str, seconds: float = 15.0) -> None:
        """Show a sentence on the page for some time."""
        self._notice = (notice, time.monotonic() + seconds)

    @property
    def notice(self) -> str | None:
        """The sentence that is shown now."""
        return self._notice[0] if time.monotonic() < self._notice[1] else None

    def redraw(self) -> None:
        """Draw again, after a change of something else than the simulation."""
        self._version += 1

    def look_from_start(self) -> None:
        """Set where a browser looks from at first, from the camera of the configuration, and how far it can drag."""
        simulation = self.session.simulation
        camera = simulation.painter.camera_at(0)
        scene = simulation.scene
        self.incoming.reach = float(scene.center.abs().amax()) + FAR * scene.size
        up = scene.frame.rotation[2].tolist()
        self.server.scene.set_up_direction(tuple(up))
        first = self.server.initial_camera
        eye, forward = camera.position.double(), camera.world_to_camera[2, :3].double()
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

    def pictures_per_second(self) -> float:
        """Pictures that the fastest browser gets."""
        now = time.perf_counter()
        return max((sum(now - t < 2.0 for t in list(times)) / 2.0 for times in self._drawn.values()), default=0.0)

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
        """Draw for a browser until it is gone."""
        while not self._shown.wait(0.1):
            if gone.is_set() or self._closed.is_set():
                return
        on_cpu = self.session.simulation.device.type == "cpu"
        size = PictureSize(0.14 if on_cpu else 0.05, self.largest, 2 if on_cpu else 0)
        seen: tuple[Any, ...] = ()
        number = -1
        while not (gone.is_set() or self._closed.is_set()):
            began = time.perf_counter()
            snapshot = self.session.wait(number, 0.02)
            camera = client.camera
            now = (snapshot.number, self._version, self.shown, self.session.paused, camera.update_timestamp)
            if now == seen:
                continue
            seen, number = now, snapshot.number
            try:
                self._send(client, snapshot, size)
            except Exception as error:  # one picture; the page goes on
                self.tell(f"A picture could not be drawn: {one_line(error)}")
                gone.wait(0.5)
            left = 1 / MOST_PER_SECOND - (time.perf_counter() - began)
            if left > 0:
                gone.wait(left)

    def _send(self, client: viser.ClientHandle, snapshot: Snapshot, size: PictureSize) -> None:
        pose, began = client.camera, time.perf_counter()
        still = self.session.paused or self.session.broken
        width, height = size.fit(pose.image_width, pose.image_height, still)
        near = max(float(pose.near), 1e-6)
        camera = camera_of(pose.wxyz.tolist(), pose.position.tolist(), float(pose.fov), width, height, near)
        with self._drawing, self.session.lock:
            waited = time.perf_counter()
            picture = draw(snapshot, camera, self.shown, self.force_end, self.streaks)
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
        """Keep the figures in the corner up to date."""
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
