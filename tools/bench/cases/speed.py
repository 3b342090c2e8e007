"""What ``bench.py speed`` measures: substeps, batches and frames, with their bytes, memory and error."""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench import record
from bench.case import Case, Measurement, chosen, numbers, option
from bench.clock import Clock, Peak, clear, copy_bandwidth, guarded, safely, spread, timed
from bench.record import Row
from bench.scenes import CUBE, block, cube, fewest_bytes, nodes_in_reach, sheet, spin, waves, wind, wind_load
from gaussian_swaying.aero.wind_batch import WindBatch
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.simulation.frame import frames_from
from gaussian_swaying.simulation.simulation import Simulation

CONFIG = record.ROOT / "configs" / "sim" / "flag.yaml"
DT = 1e-4  # s
FORMULATIONS = ("total", "updated")
SECTIONS = ("substep", "sand", "cube", "batch", "frame", "large")


@dataclass(frozen=True)
class Plan:
    """How much to measure on a device.

    Attributes:
        counts: Particles of the sheets.
        torch_limit: Most particles for which the torch path is timed as well as the Triton path.
        exact_limit: Most particles for which the error against float64 is measured.
        sand: Particles of the block of sand.
        cubes: Points of elastic cubes.
        cube_steps: Substeps of the timed rollout of a cube.
        scenes: Flags of the batch.
        side: Particles along a side of each of them.
        steps: Substeps of the timed rollout, and of the longer one that gives the slope.
        torch_steps: Substeps of the rollout with the torch path.
        warm: Rollouts before the first timed one; on CUDA, one compiles and one records graphs.
        repeats: Number of timed rollouts, and of longer ones.
        copy_bytes: Size of the copy [bytes].
        frames: Frames before the first timed one, and timed frames.
        picture: Width and height of the picture.
        spacing: Distance between the Gaussians of the flag [m].
        dx: Grid spacings of the flag [m]; the goals are for the first.
        small: Whether frames of the flag as it is configured are measured, too.
        large: Distance between the Gaussians of a larger flag [m], with the first of ``dx``; None for no such flag.
    """

    counts: tuple[int, ...]
    torch_limit: int
    exact_limit: int
    sand: int
    scenes: int
    copy_bytes: int
    picture: tuple[int, int]
    spacing: float
    dx: tuple[float, ...]
    cubes: tuple[int, ...] = ()
    cube_steps: int = 96
    small: bool = False
    large: float | None = None
    side: int = 64
    steps: tuple[int, int] = (64, 192)
    torch_steps: int = 8
    warm: int = 3
    repeats: tuple[int, int] = (7, 5)
    frames: tuple[int, int] = (5, 25)


PLANS = {
    "cuda": Plan(
        counts=(20_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000),
        torch_limit=1_000_000,
        exact_limit=1_000_000,
        sand=1_000_000,
        scenes=64,
        copy_bytes=2**30,
        picture=(1920, 1080),
        spacing=0.0031,
        dx=(0.0125, 0.025, 0.00625),
        cubes=(200_000, 1_000_000, 4_000_000),
        small=True,
        large=0.00098,
    ),
    "cpu": Plan(
        counts=(5_000, 20_000, 100_000),
        torch_limit=0,
        exact_limit=20_000,
        sand=20_000,
        scenes=4,
        copy_bytes=2**28,
        picture=(480, 270),
        spacing=0.0125,
        dx=(0.025, 0.05, 0.0125),
        warm=1,
        repeats=(9, 3),
    ),
}


def plan_for(kind: str, counts: list[int] | None = None, quick: bool = False) -> Plan:
    """The plan for a kind of device; with other counts, or small enough for a test."""
    plan = PLANS[kind]
    if quick:
        plan = replace(plan, counts=(64, 400), exact_limit=64, sand=64, scenes=2, side=8, steps=(4, 8))
        plan = replace(plan, torch_steps=2, warm=2, repeats=(2, 2), copy_bytes=2**20)
        plan = replace(plan, frames=(1, 2), picture=(64, 36), spacing=0.025, dx=(0.1,), cubes=(1000,), cube_steps=4)
        plan = replace(plan, small=False, large=None)
    return plan if counts is None else replace(plan, counts=tuple(counts))


