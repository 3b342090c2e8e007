"""What ``bench.py web`` measures: films and pages for the web, their size, their error and their speed in a browser."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import statistics
import subprocess
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
from bench.record import ROOT, Row
from bench.riders import write_rider
from gaussian_swaying.cli.live_web import asked
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.recording.checkpoint import read_checkpoint
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.film import page
from gaussian_swaying.viewer.film.page import write_film
from gaussian_swaying.viewer.live_web.block import pack_solver
from gaussian_swaying.viewer.live_web.page import PAGE, write_live_web

WINDOW = (1440, 900)  # pixels
FRAMES, REPEATS = 100, 3
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"]
FLAGS += ["--disable-component-update", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WEBGPU = "--enable-unsafe-webgpu"  # also on an adapter in software


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """The film of each run, those of places, in one part and in many, and pages that simulate."""
    for line in options.page:
        name, _, command = line.partition("=")
        yield ("pages", name), partial(page_of, shlex.split(command or name))
    for count in options.riders:
        yield ("pages", f"made rider of {count:,} Gaussians"), partial(page_of_rider, count)
    for line in options.shade:
        name, _, command = line.partition("=")
        yield ("shaders", name), partial(shaded, shlex.split(command or name))
    for count in options.places:
        for whole in (True, False):
            yield ("first", f"{count:,}, {'one' if whole else 'many'}"), partial(first_of, count, whole)
    for line in options.watch:
        name, _, command = line.partition("=")
        yield ("watched", name), partial(watch, shlex.split(command or name), options.minutes)
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
def _browser(*flags: str) -> Iterator[Any]:
    """Chromium with software WebGL2."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=[*FLAGS, *flags])
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


TURNS, SPAN = 6, 25
"""How often the solver of a page is timed, of which the fastest counts, and frames each time."""


