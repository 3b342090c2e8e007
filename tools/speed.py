"""What ``bench.py speed`` measures: substeps, batches and frames, with their bytes, memory and error; and its page."""

from __future__ import annotations

import gc
import inspect
import json
import math
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import UniformGust, WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.materials import Sand
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState
from gaussian_swaying.simulation.config import build_parser, build_pipeline

Row = dict[str, Any]

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "sim" / "flag.yaml"
DT = 1e-4  # s
CUBE = GridSpec(0.01, (0, 0, 0), (100, 100, 100))
FORMULATIONS = ("total", "updated")
SECTIONS = ("substep", "sand", "batch", "frame")

LIMITS: list[str] = [
    "A substep on a GPU moves a small share of what a copy moves (see the table), so it is not limited by memory"
    " but, it seems, by instructions and the latency of the 27 gathers and 81 sums: the particle kernel needs some"
    " 125 registers a thread, which leave 16 warps to a multiprocessor. Tried: fewer registers (96) and more"
    " (168), both slower for 8 to 32 lanes to a cell; 64 lanes with 128 registers were the fastest where cells are"
    " full, and are taken there.",
    "`total` has no atomics: the sums of each cell are written once, and each node reads those of its 27 cells."
    " In `updated` a segmented scan over the warp leaves one atomic addition for each run of particles in a cell,"
    " node and column. For few particles the pass over all nodes of the grid counts too, and sorting and reading"
    " out every 32 substeps.",
    "Sand: the singular value decomposition by Jacobi rotations. There is one a substep, shared by the return map"
    " and the stress.",
    "Batches: a single small flag already runs from CUDA graphs, so one after the other is fast, while many at"
    " once fill the GPU.",
    "Frames: most of one is simulation, at more time for a substep than a long rollout takes, as a frame's substeps"
    " are their own rollout, which sorts, reads out and looks for the largest speed once. Tried for frames: idle lanes"
    " in the middle of their cell, gusts recorded in the graphs, an energy kernel. In an object of few, crowded cells"
    " (the guitar) one program for a cell was too few to fill the GPU: crowded cells are cut into pieces.",
]
"""What limits the speed, a sentence each: text of the page that is no measurement."""


@dataclass(frozen=True)
class Plan:
    """How much is measured on a device.

    Attributes:
        counts: Particles of the sheets.
        torch_limit: Most particles for which the torch path is timed beside the Triton one.
        exact_limit: Most particles for which the error against float64 is measured.
        sand: Particles of the block of sand.
        scenes: Flags of the batch.
        side: Particles along a side of each of them.
        steps: Substeps of the rollout that is timed, and of the longer one that gives the slope.
        torch_steps: Substeps of the rollout with the torch path.
        warm: Rollouts before the first that is timed; on CUDA one compiles and one records graphs.
        repeats: Rollouts that are timed, and longer ones.
        copy_bytes: Size of the copy [bytes].
        frames: Frames before the first that is timed, and timed ones.
        picture: Its width and height.
        spacing: Distance between the Gaussians of the flag [m].
        dx: Its grid spacings [m]; the goals are those of the first.
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
    """The plan of a kind of device, with other counts (``"5000,20000"``), or all of it small enough for a test."""
    plan = PLANS[kind]
    if quick:
        plan = replace(plan, counts=(64, 400), exact_limit=64, sand=64, scenes=2, side=8, steps=(4, 8))
        plan = replace(plan, torch_steps=2, warm=2, repeats=(2, 2), copy_bytes=2**20)
        plan = replace(plan, frames=(1, 2), picture=(64, 36), spacing=0.025, dx=(0.1,))
    return plan if counts is None else replace(plan, counts=tuple(int(n) for n in counts.split(",")))


# ---- clocks


class Clock:
    """Marks in time; on a GPU events, as its stream gets to them."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.marks: list[Any] = []
        self._wait()

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def mark(self) -> None:
        """Set a mark."""
        if self.device.type == "cuda":
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self.marks.append(event)
        else:
            self.marks.append(time.perf_counter())

    def read(self) -> list[float]:
        """Milliseconds from mark to mark."""
        self._wait()
        pairs = zip(self.marks, self.marks[1:], strict=False)
        return [a.elapsed_time(b) if self.device.type == "cuda" else 1e3 * (b - a) for a, b in pairs]


