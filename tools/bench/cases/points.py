"""What ``bench.py points`` measures: error and time against the points of a cell (``scene.points``)."""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from bench.case import Case, Measurement, names, option
from bench.record import ROOT, Row
from gaussian_swaying.simulation.diagnostics import SimulationDiverged
from gaussian_swaying.simulation.simulation import Simulation

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
def run(scene: str, way: str, frames: int, device: str, ply: str | None, first: list[Tensor]) -> Row:
    """One way of a scene, compared with one point to a Gaussian, whose motion goes into ``first``."""
    row: Row = {"frames": frames}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(yaml.safe_dump(configuration(scene, way, ply)))
        simulation = Simulation.from_yaml(path, device=device)
    row["dx_m"] = simulation.solver.dx
    try:
        moved = [place.cpu() for place in motion(simulation, frames, row)]
    except SimulationDiverged as error:
        return row | {"failed": str(error)}
    if way == "gaussian":
        first += moved
    largest = max(float(place.norm(dim=-1).mean()) for place in first)
    if way == "gaussian":
        return row | {"largest_mean_displacement_m": largest}
    apart = [float((one - other).norm(dim=-1).mean()) / largest for one, other in zip(moved, first, strict=True)]
    return row | {"error": statistics.mean(apart), "error_last": apart[-1], "error_largest": max(apart)}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """All ways of each scene."""
    wanted = [scene for scene in options.only if scene != "guitar" or options.ply]
    result["rows"] = [row for row in result.get("rows", []) if row["scene"] not in wanted]
    for scene in wanted:
        first: list[Tensor] = []
        for way in WAYS:
            work = partial(run, scene, way, options.frames, options.device, options.ply, first)
            yield ("rows", {"scene": scene, "way": way}), work


CASE = Case(
    "Measure error and time against the points of a cell.",
    rows,
    (
        option("--ply", "a captured guitar, for the scene `guitar`; without it that scene is left out"),
        option("--frames", "frames of each run", type=int, default=250),
        names("--only", SCENES),
    ),
    keeps="any",
)