def _double(state: MPMState) -> MPMState:
    values = {f.name: getattr(state, f.name) for f in fields(state)}
    single = {k: v for k, v in values.items() if isinstance(v, Tensor) and v.dtype == torch.float32}
    return state.replace(**{k: v.double() for k, v in single.items()})


def error_of(end: MPMState, solver: MPMSolver, start: MPMState, steps: int, load: WindForce | None) -> Row:
    """Largest difference from the same rollout with the torch path in float64.

    Positions are relative to the largest displacement since the start, velocities to the largest velocity.
    """
    exact = MPMSolver(dx=solver.dx, formulation=solver.formulation, transfer="torch")
    exact.init_state(solver.points.map(Tensor.double))
    if load is not None:
        load = WindForce(load.aero, load.wind, load.normal.double(), load.area.double())
    true = exact.rollout(_double(start), DT, steps, load)
    position = (end.position - true.position).abs().amax() / (true.position - start.position).abs().amax()
    velocity = (end.velocity - true.velocity).abs().amax() / true.velocity.abs().amax()
    found = {"position": float(position), "velocity": float(velocity)}
    if not all(math.isfinite(value) for value in found.values()):
        raise FloatingPointError("the rollout is not finite")
    return found


@torch.inference_mode()
def bench_rollout(plan: Plan, asked: int, formulation: str, device: torch.device, copy: float, sand: bool) -> Row:
    """Time, bytes, memory and error of substeps: a sheet in wind, or a block of sand without wind."""
    peak = Peak(device)
    points = (block if sand else sheet)(asked, device)
    load = None if sand else wind_load(points, wind(0, True, device))

    def start(transfer: str) -> tuple[MPMSolver, MPMState]:
        solver = MPMSolver(dx=CUBE.dx, formulation=formulation, transfer=transfer)
        state = solver.init_state(points, waves(points.position))
        return solver, state.replace(grid=CUBE) if formulation == "updated" else state

    solver, state = start("auto")
    steps, longer = plan.steps
    for _ in range(plan.warm):
        solver.rollout(state, DT, steps, load)
    peak.start()
    row: Row = timed(lambda: solver.rollout(state, DT, steps, load), device, plan.repeats[0], 0, 1 / steps)
    row["memory_bytes"] = peak.read()
    slow = timed(lambda: solver.rollout(state, DT, longer, load), device, plan.repeats[1], 1)
    row["graph_ms"] = (slow["median_ms"] - steps * row["median_ms"]) / (longer - steps)
    row |= {"particles": points.count, "grid_nodes": state.grid.node_count, "substeps": steps}
    compiler = "triton" if solver.points.position.is_cuda else "kernels"
    row["path"] = "torch" if solver.fused() is None else compiler
    row["nodes"] = nodes_in_reach(points.position, CUBE.dx)
    row["bytes"] = fewest_bytes(formulation, points.count, row["nodes"], wind=not sand, plastic=sand)
    row["bytes_per_s"] = row["bytes"] / (1e-3 * row["median_ms"])
    row["share"] = row["bytes_per_s"] / copy
    row["share_graph"] = row["bytes"] / (1e-3 * row["graph_ms"]) / copy if row["graph_ms"] > 0 else None
    row["error"] = row["torch"] = None
    if asked <= plan.exact_limit:
        end = solver.rollout(state, DT, steps, load)
        row["error"] = guarded(lambda: error_of(end, solver, state, steps, load))
    if asked <= plan.torch_limit:
        row["torch"] = guarded(lambda: _torch_path(plan, *start("torch"), load, device))
    return row


def _torch_path(plan: Plan, solver: MPMSolver, state: MPMState, load: WindForce | None, device: torch.device) -> Row:
    """Time of a substep with ``transfer: torch``."""
    few = plan.torch_steps
    return timed(lambda: solver.rollout(state, DT, few, load), device, 3, 2, 1 / few) | {"substeps": few}


