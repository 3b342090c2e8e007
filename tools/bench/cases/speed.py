"""What ``bench.py speed`` measures: substeps, batches and frames, with their bytes, memory and error."""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench import record, stamps
from bench.clock import Clock, Peak, clear, copy_bandwidth, guarded, spread, timed
from bench.scenes import CUBE, block, cube, fewest_bytes, nodes_in_reach, sheet, spin, waves, wind, wind_load
from gaussian_swaying.aero.wind_batch import WindBatch
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.simulation.frame import frames_from
from gaussian_swaying.simulation.simulation import Simulation

Row = dict[str, Any]

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
        repeats=(3, 1),
    ),
}


def plan_for(kind: str, counts: str | None = None, quick: bool = False) -> Plan:
    """The plan for a kind of device; with other counts (``"5000,20000"``), or small enough for a test."""
    plan = PLANS[kind]
    if quick:
        plan = replace(plan, counts=(64, 400), exact_limit=64, sand=64, scenes=2, side=8, steps=(4, 8))
        plan = replace(plan, torch_steps=2, warm=2, repeats=(2, 2), copy_bytes=2**20)
        plan = replace(
            plan,
            frames=(1, 2),
            picture=(64, 36),
            spacing=0.025,
            dx=(0.1,),
            cubes=(1000,),
            cube_steps=4,
            small=False,
            large=None,
        )
    return plan if counts is None else replace(plan, counts=tuple(int(n) for n in counts.split(",")))


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
    row["path"] = "torch" if solver.fused() is None else "triton"
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


def bench_cube(plan: Plan, asked: int, walls: bool, turning: bool, device: torch.device) -> Row:
    """Substeps of an elastic cube in `updated`, from rest or turning, with or without an enclosing box."""
    points = cube(asked, device)
    box = [EnclosingBox([0.03] * 3, [1.6] * 3)] if walls else []
    solver = MPMSolver(dx=1 / 128, formulation="updated", boundaries=box)
    start = solver.init_state(points, spin(points.position) if turning else None, margin=24)
    dt, steps = 0.7 * solver.stable_substep(start), plan.cube_steps
    state = start

    def go() -> None:
        nonlocal state
        state = solver.rollout(state, dt, steps)

    row: Row = timed(go, device, 4, plan.warm, 1 / steps)
    return row | {"particles": points.count, "substeps": steps, "grid_nodes": state.grid.node_count}


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


@torch.inference_mode()
def measure(
    plan: Plan, device: torch.device, result: Row, save: Callable[[Row], None], only: list[str] | None = None
) -> None:
    """Fill ``result`` with the wanted sections and save it after each case; its key ``partial`` goes at the end.

    Args:
        plan: How much to measure.
        device: Where to measure.
        result: The record so far; sections that are not wanted stay as they are.
        save: Writes the result.
        only: Which of ``SECTIONS``; all if None.
    """
    begin = time.perf_counter()
    wanted = [name for name in SECTIONS if only is None or name in only]
    result |= {"partial": True, "dt_s": DT, "seconds": 0.0} | {name: [] for name in wanted}
    result["copy"] = copy_bandwidth(plan.copy_bytes, device)
    clear()
    copy = result["copy"]["bytes_per_s"]
    print(f"copy: {copy / 1e9:.1f} GB/s", flush=True)
    save(result)

    def case(section: str, known: Row, function: Callable[[], Row]) -> None:
        row = known | guarded(function)
        result[section].append(row)
        result["seconds"] = time.perf_counter() - begin
        save(result)
        print(f"{result['seconds']:.0f} s, {section}: {json.dumps(row)}", flush=True)

    if "substep" in wanted:
        for asked in plan.counts:
            for name in FORMULATIONS:
                known = {"formulation": name, "asked": asked}
                case("substep", known, lambda a=asked, f=name: bench_rollout(plan, a, f, device, copy, sand=False))
    if "sand" in wanted:
        known = {"formulation": "updated", "asked": plan.sand}
        case("sand", known, lambda: bench_rollout(plan, plan.sand, "updated", device, copy, sand=True))
    if "cube" in wanted:
        for asked in plan.cubes:
            for turning in (False, True):
                for walls in (False, True):
                    known = {"asked": asked, "turning": turning, "walls": walls}
                    case("cube", known, lambda a=asked, w=walls, t=turning: bench_cube(plan, a, w, t, device))
    if "batch" in wanted:
        for name in FORMULATIONS:
            for gusts in (False, True):
                known = {"formulation": name, "gusts": gusts}
                case("batch", known, lambda f=name, g=gusts: bench_batch(plan, f, g, device))
    if "frame" in wanted:
        for dx in plan.dx:
            case("frame", {"dx_m": dx, "main": dx == plan.dx[0]}, lambda dx=dx: bench_frame(plan, dx, device))
        if plan.small:
            case("frame", {"small": True}, lambda: bench_frame(plan, None, device))
    if "large" in wanted and plan.large is not None:
        case("large", {"dx_m": plan.dx[0]}, lambda: bench_frame(plan, plan.dx[0], device, plan.large))
    del result["partial"]
    save(result)


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py speed``."""
    command.add_argument("--counts", help="particles of the sheets, separated by commas")
    command.add_argument("--only", help=f"some of {', '.join(SECTIONS)}, separated by commas")
    command.add_argument("--quick", action="store_true", help="tiny counts, only to see that it runs")


def run(options: argparse.Namespace) -> None:
    """Measure rollouts of many sizes, sand, batches and frames, with memory and error."""
    device, result = record.start(options.device)
    result["kind"], result["threads"], result["quick"] = device.type, torch.get_num_threads(), options.quick
    folder = Path(options.results)
    if options.quick and folder.resolve() == record.RESULTS:
        raise SystemExit("--quick measures nothing worth keeping: choose another folder with --results")
    name = f"speed_{device.type}"
    path = folder / f"{name}.json"
    only = record.chosen("--only", options.only, SECTIONS) if options.only else None
    if only and path.exists():
        kept = json.loads(path.read_text())
        if kept["device"] == result["device"]:
            result |= {section: kept[section] for section in SECTIONS if section in kept and section not in only}
            result["measured"] = stamps.kept(kept, result)
    plan = plan_for(device.type, options.counts, options.quick)
    measure(plan, device, result, lambda now: record.write(folder, name, now, quiet=True), only)
    print(f"wrote {path}")
