"""Connections of browsers that draw themselves: who gets one, what is sent, and what they may answer."""

import gzip
import json
import threading
import time
import urllib.error
import urllib.request

import pytest
import torch
from browsers import until

pytest.importorskip("viser", reason="needs the extra [viewer]")
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as connect_socket

from gaussian_swaying.gaussians.parts import ROLES
from gaussian_swaying.viewer import streams
from gaussian_swaying.viewer.streams import ANSWER, scene_message

from .conftest import pause, pictures_since


class Drawer:
    """A browser that draws, without a browser: it confirms what it gets."""

    def __init__(self, page, key, **options):
        address = f"{page.url.split('/?')[0].replace('http', 'ws')}/states?key={key}"
        self.socket = connect_socket(address, max_size=None, close_timeout=1, ping_interval=None, **options)
        self.count = 0

    def get(self, timeout=20):
        """The head of the next message."""
        raw = self.socket.recv(timeout=timeout)
        self.count += 1
        return json.loads(raw[4 : 4 + int.from_bytes(raw[:4], "little")])

    def answer(self, rate=30.0):
        self.socket.send(ANSWER.pack(self.count, rate))

    def wait(self, kind, seconds=30, **wanted):
        """Take messages in until one of a kind comes, with these values."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            head = self.get()
            self.answer()
            if head["kind"] == kind and wanted.items() <= head.items():
                return head
        raise AssertionError(f"there was no {kind}")


@pytest.fixture
def drawer(page, join):
    """One, of a browser that viser knows."""
    known, key = join(page)
    made = Drawer(page, key)
    made.known, made.key = known, key
    yield made
    made.socket.close()


def _closed(socket):
    """Code with which the server closes a connection."""
    try:
        while True:
            socket.recv(timeout=20)
    except ConnectionClosed as error:
        return error.rcvd.code


def test_the_scene_comes_once_and_then_states_that_rise(page, drawer):
    assert drawer.get()["kind"] == "scene"
    drawer.answer()
    times = []
    while len(times) < 6:
        head = drawer.get()
        drawer.answer()
        assert head["kind"] == "state"
        times.append(head["time"])
    assert times == sorted(set(times))


def test_who_confirms_nothing_gets_no_more(page, drawer):
    """Nothing piles up; what comes after the answer is new."""
    assert [drawer.get()["kind"] for _ in range(2)] == ["scene", "state"]
    until(lambda: page.session.snapshot.health.time > 0.15)
    before = page.session.snapshot.health.time
    drawer.answer()
    assert drawer.get()["time"] >= before  # none of those in between was sent


def test_a_browser_that_draws_gets_no_pictures(page, drawer):
    """Until it shows what it cannot draw, or what it shows is recorded."""
    drawer.wait("state")
    until(lambda: drawer.wait("state") and page.streams.rate() == page.pictures_per_second() == 30)

    def pictures():
        began = time.perf_counter()
        end = time.monotonic() + 0.6
        while time.monotonic() < end:
            try:
                drawer.get(0.1)
            except TimeoutError:
                continue
            drawer.answer()
        return pictures_since(page, began)

    assert pictures() == 0
    for begin, end in (
        (lambda: setattr(page, "shown", "normal"), lambda: setattr(page, "shown", "color")),
        (lambda: setattr(page, "by_browser", False), lambda: setattr(page, "by_browser", True)),
    ):
        begin()
        page.redraw()
        drawer.wait("off")
        until(lambda: pictures() > 0)
        end()
        page.redraw()
        drawer.wait("scene")
        drawer.wait("state")
    assert pictures() == 0


def test_pictures_come_while_a_scene_is_made(page, join, monkeypatch):
    """As of millions of Gaussians; and a scene that cannot be made is said on the page."""
    made, begun = threading.Event(), []

    def slow(snapshot, turn):
        begun.append(time.perf_counter())
        assert made.wait(30)
        if len(begun) == 1:
            raise ValueError("no memory")
        return scene_message(snapshot, turn)

    monkeypatch.setattr(streams, "scene_message", slow)
    drawer = Drawer(page, join(page)[1])
    until(lambda: begun and pictures_since(page, begun[0]) > 1)
    assert len(begun) == 1
    made.set()
    until(lambda: page.notice is not None)
    assert page.notice == "A picture could not be drawn: no memory"
    drawer.wait("scene")
    drawer.wait("state")
    drawer.socket.close()


def test_changes_come_as_what_they_are(page, drawer):
    """Light alone; another motion after a reset; the end of a pause; another scene."""
    session = page.session
    first = drawer.wait("state")
    session.change({"background": [0.0, 0.0, 1.0]})
    assert drawer.wait("look")["background"] == [0.0, 0.0, 1.0]
    session.reset()
    drawer.wait("state", motion=first["motion"] + 1)
    session.pause()
    drawer.wait("state", ended=True)
    session.reset()
    paused = drawer.wait("state", motion=first["motion"] + 2)
    assert (paused["time"], paused["ended"]) == (0.0, True)
    session.change({"solver.dx": 0.09})
    assert drawer.wait("scene")["head"]["cell"] < 0.1
    last = drawer.wait("state", ended=True)
    assert (last["time"], last["motion"]) == (0.0, paused["motion"] + 1)


def test_only_a_browser_that_viser_knows_gets_states(page, drawer):
    for key in ("", "guess", "%00", "[//["):
        assert _closed(Drawer(page, key).socket) == 1008
    assert drawer.wait("state")
    drawer.known.close()
    until(lambda: not page.streams._lines)
    with pytest.raises(ConnectionClosed):
        drawer.wait("another one")


def test_another_connection_with_the_key_takes_over(page, drawer):
    drawer.wait("state")
    other = Drawer(page, drawer.key)
    assert _closed(drawer.socket) == 1000
    assert other.wait("state")
    other.socket.close()


def test_states_are_for_pages_of_this_program_only(page, drawer):
    with pytest.raises(Exception, match="403"):
        Drawer(page, drawer.key, origin="https://evil.example")


@pytest.mark.parametrize("zipped", [False, True])
def test_the_page_starts_the_program(page, zipped):
    def ask(path):
        headers = {"Accept-Encoding": "gzip"} if zipped else {}
        answer = urllib.request.urlopen(urllib.request.Request(page.url + path, headers=headers), timeout=10)
        body = answer.read()
        assert int(answer.headers["Content-Length"]) == len(body)
        assert (answer.headers["Content-Encoding"] == "gzip") is zipped
        assert answer.headers["X-Frame-Options"] == "DENY"
        return answer.headers["Content-Type"], (gzip.decompress(body) if zipped else body).decode()

    kind, text = ask("/")
    assert kind.startswith("text/html")
    assert text.index('<script src="/player.js">') < text.index("<script", text.index("watchWind"))
    kind, program = ask("/player.js?x=1")
    assert kind == "application/javascript"
    assert program.startswith("// Made by tools/player")
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(
            urllib.request.Request(page.url + "/player.js", headers={"Host": "evil.example"}), timeout=10
        )


def test_only_colours_that_changed_are_sent(page, drawer):
    """Those of another scene's Gaussians are not; without roles all have their own colours again."""
    pause(page.session)
    drawer.wait("state", ended=True, time=page.session.snapshot.health.time)
    count = len(page.session.simulation.scene.model.means)
    roles = torch.zeros(count, dtype=torch.uint8)
    for changed, value in (
        ([3, 5, 9], ROLES.index("held")),
        ([5], ROLES.index("still")),
        ([3, 9], ROLES.index("soft")),
    ):
        roles = roles.clone()
        roles[changed] = value
        page.roles = roles
        assert drawer.wait("colours")["count"] == len(changed)
    page.roles = torch.ones(count + 1, dtype=torch.uint8)
    with pytest.raises(TimeoutError):
        drawer.get(0.3)
    page.roles = None
    assert drawer.wait("colours")["count"] == 1
    page.roles = roles
    assert drawer.wait("colours")["count"] == 1
    page.session.change({"solver.dx": 0.12})
    drawer.wait("scene")
    assert drawer.wait("colours")["count"] == 1  # which the new scene did not have