@torch.inference_mode()
def bench_batch(plan: Plan, formulation: str, gusts: bool, device: torch.device) -> Row:
    """Flags in different winds: all in one rollout, one rollout after another, and one flag with as many particles."""
    steps = plan.steps[0]
    winds = [wind(k, gusts, device) for k in range(plan.scenes)]
    one = sheet(plan.side**2, device)
    many = one.map(lambda t: t.expand(plan.scenes, *t.shape).contiguous())
    results: dict[str, Any] = {}

    def start(points: MaterialPoints) -> tuple[MPMSolver, MPMState]:
        solver = MPMSolver(dx=2 * 0.9 / plan.side, formulation=formulation)
        return solver, solver.init_state(points, waves(points.position))

    together, all_at_rest = start(many)
    load = wind_load(many, WindBatch(winds))

    def batched() -> None:
        results["together"] = together.rollout(all_at_rest, DT, steps, load).position

    single, at_rest = start(one)
    patches = wind_load(one, winds[0])
    loads = [WindForce(patches.aero, w, patches.normal, patches.area) for w in winds]

    def in_turn() -> None:
        results["apart"] = [single.rollout(at_rest, DT, steps, own).position for own in loads]

    wide = sheet(one.count * plan.scenes, device, 0.9 * plan.scenes**0.5)
    large, large_at_rest = start(wide)
    over_it = wind_load(wide, winds[0])
    row: Row = {"scenes": plan.scenes, "particles": one.count, "substeps": steps}
    row["together"] = timed(batched, device, plan.repeats[0], plan.warm)
    row["large"] = timed(lambda: large.rollout(large_at_rest, DT, steps, over_it), device, plan.repeats[0], plan.warm)
    row["apart"] = timed(in_turn, device, plan.repeats[1], 2 if device.type == "cuda" else 1)
    done = plan.scenes * one.count * steps
    for name in ("together", "large", "apart"):
        row[f"{name}_per_s"] = done / (1e-3 * row[name]["median_ms"])
    row["ratio"] = row["together_per_s"] / row["apart_per_s"]
    row["share"] = row["together_per_s"] / row["large_per_s"]
    apart = torch.stack(results["apart"])
    row["difference"] = float((results["together"] - apart).abs().amax() / (apart - one.position).abs().amax())
    return row


@torch.inference_mode()
def bench_cube(plan: Plan, asked: int, walls: bool, turning: bool, device: torch.device) -> Row:
    """Substeps of an elastic cube in `updated`, from rest or turning, with or without an enclosing box."""
    points = cube(asked, device)
    box = [EnclosingBox([0.03] * 3, [1.6] * 3)] if walls else []
    # without gravity, in which it would fall out of its grid within the timed rollouts
    solver = MPMSolver(dx=1 / 128, formulation="updated", boundaries=box, gravity=[0.0, 0.0, 0.0])
    start = solver.init_state(points, spin(points.position) if turning else None, margin=32)
    dt, steps = 0.7 * solver.stable_substep(start), plan.cube_steps
    state = start

    def go() -> None:
        nonlocal state
        state = solver.rollout(state, dt, steps)

    row: Row = timed(go, device, 4, plan.warm, 1 / steps)
    return row | {"particles": points.count, "substeps": steps, "grid_nodes": state.grid.node_count}


