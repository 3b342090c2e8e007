"""The page without a server in a real browser: what it shows, what the visitor does, and damaged files."""

import math
import re
import time

import pytest
from browsers import asked_of_a_network, until

from gaussian_swaying.player.film.page import write_player
from gaussian_swaying.player.live_web.page import write_live_web

from .conftest import drawn_apart, opened


@pytest.fixture
def show(browser):
    context = browser.new_context(viewport={"width": 600, "height": 400})

    def show(path, settings="", before=""):
        context.add_init_script(before)
        return opened(context, path, settings)

    yield show
    context.close()


def test_after_two_seconds_the_gaussians_are_where_a_run_puts_them(show, written, make):
    """Read back from the graphics card; within 1 % of the motion. Nothing is asked of a network."""
    page = show(written)
    page.evaluate("windPage.complete.then(() => { windPage.tunnel.setPlaying(false); windPage.tunnel.reset(); })")
    told = page.evaluate("windPage.advance(50)")
    assert told["simulated"] == pytest.approx(2.0)
    assert told["kernels"]
    assert page.evaluate("windPage.tunnel.playback.newest ?? 0") == pytest.approx(2.0)
    error, motion = drawn_apart(page, make())
    assert motion > 0.1
    assert error < 0.01
    assert page.told == []
    assert asked_of_a_network(page) == []


def _grabbed(page):
    """True if the mouse takes hold of the middle of the sheet, which must not have swung away since its start."""
    page.locator("#reset").click()
    page.mouse.move(300, 190)
    page.mouse.down()
    for _ in range(40):
        if page.evaluate("windPage.tunnel.pull?.held"):
            return True
        time.sleep(0.02)
    page.mouse.up()
    return False


def _stops(page):
    times = [page.evaluate("windPage.tunnel.playback.newest ?? 0")]

    def stands_still():
        time.sleep(0.2)
        times.append(page.evaluate("windPage.tunnel.playback.newest ?? 0"))
        return times[-1] == times[-2]

    until(stands_still)
    return times[-1]


def test_what_the_visitor_does(show, written):
    page = show(written, "#wind=0,0,0&gusts=0&stiffness=2&speed=0.25")
    until(lambda: page.evaluate("windPage.value('stiffness')") == 2)
    assert page.evaluate("['wind', 'gusts'].map(windPage.value)") == [[0, 0, 0], 0]
    assert page.locator("#slow").get_attribute("aria-pressed") == "true"
    link = page.evaluate("windPage.tunnel.link()")
    until(lambda: _grabbed(page))
    page.mouse.move(310, 170)
    page.mouse.up()
    assert not page.evaluate("windPage.tunnel.pull?.held")
    assert page.evaluate("windPage.tunnel.link()") == link  # the view stood still
    page.locator("#slow").click()
    until(lambda: page.evaluate("windPage.tunnel.playback.newest ?? 0") > 0.3)
    page.locator("#play").click()
    assert not page.evaluate("windPage.tunnel.playing")
    stopped = _stops(page)
    page.locator("#play").click()
    until(lambda: page.evaluate("windPage.tunnel.playback.newest ?? 0") > stopped)
    hide = "(value) => { Object.defineProperty(document, 'hidden', { value, configurable: true }); "
    hide += "document.dispatchEvent(new Event('visibilitychange')); }"
    page.evaluate(hide, True)
    stopped = _stops(page)
    page.evaluate(hide, False)
    until(lambda: page.evaluate("windPage.tunnel.playback.newest ?? 0") > stopped)
    box = page.locator("#dial").bounding_box()
    page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + 0.5 * box["height"])
    assert page.evaluate("Math.hypot(...windPage.value('wind'))") == pytest.approx(10 * 0.8 / 0.96, rel=0.05)
    for name, ends in {"gusts": (0, 3), "stiffness": (math.log10(0.125), math.log10(4))}.items():
        slider = page.locator(f"input[type=range][name={name}]")
        assert [float(slider.get_attribute(end)) for end in ("min", "max")] == pytest.approx(ends)
    link = page.evaluate("windPage.tunnel.link()")
    assert re.search(r"#wind=[-\d.,]+&gusts=0&stiffness=2&view=[-\d.,]+$", link)

    def turned():
        page.mouse.move(10, 60)
        page.mouse.down()
        page.mouse.move(60, 60, steps=50)
        page.mouse.up()
        return page.evaluate("windPage.tunnel.link()") != link

    until(turned)
    other = show(written, link[link.index("#") :])
    other.evaluate("windPage.complete")
    for part in ("wind", "gusts"):
        known = [each.evaluate(f"windPage.value('{part}')") for each in (page, other)]
        assert known[0] == pytest.approx(known[1], abs=1e-3)
    page.locator("#play").click()  # or its first moments pass between two looks
    page.locator("#reset").click()
    until(lambda: page.evaluate("windPage.tunnel.playback.newest ?? 1") < 0.3)
    assert page.told == other.told == []


