"""Small bodies, and short runs of them."""

import torch
from shared import double, solid

from gaussian_swaying import MPMSolver


def block(low=(0.0, 0.0, 0.0), side=0.4, e=2e4, per_side=6):
    axis = (torch.arange(per_side).double() + 0.5) * side / per_side
    position = torch.cartesian_prod(axis, axis, axis)
    return solid(position + double(low), (side / per_side) ** 3, 100.0, e)


def run_for(
    formulation, boundaries, points, seconds, velocity=None, gravity=(0, 0, -9.8), dx=0.1, damping=0.0, transfer="auto"
):
    solver = MPMSolver(dx, formulation, boundaries=boundaries, gravity=gravity, damping=damping, transfer=transfer)
    state = solver.init_state(points, velocity)
    for _ in range(round(seconds / 0.02)):
        steps = solver.substeps(state, 0.02)
        state = solver.rollout(solver.fit_grid(state, 0.02), 0.02 / steps, steps)
    assert not state.lost.any()
    return state


def lone(places):
    return solid(double(places), 1e-3, E=1e3)


def march(solver, points, dt, steps, velocity=None, frame=None):
    states = [solver.init_state(points, velocity, margin=12, frame=frame)]
    for _ in range(steps):
        states.append(solver.step(states[-1], dt))
    assert not states[-1].lost.any()
    return states
