"""The live page draws in a real browser, from the states that it gets."""

import time

import numpy as np
import pytest
from browsers import picture_of, reached, until
from shared import double, longest, peak

pytest.importorskip("viser", reason="needs the extra [viewer]")
from gaussian_swaying.viewer.film.page import PAGE
from gaussian_swaying.viewer.film.recorded import order_of

from .conftest import PATIENT, READY, pause, pictures_since


@pytest.fixture(scope="module")
def blank(browser):
    """A page with the program, and nothing to draw."""
    page = browser.new_page()
    page.add_script_tag(path=PAGE / "film.min.js")
    yield page
    page.close()


@pytest.fixture
def drawing(open_window):
    """A window in which the browser draws."""
    window = open_window(640, 480)
    window.wait_for_function(READY)
    return window


PLAY = """([arrivals, until, ended]) => {
    // states (arrival, time), and pictures at 60 a second: clock, shown time, newest time, and the state in between
    const playback = new Playback(), seen = [];
    let next = 0;
    for (let now = 0; now < until; now += 1 / 60) {
        for (; next < arrivals.length && arrivals[next][0] <= now; next++)
            playback.add({ time: arrivals[next][1] }, arrivals[next][0], ended && next === arrivals.length - 1);
        const shown = playback.advance(now);
        if (shown === null) continue;
        const [from, to, weight] = playback.between();
        seen.push([now, shown, playback.newest, from.time + weight * (to.time - from.time), playback.states.length]);
    }
    return seen;
}"""


@pytest.mark.parametrize(
    ("count", "interval", "step", "jitter", "slowest", "fastest"),
    [(100, 0.04, 0.04, 0.0, 0.98, 1.02), (40, 0.25, 0.005, 0.0, 0.7, 1.3), (250, 0.04, 0.04, 0.03, 0.5, 1.6)],
    ids=["even", "slow", "irregular"],
)
def test_motion_between_states_is_smooth(count, interval, step, jitter, slowest, fastest, blank):
    """A picture is never ahead, in order, and moves by what passed; then the simulation stalls and ends."""
    rng, last = np.random.default_rng(1), count - 10
    arrivals = [[interval * k + jitter * float(rng.random()), step * k] for k in range(count)]
    arrivals = [[arrival + 2.0 * (k >= last), time] for k, (arrival, time) in enumerate(arrivals)]
    now, shown, newest, mixed, states = np.array(blank.evaluate(PLAY, [arrivals, interval * count + 4, True])).T
    assert (shown <= newest).all()
    assert (np.diff(shown) >= 0).all()
    assert np.abs(shown - mixed).max() < 1e-9
    assert states.max() <= 64
    even = (now > min(2.0, 0.25 * interval * last)) & (now < interval * (last - 1))
    steps = np.diff(shown[even]) * 60 * interval / step
    assert slowest < steps.min()
    assert steps.max() < fastest
    assert (newest - shown)[even].max() < 2 * step + jitter
    stalled = (now > interval * last + 0.8) & (now < interval * last + 1.9)
    assert (shown == newest)[stalled].all()
    assert shown[-1] == newest[-1] == pytest.approx(step * (count - 1))


def test_a_step_while_paused_is_shown_soon(blank):
    """Even if the simulation was so slow that the step would take minutes at its speed."""
    shown = blank.evaluate("""() => {
        const playback = new Playback();
        for (let k = 0; k < 5; k++) playback.add({ time: 1e-4 * k }, k, k === 4), playback.advance(k);
        playback.advance(6);
        playback.add({ time: 0.04 }, 10, true);
        const seen = [];
        for (let now = 10; now < 11; now += 0.1) seen.push(playback.advance(now));
        return seen;
    }""")
    assert shown[-1] == 0.04
    assert (np.diff(shown) >= 0).all()


def test_after_a_pause_it_goes_on_at_its_speed(blank):
    """The pause says nothing about how fast the simulation runs."""
    told = blank.evaluate("""() => {
        const playback = new Playback();
        const run = (begin, first, count) => {
            for (let k = 0; k < count; k++) {
                playback.add({ time: 0.04 * (first + k) }, begin + 0.04 * k, k === count - 1);
                playback.advance(begin + 0.04 * k + 0.02);
            }
        };
        run(0, 0, 50);
        playback.advance(9.99);
        const end = playback.shown;
        run(10, 50, 4);
        return [end, playback.speed, playback.shown];
    }""")
    assert told[0] == pytest.approx(1.96)
    assert told[1] == pytest.approx(1.0)
    assert 1.96 < told[2] <= 2.12


def test_a_reset_forgets_what_was_there(blank):
    told = blank.evaluate("""() => {
        const playback = new Playback();
        for (let k = 0; k < 20; k++) playback.add({ time: 0.04 * k }, 0.04 * k), playback.advance(0.04 * k);
        const before = playback.shown;
        playback.add({ time: 0 }, 1);
        return [before, playback.advance(1.01), playback.states.length];
    }""")
    assert told[0] > 0.5
    assert told[1:] == [0, 1]


def test_what_was_missed_while_the_window_was_hidden_is_skipped(blank):
    told = blank.evaluate("""() => {
        const playback = new Playback();
        let now = 0;
        for (let k = 0; k < 500; k++) {
            playback.add({ time: 0.04 * k }, (now = 0.04 * k));
            if (now < 2 || now > 15) playback.advance(now);
        }
        return [playback.shown, playback.newest, playback.states.length];
    }""")
    assert told[1] - told[0] < 0.2
    assert told[2] < 10


