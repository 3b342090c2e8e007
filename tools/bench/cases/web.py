"""What ``bench.py web`` measures: the size of films for the web, their error and their speed in a browser."""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bench.case import Case, Measurement, numbers, option
from bench.places import write_swaying
from bench.record import Row
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.recording.checkpoint import read_checkpoint
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film import page
from gaussian_swaying.viewer.film.page import write_film

WINDOW = (1440, 900)  # pixels
FRAMES, REPEATS = 100, 3
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"]
FLAGS += ["--disable-component-update", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """The film of each run, and those of places, in one part and in many."""
    for count in options.places:
        for whole in (True, False):
            yield ("first", f"{count:,}, {'one' if whole else 'many'}"), partial(first_of, count, whole)
    for name in options.run:
        row = film_of(Path(name), options.seconds)
        yield ("films", row["title"]), row.copy


def first_of(count: int, whole: bool) -> Row:
    """When a film of a place shows its first picture, and when all of it has come, in a browser that is running.

    Args:
        count: Number of Gaussians.
        whole: Whether the film is in one part instead of many, as it was before they came in parts.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder, target = Path(temporary), Path(temporary) / "film.html"
        recorder = {"images": False, "video": False, "trajectory": False, "checkpoint_every": 0}
        camera = {"width": 960, "height": 540, "azimuth": -70.0, "elevation": 8.0, "radius": 2.0}
        settings = {"recorder": recorder, "camera": {"class_path": "OrbitCamera", "init_args": camera}}
        simulation = Simulation.from_yaml(write_swaying(folder, count, **settings), device="cpu")
        simulation.run(folder / "run", FRAMES, progress=False)
        sizes = page.FIRST, page.GROUP
        if whole:
            page.FIRST, page.GROUP = {"moving": count, "still": count}, FRAMES
        try:
            film = write_film(folder / "run", target)
        finally:
            page.FIRST, page.GROUP = sizes
        row: Row = {"gaussians": count, "moving": film.head["moving"], "frames": FRAMES, "window": list(WINDOW)}
        row |= {"parts": "one" if whole else "many", "bytes": target.stat().st_size}
        opened = [_open(target) for _ in range(REPEATS)]
        times = {name: statistics.median(one[name] for one in opened) for name in ("first_s", "complete_s")}
        return row | {"chromium": opened[0]["chromium"]} | times


def _open(film: Path) -> Row:
    """Seconds from the request for a page to its first picture with Gaussians, and until all parts have come."""
    with _browser() as browser:
        warm = browser.new_page()
        warm.set_content("<canvas></canvas><script>document.querySelector('canvas').getContext('webgl2')</script>")
        time.sleep(1.0)
        window = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
        window.set_default_timeout(600_000)
        window.goto(film.as_uri(), wait_until="commit")
        while not window.evaluate("!!window.film && film.first() !== null"):
            time.sleep(0.25)
        complete = window.evaluate("film.complete.then(() => performance.now() / 1000)")
        return {"first_s": window.evaluate("film.first()"), "complete_s": complete, "chromium": browser.version}


@contextmanager
def _browser() -> Iterator[Any]:
    """Chromium with software WebGL2."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


def film_of(run: Path, seconds: float) -> Row:
    """Size, error and speed of the film of one run.

    The error is the largest distance of a Gaussian in the browser, read back from where it was computed for drawing,
    to its place in the state of the run's last frame, as a share of the object's size.

    Args:
        run: Its folder, with the checkpoint of its last frame.
        seconds: How long the film plays while it is timed.
    """
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "film.html"
        film = write_film(run, target)
        row = {
            "title": film.head["title"],
            "bytes": target.stat().st_size,
            "gaussians": film.head["count"],
            "nodes": film.head["nodes"],
            "frames": film.head["frames"],
            "window": list(WINDOW),
        }
        played = _play(target, film.head["frames"] - 1, seconds)
    expected = _last_centres(run)[film.order]
    found = torch.tensor(played.pop("centres"), dtype=torch.float64).reshape(-1, 3)
    return row | played | {"error": float((found - expected).norm(dim=-1).max())}


def _play(film: Path, last: int, seconds: float) -> Row:
    """Open a film in Chromium with software WebGL2, play it, and read the centres of its last frame."""
    with _browser() as browser:
        window = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
        window.set_default_timeout(300_000)
        begin = time.perf_counter()
        window.goto(film.as_uri())
        while not window.evaluate("!!window.film && film.drawn() > 3"):
            time.sleep(0.1)
        loaded = time.perf_counter() - begin
        window.evaluate("film.complete")
        drawn, begin = window.evaluate("film.drawn()"), time.perf_counter()
        time.sleep(seconds)
        rate = (window.evaluate("film.drawn()") - drawn) / (time.perf_counter() - begin)
        window.evaluate(f"film.seek({last})")
        centres = window.evaluate("film.positions().then((found) => Array.from(found))")
        version = browser.version
    return {"load_s": loaded, "pictures_per_s": rate, "chromium": version, "centres": centres}


@torch.inference_mode()
def _last_centres(run: Path) -> torch.Tensor:
    """Centres of the Gaussians in the last state of a run, in units of the object's size, z up, float64."""
    scene = Simulation.from_yaml(run / "config.yaml", device="cpu").scene
    state = MPMState.from_state_dict(read_checkpoint(run / "checkpoint.pt")["state"])
    means = scene.deformed(state).means.double()
    return scene.frame.point_to_sim(means) / (scene.size * scene.frame.metres_per_unit)


CASE = Case(
    "Measure films for the web: size, error, and speed in headless Chromium.",
    rows,
    (
        option("--run", "folder of a finished run of `total`; repeatable", action="append", default=[]),
        numbers("--places", "Gaussians of places whose first picture is timed", default=""),
        option("--seconds", "for which a film plays while it is timed", type=float, default=20.0),
    ),
    page="web.md",
)
