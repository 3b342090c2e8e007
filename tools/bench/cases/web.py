"""What ``bench.py web`` measures: the size of films for the web, their error and their speed in a browser."""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from bench.case import Case, Measurement, option
from bench.record import Row
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.recording.checkpoint import read_checkpoint
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film.page import write_film

WINDOW = (1440, 900)  # pixels
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"]
FLAGS += ["--disable-component-update", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """The film of each run."""
    for name in options.run:
        row = film_of(Path(name), options.seconds)
        yield ("films", row["title"]), row.copy


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
    expected = _last_centres(run)
    found = torch.tensor(played.pop("centres"), dtype=torch.float64).reshape(-1, 3)
    return row | played | {"error": float((found - expected).norm(dim=-1).max())}


def _play(film: Path, last: int, seconds: float) -> Row:
    """Open a film in Chromium with software WebGL2, play it, and read the centres of its last frame."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
        page.set_default_timeout(300_000)
        begin = time.perf_counter()
        page.goto(film.as_uri())
        while not page.evaluate("!!window.film && film.drawn() > 3"):
            time.sleep(0.1)
        loaded = time.perf_counter() - begin
        drawn, begin = page.evaluate("film.drawn()"), time.perf_counter()
        time.sleep(seconds)
        rate = (page.evaluate("film.drawn()") - drawn) / (time.perf_counter() - begin)
        page.evaluate(f"film.seek({last})")
        centres = page.evaluate("film.positions().then((found) => Array.from(found))")
        version = browser.version
        browser.close()
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
        option("--seconds", "for which a film plays while it is timed", type=float, default=20.0),
    ),
    page="web.md",
)
