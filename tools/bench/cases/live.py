"""What ``bench.py live`` measures: how many pictures a second the live page can draw, and how fast its time passes."""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

from bench import record
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.viewer.page import MOST_PER_SECOND
from gaussian_swaying.viewer.pictures import camera_of, draw
from gaussian_swaying.viewer.session import Session

Row = dict[str, Any]
SIZE = (640, 360)
WARM = 6.0  # s until steps have found their length


def rates(name: str, arguments: list[str], device: str, seconds: float) -> Row:
    """A session, and a thread that draws its newest snapshot as a browser's does, without a browser."""
    from gaussian_swaying.geometry.rotations import rotation_to_quat

    parser = Simulation.parser()
    session = Session(parser, parser.parse_args([*arguments, "--device", device]))
    given = session.simulation.painter.camera_at(0)
    wxyz = rotation_to_quat(given.world_to_camera[:3, :3].double().mT).tolist()
    camera = camera_of(wxyz, given.position.tolist(), 0.7, *SIZE)
    session.start()
    number, drawn, each, factors = -1, 0, [], []
    begin = time.perf_counter()
    while (now := time.perf_counter()) < begin + WARM + seconds:
        snapshot = session.wait(number, 0.02)
        if snapshot.number == number:
            continue
        number = snapshot.number
        with session.lock:
            draw(snapshot, camera)
        if now > begin + WARM:
            drawn += 1
            each.append(time.perf_counter() - now)
            factors.append(session.rates().real_time)
        time.sleep(max(0.0, 1 / MOST_PER_SECOND - (time.perf_counter() - now)))
    session.close()
    scene = session.simulation.scene
    return {
        "name": name,
        "gaussians": len(scene.model.means),
        "points": scene.points.count,
        "width": SIZE[0],
        "height": SIZE[1],
        "seconds": seconds,
        "pictures_per_s": drawn / seconds,
        "picture_ms": 1e3 * statistics.median(each) if each else None,
        "real_time": statistics.median(factors) if factors else None,
        "step_s": session.simulation.frame_dt,
        "problem": session.problem,
    }


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py live``."""
    command.add_argument("--ply", help="a captured object for configs/sim/hanging_object.yaml")
    command.add_argument("--seconds", type=float, default=20.0, help="for how long each scene is watched")


def live(options: argparse.Namespace) -> None:
    """Measure the default flag, and a captured object."""
    device, result = record.start(options.device)
    configs = record.ROOT / "configs" / "sim"
    scenes = [("flag", ["--config", str(configs / "flag.yaml")])]
    if options.ply:
        hanging = ["--config", str(configs / "hanging_object.yaml"), "--scene.ply", options.ply]
        scenes.append((Path(options.ply).stem, hanging))
    result["rows"] = [rates(name, arguments, device.type, options.seconds) for name, arguments in scenes]
    record.write(Path(options.results), f"live_{device.type}", result)
