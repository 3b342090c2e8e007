"""What ``bench.py winds`` measures: substeps in winds that differ from place to place and with obstacles, and a box."""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch

from bench.case import Case, Measurement, names, numbers
from bench.clock import Clock, guarded
from bench.record import Row
from bench.scenes import CUBE, sheet, waves, wind_load
from gaussian_swaying.aero.carried import Turbulence
from gaussian_swaying.aero.effects import LogProfile, WindEffect
from gaussian_swaying.aero.obstacles import CylinderObstacle, EllipsoidObstacle
from gaussian_swaying.aero.shelter import Shelter
from gaussian_swaying.aero.turbulence_box import turbulence_box
from gaussian_swaying.aero.wind import UniformGust, WindField
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.boundary import Boundary
from gaussian_swaying.mpm.boundaries.mesh import MeshObstacle
from gaussian_swaying.mpm.solver import MPMSolver

DT = 1e-4  # s
BOX = (256, 128, 128)
COUNTS = {"cuda": (100_000, 1_000_000), "cpu": (5_000, 20_000, 100_000)}
STEPS = {"cuda": 64, "cpu": 6}
ROUNDS = {"cuda": 15, "cpu": 9}


def effects(name: str) -> list[WindEffect]:
    """The effects of a wind to measure."""
    turbulence = Turbulence(0.2, 0.5, cells=BOX)
    profile = LogProfile([0.0, 0.0, -1.0], height=2.0)
    return {
        "uniform": [],
        "turbulence": [turbulence],
        "profile, turbulence": [profile, turbulence],
        "profile, turbulence, shelter": [profile, turbulence, Shelter()],
        "cylinder": [CylinderObstacle([-0.5, 0.0, 0.0], 0.1, axis=[0.0, 1.0, 0.0])],
        "ellipsoid": [EllipsoidObstacle([-0.5, 0.5, 0.0], [0.1, 0.5, 0.5])],
    }[name]


KINDS = ("uniform", "turbulence", "profile, turbulence", "profile, turbulence, shelter", "cylinder", "ellipsoid")
OBSTACLES = ("none", "ball", "moving ball", "mesh")


def solids(name: str, folder: Path) -> list[Boundary]:
    """What the body meets: the ball and the mesh, an octahedron, reach just above the middle of the sheet."""
    if name == "none":
        return []
    if name == "mesh":
        corners = [[s * 0.2 if k == axis else 0.0 for k in range(3)] for axis in range(3) for s in (1, -1)]
        faces = [(1, 3, 5), (3, 2, 5), (2, 4, 5), (4, 1, 5), (3, 1, 6), (2, 3, 6), (4, 2, 6), (1, 4, 6)]
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
        (folder / "octahedron.obj").write_text("\n".join(lines) + "\n")
        return [MeshObstacle(str(folder / "octahedron.obj"), center=[0.5, 0.5, 0.33])]
    path = KeyedPath([0.0, 10.0], [[0.0] * 3, [0.0, 0.0, 0.1]], [[0.0] * 3, [0.0, 0.0, 90.0]])
    return [BallObstacle([0.5, 0.5, 0.33], 0.2, path=path if name == "moving ball" else None)]


def in_turns(runs: dict[str, Callable[[], object]], device: torch.device, steps: int, rounds: int) -> dict[str, Row]:
    """Milliseconds of a substep of several rollouts, in turns, so that other work disturbs all of them alike.

    The ratio is the median over the rounds of the time to that of the first one in the same round.
    """
    for roll in runs.values():
        for _ in range(3):
            roll()
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, roll in runs.items():
            clock = Clock(device)
            clock.mark()
            roll()
            clock.mark()
            times[name] += [ms / steps for ms in clock.read()]
    first = next(iter(times.values()))
    ratios = {name: [a / b for a, b in zip(samples, first, strict=True)] for name, samples in times.items()}
    return {
        name: {"median_ms": statistics.median(samples), "ratio": statistics.median(ratios[name]), "rounds": rounds}
        for name, samples in times.items()
    }


