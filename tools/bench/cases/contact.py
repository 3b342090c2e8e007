"""``bench.py contact``: what contact costs in a substep, and how close surfaces come in scenes that touch."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor

from bench.case import Case, Measurement, numbers, option
from bench.clock import spread, timed
from bench.problems.contacts import crossings, gaps, sheet_triangles
from bench.record import Row
from gaussian_swaying.mpm.boundaries.half_space import HalfSpaceObstacle
from gaussian_swaying.mpm.contact.surface import Contact, Surface
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState

WIDTH, THICKNESS, PER_CELL = 0.9, 0.005, 2.2
STEPS = 24
"""Substeps of a timed rollout."""

CASES = ("off", "nothing near", "a fifth in contact", "all in contact")
"""Two sheets without contact; with contact, but far from each other; lying on each other by a fifth; and wholly."""


def level(place: Tensor, spacing: float, thickness: float, E: float = 2e4) -> tuple[MaterialPoints, Tensor]:
    """Points of level sheets, and their normals."""
    made = MaterialPoints.create(
        place, volume=spacing**2 * thickness, density=100.0, youngs_modulus=E, poisson_ratio=0.3
    )
    return made, place.new_tensor([0.0, 0.0, 1.0]).expand(made.count, 3)


def sheets(points: int, device: torch.device) -> tuple[MaterialPoints, Tensor]:
    """Two level sheets of half the points each, and their normals; at rest they are 0.5 m apart."""
    side = round((points / 2) ** 0.5)
    spacing = WIDTH / side
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) * spacing
    place = torch.cartesian_prod(axis, axis, torch.tensor([0.0, 0.5], device=device))
    return level(place[place[:, 2].argsort(stable=True)].contiguous(), spacing, THICKNESS, 5e3)


def prepare(
    points: int, case: str, device: torch.device, iterations: int = Contact.iterations
) -> tuple[MPMSolver, MPMState, float]:
    """A solver, the state from which a rollout is timed, and its substep [s]."""
    made, normal = sheets(points, device)
    spacing = WIDTH / round((points / 2) ** 0.5)
    contact = None if case == "off" else Contact(thickness=THICKNESS, iterations=iterations)
    surface = None if contact is None else Surface.of_points(made, normal, spacing, THICKNESS, contact)
    solver = MPMSolver(dx=PER_CELL * spacing, gravity=(0.0, 0.0, 0.0))
    state = solver.init_state(made, surface=surface)
    if case in CASES[2:]:  # the upper one just above the lower one, and falling onto it
        nodes = state.grid.node_positions(made.position)
        upper = (nodes[:, 2] > 0.25).to(nodes)
        moved, velocity = torch.zeros_like(nodes), torch.zeros_like(nodes)
        moved[:, 2] = upper * (THICKNESS - 0.5)
        moved[:, 0] = upper * (0.8 * WIDTH if case == CASES[2] else 0.0)
        velocity[:, 2] = -0.5 * upper
        state = solver.bound.read_particles(state, moved, velocity)  # type: ignore[attr-defined]
    return solver, state, solver.stable_substep() * 0.4


@torch.inference_mode()
def cost(points: int, case: str, device: torch.device, repeats: int, iterations: int = Contact.iterations) -> Row:
    """Milliseconds of a substep (on a CPU those of the processor), and the pairs that are listed."""
    solver, state, dt = prepare(points, case, device, iterations)
    roll = partial(solver.rollout, state, dt, STEPS)
    if device.type == "cuda":
        row = timed(roll, device, repeats, warm=3, share=1 / STEPS)  # the first makes room, the second records
    else:  # time of the processor, so that other work on the machine does not count
        roll()
        marks = [time.process_time()]
        for _ in range(repeats):
            roll()
            marks.append(time.process_time())
        row = spread([1e3 * (b - a) for a, b in pairwise(marks)], 1 / STEPS)
    return {"points": solver.points.count, "case": case, "pairs": listed(solver), **row}


def listed(solver: MPMSolver) -> int:
    """How many pairs of places are listed."""
    stage, fused = solver.bound.contact, solver.fused()  # type: ignore[attr-defined]
    if stage is None:
        return 0
    if fused is not None:
        return fused.touching.pairs  # type: ignore[attr-defined]
    return 0 if stage.lists is None else len(stage.lists.first)


@torch.inference_mode()
def collision(
    speed: float, device: torch.device, points: int = 900, frames: int = 30, iterations: int = Contact.iterations
) -> Row:
    """A small sheet that flies onto a larger one: the gaps of all frames, and what crosses."""
    side = round(points**0.5)
    spacing = WIDTH / side
    axis = torch.arange(side, device=device, dtype=torch.float32) * spacing
    few = axis[: 2 * side // 3]
    low = torch.cartesian_prod(axis, axis, torch.zeros(1, device=device))
    high = torch.cartesian_prod(few + 0.13 * WIDTH, few + 0.11 * WIDTH, torch.full((1,), 5 * spacing, device=device))
    thickness = 0.5 * spacing
    made, normal = level(torch.cat([low, high]), spacing, thickness)
    velocity = torch.zeros_like(made.position)
    velocity[len(low) :] = speed * torch.tensor([0.3, 0.0, -1.0], device=device)
    solver = MPMSolver(dx=PER_CELL * spacing, gravity=(0.0, 0.0, 0.0))
    state = solver.init_state(
        made, velocity, surface=Surface.of_points(made, normal, spacing, thickness, Contact(iterations=iterations))
    )
    momentum = solver.momenta(state)["linear"].double()
    triangles = torch.cat([sheet_triangles(side, side), sheet_triangles(len(few), len(few), len(low))])
    frame, shares, crossed = 25 * spacing / speed / frames, [], 0
    for _ in range(frames):
        steps = solver.substeps(state, frame)
        state = solver.rollout(state, frame / steps, steps)
        shares.append(gaps(solver.bound.contact, state).cpu())  # type: ignore[attr-defined]
        crossed += crossings(state.position, triangles)
    found = torch.cat(shares)
    change = solver.momenta(state)["linear"].double() - momentum
    return {
        "speed_m_s": speed,
        "points": made.count,
        "frames": frames,
        "pairs": len(found),
        "closest": float(found.amin()),
        "closer_than_half": float((found < 0.5).double().mean()),
        "crossings": crossed,
        "momentum_change": float(change.norm() / momentum.norm()),
    }


@torch.inference_mode()
def pile(
    seconds: float,
    device: torch.device,
    layers: int = 8,
    per_side: int = 5,
    iterations: int = Contact.iterations,
) -> list[Row]:
    """Layers that lie on each other and on the ground, shifted by some millimetres: what moves, each second.

    Energies are in units of the weight times a thickness, ``top`` is the height of the uppermost layer in thicknesses,
    ``slid`` its mean place along x [m], and ``rounds`` the iterations of a substep, where the kernels count them;
    ``closest`` and ``gap`` are the least and the mean distance of layers in thicknesses, ``fastest`` a speed [m/s].
    """
    spacing, thickness = 0.02, 0.01
    axis = torch.arange(per_side, device=device, dtype=torch.float32) * spacing
    low = [torch.tensor([0.003 * (k % 3), 0.002 * (k % 2), 0.2 * k], device=device) for k in range(layers)]
    flat = torch.cartesian_prod(axis, axis, torch.zeros(1, device=device))
    made, normal = level(torch.cat([flat + corner for corner in low]), spacing, thickness)
    ground = HalfSpaceObstacle([0.0, 0.0, -0.5 * thickness], [0.0, 0.0, 1.0])
    solver = MPMSolver(dx=2.2 * spacing, gravity=(0.0, 0.0, -9.8), boundaries=[ground], stiffness_damping=1e-3)
    state = solver.init_state(
        made, surface=Surface.of_points(made, normal, spacing, thickness, Contact(iterations=iterations))
    )
    nodes = state.grid.node_positions(state.position)
    layer = ((nodes[:, 2] + 0.1) / 0.2).floor().clamp(0, layers - 1)
    moved = torch.zeros_like(nodes)
    moved[:, 2] = layer * (thickness - 0.2)  # apart at rest, so that no layer is the neighbour of another one
    state = solver.bound.read_particles(state, moved, torch.zeros_like(moved))  # type: ignore[attr-defined]
    weight = float(solver.points.mass.sum()) * 9.8
    rows: list[Row] = []
    for second in range(round(seconds)):
        fused = solver.fused()
        before = 0 if fused is None else fused.touching.rounds  # type: ignore[attr-defined]
        count = solver.substeps(state, 0.1) * 10
        state = solver.rollout(state, 1.0 / count, count)
        energy = {name: float(value) / (weight * thickness) for name, value in solver.energies(state).items()}
        top = state.position[-(per_side**2) :].mean(0)
        row = {"time": second + 1.0, **{name: energy[name] for name in ("kinetic", "elastic", "potential")}}
        between = gaps(solver.bound.contact, state)  # type: ignore[attr-defined]
        row |= {"closest": float(between.amin()), "gap": float(between.mean())}
        row |= {"fastest": float(state.velocity.norm(dim=-1).amax())}
        rows.append(row | {"top": float(top[2]) / thickness, "slid": float(top[0])})
        if fused is not None:
            rows[-1]["rounds"] = (fused.touching.rounds - before) / count  # type: ignore[attr-defined]
    return rows


@torch.inference_mode()
def slide(degrees: float, device: torch.device, iterations: int, seconds: float = 0.5, friction: float = 0.3) -> float:
    """The speed that a sheet has on a slope after a time, in units of what Coulomb's law gives a sheet that slides."""
    spacing, thickness, tilt = 0.02, 0.01, math.radians(degrees)
    axis = torch.arange(12, device=device, dtype=torch.float32) * spacing
    made, normal = level(torch.cartesian_prod(axis, axis, torch.zeros(1, device=device)), spacing, thickness)
    ground = HalfSpaceObstacle([0.0, 0.0, -0.5 * thickness], [0.0, 0.0, 1.0], friction=friction)
    gravity = (9.8 * math.sin(tilt), 0.0, -9.8 * math.cos(tilt))
    solver = MPMSolver(dx=2.2 * spacing, gravity=gravity, boundaries=[ground])
    touching = Contact(iterations=iterations)
    state = solver.init_state(made, surface=Surface.of_points(made, normal, spacing, thickness, touching))
    count = solver.substeps(state, seconds)
    state = solver.rollout(state, seconds / count, count)
    return float(state.velocity[:, 0].mean()) / (seconds * 9.8 * (math.sin(tilt) - friction * math.cos(tilt)))


