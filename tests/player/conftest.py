import asyncio
import json
import threading
import time

import aiohttp
import pytest
from browsers import listened, until

from gaussian_swaying.player.server import Server
from gaussian_swaying.player.session import Session

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
    session.pause()
    in_turn(session)


# a camera in the axes of a film, y up and z backwards, column by column: it looks along y from in front of the object
LOOK = {"matrix": [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, -2, 0, 1], "fov": 40.0, "near": 0.01, "size": [400, 300]}


class Client:
    """A browser without a browser: says what it likes, and confirms what it takes in."""

    def __init__(self, server, **options):
        self._loop, self._count = asyncio.new_event_loop(), 0
        self._session = self._run(self._open())
        self.socket = self._run(self._session.ws_connect(f"{server.url.split('/?')[0]}/socket", **options))

    async def _open(self):
        return aiohttp.ClientSession()

    def _run(self, what):
        return self._loop.run_until_complete(what)

    def say(self, kind, **fields):
        self._run(self.socket.send_str(json.dumps({"kind": kind, **fields})))

    def get(self, seconds=20.0, confirm=True):
        said = self._run(asyncio.wait_for(self.socket.receive(), seconds))
        if said.type is aiohttp.WSMsgType.TEXT:
            head = json.loads(said.data)
        else:
            assert said.type is aiohttp.WSMsgType.BINARY, said
            size = int.from_bytes(said.data[:4], "little")
            head = json.loads(said.data[4 : 4 + size]) | {"rest": said.data[4 + size :]}
        self._count += "rest" in head
        if confirm and "rest" in head:
            self.confirm()
        return head

    def confirm(self):
        self.say("ack", count=self._count, rate=30.0)

    def wait(self, kind, holds=lambda head: True, seconds=60.0, **wanted):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            head = self.get()
            if head["kind"] == kind and wanted.items() <= head.items() and holds(head):
                return head
        raise AssertionError(f"there was no {kind}")

    def control(self, name, holds):
        """Wait until the panel has a control with a value."""

        def found(panel):
            known = {one["name"]: one for part in panel["groups"] for one in part["controls"]}
            return name in known and holds(known[name].get("value"))

        return self.wait("panel", found)

    def close(self):
        if self._loop.is_closed():
            return
        self._run(self.socket.close())
        self._run(self._session.close())
        self._loop.close()


@pytest.fixture
def connect():
    opened = []

    def connect(server, looks=True, **options):
        opened.append(Client(server, **options))
        if looks:
            opened[-1].say("view", **LOOK)
        return opened[-1]

    yield connect
    for client in opened:
        client.close()


@pytest.fixture
def show(parser, settings):
    shown = []

    def show(session=None, server=None, **options):
        server = server or Server(**{"port": 8400, "largest": 320, **options})
        shown.append(server.show(session or Session(parser, settings)))
        server.session.start()
        return server

    yield show
    for server in shown:
        server.close()
        server.session.close()


@pytest.fixture
def page(show):
    return show()


@pytest.fixture(scope="module")
def launch(chromium):
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


def holds(window, condition):
    guarded = f"(() => {{ try {{ return {condition}; }} catch {{ return false; }} }})()"
    until(lambda: window.evaluate(guarded), 90)


READY = "wind.on && wind.view.drawing.ready"
PATIENT = "addEventListener('load', () => (wind.patience = 1e12))"


@pytest.fixture
def open_window(browser, page):
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
