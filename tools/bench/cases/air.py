"""What ``bench.py air`` measures: computed air beside exact and published flows and flags, and its speed."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bench.case import PICTURES, Case, Measurement, option
from bench.clock import guarded
from bench.problems import air, filaments
from bench.record import ROOT, Row
from bench.tables.plots import save_figure, subplots
from gaussian_swaying.aero.computed_air import BYTES
from gaussian_swaying.air.flow import FlowState, LatticeFlow
from gaussian_swaying.simulation.simulation import Simulation


def _flow(device: str, cells: tuple[int, int, int], steps: int = 60) -> Row:
    """Updates of cells per second of the flow alone, in an open box."""
    flow = LatticeFlow(cells, air.units_of(0.02, 1e5)).to(device)
    now = flow.start([1.0, 0.0, 0.0]).moments
    spare, wind = torch.empty_like(now), torch.tensor([1.0, 0.0, 0.0], device=device)
    best = float("inf")
    for _ in range(4):
        _wait(device)
        began = time.perf_counter()
        for _ in range(steps):
            flow.advance(now, spare, wind)
            now, spare = spare, now
        _wait(device)
        best = min(best, (time.perf_counter() - began) / steps)
    return {"updates_per_s": now[0].numel() / best, "bytes_per_cell": BYTES}


def _scene(device: str, frames: int = 4) -> Row:
    """The fastest of some frames of the shipped scene."""
    simulation = Simulation.from_yaml(ROOT / "configs/sim/flag_in_air.yaml", device=device)
    stepper = simulation.stepper
    state, _ = stepper.advance(stepper.start())
    best, made = float("inf"), stepper.air
    assert made is not None
    for _ in range(frames):
        began = time.perf_counter()
        state, health = stepper.advance(state)
        _wait(device)
        best = min(best, time.perf_counter() - began)
    return {
        "frame_s": best, "steps": made.steps, "substeps": health.substeps, "points": simulation.scene.points.count,
        "cells": list(made.flow.cells), "threads": torch.get_num_threads(),
    }  # fmt: skip


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def _number(name: str, found: Any) -> Row:
    """A result that is one number, under its name."""
    return {name: found} if isinstance(found, float) else {k: v for k, v in found.items() if k != "tips"}


def cases(device: str) -> Iterable[tuple[str, Row, Callable[[], Row]]]:
    """The name, the parameters and the function of each measurement."""
    for cells in (16, 32, 64):
        yield "vortices", {"cells": cells}, lambda cells=cells: _number("error", air.taylor_green(cells))
    for cells in (8, 16):
        yield "walls", {"cells": cells}, lambda cells=cells: _number("error", air.poiseuille(cells))
    for cells in (32, 64, 96):
        yield "cavity", {"cells": cells}, lambda cells=cells: _number("error", air.cavity(cells))
    for stiffness in (0.5, 0.2, 0.03):
        given = {"stiffness": stiffness}
        yield (
            "inverted flag",
            given,
            lambda k=stiffness: filaments.flag(1.0, k, 200.0, held="tail", cells=20, until=40.0, before=3.0),
        )
    for cells in (24, 32):
        yield "hanging filament", {"cells": cells}, lambda cells=cells: filaments.hanging(cells, until=24.0)
    for gap in (0.5, 2.0):
        yield "two flags", {"gap": gap}, lambda gap=gap: filaments.tandem(gap, cells=20, until=24.0)
    yield "plate", {"cells": 10}, lambda: air.plate(10, until=20.0)
    yield "cylinder", {"cells": 12}, lambda: air.cylinder(12, until=110.0)
    for cells in (10, 14):
        yield "sphere", {"cells": cells}, lambda cells=cells: air.sphere(cells, until=12.0)
    yield "flow", {"size": [48, 32, 32]}, lambda: _flow(device, (48, 32, 32))
    yield "flow", {"size": [128, 96, 96]}, lambda: _flow(device, (128, 96, 96), 20)
    yield "scene", {}, lambda: _scene(device)


def picture(folder: str, frames: int = 60) -> Row:
    """Draw ``air.png``: vorticity behind the flag of the shipped scene, and behind two flags in a row."""
    simulation = Simulation.from_yaml(ROOT / "configs/sim/flag_in_air.yaml", device="cpu")
    stepper = simulation.stepper
    state = stepper.start()
    for _ in range(frames):
        state, _ = stepper.advance(state)
    made = stepper.air
    assert made is not None
    settings, flow = made.settings, made.flow
    figure, (left, right) = subplots(1, 2, figsize=(13, 4.2))
    level = flow.cells[2] // 2
    around = flow.vorticity(FlowState(state.air))[2, :, :, level]
    extent = [settings.low[0], settings.high[0], settings.low[1], settings.high[1]]
    style = {"cmap": "RdBu_r", "origin": "lower", "interpolation": "bilinear"}
    left.imshow(around.T, extent=extent, vmin=-40, vmax=40, **style)
    at = settings.low[2] + (level + 0.5) * settings.spacing
    near = state.position[(state.position[:, 2] - at).abs() < 0.02]
    left.plot(*near[near[:, 0].argsort(), :2].T, ".k", markersize=2)
    left.set(title=f"flag_in_air from above after {frames} frames", xlabel="x [m]", ylabel="y [m]")
    cells = 24
    pair = [filaments.Filament.straight(2 * cells + 1, 0.5, 1e-3, 0.1) for _ in range(2)]
    found = filaments.flap(pair, [(0.0, 0.0), (2.0, 0.0)], cells=cells, until=20.0, length=9.0, height=4.0)
    around = -found["flow"].vorticity(found["state"])[1, :, 0]
    right.imshow(around.T, extent=[-2, 7, -2, 2], vmin=-8, vmax=8, **style)
    for shift, one in zip((0.0, 2.0), pair, strict=True):
        right.plot(one.place[:, 0] + shift, one.place[:, 1], "k", linewidth=2)
    right.set(title="Two flags in a plane, Re 200, after 20 lengths", xlabel="x / L", ylabel="z / L")
    save_figure(figure, Path(folder) / "air.png")
    return {"frames": frames}


def _result(function: Callable[[], Row]) -> Row:
    return {"result": guarded(function)}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """All cases, or those whose problem is ``only``."""
    only = options.only or ""
    result["rows"] = [row for row in result.get("rows", []) if only and only != row["problem"]]
    for name, parameters, function in cases(options.device):
        if only in ("", name):
            yield ("rows", {"problem": name, "parameters": parameters}), partial(_result, function)
    if only in ("", "picture"):
        yield ("picture",), partial(picture, options.pictures)


CASE = Case(
    "Measure computed air beside exact and published flows and flags, and its speed.",
    rows,
    (option("--only", "only this problem, or the picture"), PICTURES),
    page="air.md",
)
