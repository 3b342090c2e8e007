"""Pages that a user can put on any website, in a browser: the film of a run, and a simulation."""

import numpy as np
import pytest
from shared import PIN, words

from gaussian_swaying.cli.main import main
from tests.browsers import asked_of_a_network, listened, picture_of, until

SMALL = words({"scene.generator.init_args.spacing": 0.05, "solver.dx": 0.1, "solver.boundaries": [PIN]})
GRAPHICS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture
def show(chromium):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=GRAPHICS)

        def show(path, ready):
            page = listened(browser.new_page(viewport={"width": 480, "height": 270}))
            page.goto(path.as_uri())
            until(lambda: page.evaluate(ready))
            return page

        yield show
        browser.close()


def picture(page):
    """The canvas without the controls, shape (H, W, 3)."""
    page.add_style_tag(content="header, footer { display: none !important; }")
    return picture_of(page)


def drawn(page):
    until(lambda: np.abs(picture(page) - picture(page)[0, 0]).max() > 20)
    return picture(page)


def check_motion(page, before):
    until(lambda: np.abs(picture(page) - before).max() > 20)
    assert page.told == []
    assert asked_of_a_network(page) == []


def test_a_film(show, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    size = ["--camera.init_args.width=64", "--camera.init_args.height=36"]
    assert main(["sim", "--config=flag", "--device=cpu", "--frames=6", "--output=run", *SMALL, *size]) == 0
    assert main(["export", "--web", "run"]) == 0
    page = show(tmp_path / "run/film.html", "!!window.film")
    page.evaluate("film.seek(0)")
    assert page.evaluate("film.frame()") == 0
    before = drawn(page)
    page.evaluate("film.seek(5)")
    check_motion(page, before)


def test_a_simulation(show, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "--live-web", "flag", *SMALL, "--material.E=9e3"]) == 0
    page = show(tmp_path / "flag.html", "!!window.windPage")
    page.evaluate("windPage.complete.then(() => { windPage.tunnel.setPlaying(false); windPage.tunnel.reset(); })")
    before = drawn(page)
    assert page.evaluate("windPage.advance(25)")["simulated"] == pytest.approx(1.0)
    check_motion(page, before)
