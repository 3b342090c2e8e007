"""What ``bench.py drawn`` measures: what a browser that draws the live page gets, and what the server saves."""

from __future__ import annotations

import argparse
import io
import shutil
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from bench.case import Case, Measurement, option
from bench.cases.web import FLAGS
from bench.record import ROOT, Row
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.controls import Page
from gaussian_swaying.viewer.pictures import draw
from gaussian_swaying.viewer.screen import JPEG_QUALITY
from gaussian_swaying.viewer.session import Session, Snapshot, share_cores
from gaussian_swaying.viewer.states import scene_message, state_message

WINDOW = (640, 360)  # pixels
WARM = 8.0  # s until the pictures have found their size
REPEATS = 9


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """The default flag, and a captured object."""
    configs = ROOT / "configs" / "sim"
    scenes = {"flag": ["--config", str(configs / "flag.yaml")]}
    if options.ply:
        scenes[Path(options.ply).stem] = ["--config", str(configs / "hanging_object.yaml"), "--scene.ply", options.ply]
    for name, arguments in scenes.items():
        yield ("scenes", name), partial(scene_of, [*arguments, "--device", options.device], options.seconds)


def scene_of(arguments: list[str], seconds: float) -> Row:
    """Messages, times and pictures of one scene.

    Args:
        arguments: Options of ``gaussian-swaying sim``.
        seconds: How long a browser watches it.
    """
    parser = Simulation.parser()
    session = Session(parser, parser.parse_args(arguments))
    if session.simulation.device.type == "cpu":
        share_cores()
    page = Page(port=8750, largest=max(WINDOW)).show(session)
    try:
        session.start()
        watched = _watch(page, seconds)
        session.pause()
        time.sleep(1.0)
        return watched | _costs(session.snapshot, page)
    finally:
        page.close()
        session.close()


def _watch(page: Page, seconds: float) -> Row:
    """What headless Chromium with software WebGL2 draws while the simulation runs on the same processor."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        window = browser.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
        window.set_default_timeout(300_000)
        # it would ask the server for pictures
        window.add_init_script("addEventListener('DOMContentLoaded', () => (wind.patience = 1e9))")
        window.goto(page.url)
        window.wait_for_function("wind.on && wind.drawing.ready")
        time.sleep(WARM)
        window.evaluate("wind.count = 0; wind.first = wind.playback.shown")
        number, began = page.session.snapshot.number, time.perf_counter()
        time.sleep(seconds)
        drawn, passed = window.evaluate("wind.count"), time.perf_counter() - began
        states = page.session.snapshot.number - number
        pixels = window.evaluate("[wind.canvas.width, wind.canvas.height]")
        version = browser.version
        browser.close()
    return {
        "pictures_per_s": drawn / passed,
        "steps_per_s": states / passed,
        "picture": "x".join(map(str, pixels)),
        "chromium": version,
    }


def _costs(snapshot: Snapshot, page: Page) -> Row:
    """Bytes of a scene, a state and a picture, and the server's processor time for the latter two [ms]."""
    from PIL import Image

    camera = snapshot.simulation.painter.camera_at(0)
    shrink = torch.tensor([[WINDOW[0] / camera.width], [WINDOW[1] / camera.height], [1.0]]).to(camera.intrinsics)
    camera = replace(camera, intrinsics=shrink * camera.intrinsics, width=WINDOW[0], height=WINDOW[1])
    states, pictures = [], []
    for _ in range(REPEATS):
        begin = time.process_time()
        state = state_message(snapshot, False)
        states.append(time.process_time() - begin)
        begin, file = time.process_time(), io.BytesIO()
        Image.fromarray(draw(snapshot, camera)).save(file, "jpeg", quality=JPEG_QUALITY)
        pictures.append(time.process_time() - begin)
    scene = snapshot.simulation.scene
    nodes = scene.follow.nodes(snapshot.state)
    assert nodes is not None
    return {
        "gaussians": len(scene.model.means),
        "nodes": len(nodes),
        "scene_bytes": len(scene_message(snapshot, page._turn)),
        "state_bytes": len(state),
        "jpeg_bytes": len(file.getvalue()),
        "state_ms": 1e3 * statistics.median(states),
        "jpeg_ms": 1e3 * statistics.median(pictures),
    }


CASE = Case(
    "Measure what a browser that draws the live page gets, and what that saves.",
    rows,
    (
        option("--ply", "a captured object for configs/sim/hanging_object.yaml"),
        option("--seconds", "for how long each scene is watched", type=float, default=20.0),
    ),
    page="live.md",
)