@torch.no_grad()
def measure_obstacles(count: int, formulation: str, device: torch.device, steps: int, rounds: int) -> list[Row]:
    """Substeps of a sheet that lies on each of :data:`OBSTACLES`."""
    points = sheet(count, device)
    runs, solvers = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        for name in OBSTACLES:
            solver = MPMSolver(dx=CUBE.dx, formulation=formulation, boundaries=solids(name, Path(folder))).to(device)
            state = solver.init_state(points, waves(points.position))
            if formulation == "updated":
                state = state.replace(grid=CUBE)
            runs[name], solvers[name] = partial(solver.rollout, state, DT, steps), solver
    rows = []
    for name, found in in_turns(runs, device, steps, rounds).items():
        fused = solvers[name].fused()
        row: Row = {"particles": points.count, "formulation": formulation, "obstacle": name, "substeps": steps}
        rows.append(row | found | {"path": "torch" if fused is None else "kernels"})
    return rows


@torch.no_grad()
def measure_winds(count: int, formulation: str, device: torch.device, steps: int, rounds: int) -> list[Row]:
    """Substeps of a sheet in each wind."""
    points = sheet(count, device)
    winds = {
        name: WindField([2.0, 0.0, 1.0], modulations=[UniformGust()], effects=effects(name)).to(device)
        for name in KINDS
    }
    runs, parts = {}, {}
    for name, wind in winds.items():
        solver = MPMSolver(dx=CUBE.dx, formulation=formulation)
        state = solver.init_state(points, waves(points.position))
        if formulation == "updated":
            state = state.replace(grid=CUBE)
        load = wind_load(points, wind)
        load.refresh(state)
        runs[name], parts[name] = partial(solver.rollout, state, DT, steps, load), (solver, load)
    rows = []
    for name, found in in_turns(runs, device, steps, rounds).items():
        solver, load = parts[name]
        kernels = solver.fused() is not None and load.twin() is not None
        row: Row = {"particles": points.count, "formulation": formulation, "wind": name, "substeps": steps}
        rows.append(row | found | {"path": "kernels" if kernels else "torch"})
    return rows


@torch.no_grad()
def measure_box(device: torch.device, rounds: int = 7) -> Row:
    """Time to make a box, isotropic and with shear, after one that is not counted."""
    row: Row = {"cells": list(BOX)}
    for name, gamma in (("isotropic", 0.0), ("sheared", 3.9)):
        samples = []
        for number in range(rounds + 1):
            if device.type == "cuda":
                torch.cuda.synchronize()
            begin = time.perf_counter()
            turbulence_box(BOX, [1 / 16] * 3, 1.0, gamma=gamma, seed=number, device=device)
            if device.type == "cuda":
                torch.cuda.synchronize()
            samples.append(time.perf_counter() - begin)
        row[f"{name}_s"] = statistics.median(samples[1:])
    return row


PARTS: dict[str, tuple[str, Callable[..., list[Row]]]] = {
    "rows": ("wind", measure_winds), "obstacles": ("obstacle", measure_obstacles)
}  # fmt: skip
"""Tables of the record: what their rows differ by, and what measures them."""


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The box, and each table for each size and formulation."""
    device = torch.device(options.device)
    kind = device.type
    if "box" in options.only:
        yield ("box",), partial(measure_box, device)
    for count in options.counts or COUNTS[kind]:
        for formulation in options.formulations:
            for key, (what, take) in PARTS.items():
                if key in options.only:
                    known = {"particles": sheet(count, device).count, "formulation": formulation}
                    work = partial(take, count, formulation, device, STEPS[kind], ROUNDS[kind])
                    found = guarded(lambda work=work: {"rows": work()})
                    failed = {what: "-", "failed": found.get("failed")}
                    result[key] = [row for row in result.get(key, []) if known.items() - row.items()]
                    for row in found.get("rows", [failed]):
                        yield (key, known | {what: row[what]}), row.copy


CASE = Case(
    "Measure substeps in winds that differ from place to place, and a box of turbulence.",
    rows,
    (
        numbers("--counts", "particles"),
        names("--formulations", ("total", "updated")),
        names("--only", ("box", *PARTS)),
    ),
    page="wind.md",
)
