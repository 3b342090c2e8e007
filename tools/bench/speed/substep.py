"""Substeps of sheets in wind, of blocks of sand, and of elastic cubes."""

from __future__ import annotations

from functools import partial
from itertools import product

import torch
from torch import Tensor

from bench.runner import Row, study
from bench.speed.timing import CUBE, DT, STEPS, load, sheet, timed, waves, wind
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.colliders import Wall
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints

NUMBERS = {"total": (6, 13), "updated": (28, 14)}
"""How many numbers a substep reads and writes for a point and for a node: each input once, each output once."""


def grid(device: str) -> list[Row]:
    """Sizes that a device can hold."""
    sizes = [5_000, 20_000, 100_000] if device == "cpu" else [2 * 10**4, 10**5, 3 * 10**5, 10**6, 3 * 10**6, 10**7]
    rows: list[Row] = [{"case": "substep", "formulation": f, "asked": n} for n in sizes for f in ("total", "updated")]
    rows.append({"case": "sand", "formulation": "updated", "asked": 20_000 if device == "cpu" else 10**6})
    both = (False, True)
    cubes = product((200_000, 10**6, 4 * 10**6) if device == "cuda" else (), both, both)
    return rows + [{"case": "cube", "asked": n, "turning": turning, "walls": walls} for n, turning, walls in cubes]


def block(points: int, spacing: float, start: float, device: str, **material: object) -> MaterialPoints:
    """A cube of points."""
    axis = (torch.arange(round(points ** (1 / 3)), device=device, dtype=torch.float32) + 0.5) * spacing + start
    position = torch.cartesian_prod(axis, axis, axis)
    return MaterialPoints.create(position, volume=spacing**3, poisson_ratio=0.3, **material)  # type: ignore[arg-type]


def copied_per_s(device: str) -> float:
    """Bytes per second of a copy within device memory, reads and writes."""
    source = torch.rand(2**26 if device == "cpu" else 2**28, device=device)
    target = torch.empty_like(source)
    return 8 * len(source) / (1e-3 * timed(lambda: target.copy_(source), device)["median_ms"])


@study("substep", grid)
@torch.inference_mode()
def substep(
    case: str, asked: int, device: str, formulation: str = "updated", turning: bool = False, walls: bool = False
) -> Row:
    """Time of a substep in a rollout, the slope between it and a longer one, memory, share of a copy's speed."""
    if case == "cube":
        return cube(asked, device, turning, walls)
    sand = {"density": 1600.0, "youngs_modulus": 1e6, "law": Sand()}
    side = max(round(asked ** (1 / 3)), 100)
    points = sheet(asked, device) if case == "substep" else block(asked, 0.9 / side, 0.05, device, **sand)
    force = load(points, wind(0, True, device)) if case == "substep" else None

    def rollout(transfer: str, steps: int) -> Tensor:
        return solvers[transfer].rollout(states[transfer], DT, steps, force).position

    solvers = {name: MPMSolver(dx=CUBE.dx, formulation=formulation, transfer=name) for name in ("auto", "torch")}
    states = {name: solver.init_state(points, waves(points.position)) for name, solver in solvers.items()}
    if formulation == "updated":
        states = {name: state.replace(grid=CUBE) for name, state in states.items()}
    row = {"particles": points.count, "substeps": STEPS, "memory_bytes": None, "torch": None}
    row |= timed(partial(rollout, "auto", STEPS), device, steps=STEPS)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        rollout("auto", STEPS)
        row["memory_bytes"] = torch.cuda.max_memory_allocated()
    longer = timed(partial(rollout, "auto", 3 * STEPS), device)["median_ms"]
    row["graph_ms"] = (longer - STEPS * row["median_ms"]) / (2 * STEPS)
    if device == "cuda" and asked <= 10**6:
        row["torch"] = timed(partial(rollout, "torch", 8), device, 3, 8)
    cells = torch.floor(points.position / CUBE.dx - 0.5).long()
    steps = torch.cartesian_prod(*[torch.arange(3, device=cells.device)] * 3)
    nodes = len(torch.unique(((cells[:, None] + steps) * cells.new_tensor([1, 1000, 10**6])).sum(-1)))
    a_point, a_node = NUMBERS[formulation]
    row["bytes"] = 4 * (points.count * (a_point + (4 if case == "substep" else 18)) + nodes * a_node)
    return row | {"nodes": nodes, "share": row["bytes"] / (1e-3 * row["median_ms"]) / copied_per_s(device)}


def cube(asked: int, device: str, turning: bool, walls: bool) -> Row:
    """An elastic cube with eight points in a cell, at rest or turning, with or without an enclosing box."""
    points = block(asked, 1 / 256, 0.1, device, density=1000.0, youngs_modulus=1e5)
    box = [Wall(Box([0.03] * 3, [1.6] * 3))] if walls else []
    solver = MPMSolver(dx=1 / 128, formulation="updated", boundaries=box, gravity=[0.0, 0.0, 0.0])
    arm = points.position - points.position.mean(0)
    spin = torch.linalg.cross(arm.new_tensor([0.6, 1.0, 2.0]).expand_as(arm), arm)
    state = solver.init_state(points, spin if turning else None, margin=32)
    dt = 0.7 * solver.stable_substep(state)
    return timed(lambda: solver.rollout(state, dt, 96), device, 4, 96) | {"particles": points.count, "substeps": 96}