def page_of(command: list[str]) -> Row:
    """Size and speed of a page that simulates: of its solver alone, in Node.js and in Chromium.

    Args:
        command: The scene and options of ``export --live-web``.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        page = asked([*command])
        simulation, target = page.simulation, folder / "page.html"
        written = write_live_web(simulation, page.name, target)
        nodes = simulation.scene.follow.nodes(simulation.start())
        assert nodes is not None
        (folder / "block").write_bytes(pack_solver(simulation, nodes))
        hurried, lanes, plain = _in_node(folder, hurried=True), _in_node(folder), _in_node(folder, plain=True)
        row: Row = {
            "gaussians": written.gaussians,
            "points": written.points,
            "dx_m": simulation.solver.dx,
            "substeps_per_s": lanes["substeps"] / lanes["simulated"],
            "longest_per_s": hurried["substeps"] / hurried["simulated"],
            "bytes": target.stat().st_size,
            "hurried": hurried["simulated"] / hurried["cpu"],
            "node": lanes["simulated"] / lanes["cpu"],
            "plain": plain["simulated"] / plain["cpu"],
        }
        return row | _in_page(target)


RIDER_DX = 0.0455
"""Spacing of the grid of a made rider [m], for some 5,000 points."""


def page_of_rider(count: int) -> Row:
    """As :func:`page_of`, of a made rider on a bicycle of some Gaussians."""
    with tempfile.TemporaryDirectory() as folder:
        return page_of([str(write_rider(Path(folder), count, RIDER_DX))])


FEW = 2
"""Frames in which substeps in compute shaders are timed."""


def shaded(command: list[str]) -> Row:
    """Time of a substep in the page's worker, and in compute shaders on an adapter in software.

    Args:
        command: The scene and options of ``export --live-web``.
    """
    with tempfile.TemporaryDirectory() as temporary, _browser(WEBGPU) as browser:
        page, target = asked([*command]), Path(temporary) / "page.html"
        write_live_web(page.simulation, page.name, target)
        row: Row = {"points": page.simulation.setup.points.count, "chromium": browser.version}
        for solver in ("worker", "webgpu"):
            window = browser.new_page(viewport={"width": 480, "height": 320})
            window.set_default_timeout(600_000)
            window.goto(f"{target.as_uri()}#solver={solver}")
            _until_drawn(window)
            window.evaluate("windPage.complete.then(() => windPage.pause())")
            while (window.evaluate("windPage.solver()") == "webgpu") != (solver == "webgpu"):
                if why := window.evaluate("windPage.why()"):
                    raise SystemExit(f"error: WebGPU is not used, as {why}")
                time.sleep(0.1)
            window.evaluate("windPage.reset()")
            turns = [window.evaluate(f"windPage.advance({FEW})") for _ in range(REPEATS)]
            best = min(turns, key=lambda turn: turn["seconds"] / turn["substeps"])
            row |= {f"{solver}_s": best["seconds"] / best["substeps"]}
            row["substeps_per_s"] = best["substeps"] / best["simulated"]
            window.close()
        return row


def _in_node(folder: Path, *, plain: bool = False, hurried: bool = False) -> Row:
    """The turn of the solver in Node.js with the least CPU time; without WebAssembly, or with the longest substeps."""
    turns = json.dumps([{"kind": "frames", "count": SPAN, "hurried": hurried}] * TURNS)
    script = ROOT / "tools" / "player" / "live_web" / "run.js"
    command = ["node", script, PAGE / "worker.min.js", folder / "block", folder / "state", turns]
    told = subprocess.run([*command, *["plain"] * plain], capture_output=True, text=True, check=True)
    return min(json.loads(told.stdout), key=lambda turn: turn["cpu"])


def _in_page(target: Path) -> Row:
    """When a page shows its first picture, and the fastest turn of its solver while it draws, in Chromium.

    The former is the median of some browsers, the latter that of the last one.
    """
    firsts: list[float] = []
    while len(firsts) < REPEATS:
        with _browser() as browser:
            window = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
            window.set_default_timeout(600_000)
            window.goto(target.as_uri(), wait_until="commit")
            _until_drawn(window)
            firsts.append(window.evaluate("windPage.first()"))
            if len(firsts) < REPEATS:
                continue
            window.evaluate("windPage.complete.then(() => { windPage.pause(); windPage.reset(); })")
            turns = [window.evaluate(f"windPage.advance({SPAN}, true)") for _ in range(TURNS)]
            best = min(turns, key=lambda turn: turn["seconds"])
            version = browser.version
    row: Row = {"window": list(WINDOW), "chromium": version, "first_s": statistics.median(firsts)}
    return row | {"browser": best["simulated"] / best["seconds"]}


def _until_drawn(window: Any) -> None:
    while not window.evaluate("!!window.windPage && windPage.first() !== null"):
        time.sleep(0.25)


QUIET = 5.0
"""Seconds without a picture after which none waits to be drawn."""

EVERY = 30.0
"""Seconds between two measurements of memory."""

HIDE = """() => {
  Object.defineProperty(document, "hidden", { value: true, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


def watch(command: list[str], minutes: float) -> Row:
    """Memory of Chromium with a page that runs for some time, and its CPU time while the page is shown and hidden.

    Args:
        command: The scene and options of ``export --live-web``.
        minutes: For how long.
    """
    with tempfile.TemporaryDirectory() as temporary, _browser() as browser:
        page, target = asked([*command]), Path(temporary) / "page.html"
        write_live_web(page.simulation, page.name, target)
        window = browser.new_page(viewport={"width": 480, "height": 320})
        window.goto(target.as_uri())
        _until_drawn(window)
        window.evaluate("windPage.complete")
        heap = window.context.new_cdp_session(window)
        processes, resident, used = _descendants(os.getpid()), [], []
        before, began = _cpu_time(processes), time.perf_counter()
        while time.perf_counter() - began < 60 * minutes:
            time.sleep(min(EVERY, 60 * minutes))
            heap.send("HeapProfiler.collectGarbage")
            sizes = heap.send("Runtime.getHeapUsage")
            used.append((sizes["usedSize"] + sizes["backingStorageSize"]) / 1e6)
            resident.append(sum(_resident(one) for one in processes) / 1e6)
        shown = (_cpu_time(processes) - before) / (time.perf_counter() - began)
        rate = window.evaluate("windPage.time()") / (time.perf_counter() - began)
        window.evaluate(HIDE)
        drawn = None
        while drawn != (drawn := window.evaluate("windPage.drawn()")):  # until the pictures that wait are drawn
            time.sleep(QUIET)
        before, began = _cpu_time(processes), time.perf_counter()
        time.sleep(10.0)
        hidden = (_cpu_time(processes) - before) / (time.perf_counter() - began)
        row: Row = {"minutes": minutes, "points": page.simulation.setup.points.count, "real_time": rate}
        row |= {"heap_mb": used, "resident_mb": resident, "shown_cores": shown, "hidden_cores": hidden}
        return row | {"chromium": browser.version}


def _descendants(process: int) -> list[int]:
    """Processes that a process started, and those that they started."""
    found: list[int] = []
    for task in Path(f"/proc/{process}/task").iterdir():
        for child in map(int, (task / "children").read_text().split()):
            found += [child, *_descendants(child)]
    return found


def _cpu_time(processes: list[int]) -> float:
    """CPU time of processes [s]."""
    fields = [Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split() for one in processes]
    return sum(int(own[11]) + int(own[12]) for own in fields) / os.sysconf("SC_CLK_TCK")


def _resident(process: int) -> float:
    """Memory that only one process has, in bytes."""
    lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    return sum(1024.0 * int(line.split()[1]) for line in lines if line.startswith("Private_"))


CASE = Case(
    "Measure films and pages for the web: size, error, and speed in headless Chromium.",
    rows,
    (
        option("--run", "folder of a finished run of `total`; repeatable", action="append", default=[]),
        numbers("--places", "Gaussians of places whose first picture is timed", default=""),
        option(
            "--page",
            "a page that simulates, as its name, =, and the scene and options of export --live-web; repeatable",
            action="append",
            default=[],
        ),
        numbers("--riders", "Gaussians of a made rider on a bicycle, whose page is measured", default=""),
        option(
            "--shade", "as --page: its substeps in compute shaders are timed; repeatable", action="append", default=[]
        ),
        option("--watch", "as --page: its memory and CPU time are measured; repeatable", action="append", default=[]),
        option("--minutes", "for which a page is watched", type=float, default=10.0),
        option("--seconds", "for which a film plays while it is timed", type=float, default=20.0),
    ),
    page="web.md",
)
