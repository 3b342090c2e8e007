import numpy as np
import pytest
import torch
from browsers import listened, picture_of, reached, until
from shared import double, longest, peak

from gaussian_swaying.gaussians.parts import ROLES, Parts
from gaussian_swaying.player.film.page import PAGE
from gaussian_swaying.player.film.recorded import order_of
from gaussian_swaying.rendering.cameras.camera import project
from gaussian_swaying.rendering.tints import TINTS

from .conftest import PATIENT, READY, holds, in_turn, pause


@pytest.fixture(scope="module")
def blank(browser):
    page = browser.new_page()
    page.add_script_tag(path=PAGE / "film.min.js")
    yield page
    page.close()


@pytest.fixture
def drawing(open_window):
    window = open_window(640, 480)
    holds(window, READY)
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
    told = blank.evaluate("""() => {
        const playback = new Playback();
        playback.add({ time: 0.04, name: "old" }, 0, true);
        playback.add({ time: 0.04, name: "new" }, 5, true);
        playback.advance(6);
        return playback.between()[0].name;
    }""")
    assert told == "new"


CLIP = {"x": 150, "y": 260, "width": 600, "height": 440}  # beside the controls and below what the page tells
SMALL = {"x": 0, "y": 100, "width": 300, "height": 220}


def _centres(window):
    window.evaluate("wind.view.settled()")
    return double(window.evaluate("Array.from(wind.view.drawing.positions())")).reshape(-1, 3)


def _picture(window):
    holds(window, "!wind.on || (wind.view.sharp && wind.view.left === 0 && wind.view.drawing.sorted)")
    window.mouse.move(20, window.viewport_size["height"] - 20)  # the ring of the brush follows it
    return picture_of(window, **(CLIP if window.viewport_size["width"] > 900 else SMALL))


def _drawn(window, page):
    """The centres of the paused scene as the browser drew them, and where the run has them, in units of the object."""
    holds(window, f"wind.on && wind.tunnel.playback.shown === {page.session.snapshot.health.time}")
    snapshot = page.session.snapshot
    scene = snapshot.simulation.scene
    size = scene.size * scene.frame.metres_per_unit
    expected = scene.frame.point_to_sim(scene.deformed(snapshot.state).means.double()) / size
    return _centres(window), expected[order_of(scene)[1]]


def test_the_canvas_shows_the_state_as_the_server_draws_it(page, drawing):
    session, window = page.session, drawing
    reached(session, 0.2)
    pause(session)
    window.evaluate("wind.view.camera.position.add({ x: 0.3, y: 0.1, z: 0.2 })")
    found, expected = _drawn(window, page)
    assert longest(found - expected) < 1e-3  # of the object's size
    rest = session.simulation.scene.rest().means.double()
    scene = session.simulation.scene
    at_rest = scene.frame.point_to_sim(rest) / (scene.size * scene.frame.metres_per_unit)
    assert peak(expected - at_rest[order_of(scene)[1]]) > 0.02
    window.locator("#more").click()
    window.locator("summary", has_text="Picture").click()
    there = _picture(window)
    assert there.std() > 20
    page.largest = page.clients[0].size.largest = 1000
    window.get_by_label("Drawn by the server").check()
    holds(window, "!wind.on")
    until(lambda: 10 * np.log10(255**2 / np.mean((_picture(window) - there) ** 2)) > 28)
    window.get_by_label("Drawn by the server").uncheck()
    holds(window, "wind.on")
    window.evaluate("wind.view.settled()")
    until(lambda: np.abs(_picture(window) - there).max() < 3)
    assert window.problems == []


def test_pictures_change_between_states_and_never_show_the_future(page, drawing):
    session, window = page.session, drawing
    session.pace(0.02)
    until(lambda: session.rate() < 0.05)
    window.evaluate("""() => {
        window.seen = [];
        const look = () => {
            const { playback, motion } = wind.tunnel;
            if (wind.on) seen.push([playback.shown, playback.newest, motion]);
            requestAnimationFrame(look);
        };
        look();
    }""")
    holds(window, "new Set(seen.map((each) => each[1])).size > 6")
    session.reset()
    holds(window, "seen[seen.length - 1][2] > seen[0][2] && wind.tunnel.playback.newest > 0")
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
        return name === this.MAX_TEXTURE_SIZE ? 0 : ask.call(this, name);
    };
"""
NO_WEBGL = """
    const get = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
        return kind === "webgl2" ? null : get.call(this, kind, ...more);
    };
