"""What ``bench.py air`` measures: computed air beside exact and published flows and flags, and its speed."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bench.case import PICTURES, Case, Measurement, names
from bench.clock import guarded
from bench.problems import air, filaments, flutter, tumbling
from bench.record import ROOT, Row
from bench.tables.plots import save_figure, subplots
from gaussian_swaying.aero.computed_air import BYTES, ComputedAir
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.air.flow import FlowState, LatticeFlow
from gaussian_swaying.air.immersed import exchange
from gaussian_swaying.kernels.graphs import Replayed
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.simulation.wind_picture import draw_vorticity


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


def _coupling(device: str, cells: tuple[int, int, int], points: int, steps: int = 60) -> Row:
    """Share of the exchange with a sheet in a step of the air: its time with and without, by turns."""
    flow = LatticeFlow(cells, air.units_of(0.02, 1e5)).to(device)
    now = flow.start([1.0, 0.0, 0.0]).moments
    spare, wind = torch.empty_like(now), torch.tensor([1.0, 0.0, 0.0], device=device)
    side = round(points**0.5)
    line = (torch.arange(side, device=device) + 0.5) / side - 0.5
    first, second = torch.meshgrid(line, line, indexing="ij")
    size = 0.5 * min(cells[1:])
    middle = torch.tensor([cells[0] / 3, cells[1] / 2, cells[2] / 2], device=device)
    place = torch.stack([first, 0.2 * first, second], -1).reshape(-1, 3) * size + middle
    area = torch.full((side**2,), (size / side) ** 2, device=device)
    still, mass = torch.zeros(side**2, 3, device=device), torch.full((side**2,), 1.0, device=device)

    def two(coupled: bool, wind: torch.Tensor) -> list[torch.Tensor]:
        for first, second in ((now, spare), (spare, now)):
            if coupled:
                exchange(first, still, area, mass, place, flow.kind)
            flow.advance(first, second, wind)
        return []

    recorded = {coupled: Replayed() for coupled in (False, True)}  # as in a run
    times: dict[bool, list[float]] = {False: [], True: []}
    for coupled in [False, True] * 6:
        _wait(device)
        began = time.perf_counter()
        for _ in range(steps // 2):
            with torch.no_grad():
                recorded[coupled](coupled, partial(two, coupled), wind)
        _wait(device)
        times[coupled].append((time.perf_counter() - began) / (2 * (steps // 2)))
    alone, both = (statistics.median(times[coupled][1:]) for coupled in (False, True))
    return {"alone_s": alone, "coupled_s": both, "share": 1 - alone / both, "points": side**2}


def _onset(mass_ratio: float, cells: int) -> Row:
    """Where a flag begins to flutter, beside the linear theory of an ideal flow."""
    linear, frequency = flutter.onset(mass_ratio)
    found, tried = flutter.neutral(lambda stiffness: flutter.growth(mass_ratio, stiffness, cells=cells), linear)
    speed = (linear / found) ** 0.5
    return {"linear": linear, "frequency": frequency, "growths": tried, "found": found, "speed": speed}


def _fall(froude: float) -> Row:
    return {name: value for name, value in tumbling.falling(froude, until=50.0).items() if name != "angles"}


Problem = tuple[str, Row, Callable[[], Row]]


def _on_a_laptop() -> Iterator[Problem]:
    """Flows in a plane, and small ones in space."""
    for cells in (16, 32, 64):
        yield "vortices", {"cells": cells}, lambda cells=cells: _number("error", air.taylor_green(cells))
    for cells in (8, 16):
        yield "walls", {"cells": cells}, lambda cells=cells: _number("error", air.poiseuille(cells))
    for cells in (32, 64, 96):
        yield "cavity", {"cells": cells}, lambda cells=cells: _number("error", air.cavity(cells))
    for cells in (20, 40):
        yield "step", {"cells": cells}, partial(air.step, cells)
    for stiffness in (0.5, 0.2, 0.03):
        bent = partial(filaments.flag, 1.0, stiffness, 200.0, held="tail", cells=20, until=40.0, before=3.0)
        yield "inverted flag", {"stiffness": stiffness}, bent
    for cells in (24, 32, 48):
        yield "hanging filament", {"cells": cells}, partial(filaments.hanging, cells, until=24.0)
    for gap in (0.25, 0.5, 1.0, 2.0, 4.0):
        yield "two flags", {"gap": gap}, partial(filaments.tandem, gap, cells=20)
    for mass_ratio, cells in ((0.2, 24), (0.2, 36), (0.5, 24), (1.0, 24), (1.0, 36), (2.0, 24)):
        yield "onset", {"mass_ratio": mass_ratio, "cells": cells}, partial(_onset, mass_ratio, cells)
    for froude in (0.3, 0.5, 0.9, 1.2):
        yield "falling plate", {"froude": froude}, partial(_fall, froude)
    yield "plate", {"cells": 10}, partial(air.plate, 10)
    yield "square flag", {"cells": 24, "width": 8}, partial(filaments.square_flag, 24, width=8)
    yield "cylinder", {"cells": 12}, partial(air.cylinder, 12, until=110.0)


def _on_a_gpu() -> Iterator[Problem]:
    """What needs more cells than a laptop has time for."""
    for cells, length, width in ((16, 12, 8), (16, 18, 12), (24, 18, 12)):
        given = {"cells": cells, "length": length, "width": width}
        yield "sphere", given, partial(air.sphere, cells, 24.0, length=length, width=width, device="cuda")
    for cells in (12, 24):
        yield "cylinder", {"cells": cells}, partial(air.cylinder, cells, 110.0, device="cuda")
    for cells in (10, 20):
        yield "plate", {"cells": cells}, partial(air.plate, cells, device="cuda")
    for cells, width in ((24, 4), (32, 8), (48, 8)):
        given = {"cells": cells, "width": width}
        yield "square flag", given, partial(filaments.square_flag, cells, width=width, device="cuda")


def cases(device: str) -> Iterator[Problem]:
    """The name, the parameters and the function of each measurement."""
    yield from _on_a_gpu() if device == "cuda" else _on_a_laptop()
    for size, steps in (((48, 32, 32), 60), ((128, 96, 96), 20)):
        yield "flow", {"size": list(size)}, partial(_flow, device, size, steps)
        yield "coupling", {"size": list(size)}, partial(_coupling, device, size, 20_000, steps)
    yield "scene", {}, lambda: _scene(device)


def _plant(frames: int = 30) -> Any:
    """The picture ``vorticity`` of the shipped ficus behind a wall, in computed air, shape (H, W, 3)."""
    simulation = Simulation.from_yaml(
        ROOT / "configs/sim/ficus_behind_wall.yaml",
        air=ComputedAir([-2.6, -1.6, -1.2], [2.6, 1.6, 1.6], 52, force="law", still_walls=True, speed=8.0),
        wind=WindField([6.0, 0.0, 0.0]),
        camera=OrbitCamera(width=640, height=400, fov_y=40.0, azimuth=-90.0, elevation=6.0, radius=2.6),
        device="cpu",
    )
    stepper, painter = simulation.stepper, simulation.painter
    state, camera = stepper.start(), painter.camera_at(0)
    for _ in range(frames):
        state, _ = stepper.advance(state)
    gaussians = painter.deformed(state)
    drawn = painter.draw(gaussians, painter.colors(gaussians, camera), camera)
    return draw_vorticity(stepper, state, camera, drawn).numpy()


def picture(folder: str, frames: int = 60) -> Row:
    """Draw ``air.png``: vorticity behind the flag of the shipped scene, two flags in a row, and a plant."""
    simulation = Simulation.from_yaml(ROOT / "configs/sim/flag_in_air.yaml", device="cpu")
    stepper = simulation.stepper
    state = stepper.start()
    for _ in range(frames):
        state, _ = stepper.advance(state)
    made = stepper.air
    assert made is not None
    settings, flow = made.settings, made.flow
    figure, (left, right, last) = subplots(1, 3, figsize=(19, 4.2))
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
    last.imshow(_plant())
    last.set(title="A ficus behind a wall (force: law, still_walls), 6 m/s, after 1.2 s", xticks=[], yticks=[])
    save_figure(figure, Path(folder) / "air.png")
    return {"frames": frames}


def _result(function: Callable[[], Row]) -> Row:
    began = time.perf_counter()
    return {"result": guarded(function), "seconds": time.perf_counter() - began}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The cases whose problem is one of ``only``."""
    result["rows"] = [row for row in result.get("rows", []) if row["problem"] not in options.only]
    for name, parameters, function in cases(options.device):
        if name in options.only:
            yield ("rows", {"problem": name, "parameters": parameters}), partial(_result, function)
    if "picture" in options.only and options.device == "cpu":
        yield ("picture",), partial(picture, options.pictures)


NAMES = list(dict.fromkeys([name for device in ("cpu", "cuda") for name, *_ in cases(device)] + ["picture"]))

CASE = Case(
    "Measure computed air beside exact and published flows and flags, and its speed.",
    rows,
    (names("--only", NAMES, "only these problems"), PICTURES),
    page="air.md",
)