def spread(samples: list[float], share: float = 1.0) -> dict[str, float]:
    """Median and quartiles of times [ms], each times ``share``."""
    low, median, high = statistics.quantiles(samples, n=4) if len(samples) > 1 else samples * 3
    return {
        "median_ms": share * median,
        "quartile_low_ms": share * low,
        "quartile_high_ms": share * high,
        "repeats": len(samples),
    }


def timed(
    function: Callable[[], Any], device: torch.device, repeats: int, warm: int = 3, share: float = 1.0
) -> dict[str, float]:
    """Milliseconds of a call after warm-up, times ``share``: median and quartiles; on a GPU between events."""
    for _ in range(warm):
        function()
    samples = []
    for _ in range(repeats):
        clock = Clock(device)
        clock.mark()
        function()
        clock.mark()
        samples += clock.read()
    return spread(samples, share)


def copy_bandwidth(size: int, device: torch.device) -> Row:
    """Bytes per second of a copy within the memory of the device, read and written."""
    source = torch.rand(size // 4, device=device)
    target = torch.empty_like(source)
    took = timed(lambda: target.copy_(source), device, 20 if device.type == "cuda" else 7)
    return {"copy_bytes": size, "bytes_per_s": 2 * size / (1e-3 * took["median_ms"])} | took


def _clear() -> None:
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def guarded(function: Callable[[], Row]) -> Row:
    """What the function gives, or ``failed`` with the reason: one case must not cost the others."""
    try:
        return function()
    except Exception as error:
        full = isinstance(error, (torch.OutOfMemoryError, MemoryError)) or "can't allocate memory" in str(error)
        return {"failed": "out of memory" if full else f"{type(error).__name__}: {error}"}
    finally:
        _clear()


class Peak:
    """Most memory that torch's allocator held since the last start, beyond what it held at first; None on a CPU."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        _clear()
        self.before = torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
        self.start()

    def start(self) -> None:
        """Forget the peak so far."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)

    def read(self) -> int | None:
        """The peak [bytes]."""
        return torch.cuda.max_memory_allocated(self.device) - self.before if self.device.type == "cuda" else None


# ---- problems


def sheet(particles: int, device: torch.device) -> MaterialPoints:
    """A square sheet of 0.9 m, level but for a ripple, within a cube of 1 m."""
    side = round(particles**0.5)
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) / side * 0.9 + 0.05
    x, y = (g.reshape(-1) for g in torch.meshgrid(axis, axis, indexing="ij"))
    position = torch.stack([x, y, 0.5 + 0.003 * torch.sin(9 * x)], dim=-1)
    area = (0.9 / side) ** 2
    return MaterialPoints.create(position, volume=area * 0.01, density=50.0, youngs_modulus=5e3, poisson_ratio=0.3)


def block(particles: int, device: torch.device) -> MaterialPoints:
    """A cube of sand: at a million particles it is 0.9 m wide, with fewer smaller, with more denser."""
    side = round(particles ** (1 / 3))
    spacing = 0.9 / max(side, 100)
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) * spacing + 0.05
    position = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    return MaterialPoints.create(
        position, volume=spacing**3, density=1600.0, youngs_modulus=1e6, poisson_ratio=0.3, law=Sand()
    )


def waves(position: Tensor) -> Tensor:
    """A smooth velocity across the sheet, up to 1 m/s, so that what moves is more than round-off."""
    x, y, _ = position.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, zero, torch.sin(2 * math.pi * x) * torch.cos(2 * math.pi * y)], dim=-1)


def wind_load(points: MaterialPoints, winds: WindField | list[WindField]) -> WindForce:
    """Wind on every particle of a sheet, or of many."""
    slope = 0.027 * torch.cos(9 * points.position[..., 0])
    normal = torch.stack([-slope, torch.zeros_like(slope), torch.ones_like(slope)], dim=-1)
    device = points.position.device
    area = (points.volume / 0.01).contiguous()
    return WindForce(AeroForce().to(device), winds, torch.nn.functional.normalize(normal, dim=-1), area)


def wind(number: int, gusts: bool, device: torch.device) -> WindField:
    """A wind, another one for each number."""
    modulations = [UniformGust()] if gusts else []
    return WindField([2.0, 0.0, 1.0 + 0.01 * number], modulations=modulations, seed=number).to(device)


