"""A small flag, and a session of it."""

import threading

import pytest
from browsers import listened, until

from gaussian_swaying.viewer.session import Session

SMALL = [
    "--config=configs/sim/flag.yaml",
    "--solver.dx=0.1",
    "--scene.generator.init_args={spacing: 0.025, overlap: 0.6, stand: none}",
    "--scene.region=Everything",
    "--contact=null",
    "--material.E=9e3",  # soft, for few substeps
    "--device=cpu",
]


FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FLAGS += ["--disable-component-update", "--disable-sync"]
DRAWN = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture
def settings(parser, request):
    root = request.config.rootpath
    return parser.parse_args([SMALL[0].replace("configs", str(root / "configs")), *SMALL[1:]])


@pytest.fixture
def session(parser, settings):
    """A session that is not started yet; it is closed at the end."""
    made = Session(parser, settings)
    yield made
    made.close()


def in_turn(session):
    """Wait until the thread of a session has gone around twice: all that it was about to do is done."""
    for _ in range(2):
        done = threading.Event()
        session._ask(done.set)
        assert done.wait(60), "the session does nothing"


def pause(session):
    """Pause a session that runs, and wait until the step that was under way is done."""
    session.pause()
    in_turn(session)


def pictures_since(page, began):
    """Pictures that the server has drawn for its browsers from a time on; a page remembers its last 120 only."""
    return sum(start > began for times in list(page._drawn.values()) for start in list(times))


POSE = {"wxyz": [0.7071, -0.7071, 0, 0], "position": [0.6, -2, 0.4], "look_at": [0.6, 0, 0.4], "fov": 0.8}
POSE |= {"up_direction": [0, 0, 1], "near": 0.01, "far": 100.0}


class Client:
    """A browser without a browser: sends what it likes, and reads as few frames ahead as possible."""

    def __init__(self, page, width=64, height=32, **options):
        viser = pytest.importorskip("viser", reason="needs the extra [viewer]")
        self._encode = pytest.importorskip("msgspec").msgpack.encode
        connect = pytest.importorskip("websockets.sync.client").connect
        protocols = [f"viser-v{viser.__version__}"]
        address = page.url.replace("http", "ws")
        quiet = {"max_size": None, "max_queue": 1, "close_timeout": 1, "ping_interval": None}
        self.socket = connect(address, subprotocols=protocols, **quiet, **options)
        self.look(image_width=width, image_height=height)

    def look(self, **pose):
        self.send("ViewerCameraMessage", **(POSE | {"image_width": 64, "image_height": 32} | pose))

    def send(self, kind, **fields):
        self.socket.send(self._encode({"type": kind, **fields}))

    def set(self, control, value):
        self.send("GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})

    def drag(self, name, position):
        self.send("TransformControlsUpdateMessage", name=name, wxyz=[1, 0, 0, 0], position=position, owner="")

    def click(self, origin, direction):
        place = {"ray_origin": origin, "ray_direction": direction, "screen_pos": [[0.5, 0.5]]}
        self.send("ScenePointerMessage", event_type="click", modifier=None, **place)

    def close(self):
        self.socket.close()


@pytest.fixture
def connect():
    """Connects to a page, which knows of it then; what is open at the end is closed."""
    opened = []

    def connect(page, *arguments, wait=True, **options):
        known = len(page.server.get_clients())
        opened.append(Client(page, *arguments, **options))
        if wait:
            until(lambda: len(page.server.get_clients()) > known)
        return opened[-1]

    yield connect
    for client in opened:
        client.close()


@pytest.fixture
def join(connect):
    """Connects to a page: the client, and the key with which its program opens connections of its own."""

    def join(page):
        known = set(page.streams._lines)
        client = connect(page)
        until(lambda: set(page.streams._lines) - known)
        return client, *(set(page.streams._lines) - known)

    return join


@pytest.fixture
def show(parser, settings):
    """Shows a session, which is that of a small flag unless it is given, on a page; both are closed at the end."""
    pytest.importorskip("viser", reason="needs the extra [viewer]")
    from gaussian_swaying.viewer.controls import Page

    shown = []

    def show(session=None, page=None, **options):
        page = page or Page(**{"port": 8400, "largest": 320, **options})
        shown.append(page.show(session or Session(parser, settings)))
        page.session.start()
        return page

    yield show
    for page in shown:
        page.close()
        page.session.close()


@pytest.fixture
def page(show):
    """A page with a small flag, and its session, which runs."""
    return show()


@pytest.fixture(scope="module")
def launch(chromium):
    """Starts browsers with some flags; they are closed at the end."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        started = []

        def launch(*flags):
            started.append(driver.chromium.launch(executable_path=chromium, args=[*FLAGS, *flags]))
            return started[-1]

        yield launch
        for browser in started:
            browser.close()


@pytest.fixture(scope="module")
def browser(launch):
    return launch(*DRAWN)


@pytest.fixture(scope="module")
def shading_browser(launch):
    """As ``browser``, with WebGPU on an adapter in software where this Chromium has one."""
    return launch(*DRAWN, "--enable-unsafe-webgpu")


READY = "wind.on && wind.drawing.ready"
PATIENT = "addEventListener('DOMContentLoaded', () => (wind.patience = 1e9))"


@pytest.fixture
def open_window(browser, page):
    """Opens a window with the live page, after some scripts."""
    opened = []

    def open_window(width=1100, height=900, scripts=(PATIENT,)):
        opened.append(browser.new_context(viewport={"width": width, "height": height}, accept_downloads=True))
        opened[-1].set_default_timeout(90_000)  # a browser that draws without a GPU is slow on a busy machine
        window = listened(opened[-1].new_page())
        for script in scripts:
            window.add_init_script(script)
        window.goto(page.url)
        return window

    yield open_window
    for context in opened:
        context.close()
