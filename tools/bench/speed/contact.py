"""Substeps of two sheets without contact, with contact but far apart, and lying on each other."""

from __future__ import annotations

import torch

from bench.runner import Row, study
from bench.speed.timing import timed
from gaussian_swaying.mpm.contact import Contact, Surface
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints

WIDTH, THICKNESS, PER_CELL, STEPS = 0.9, 0.005, 2.2, 24
CASES = ("off", "nothing near", "a fifth in contact", "all in contact")


@study("contact", lambda device: [{"asked": n, "case": case} for n in (10_000, 100_000) for case in CASES])
@torch.inference_mode()
def contact(asked: int, case: str, device: str) -> Row:
    """Time of a substep; the upper sheet falls onto the lower one."""
    side = round((asked / 2) ** 0.5)
    spacing = WIDTH / side
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) * spacing
    place = torch.cartesian_prod(axis, axis, torch.tensor([0.0, 0.5], device=device))
    place = place[place[:, 2].argsort(stable=True)].contiguous()
    volume = spacing**2 * THICKNESS
    made = MaterialPoints.create(place, volume=volume, density=100.0, youngs_modulus=5e3, poisson_ratio=0.3)
    normal = place.new_tensor([0.0, 0.0, 1.0]).expand(made.count, 3)
    touching = Contact(thickness=THICKNESS)
    surface = None if case == "off" else Surface.of_points(made, normal, spacing, THICKNESS, touching)
    solver = MPMSolver(dx=PER_CELL * spacing, gravity=(0.0, 0.0, 0.0))
    state = solver.init_state(made, surface=surface)
    if "in contact" in case:
        nodes = state.grid.node_positions(made.position)
        upper = (nodes[:, 2] > 0.25).to(nodes)
        moved, velocity = torch.zeros_like(nodes), torch.zeros_like(nodes)
        moved[:, 2] = upper * (THICKNESS - 0.5)
        moved[:, 0] = upper * (0.8 * WIDTH if case == CASES[2] else 0.0)
        velocity[:, 2] = -0.5 * upper
        state = solver.bound.read_particles(state, moved, velocity)  # type: ignore[attr-defined]
    dt = solver.stable_substep() * 0.4
    return timed(lambda: solver.rollout(state, dt, STEPS), device, 7, STEPS) | {"points": made.count}