def nodes_in_reach(position: Tensor, dx: float) -> int:
    """Number of grid nodes in the stencil of any particle: those that get mass."""
    low = torch.floor(position.reshape(-1, 3).double() / dx - 0.5).long()
    low = low - low.amin(0)
    shape = [int(n) + 3 for n in low.amax(0)]
    cells = torch.unique((low[:, 0] * shape[1] + low[:, 1]) * shape[2] + low[:, 2])
    steps = [(i * shape[1] + j) * shape[2] + k for i in range(3) for j in range(3) for k in range(3)]
    return len(torch.unique(cells[:, None] + torch.tensor(steps, device=cells.device)))


def fewest_bytes(formulation: str, particles: int, nodes: int, wind: bool = False, plastic: bool = False) -> int:
    """Fewest bytes that a substep in float32 must move through the memory of the device.

    Each input of a particle is read once, each output written once; the fields of the nodes that have mass are read
    once and written once. The end of a substep and the start of the next count as one pass over the particles. Not
    counted are sorting, indices, and the work of the wind, which is one sum.

    ``total``: per particle, rest position, volume and Lamé parameters (6 numbers) are read, and nothing is written; per
    node, displacement and velocity (6) are read and written, and the mass (1) is read.

    ``updated``: per particle, position and deformation gradient (12) are read and written, and mass, volume and Lamé
    parameters (4) are read; velocity and its gradient come from the nodes. Per node, mass and momentum (4) and velocity
    (3) are written and read.

    With wind, normal and area of the patch (4) are read too; with a plastic law, the total deformation gradient (9) is
    read and written too.

    Args:
        formulation: ``total`` or ``updated``.
        particles: Number of particles.
        nodes: Number of nodes that have mass.
        wind: Whether wind acts on the particles.
        plastic: Whether their law is plastic.

    Returns:
        Bytes.
    """
    per_particle = {"total": 6, "updated": 2 * 12 + 4}[formulation] + (4 if wind else 0) + (2 * 9 if plastic else 0)
    per_node = {"total": 2 * 6 + 1, "updated": 2 * (4 + 3)}[formulation]
    return 4 * (particles * per_particle + nodes * per_node)


# ---- measurements


def _double(state: MPMState) -> MPMState:
    values = {f.name: getattr(state, f.name) for f in fields(state)}
    single = {k: v for k, v in values.items() if isinstance(v, Tensor) and v.dtype == torch.float32}
    return state.replace(**{k: v.double() for k, v in single.items()})