@torch.inference_mode()
def bench_frame(plan: Plan, dx: float | None, device: torch.device, spacing: float | None = None) -> Row:
    """Frames of configs/sim/flag.yaml: from the state of one frame to the picture of the next, on the device.

    On a GPU, a run draws a frame while it simulates the next one, and so do these. The parts are measured one after
    the other, afterwards. Without ``dx`` the flag is as it is configured. ``spacing`` [m] replaces that of the plan.
    """
    arguments = ["--config", str(CONFIG), "--device", device.type]
    if dx is not None:
        arguments += ["--solver.dx", str(dx), "--scene.generator.init_args.spacing", str(spacing or plan.spacing)]
        for name, size in zip(("width", "height"), plan.picture, strict=True):
            arguments += [f"--camera.init_args.{name}", str(size)]
    parser = Simulation.parser()
    peak = Peak(device)
    with torch.inference_mode(False):  # as a user makes it: what inference tensors hold cannot be foreseen
        simulation = Simulation.from_settings(parser, parser.parse_args(arguments))
    painter = simulation.painter
    state = simulation.start()
    build_memory = peak.read()
    peak.start()
    drawn = torch.cuda.Stream(device) if device.type == "cuda" else None
    warm, count = plan.frames
    samples, substeps = [], []
    begin = time.perf_counter()
    for frame in frames_from(simulation.painter, simulation.editor, state, 0, 1 + warm + count, drawn):
        with torch.cuda.stream(drawn):
            painter.render(frame.state, frame.index)
        now = time.perf_counter()
        if frame.index > warm:
            samples.append(1e3 * (now - begin))
            substeps.append(frame.health.substeps)
        begin, state = now, frame.state
    parts: list[list[float]] = []
    for index in range(max(count // 3, 2)):
        clock = Clock(device)
        clock.mark()
        state, _ = simulation.advance(state)
        clock.mark()
        camera = painter.camera_at(index)
        gaussians = painter.deformed(state)
        colours = painter.colors(gaussians, camera)
        clock.mark()
        painter.draw(gaussians, colours, camera)
        clock.mark()
        parts.append(clock.read())
    row: Row = spread(samples)
    names = ("simulation_ms", "shading_ms", "rendering_ms")
    row |= {name: statistics.median(column) for name, column in zip(names, zip(*parts, strict=True), strict=True)}
    row |= {"particles": len(simulation.scene.simulated), "points": simulation.scene.points.count}
    row |= {"width": camera.width, "height": camera.height}
    row["substep_ms"] = row["simulation_ms"] / statistics.median(substeps)
    row |= {"substeps": statistics.median(substeps), "renderer": type(painter.renderer).__name__}
    return row | {"memory_bytes": peak.read(), "build_memory_bytes": build_memory, "dx_m": simulation.solver.dx}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The wanted sections; the others stay as they are, and ``partial`` says whether all was measured."""
    if options.quick and Path(options.results).resolve() == record.RESULTS:
        raise SystemExit("--quick measures nothing worth keeping: choose another folder with --results")
    begin, device = time.perf_counter(), torch.device(options.device)
    wanted = SECTIONS if options.only is None else chosen("--only", SECTIONS, options.only)
    plan = plan_for(device.type, options.counts, options.quick)
    result |= {"kind": device.type, "threads": torch.get_num_threads(), "quick": options.quick}
    result |= {"partial": True, "dt_s": DT, "seconds": 0.0} | {name: [] for name in wanted}
    yield ("copy",), lambda: copy_bandwidth(plan.copy_bytes, device)
    clear()
    for section, known, work in _sections(plan, device, result["copy"]["bytes_per_s"]):
        if section in wanted:
            yield (section, known), work
            result["seconds"] = time.perf_counter() - begin
    result["partial"] = False


def _sections(plan: Plan, device: torch.device, copy: float) -> Iterator[tuple[str, Row, Callable[[], Row]]]:
    """Each case of each section: what it is known by, and its measurement."""
    for asked in plan.counts:
        for name in FORMULATIONS:
            work = safely(bench_rollout, plan, asked, name, device, copy, sand=False)
            yield "substep", {"formulation": name, "asked": asked}, work
    work = safely(bench_rollout, plan, plan.sand, "updated", device, copy, sand=True)
    yield "sand", {"formulation": "updated", "asked": plan.sand}, work
    for asked in plan.cubes:
        for turning in (False, True):
            for walls in (False, True):
                known = {"asked": asked, "turning": turning, "walls": walls}
                yield "cube", known, safely(bench_cube, plan, asked, walls, turning, device)
    for name in FORMULATIONS:
        for gusts in (False, True):
            yield "batch", {"formulation": name, "gusts": gusts}, safely(bench_batch, plan, name, gusts, device)
    for dx in plan.dx:
        yield "frame", {"dx_m": dx, "main": dx == plan.dx[0]}, safely(bench_frame, plan, dx, device)
    if plan.small:
        yield "frame", {"small": True}, safely(bench_frame, plan, None, device)
    if plan.large is not None:
        yield "large", {"dx_m": plan.dx[0]}, safely(bench_frame, plan, plan.dx[0], device, plan.large)


CASE = Case(
    "Measure rollouts of many sizes, sand, batches and frames, with memory and error.",
    rows,
    (
        numbers("--counts", "particles of the sheets"),
        option("--only", f"some of {', '.join(SECTIONS)}, separated by commas"),
        option("--quick", "tiny counts, only to see that it runs", action="store_true"),
    ),
)