def effort(iterations: int, device: torch.device, repeats: int) -> Row:
    """How close surfaces come, how a pile rests and what it costs with at most so many iterations in a substep."""
    points = 100_000 if device.type == "cuda" else 10_000
    times = {case: cost(points, case, device, repeats, iterations)["median_ms"] for case in CASES}
    return {
        "iterations": iterations,
        "points": points,
        "ratio": {case: times[case] / times["off"] for case in CASES[1:]},
        "collisions": {f"{speed:g}": collision(speed, device, iterations=iterations) for speed in (2.0, 50.0)},
        "pile": pile(3.0, device, iterations=iterations)[-1],
        "sliding_error": slide(20.0, device, iterations) - 1,
    }


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The cost of each case, the collisions, the pile, and all of them with few iterations."""
    device = torch.device(options.device)
    sizes = [10_000, 100_000, 1_000_000][: 3 if device.type == "cuda" else 2]
    for points in sizes if options.points is None else options.points:
        for case in CASES:
            yield ("rows", {"wanted": points, "case": case}), partial(cost, points, case, device, options.repeats)
    for speed in options.speeds:
        yield ("collisions", {"speed_m_s": speed}), partial(collision, speed, device)
    for row in pile(options.pile, device) if options.pile else ():
        yield ("pile", {"time": row["time"]}), row.copy
    for count in options.effort:
        yield ("effort", {"iterations": count}), partial(effort, count, device, options.repeats)


CASE = Case(
    "Measure what contact costs, and how close surfaces come.",
    rows,
    (
        numbers("--points", "of both sheets; 10000,100000 and, on a GPU, 1000000 if left out, none if empty"),
        option("--repeats", "timed rollouts of each case (default: %(default)s)", type=int, default=5),
        numbers("--speeds", "of the collisions [m/s]", float, "2,50"),
        option("--pile", "seconds that eight layers rest (default: %(default)g)", type=float, default=0.0),
        numbers("--effort", "most iterations, each of which is measured (default: none)", int, ""),
    ),
    page="contact.md",
)