def error_of(end: MPMState, solver: MPMSolver, start: MPMState, steps: int, load: WindForce | None) -> Row:
    """Largest difference from the same rollout by the torch path in float64.

    Positions relative to the largest displacement since the start, velocities to the largest velocity.
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
    """Time, bytes, memory and error of substeps: a sheet in wind, or a block of sand without."""
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
    """Flags in different winds: all in one rollout, against a rollout of each, one after the other."""
    steps = plan.steps[0]
    winds = [wind(k, gusts, device) for k in range(plan.scenes)]
    one = sheet(plan.side**2, device)
    many = one.map(lambda t: t.expand(plan.scenes, *t.shape).contiguous())
    results: dict[str, Any] = {}

    def start(points: MaterialPoints) -> tuple[MPMSolver, MPMState]:
        solver = MPMSolver(dx=2 * 0.9 / plan.side, formulation=formulation)
        return solver, solver.init_state(points, waves(points.position))

    together, all_at_rest = start(many)
    load = wind_load(many, winds)

    def batched() -> None:
        results["together"] = together.rollout(all_at_rest, DT, steps, load).position

    single, at_rest = start(one)
    patches = wind_load(one, winds[0])
    loads = [WindForce(patches.aero, w, patches.normal, patches.area) for w in winds]

    def in_turn() -> None:
        results["apart"] = [single.rollout(at_rest, DT, steps, own).position for own in loads]

    row: Row = {"scenes": plan.scenes, "particles": one.count, "substeps": steps}
    row["together"] = timed(batched, device, plan.repeats[0], plan.warm)
    row["apart"] = timed(in_turn, device, plan.repeats[1], 2 if device.type == "cuda" else 1)
    done = plan.scenes * one.count * steps
    for name in ("together", "apart"):
        row[f"{name}_per_s"] = done / (1e-3 * row[name]["median_ms"])
    row["ratio"] = row["together_per_s"] / row["apart_per_s"]
    apart = torch.stack(results["apart"])
    row["difference"] = float((results["together"] - apart).abs().amax() / (apart - one.position).abs().amax())
    return row


def bench_frame(plan: Plan, dx: float, device: torch.device) -> Row:
    """Frames of configs/sim/flag.yaml, from the state of one to the picture of the next on the device."""
    width, height = plan.picture
    arguments = ["--config", str(CONFIG), "--device", device.type, "--solver.dx", str(dx)]
    arguments += ["--scene.generator.init_args.spacing", str(plan.spacing)]
    arguments += ["--camera.init_args.width", str(width), "--camera.init_args.height", str(height)]
    parser = build_parser()
    peak = Peak(device)
    pipeline, _ = build_pipeline(parser, parser.parse_args(arguments))
    state = pipeline.start()
    build_memory = peak.read()
    peak.start()
    parts: list[list[float]] = []
    substeps = []
    for frame in range(1, 1 + sum(plan.frames)):
        clock = Clock(device)
        clock.mark()
        state, health = pipeline.advance(state)
        clock.mark()
        camera = pipeline.camera_at(frame)
        gaussians, colours = pipeline.shade(state, camera)
        clock.mark()
        pipeline.draw(gaussians, colours, camera)
        clock.mark()
        if frame > plan.frames[0]:
            parts.append(clock.read())
            substeps.append(health.substeps)
    row: Row = spread([sum(part) for part in parts])
    names = ("simulation_ms", "shading_ms", "rendering_ms")
    row |= {name: statistics.median(column) for name, column in zip(names, zip(*parts, strict=True), strict=True)}
    row |= {"particles": pipeline.solver.points.count, "width": width, "height": height}
    row |= {"substeps": statistics.median(substeps), "renderer": type(pipeline.renderer).__name__}
    return row | {"memory_bytes": peak.read(), "build_memory_bytes": build_memory}


@torch.inference_mode()
def measure(
    plan: Plan, device: torch.device, result: Row, save: Callable[[Row], None], only: list[str] | None = None
) -> None:
    """Fill ``result`` with the wanted sections and save it after each case; ``partial`` is in it until the last.

    Args:
        plan: How much to measure.
        device: Where.
        result: What is known already; sections that are not wanted stay as they are.
        save: Writes the result.
        only: Which of ``SECTIONS``; all if None.
    """
    begin = time.perf_counter()
    wanted = [name for name in SECTIONS if only is None or name in only]
    result |= {"partial": True, "dt_s": DT, "seconds": 0.0} | {name: [] for name in wanted}
    result["copy"] = copy_bandwidth(plan.copy_bytes, device)
    _clear()
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
    if "batch" in wanted:
        for name in FORMULATIONS:
            for gusts in (False, True):
                known = {"formulation": name, "gusts": gusts}
                case("batch", known, lambda f=name, g=gusts: bench_batch(plan, f, g, device))
    if "frame" in wanted:
        for dx in plan.dx:
            case("frame", {"dx_m": dx, "main": dx == plan.dx[0]}, lambda dx=dx: bench_frame(plan, dx, device))
    del result["partial"]
    save(result)


def write_whole(path: Path, text: str) -> None:
    """Write a file so that there is always a whole one, whenever the process is killed."""
    draft = path.with_name(path.name + ".part")
    draft.write_text(text)
    os.replace(draft, path)


# ---- goals: an H200; times in ms, the second of a pair is the stretch goal

SUBSTEP_GOALS = {
    ("total", 100_000): (0.06, 0.03),
    ("total", 1_000_000): (0.25, 0.12),
    ("updated", 100_000): (0.09, 0.05),
    ("updated", 1_000_000): (0.34, 0.20),
}
SCALING_GOAL = (1.1, 1.0)
SAND_GOAL = (1_000_000, (0.6, 0.4))
BATCH_GOAL = 20.0
FRAME_GOAL = (8.0, 4.0)
MEMORY_GOAL = (0.3, 0.15)  # GiB

Goal = tuple[str, str, bool | None, str, bool | None]
"""Goal, what was measured, whether it was reached (None: not measured), the stretch goal, and whether that was."""


def goals(result: Row) -> list[Goal]:
    """The goals of a recorded run on a GPU; none for a CPU."""
    if result["kind"] != "cuda":
        return []

    def find(section: str, **wanted: Any) -> Row | None:
        matching = [r for r in result.get(section, []) if all(r.get(k) == v for k, v in wanted.items())]
        return matching[0] if matching else None

    def goal(text: str, row: Row | None, key: str, limits: tuple[float, float], unit: str, scale: float = 1.0) -> Goal:
        """At most the first limit, and as a stretch goal the second."""
        text = f"one H200: {text} within {limits[0]:g} {unit}"
        stretch = f"{limits[1]:g} {unit}"
        if row is None or "failed" in row or row.get(key) is None:
            failed = None if row is None or "failed" not in row else False
            return text, "not measured" if row is None else row.get("failed", "-"), failed, stretch, failed
        value = row[key] * scale
        return text, f"{value:.3g} {unit}", value <= limits[0], stretch, value <= limits[1]

    found = []
    for (name, asked), limits in SUBSTEP_GOALS.items():
        row = find("substep", formulation=name, asked=asked)
        found.append(goal(f"substep of {asked:,} particles in wind, `{name}`,", row, "median_ms", limits, "ms"))
    for name in FORMULATIONS:
        one, ten = (find("substep", formulation=name, asked=n) for n in (1_000_000, 10_000_000))
        row = ten if one is not None and "failed" not in one else one
        if one is not None and ten is not None and "failed" not in one | ten:
            row = {"ratio": ten["median_ms"] / one["median_ms"] / 10}
        text = f"substep of 10,000,000 particles in wind, `{name}`, against ten of 1,000,000,"
        found.append(goal(text, row, "ratio", SCALING_GOAL, "times"))
    asked, limits = SAND_GOAL
    found.append(goal(f"substep of {asked:,} particles of sand", find("sand", asked=asked), "median_ms", limits, "ms"))
    for name in FORMULATIONS:
        for gusts in (False, True):
            text = f"one H200: many flags at once, `{name}`, {'gusts' if gusts else 'steady winds'}: throughput"
            text += f" {BATCH_GOAL:g} times that of one after the other"
            row = find("batch", formulation=name, gusts=gusts)
            if row is None or "failed" in row:
                found.append((text, "not measured" if row is None else row["failed"], row and False, "-", None))
            else:
                found.append((text, f"{row['ratio']:.1f} times", row["ratio"] >= BATCH_GOAL, "-", None))
    row = find("frame", main=True)
    what = "frame of a flag of 100,000 Gaussians at 1920x1080"
    found.append(goal(what, row, "median_ms", FRAME_GOAL, "ms"))
    found.append(goal("device memory of such a frame", row, "memory_bytes", MEMORY_GOAL, "GiB", 2**-30))
    return found


# ---- the page


def page(results: list[tuple[str, Row]], pictures: Path) -> list[str]:
    """Lines of the page from the recorded runs, each with the name of its file; draws their plots into a folder."""
    lines = [
        "## Speed of substeps, batches and frames",
        "",
        "Rollouts with `WindForce`, as a user starts them: the time of a substep is that of a whole rollout, with",
        "sorting, wind and the fields of the particles at its end, by the number of its substeps. The slope between it",
        "and a longer one leaves out what a rollout costs once. The sheet starts with waves of 1 m/s; `updated` has a",
        "grid of 100³ nodes. Torch: the same with `transfer: torch`. Memory: the peak of torch's allocator. Error: the",
        "largest difference from the torch path in float64 at the end of the rollout, of positions relative to the",
        "largest displacement, of velocities relative to the largest velocity.",
        "",
        *(inspect.getdoc(fewest_bytes) or "").split("\n\nArgs:")[0].replace("``", "`").splitlines(),
        "",
        "What fits into the caches may be moved faster than the copy.",
        "",
    ]
    for name, result in results:
        lines += _device_lines(name, result, pictures)
    return lines + (["### What limits it", "", *(f"- {line}" for line in LIMITS), ""] if LIMITS else [])


def _device_lines(name: str, result: Row, pictures: Path) -> list[str]:
    stack = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
    lines = [f"### `{name}`: {result['device']}", "", f"{stack}; seed {result['seed']}.", ""]
    if result.get("partial"):
        lines += ["The run was stopped before its end: what follows is a part.", ""]
    if result.get("quick"):
        lines += ["Made with `--quick`: tiny counts, which only show that it runs.", ""]
    copy = result["copy"]
    lines += [
        f"A copy of {copy['copy_bytes'] / 2**20:,.0f} MiB within the memory of the device moves "
        f"{copy['bytes_per_s'] / 1e9:,.0f} GB/s, read and written (median of {copy['repeats']}).",
        "",
    ]
    rows = result.get("substep", []) + [row | {"sand": True} for row in result.get("sand", [])]
    if rows:
        lines += _rollout_lines(rows)
    if any("failed" not in row for row in rows):
        picture = f"speed_{result['kind']}.png"
        _plot(result, pictures / picture)
        lines += [f"![Time and memory of a substep against the number of particles](pictures/{picture})", ""]
    if result.get("batch"):
        lines += _batch_lines(result["batch"])
    if result.get("frame"):
        lines += _frame_lines(result["frame"])
    return lines


def _table(head: list[str], rows: list[tuple[str, Row, Callable[[Row], list[str]]]]) -> list[str]:
    """A table whose first column is a label; a case that failed says so in the second."""
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for label, row, cells in rows:
        failed = [f"failed: {row['failed']}".replace("\n", " ")] if "failed" in row else []
        shown = [label, *(failed + ["-"] * (len(head) - 2) if failed else cells(row))]
        lines.append(f"| {' | '.join(shown)} |")
    return [*lines, ""]


def _rollout_lines(rows: list[Row]) -> list[str]:
    head = ["substep", "kernels", "nodes with mass", "median [ms]", "quartiles [ms]", "slope [ms]", "torch [ms]"]
    head += ["fewest bytes [MB]", "moved [GB/s]", "share of the copy [%]", "of the slope [%]", "memory [MiB]"]
    head += ["error of positions", "of velocities"]

    def cells(row: Row) -> list[str]:
        error, torch_path = row["error"] or {}, row["torch"] or {}
        slope = "-" if row["share_graph"] is None else f"{100 * row['share_graph']:.1f}"
        return [
            row["path"],
            f"{row['nodes']:,}",
            _digits(row["median_ms"]),
            f"{_digits(row['quartile_low_ms'])} to {_digits(row['quartile_high_ms'])}",
            _digits(row["graph_ms"]),
            torch_path.get("failed") or _digits(torch_path.get("median_ms")),
            _digits(row["bytes"] / 1e6),
            _digits(row["bytes_per_s"] / 1e9),
            f"{100 * row['share']:.1f}",
            slope,
            "-" if row["memory_bytes"] is None else f"{row['memory_bytes'] / 2**20:,.0f}",
            *(
                error.get("failed") or ("-" if key not in error else f"{error[key]:.1e}")
                for key in ("position", "velocity")
            ),
        ]

    def label(row: Row) -> str:
        what = "block of sand" if row.get("sand") else "sheet in wind"
        steps = f", {row['substeps']} substeps" if "substeps" in row else ""
        return f"`{row['formulation']}`, {what}, {row.get('particles', row['asked']):,} particles{steps}"

    return _table(head, [(label(row), row, cells) for row in rows])


def _batch_lines(rows: list[Row]) -> list[str]:
    head = ["flags at once", "together [ms]", "one after the other [ms]", "together [10⁶ particle substeps/s]"]
    head += ["one after the other [10⁶/s]", "ratio", "largest difference of positions"]

    def cells(row: Row) -> list[str]:
        times = [_digits(row[name]["median_ms"]) for name in ("together", "apart")]
        rates = [_digits(row[name] / 1e6) for name in ("together_per_s", "apart_per_s")]
        return [*times, *rates, f"{row['ratio']:.1f}", f"{row['difference']:.1e}"]

    def label(row: Row) -> str:
        size = f"{row['scenes']} of {row['particles']:,} particles, " if "scenes" in row else ""
        steps = f", {row['substeps']} substeps" if "substeps" in row else ""
        return f"{size}`{row['formulation']}`, {'gusts' if row['gusts'] else 'steady winds'}{steps}"

    lines = ["Flags in as many winds, in one rollout with a batch dimension, and one rollout after the other:", ""]
    return lines + _table(head, [(label(row), row, cells) for row in rows])


def _frame_lines(rows: list[Row]) -> list[str]:
    head = ["frame of 0.04 s of configs/sim/flag.yaml", "substeps", "median [ms]", "quartiles [ms]", "simulation [ms]"]
    head += ["shading [ms]", "rendering [ms]", "renderer", "memory [GiB]", "memory to build [GiB]"]

    def cells(row: Row) -> list[str]:
        memory = [row["memory_bytes"], row["build_memory_bytes"]]
        return [
            f"{row['substeps']:g}",
            _digits(row["median_ms"]),
            f"{_digits(row['quartile_low_ms'])} to {_digits(row['quartile_high_ms'])}",
            *(_digits(row[name]) for name in ("simulation_ms", "shading_ms", "rendering_ms")),
            row["renderer"],
            *("-" if value is None else f"{value / 2**30:.3f}" for value in memory),
        ]

    def label(row: Row) -> str:
        size = f", {row['particles']:,} Gaussians, {row['width']}x{row['height']}" if "particles" in row else ""
        return f"dx = {row['dx_m']:g} m{size}"

    lines = ["From the state of a frame to the picture of the next, on the device, without files:", ""]
    return lines + _table(head, [(label(row), row, cells) for row in rows])


def _digits(value: float | None) -> str:
    """Three digits, without exponents."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _plot(result: Row, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    sheets = [row for row in result.get("substep", []) if "failed" not in row]
    sand = [row for row in result.get("sand", []) if "failed" not in row]
    with_memory = any(row["memory_bytes"] is not None for row in sheets + sand)
    figure, grid = plt.subplots(
        1, 1 + with_memory, figsize=(6.5 + 5 * with_memory, 5.4), layout="constrained", squeeze=False
    )
    axes = grid[0]

    def draw(axis: Any, rows: list[Row], value: Callable[[Row], float | None], **style: Any) -> None:
        pairs = [(row["particles"], value(row)) for row in rows]
        pairs = sorted((n, v) for n, v in pairs if v is not None and v > 0)
        if pairs:
            axis.loglog(*zip(*pairs, strict=True), **style)

    copy = result["copy"]["bytes_per_s"]
    star = {"color": "tab:brown", "marker": "*", "markersize": 11, "linestyle": "", "label": "updated, sand: rollout"}
    for name, color in (("total", "tab:blue"), ("updated", "tab:orange")):
        rows = sorted((r for r in sheets if r["formulation"] == name), key=lambda r: r["particles"])
        whole = {"color": color, "marker": "o", "label": f"{name}: rollout"}
        draw(axes[0], rows, lambda r: r["median_ms"], **whole)
        low, high = ([row[f"quartile_{end}_ms"] for row in rows] for end in ("low", "high"))
        axes[0].fill_between([row["particles"] for row in rows], low, high, color=color, alpha=0.2, linewidth=0)
        draw(axes[0], rows, lambda r: r["graph_ms"], color=color, linestyle="--", label=f"{name}: slope")
        own = {"color": color, "marker": "s", "markerfacecolor": "none", "linestyle": "-.", "linewidth": 0.8}
        draw(axes[0], rows, lambda r: (r["torch"] or {}).get("median_ms"), **own, label=f"{name}: transfer torch")
        floor = {"color": color, "linestyle": ":", "label": f"{name}: fewest bytes at the copy's bandwidth"}
        draw(axes[0], rows, lambda r: 1e3 * r["bytes"] / copy, **floor)
        if name == "total":  # so that each formulation has its column of the legend
            draw(axes[0], sand, lambda r: r["median_ms"], **star)
        if with_memory:
            draw(axes[1], rows, lambda r: (r["memory_bytes"] or 0) / 2**20, color=color, marker="o")
    axes[0].set_ylabel("time of a substep [ms]")
    if with_memory:
        draw(axes[1], sand, lambda r: (r["memory_bytes"] or 0) / 2**20, **star)
        axes[1].set_ylabel("peak device memory [MiB]")
    for axis in axes:
        axis.set_xlabel("particles N")
        axis.grid(True, which="major", linewidth=0.4, alpha=0.6)
    figure.suptitle(f"{result['device']}, sheet in wind", fontsize=10)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