def test_a_state_with_the_same_time_replaces_the_last(blank):
    """As after a change of the material while paused."""
    told = blank.evaluate("""() => {
        const playback = new Playback();
        playback.add({ time: 0.04, name: "old" }, 0, true);
        playback.add({ time: 0.04, name: "new" }, 5, true);
        playback.advance(6);
        return playback.between()[0].name;
    }""")
    assert told == "new"


def _centres(window):
    window.wait_for_function("wind.left === 0 && wind.drawing.sorted")
    return double(window.evaluate("Array.from(wind.positions())")).reshape(-1, 3)


def _picture(window):
    return picture_of(window, x=0, y=200, width=300, height=280)  # beside the controls and below what viser tells


def test_the_canvas_shows_the_state_as_the_server_draws_it(page, drawing):
    """Centres from the GPU, and the picture, of a paused flag, from another side than at first."""
    session, window = page.session, drawing
    reached(session, 0.2)
    pause(session)
    (client,) = page.server.get_clients().values()
    wanted = client.camera.position + np.array([0.3, 0.1, 0.2])
    client.camera.position = wanted
    asked = client.camera.update_timestamp
    until(lambda: client.camera.update_timestamp > asked and np.allclose(client.camera.position, wanted, atol=1e-3))
    window.evaluate("new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    window.wait_for_function(f"wind.playback.shown === {session.snapshot.health.time}")
    snapshot = session.snapshot
    scene = snapshot.simulation.scene
    size = scene.size * scene.frame.metres_per_unit
    expected = scene.frame.point_to_sim(scene.deformed(snapshot.state).means.double()) / size
    assert longest(_centres(window) - expected[order_of(scene)[1]]) < 1e-3  # of the object's size
    assert peak(expected - scene.frame.point_to_sim(scene.rest().means.double()) / size) > 0.02
    there = _picture(window)
    assert there.std() > 20
    page.largest = 1000
    page.by_browser = False
    page.redraw()
    window.wait_for_function("!wind.on")
    until(lambda: 10 * np.log10(255**2 / np.mean((_picture(window) - there) ** 2)) > 28)
    page.by_browser = True
    page.redraw()
    window.wait_for_function("wind.on && wind.left === 0 && wind.drawing.sorted")
    until(lambda: np.abs(_picture(window) - there).max() < 3)
    assert window.problems == []


def test_pictures_change_between_states_and_never_show_the_future(page, drawing):
    """The simulation gives few states a second; the time that is shown rises from picture to picture."""
    session, window = page.session, drawing
    session.pace(0.02)
    until(lambda: session.rates().real_time < 0.05)
    window.evaluate("""() => {
        window.seen = [];
        const look = () => {
            const { playback } = wind;
            if (wind.on) seen.push([playback.shown, playback.newest, wind.motion]);
            requestAnimationFrame(look);
        };
        look();
    }""")
    window.wait_for_function("new Set(seen.map((each) => each[1])).size > 6")
    drawn = window.evaluate("""async () => {
        // two pictures with the same newest state
        const read = async () => {
            await new Promise((resolve) => requestAnimationFrame(resolve));
            const { canvas } = wind.above;
            return [wind.playback.newest, wind.playback.shown, wind.together(canvas).toDataURL()];
        };
        for (;;) {
            const first = await read();
            await new Promise((resolve) => setTimeout(resolve, 100));
            const second = await read();
            if (first[0] === second[0] && first[1] < second[1]) return first[2] !== second[2];
        }
    }""")
    assert drawn
    session.reset()
    window.wait_for_function("seen[seen.length - 1][2] > seen[0][2] && wind.playback.newest > 0")
    shown, newest, motion = np.array(window.evaluate("seen")).T
    assert (shown <= newest).all()
    begun = np.diff(motion) > 0
    assert begun.sum() == 1
    assert (np.diff(shown)[~begun] >= 0).all()
    assert len(np.unique(shown)) > 2 * len(np.unique(newest))
    assert window.problems == []


SMALL_TEXTURES = """
    const ask = WebGL2RenderingContext.prototype.getParameter;
    WebGL2RenderingContext.prototype.getParameter = function (name) {
        return this.canvas.id === "wind" && name === this.MAX_TEXTURE_SIZE ? 0 : ask.call(this, name);
    };
"""


@pytest.mark.parametrize("way", ["small textures", "slow"])
def test_a_browser_that_cannot_draw_gets_pictures(page, open_window, way):
    if way == "slow":
        window = open_window(640, 480)
        window.wait_for_function(READY)
        window.evaluate("Object.assign(wind, { slow: 1e9, patience: 0.5 })")
        window.wait_for_function("wind.failed?.startsWith('this browser draws slowly') && !wind.on")
    else:
        window = open_window(640, 480, [SMALL_TEXTURES, PATIENT])
        window.wait_for_function("wind.failed === 'the scene is too large for the textures of this browser'")
    until(lambda: len(page.server.get_clients()) == 1)
    now = time.perf_counter()
    until(lambda: pictures_since(page, now) > 3)
    until(lambda: _picture(window).std() > 20)
    before = _picture(window)
    until(lambda: np.abs(_picture(window) - before).max() > 20)
    assert window.problems == []
