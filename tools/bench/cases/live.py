"""What ``bench.py live`` measures: states and pictures for a client of the live page, and how soon a control shows."""

from __future__ import annotations

import argparse
import io
import math
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.case import Case, Measurement, option
from bench.record import ROOT, Row
from gaussian_swaying.cli.live import session_of
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.controls import Page
from gaussian_swaying.viewer.session import Session

if TYPE_CHECKING:
    from bench.page_client import PageClient

SIZES = {"cpu": (640, 360), "cuda": (1920, 1080)}
WARM = 8.0  # s until steps and pictures have found their size
CHANGES = 7  # of the background, for the latency
PATIENCE = 10.0  # s


def watch(arguments: list[str], device: str, seconds: float) -> Row:
    """A page as ``gaussian-swaying live`` makes it, and one client on the same machine: first it draws itself."""
    from bench.page_client import PageClient, StateClient  # needs the extra [viewer]

    parser = Simulation.parser()
    settings = parser.parse_args([*arguments, "--device", device])
    session = session_of(parser, settings, real_time=True)
    page = Page(port=8700, largest=max(SIZES[device])).show(session)
    first = page.server.initial_camera
    wxyz = camera_rotation(first.position, first.look_at, session.simulation.scene.frame.rotation[2].tolist())
    session.start()
    width, height = SIZES[device]
    eye, target = ([float(x) for x in place] for place in (first.position, first.look_at))
    client = PageClient(page.server.get_port(), width, height, wxyz, eye, target)
    drawing = StateClient(page)
    drawing.states(WARM)
    states, states_speed = _followed(session, lambda: drawing.states(seconds))
    drawing.close()
    for _ in client.pictures(WARM):
        pass
    received, real_time = _followed(session, lambda: [(at, len(jpeg)) for at, jpeg in client.pictures(seconds)])
    step = session.simulation.frame_dt
    waited = [latency(session, client, 0)]
    if math.isfinite(waited[0]):  # in a place the sky may hide the background
        waited += [latency(session, client, k) for k in range(1, CHANGES)]
    client.close()
    page.close()
    session.close()
    scene = session.simulation.scene
    return {
        "gaussians": len(scene.model.means),
        "points": scene.points.count,
        "dx_m": session.simulation.solver.dx,
        "configured_dx_m": float(settings.solver.dx),
        "states_per_s": states / seconds,
        "states_real_time": states_speed,
        "window": [width, height],
        "seconds": seconds,
        "pictures_per_s": len(received) / seconds,
        "picture_bytes": statistics.median(size for _, size in received) if received else None,
        "picture": "x".join(map(str, page.drawn_size)),  # it is enlarged to the window before it is sent
        "latency_ms": statistics.median(waited) if math.isfinite(waited[0]) else None,
        "real_time": real_time,
        "step_s": step,
        "problem": session.problem,
    }


def _followed(session: Session, watch: Callable[[], Any]) -> tuple[Any, float]:
    """What a client received, and the seconds simulated per second meanwhile."""
    began, simulated = time.perf_counter(), session.snapshot.health.time
    received = watch()
    return received, (session.snapshot.health.time - simulated) / (time.perf_counter() - began)


def latency(session: Session, client: PageClient, k: int) -> float:
    """Milliseconds from a change of the background to the first picture that shows it."""
    wanted = [1.0, 0.0, 0.0] if k % 2 == 0 else [0.0, 0.0, 1.0]
    begin = time.perf_counter()
    session.change({"background": wanted})
    for at, jpeg in client.pictures(PATIENCE):
        corner = pixels_of(jpeg)[:4, :4].astype(float).mean((0, 1))
        if np.abs(corner - 255 * np.array(wanted)).max() < 40:
            return 1e3 * (at - begin)
    return float("nan")


def camera_rotation(eye: Any, target: Any, up: list[float]) -> list[float]:
    """Quaternion of a camera that looks from an eye at a target."""
    import torch

    from gaussian_swaying.geometry.rotations import rotation_to_quat
    from gaussian_swaying.rendering.cameras.camera import look_at_camera

    eye, target = (torch.as_tensor(np.array(place, dtype=float)) for place in (eye, target))
    camera = look_at_camera(eye, target, up, 40.0, 2, 2, dtype=torch.float64)
    return [float(x) for x in rotation_to_quat(camera.world_to_camera[:3, :3].T.contiguous())]


def pixels_of(jpeg: bytes) -> np.ndarray:
    """The pixels of a picture, uint8 (H, W, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB"))


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The default flag, on a GPU one of 100,000 Gaussians too, and a captured object."""
    result["rows"] = []
    configs = ROOT / "configs" / "sim"
    flag = ["--config", str(configs / "flag.yaml")]
    scenes = {"flag": flag}
    if options.device == "cuda":
        scenes["large flag"] = [*flag, "--solver.dx=0.0125", "--scene.generator.init_args.spacing=0.0031"]
    if options.ply:
        scenes[Path(options.ply).stem] = ["--config", str(configs / "hanging_object.yaml"), "--scene.ply", options.ply]
    if options.scene:
        scenes[Path(options.scene).parent.name] = ["--config", options.scene]
    for name, arguments in scenes.items():
        yield ("rows", {"name": name}), partial(watch, arguments, options.device, options.seconds)


CASE = Case(
    "Measure the pictures a second of the live page.",
    rows,
    (
        option("--ply", "a captured object for configs/sim/hanging_object.yaml"),
        option("--scene", "a configuration to watch, too, such as the starter of a preview"),
        option("--seconds", "for how long each scene is watched", type=float, default=20.0),
    ),
    page="live.md",
    keeps="none",
)