def test_a_page_that_falls_behind_slows_time_and_says_so(show, make, tmp_path):
    write_live_web(make(solver={"substep": 1e-5}), "sheet", tmp_path / "slow.html")
    page = show(tmp_path / "slow.html")
    page.locator("#note").filter(has_text="too slow for real time").wait_for(timeout=60_000)
    told = page.locator("#note").inner_text()
    assert re.fullmatch(r"This device is too slow for real time: the motion runs at 0\.\d\d of it\.", told)
    assert page.evaluate("windPage.tunnel.playing")


def test_a_file_that_is_cut_short_or_damaged_says_so(show, written, tmp_path):
    content = written.read_text()
    for k, name in enumerate(("code", "solver", "part-0")):
        at = content.index(f'id="film-{name}"')
        (tmp_path / f"{k}.html").write_text(content[: at + 200])
        page = show(tmp_path / f"{k}.html")
        message = page.locator("#message")
        message.filter(has_text="The file of this page is cut short: copy it again, or export it again.").wait_for()
        assert message.is_visible()
    at = content.index(">", content.index('id="film-solver"')) + 100
    (tmp_path / "damaged.html").write_text(content[:at] + "AAAA" + content[at + 4 :])
    message = show(tmp_path / "damaged.html").locator("#message")
    message.filter(has_text=re.compile(r"^This page cannot be shown \([^()]+\)\.$")).wait_for()


def test_a_browser_without_vectors_in_webassembly_says_so(show, written):
    """Its worker, which is a Blob, accepts no module."""
    old = "const All = Blob; Blob = class extends All { constructor(parts, given) "
    old += "{ super(['WebAssembly.validate = () => false;', ...parts], given); } };"
    message = show(written, before=old).locator("#message")
    message.filter(has_text="This page cannot be shown (this browser has no WebAssembly with SIMD).").wait_for()


def test_a_page_within_another_page(browser, written):
    write_player(written.parent)
    outer = written.parent / "outer.html"
    element = f'<gaussian-swaying src="{written.name}" wind="1,2,0" view="0,-3,0,0,0,0"></gaussian-swaying>'
    outer.write_text(f'<!doctype html><script src="gaussian-swaying.js"></script>{element}')
    page = browser.new_page()
    page.goto(outer.as_uri())
    until(lambda: len(page.frames) == 2 and page.frames[1].evaluate("!!window.windPage"))
    inner = page.frames[1]
    until(lambda: inner.evaluate("windPage.value('wind')") == [1, 2, 0])
    assert re.search(r"&?view=0,-3,0,0,0,0$", inner.evaluate("windPage.tunnel.link()"))
    page.evaluate("document.querySelector('gaussian-swaying').setAttribute('wind', '-3,0,0')")
    until(lambda: inner.evaluate("windPage.value('wind')[0]") == -3)
    page.close()
