"""What ``bench.py winds`` measures: substeps in winds that differ from place to place, and the time to make a box."""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import torch

from bench import record
from bench.clock import Clock, guarded
from bench.problems import CUBE, sheet, waves, wind_load
from gaussian_swaying.aero.carried import Turbulence
from gaussian_swaying.aero.effects import LogProfile, WindEffect
from gaussian_swaying.aero.obstacles import CylinderObstacle
from gaussian_swaying.aero.shelter import Shelter
from gaussian_swaying.aero.turbulence_box import turbulence_box
from gaussian_swaying.aero.wind import UniformGust, WindField
from gaussian_swaying.mpm.solver import MPMSolver

Row = dict[str, Any]

DT = 1e-4  # s
BOX = (256, 128, 128)
COUNTS = {"cuda": (20_000, 100_000, 1_000_000), "cpu": (5_000, 20_000, 100_000)}
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
    }[name]


KINDS = ("uniform", "turbulence", "profile, turbulence", "profile, turbulence, shelter", "cylinder")


def measure(count: int, formulation: str, device: torch.device, steps: int, rounds: int) -> list[Row]:
    """Substeps of a sheet in each wind, in turns, so that a machine that others use disturbs all of them alike.

    The ratio is the median over the rounds of the time in this wind to that in the uniform one of the same round.
    """
    points = sheet(count, device)
    winds = {
        name: WindField([2.0, 0.0, 1.0], modulations=[UniformGust()], effects=effects(name)).to(device)
        for name in KINDS
    }
    runs = {}
    for name, wind in winds.items():
        solver = MPMSolver(dx=CUBE.dx, formulation=formulation)
        state = solver.init_state(points, waves(points.position))
        if formulation == "updated":
            state = state.replace(grid=CUBE)
        load = wind_load(points, wind)
        load.refresh(state)
        for _ in range(3):
            solver.rollout(state, DT, steps, load)
        runs[name] = (solver, state, load)
    times: dict[str, list[float]] = {name: [] for name in KINDS}
    for _ in range(rounds):
        for name, (solver, state, load) in runs.items():
            clock = Clock(device)
            clock.mark()
            solver.rollout(state, DT, steps, load)
            clock.mark()
            times[name] += [ms / steps for ms in clock.read()]
    rows = []
    for name, samples in times.items():
        shares = [a / b for a, b in zip(samples, times["uniform"], strict=True)]
        solver, _, load = runs[name]
        kernels = solver.fused() is not None and load.has_twin
        row: Row = {"particles": points.count, "formulation": formulation, "wind": name, "substeps": steps}
        row |= {"median_ms": statistics.median(samples), "ratio": statistics.median(shares), "rounds": rounds}
        rows.append(row | {"path": "kernels" if kernels else "torch"})
    return rows


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


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py winds``."""
    command.add_argument("--counts", help="particles, separated by commas")
    command.add_argument("--formulations", default="total,updated", help="separated by commas")


@torch.no_grad()
def run(options: argparse.Namespace) -> None:
    """Measure substeps in winds, and a box of turbulence."""
    device, result = record.start(options.device)
    kind, folder = device.type, Path(options.results)
    counts = COUNTS[kind] if options.counts is None else [int(n) for n in options.counts.split(",")]
    result |= {"box": measure_box(device), "rows": []}
    for formulation in options.formulations.split(","):
        for count in counts:
            found = guarded(lambda c=count, f=formulation: {"rows": measure(c, f, device, STEPS[kind], ROUNDS[kind])})
            failed = {"particles": count, "formulation": formulation, "wind": "-", "failed": found.get("failed")}
            result["rows"] += found.get("rows", [failed])
            print(json.dumps(result["rows"][-1]), flush=True)
            record.write(folder, f"winds_{kind}", result, quiet=True)
