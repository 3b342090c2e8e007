"""The page of a live wind tunnel: pictures drawn here, sent to every browser behind the camera of viser."""

from __future__ import annotations

import http
import io
import socket
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import torch

from gaussian_swaying.viewer.film_strip import FilmStrip
from gaussian_swaying.viewer.pictures import PictureSize, camera_of, draw
from gaussian_swaying.viewer.session import Session, Snapshot

if TYPE_CHECKING:
    import viser

MOST_PER_SECOND = 30  # pictures for a browser
JPEG_QUALITY = 75
LARGEST_UPLOAD = 1 << 30  # bytes
BACK = 1.35  # the first view is from farther away than that of the configuration, as the controls cover a part of it


def make_server(host: str, port: int) -> viser.ViserServer:
    """A viser server that opens no tunnel to the internet, whoever asks.

    Args:
        host: Address to listen on.
        port: Port; the next free one if it is taken.

    Raises:
        ImportError: If viser is not installed.
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
    with redirect_stdout(io.StringIO()), own_pages_only(host):  # its banner; the caller tells the address
        return Server(host=host, port=port, label="Wind tunnel", verbose=False)


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


LOCAL = ("127.0.0.1", "localhost", "[::1]")


def allowed(host: str, headers: Mapping[str, str]) -> bool:
    """Whether a request comes from a page of the server itself, and not from another website in the same browser.

    Args:
        host: Where the server listens.
        headers: Of the request.
    """
    asked, origin = headers.get("Host") or "", headers.get("Origin")
    if host in ("127.0.0.1", "localhost", "::1") and asked.rsplit(":", 1)[0] not in LOCAL:
        return False  # a name that another site has pointed at this computer
    return origin is None or urlsplit(origin).netloc == asked


@contextmanager
def own_pages_only(host: str) -> Iterator[None]:
    """Servers that are started meanwhile refuse requests that are not :func:`allowed`."""
    import websockets.asyncio.server as websockets

    serve = websockets.serve

    def checked(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not allowed(host, request.headers):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This is for pages of this program only.\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*arguments, process_request=process, **options)

    websockets.serve = checked  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.serve = serve  # type: ignore[misc]


def limit_uploads(server: viser.ViserServer, most: int, refused: Callable[[], None]) -> None:
    """Drop uploads that are too large before they fill the memory.

    Args:
        server: The server.
        most: Largest file [bytes].
        refused: Called for each file that is dropped.
    """
    from viser._messages import FileTransferPart, FileTransferStartUpload

    gui, socket = server.gui, server._websock_server
    start, part = gui._handle_file_transfer_start, gui._handle_file_transfer_part

    def check_start(client: Any, message: Any) -> None:
        under_way = sum(state["total_bytes"] for state in gui._current_file_upload_states.values())
        if under_way + message.size_bytes > most:
            refused()
        else:
            start(client, message)

    def check_part(client: Any, message: Any) -> Any:
        state = gui._current_file_upload_states.get(message.transfer_uuid)
        if state is not None and state["transferred_bytes"] + len(message.content) > most:  # more than was announced
            gui._current_file_upload_states.pop(message.transfer_uuid, None)
            refused()
        return part(client, message)

    for kind, ours in ((FileTransferStartUpload, check_start), (FileTransferPart, check_part)):
        socket.unregister_handler(kind)
        socket.register_handler(kind, ours)


class Page:
    """Serves a session.

    The simulation never waits for a browser. Each browser has a thread that draws the newest snapshot from its camera;
    a slow one gets fewer pictures, as viser replaces a picture that is not sent yet.

    Args:
        session: The session.
        host: Address to listen on.
        port: Port; the next free one if it is taken.
        largest: Most pixels of the longer side of a picture.

    Attributes:
        shown: What is drawn, one of :data:`.pictures.SHOWN`.
        streaks: Whether streaks of air are drawn over it.
        recording: The video that is being recorded, or None.
    """

    def __init__(self, session: Session, host: str = "127.0.0.1", port: int = 8080, largest: int = 1920) -> None:
        from gaussian_swaying.viewer.controls import Controls

        self.session, self.largest = session, largest
        self.shown = "colour"
        self.streaks = False
        self.recording: FilmStrip | None = None
        self.recorder: int | None = None  # the browser from whose camera is recorded
        self._closed = threading.Event()
        self._gone: dict[int, threading.Event] = {}
        self._drawn: dict[int, deque[float]] = {}
        self._threads: list[threading.Thread] = []
        self._notice = ("", 0.0)
        self._version = 0  # of what is drawn besides snapshot and camera
        self.server = make_server(host, port)
        limit_uploads(self.server, LARGEST_UPLOAD, self._refuse_upload)
        self.server.gui.configure_theme(
            control_layout="floating", control_width="medium", show_logo=False, show_share_button=False
        )
        self.look_from_start()
        self.controls = Controls(self)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)
        self._health = threading.Thread(target=self._keep_telling, name="health", daemon=True)
        self._health.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
        return f"http://{host}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop serving."""
        self._closed.set()
        for thread in [*self._threads, self._health]:
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
        """Draw again, as something else than the simulation has changed."""
        self._version += 1

    def look_from_start(self) -> None:
        """Set where a browser looks from at first: from the camera of the configuration."""
        simulation = self.session.simulation
        camera = simulation.painter.camera_at(0)
        scene = simulation.scene
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

    def _refuse_upload(self) -> None:
        most = f"{LARGEST_UPLOAD >> 20:,} MiB"
        self.tell(f"The file is larger than {most}: give it on the command line instead.")

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
            self.controls.stop_recording(None)

    def _serve(self, client: viser.ClientHandle, gone: threading.Event) -> None:
        """Draw for a browser until it is gone."""
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
                self.tell(f"A picture could not be drawn: {' '.join(str(error).split())}")
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
        with self.session.lock:
            waited = time.perf_counter()
            picture = draw(snapshot, camera, self.shown, self.controls.force_end, self.streaks)
        if not still:
            size.took(time.perf_counter() - waited)
        client.scene.set_background_image(picture, format="jpeg", jpeg_quality=JPEG_QUALITY)
        times = self._drawn.get(client.client_id)
        if times is not None:
            times.append(began)
        film = self.recording
        if film is not None and self.recorder == client.client_id:
            film.add(snapshot.health.time, np.ascontiguousarray(picture))
            if film.full:
                self.controls.stop_recording(client)
                self.tell(f"The video has the greatest length, {film.seconds:.0f} s, and was saved.")

    def _keep_telling(self) -> None:
        """Keep the figures in the corner up to date."""
        while not self._closed.wait(0.4):
            with suppress(Exception):  # the figures of a moment, while a scene is replaced
                self.controls.tell()