"""


@pytest.mark.parametrize("way", ["small textures", "no WebGL2", "slow"])
def test_a_browser_that_cannot_draw_gets_pictures(page, open_window, way):
    """And every control: it pauses, and turns the wind."""
    if way == "slow":
        window = open_window(640, 480)
        holds(window, READY)
        window.evaluate("Object.assign(wind, { slow: 1e9, patience: 500 })")
        holds(window, "wind.failed?.startsWith('this browser draws slowly') && !wind.on")
    else:
        scripts = {"small textures": SMALL_TEXTURES, "no WebGL2": NO_WEBGL}
        window = open_window(640, 480, [scripts[way], PATIENT])
        reason = {"small textures": "the scene is too large for the textures of this browser"}
        holds(window, f"wind.failed === '{reason.get(way, 'this browser has no WebGL2')}'")
    until(lambda: _picture(window).std() > 20)
    before = _picture(window)
    until(lambda: np.abs(_picture(window) - before).max() > 20)
    window.locator("#play").click()
    until(lambda: page.session.paused)
    window.locator("#dial").focus()
    flow = page.session.simulation.wind.flows.clone()
    window.keyboard.press("ArrowUp")
    until(lambda: not np.allclose(page.session.simulation.wind.flows, flow))
    assert window.problems == []


def test_the_bar_and_the_panel_steer_the_session(page, drawing):
    session, window = page.session, drawing
    reached(session, 0.1)
    window.keyboard.press(" ")
    until(lambda: session.paused)
    in_turn(session)  # the step that was under way is done
    number = session.snapshot.number
    window.get_by_role("button", name="Advance by one step").click()
    until(lambda: session.snapshot.number == number + 1)
    window.locator("#play").click()
    until(lambda: not session.paused)
    window.locator("#slow").click()
    until(lambda: session.speed == 0.25)
    window.get_by_role("button", name="Controls").click()
    field = window.locator("input[type=number][name='wind.speed']")
    field.fill("12")
    field.press("Enter")
    until(lambda: session.simulation.wind.flows.norm() > 11.9)
    link = window.evaluate("wind.tunnel.link()")
    assert "#wind.speed=12&speed=0.25&view=" in link
    window.keyboard.press("Control+z")
    until(lambda: session.simulation.wind.flows.norm() < 7)
    session.change({"wind.flow": [1e4, 0.0, 0.0]})
    window.locator("#note").filter(has_text="Press Reset to start again").wait_for()
    session.change({"wind.flow": [2.0, 0.0, 0.0]})
    window.locator("#reset").click()
    until(lambda: session.snapshot.health.time > 0.02 and not session.broken)
    assert window.problems == []


def test_a_field_that_is_left_sends_what_was_typed_alone(page, drawing):
    """Not what the page has written into it since."""
    session, window = page.session, drawing
    window.get_by_role("button", name="Controls").click()
    field = window.locator("input[type=number][name='wind.speed']")
    field.fill("12")
    field.press("Enter")
    until(lambda: session.simulation.wind.flows.norm() > 11.9)
    window.keyboard.press("Control+z")  # in the field, too
    until(lambda: session.simulation.wind.flows.norm() < 7)
    session.change({"wind.flow": [9.0, 0.0, 0.0]})
    until(lambda: field.input_value() == "9")
    window.evaluate("() => { window.said = []; wind.say = (what) => said.push(what); }")
    field.blur()
    assert "set" not in window.evaluate("said.map((what) => what.kind)")
    field.fill("8")
    field.blur()
    assert {"kind": "set", "name": "wind.speed", "value": 8} in window.evaluate("said")


def test_a_window_records_what_it_shows(page, drawing, tmp_path):
    iio, window = pytest.importorskip("imageio.v3"), drawing
    window.get_by_role("button", name="Controls").click()
    window.locator("summary", has_text="Files").click()
    window.get_by_role("button", name="Record a video").click()
    reached(page.session, page.session.snapshot.health.time + 0.5)
    with window.expect_download(timeout=30_000) as download:
        window.get_by_role("button", name="Stop recording").click()
    assert download.value.suggested_filename == "wind.webm"
    download.value.save_as(tmp_path / "wind.webm")
    first, *_, last = iio.imiter(tmp_path / "wind.webm", fps=10)  # the browser says 1000, which fills the memory
    assert np.abs(last.astype(int) - first).max() > 20  # it moves
    window.get_by_role("button", name="Record a video").wait_for()
    assert window.problems == []


def test_a_link_sets_what_it_says(page, browser):
    context = browser.new_context(viewport={"width": 500, "height": 400})
    window = listened(context.new_page())
    window.goto(f"{page.url}#wind.flow=0,3,0&material.E=2e4&speed=0.5&view=0,-3,0,0,0,0")
    until(lambda: page.session.settings.wind.flow == [0.0, 3.0, 0.0] and page.session.speed == 0.5)
    until(lambda: page.session.settings.material.E == 2e4)
    assert window.evaluate("wind.view.camera.position.y") == pytest.approx(-3.0, abs=1e-6)
    assert "#wind.flow=0,3,0&material.E=20000&speed=0.5&view=" in window.evaluate("wind.tunnel.link()")
    assert window.problems == []
    context.close()


def test_the_flag_is_pulled_where_it_is_touched(page, drawing):
    session, window = page.session, drawing
    reached(session, 0.1)
    scene, size = session.simulation.scene, window.viewport_size
    eye = page.clients[0].eye
    camera = eye.camera(scene, size["width"], size["height"])
    means = session.simulation.painter.deformed(session.snapshot.state).means.double()
    wanted = means[(means - scene.center.double()).norm(dim=-1).argmin()]
    pixel = project(wanted[None], camera)[0][0].tolist()
    window.mouse.move(*pixel)
    window.mouse.down()
    until(lambda: session.pulls)
    window.mouse.move(pixel[0] + 30, pixel[1], steps=3)
    pull = session._pull
    until(lambda: pull is not None and window.evaluate("wind.tunnel.pull?.held ?? false"))
    window.mouse.up()
    until(lambda: not session.pulls)
    assert page.clients[0].eye is eye or np.allclose(page.clients[0].eye.matrix, eye.matrix)

    def turned():  # once the server has said that nothing is there
        window.mouse.move(10, 300)
        window.mouse.down()
        window.mouse.move(60, 300, steps=50)
        window.mouse.up()
        return not np.allclose(page.clients[0].eye.matrix, eye.matrix)

    until(turned)
    assert window.problems == []


def test_two_browsers_see_the_same_scene_and_closing_one_ends_nothing(page, drawing, browser):
    second = browser.new_context(viewport={"width": 300, "height": 400})
    other = listened(second.new_page())
    other.add_init_script(PATIENT)
    other.goto(page.url)
    holds(other, READY)
    drawing.locator("#play").click()
    other.get_by_role("button", name="Play", exact=True).wait_for()
    until(lambda: page.session.paused)
    for window in (drawing, other):
        found, expected = _drawn(window, page)
        assert longest(found - expected) < 1e-3
    second.close()
    until(lambda: len(page.clients) == 1)
    page.session.pause(False)
    number = page.session.snapshot.number
    until(lambda: page.session.snapshot.number > number + 3)
    assert other.problems == drawing.problems == []


def _is_tinted(now, before):
    return np.abs(now - (0.3 * before + 0.7 * np.array(TINTS["held"]))).max() < 40 < np.abs(now - before).max()


def test_parts_are_painted_with_the_mouse(page, open_window, tmp_path):
    """What was painted as held stays exactly where it is in the wind, while the rest moves."""
    window, session, painting = open_window(), page.session, page.painting
    holds(window, READY)
    window.locator("summary", has_text="Paint parts").click()
    window.get_by_label("Paint", exact=True).check()
    holds(window, "wind.brush.own.on && wind.tunnel.playback.shown === 0")
    plain = _picture(window)
    scene, size = session.simulation.scene, window.viewport_size
    places = project(scene.model.means, page.clients[0].eye.camera(scene, size["width"], size["height"]))[0].numpy()
    middle = places[np.abs(places - [450, 420]).sum(1).argmin()]
    a, b = middle - np.array([90, 40]), middle + np.array([90, 60])
    share = np.clip((places - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    away = np.linalg.norm(places - a - share[:, None] * (b - a), axis=1)
    near, far = away < 19, away > 21  # the brush has a radius of 20 pixels

    def painted():
        if painting._strokes is None:
            return False
        held = painting._strokes.roles.numpy() == ROLES.index("held")
        return held[near].all() and not held[far].any()

    window.mouse.move(*a)
    window.mouse.down()
    window.mouse.move(*b, steps=9)
    window.mouse.up()
    until(painted)
    window.locator("#legend").get_by_text(
        f"held: {int((painting._strokes.roles == ROLES.index('held')).sum())}"
    ).wait_for()
    line = [tuple((a + share * (b - a) - [CLIP["x"], CLIP["y"]]).round().astype(int)) for share in (0.1, 0.5, 0.9)]
    until(lambda: all(_is_tinted(_picture(window)[y, x], plain[y, x]) for x, y in line))
    assert np.abs((_picture(window) - plain)[-60:]).max() < 3  # below the stroke
    window.get_by_role("button", name="Undo the stroke").click()
    until(lambda: not painting._strokes.roles.any())
    until(lambda: np.abs(_picture(window) - plain).max() < 3)
    window.mouse.move(*a)
    window.mouse.down()
    window.mouse.move(*b, steps=9)
    window.mouse.up()
    until(painted)
    with window.expect_download(timeout=30_000) as download:
        window.get_by_role("button", name="Save the parts").click()
    download.value.save_as(tmp_path / "parts.npz")
    saved = Parts.load(tmp_path / "parts.npz")
    held = saved.mask(role="held").numpy()
    assert held[near].all()
    assert not held[far].any()
    before, rest = session.simulation, scene.rest().means.numpy()
    window.get_by_role("button", name="Apply the parts").click()
    until(lambda: session.simulation is not before and session.snapshot.health.time > 0.3)
    assert torch.equal(session.simulation.scene.parts.labels, saved.labels)
    moved = np.linalg.norm(session.simulation.scene.deformed(session.snapshot.state).means.numpy() - rest, axis=1)
    assert moved[held].max() == 0
    assert np.median(moved[~held]) > 1e-3
    holds(window, "!wind.brush.own.on")
    session.pause()
    session.reset()
    until(lambda: np.abs(_picture(window) - plain).max() < 40)  # without tints; what is held has no shading
    assert session.problem is None
    assert window.problems == []
