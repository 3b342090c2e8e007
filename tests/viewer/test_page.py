"""The live page, in a real browser where there is one."""

import socket
import threading
import time
import urllib.error
import urllib.request

import pytest
import yaml
from browsers import reached, until
from shared import double

from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.viewer.session import Session

pytest.importorskip("viser", reason="needs the extra [viewer]")
from gaussian_swaying.viewer.controls import Page
from gaussian_swaying.viewer.pictures import camera_of

from .conftest import pause


@pytest.fixture
def window(open_window):
    opened = open_window(scripts=())
    opened.get_by_text("pictures a second").wait_for()
    return opened


def _seen(window):
    """The part of the window beside the controls."""
    return window.screenshot(clip={"x": 350, "y": 150, "width": 380, "height": 600})


def test_it_listens_on_this_computer_only_and_serves_no_files(page):
    assert page.url.startswith("http://127.0.0.1:")
    assert urllib.request.urlopen(page.url, timeout=10).status == 200
    for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..%2fpage.py"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(page.url + path, timeout=10)
    assert page.server.request_share_url() is None  # no tunnel, whoever asks


def test_closing_ends_all_threads(parser, settings):
    before = set(threading.enumerate())
    session = Session(parser, settings)
    page = Page(port=8450).show(session)
    session.start()
    page.close()
    session.close()
    until(lambda: not {t.name for t in set(threading.enumerate()) - before} & {"turns", "simulation"})


@pytest.mark.slow
def test_a_client_that_reads_nothing_slows_nobody(page, connect):
    """Another one gets its pictures; for the first one only the last picture waits, and it goes without a word."""
    page.largest = 1000
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # before it connects; the system takes no more in
    narrow.connect(("127.0.0.1", page.server.get_port()))
    connect(page, 1000, 500, sock=narrow)
    quick = connect(page, 200, 100)
    buffer, _ = (state.message_buffer for state in page.server._websock_server._client_state_from_id.values())
    number, stuck = page.session.snapshot.number, 0
    while stuck < 20 or page.session.snapshot.number < number + 6:
        if len(quick.socket.recv(timeout=20)) > 500:  # a picture
            stuck = stuck + 1 if buffer.message_from_id else 0
    assert len(buffer.message_from_id) < 10
    quick.close()
    narrow.close()
    until(lambda: not page.server.get_clients())
    number = page.session.snapshot.number
    until(lambda: page.session.snapshot.number > number + 2)
    assert page.session.problem is None


def test_the_page_moves_pauses_and_steps(page, window):
    session = page.session
    first = _seen(window)
    reached(session, 0.2)
    until(lambda: _seen(window) != first)
    window.get_by_role("button", name="Pause").click()
    until(lambda: session.paused)
    pictures = [_seen(window)]

    def stands_still():
        time.sleep(0.7)
        pictures.append(_seen(window))
        return pictures[-1] == pictures[-2]

    until(stands_still)  # the browser shows the last steps a while later
    still = pictures[-1]
    window.get_by_role("button", name="Step").click()
    until(lambda: _seen(window) != still)
    assert window.problems == []


@pytest.mark.slow
def test_controls_change_the_wind_and_say_what_is_wrong(page, window):
    session = page.session
    before = session.simulation.wind.flows.clone()
    field = window.get_by_text("Speed [m/s]").locator("xpath=ancestor::*[.//input][1]").locator("input").last
    field.fill("12")
    field.press("Enter")
    until(lambda: session.simulation.wind.flows.norm() > 11.9)
    flows = session.simulation.wind.flows
    assert flows / flows.norm() == pytest.approx((before / before.norm()).numpy(), abs=0.02)  # the same direction
    session.change({"wind.flow": [1e4, 0.0, 0.0]})
    window.get_by_text("to start again").wait_for()
    session.change({"wind.flow": [2.0, 0.0, 0.0]})
    window.get_by_role("button", name="Back to rest").click()
    until(lambda: session.snapshot.health.time > 0.1 and not session.broken)


@pytest.mark.slow
def test_a_video_and_the_configuration_come_out(page, window, tmp_path):
    iio = pytest.importorskip("imageio.v3")
    window.get_by_role("button", name="Record a video").click()
    until(lambda: page.recording is not None and page.recording.seconds > 0.3, 240)
    with window.expect_download(timeout=30_000) as download:
        window.get_by_role("button", name="Stop recording").click()
    video = tmp_path / "wind.mp4"
    download.value.save_as(video)
    frames = iio.imread(video)
    assert len(frames) > 7
    assert abs(frames[0].astype(int) - frames[-1].astype(int)).max() > 20  # it moves
    with window.expect_download(timeout=30_000) as download:
        window.get_by_role("button", name="Save the configuration").click()
    file = tmp_path / "live.yaml"
    download.value.save_as(file)
    assert yaml.safe_load(file.read_text())["solver"]["dx"] == 0.1


@pytest.mark.slow
def test_a_click_takes_hold_of_the_flag(page, window):
    """Where it is clicked; the handle appears there, and lets go."""
    session, holding = page.session, page.controls.holding
    client = next(iter(page.server.get_clients().values()))
    pause(session)
    pose, scene = client.camera, session.simulation.scene
    width, height = window.viewport_size["width"], window.viewport_size["height"]
    camera = camera_of(pose.wxyz, pose.position, pose.fov, width, height)
    means = session.simulation.painter.deformed(session.snapshot.state).means.double()
    wanted = means[(means - scene.center.double()).norm(dim=-1).argmin()]
    pixel, _ = project(wanted[None], camera)
    window.mouse.click(*pixel[0].tolist())
    until(lambda: session.pulls and holding._handle is not None and not holding.release.disabled, 60)
    grabbed = double(holding._handle.position)
    assert (grabbed - wanted).norm() < 0.05 * scene.size
    window.mouse.click(10, height - 10)  # beside the object: what is held stays held
    let_go = window.get_by_role("button", name="Let go of it")
    until(let_go.is_enabled, 60)  # a slow browser hears of it later
    let_go.dispatch_event("click")
    until(lambda: not session.pulls and holding._handle is None, 60)
    assert window.problems == []


@pytest.mark.slow
def test_two_browsers_see_the_same_scene_and_closing_one_ends_nothing(page, window, browser):
    second = browser.new_context(viewport={"width": 500, "height": 700})
    other = second.new_page()
    other.goto(page.url)
    until(lambda: len(page.server.get_clients()) == 2, 240)
    page.by_browser = False
    until(lambda: sum(len(times) > 3 for times in list(page._drawn.values())) == 2, 240)
    second.close()
    until(lambda: len(page.server.get_clients()) == 1)
    number = page.session.snapshot.number
    until(lambda: page.session.snapshot.number > number + 3)
    assert page.session.problem is None
