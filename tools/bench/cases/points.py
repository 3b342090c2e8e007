"""What ``bench.py points`` measures: error and time against the points of a cell (``scene.points``)."""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from bench import record
from bench.record import ROOT
from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation

Row = dict[str, Any]

SCENES = ("guitar", "ficus", "alocasia", "telephone")
WAYS: dict[str, dict[str, Any]] = {
    "gaussian": {"points": "gaussian"},
    "nudged": {"points": "gaussian"},
    **{f"grid {n}": {"points": "grid", "points_per_cell": n} for n in (1, 2, 3, 4, 6)},
}
NUDGE = 1.01
"""Factor on dx of the row ``nudged``, one point to a Gaussian on another grid: what any change does to the motion."""


def configuration(scene: str, way: str | None, ply: str | None = None) -> dict[str, Any]:
    """The YAML of a scene, with one way to choose its points."""
    name = "hanging_object" if scene == "guitar" else scene
    found: dict[str, Any] = yaml.safe_load((ROOT / "configs" / "sim" / f"{name}.yaml").read_text())
    if scene == "guitar":
        found["scene"]["ply"] = ply
    if way is None:
        return found
    found["scene"] |= WAYS[way]
    if way == "nudged":
        found["solver"]["dx"] *= NUDGE
    return found


def motion(simulation: Simulation, frames: int, row: Row) -> Iterator[Tensor]:
    """Displacement of the simulated Gaussians [m] in each frame; the row gets times and counts."""
    scene = simulation.scene
    rest, times, substeps = scene.rest().means[scene.simulated], [], 0
    state = simulation.start()
    for _ in range(frames):
        begin = time.perf_counter()
        state, health = simulation.advance(state)
        gaussians = simulation.painter.deformed(state)
        if simulation.device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - begin)
        substeps += health.substeps
        yield (gaussians.means[scene.simulated] - rest) * scene.frame.metres_per_unit
    row |= {"points": scene.points.count, "gaussians": len(scene.simulated), "substeps": substeps}
    row["ms_per_frame"] = 1e3 * statistics.median(times[min(3, frames - 1) :])


@torch.inference_mode()
def measure(scene: str, frames: int, device: str, ply: str | None) -> list[Row]:
    """All ways of one scene, each compared with one point to a Gaussian."""
    rows: list[Row] = []
    first: list[Tensor] = []
    with tempfile.TemporaryDirectory() as folder:
        for way in WAYS:
            path = Path(folder) / "scene.yaml"
            path.write_text(yaml.safe_dump(configuration(scene, way, ply)))
            row: Row = {"scene": scene, "way": way, "frames": frames}
            simulation = Simulation.from_yaml(path, device=device)
            row["dx_m"] = simulation.solver.dx
            try:
                if way == "gaussian":
                    first = [moved.cpu() for moved in motion(simulation, frames, row)]
                    means = [float(moved.norm(dim=-1).mean()) for moved in first]
                    largest = max(means)
                    row["largest_mean_displacement_m"] = largest
                else:
                    apart = [
                        float((moved.cpu() - other).norm(dim=-1).mean())
                        for moved, other in zip(motion(simulation, frames, row), first, strict=True)
                    ]
                    row["error"] = statistics.mean(apart) / largest
                    row["error_last"] = apart[-1] / largest
                    row["error_largest"] = max(apart) / largest
            except SimulationDiverged as error:
                row["failed"] = str(error)
            rows.append(row)
            print(json.dumps(row), flush=True)
    return rows


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py points``."""
    command.add_argument("--ply", help="a captured guitar, for the scene `guitar`; without it that scene is left out")
    command.add_argument("--frames", type=int, default=250, help="frames of each run")
    command.add_argument("--only", help="only these scenes, separated by commas")


def run(options: argparse.Namespace) -> None:
    """Measure error and time against the points of a cell."""
    device, result = record.start(options.device)
    wanted = options.only.split(",") if options.only else list(SCENES)
    folder, name = Path(options.results), f"points_{device.type}"
    record.keep_rows(result, folder, name, lambda row: row["scene"] not in wanted)
    for scene in wanted:
        if scene == "guitar" and options.ply is None:
            continue
        result["rows"] += measure(scene, options.frames, str(device), options.ply)
        record.write(folder, name, result, quiet=True)
