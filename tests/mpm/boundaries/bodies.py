"""Small bodies, and short runs of them."""

import pytest
import torch
from shared import double, solid
from torch.testing import assert_close

from gaussian_swaying import MaterialPoints, MPMSolver

in_both = pytest.mark.parametrize("formulation", ["total", "updated"])


def near(found, expected, within):
    """The two differ by no more than an absolute bound."""
    assert_close(found, expected, rtol=0, atol=within)


def block(low=(0.0, 0.0, 0.0), side=0.4, e=2e4, per_side=6):
    axis = (torch.arange(per_side, dtype=torch.float64) + 0.5) * side / per_side
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
    assert not bool(state.lost.any())
    return state


def lone(places, **material):
    """Particles without neighbours: stencils do not overlap."""
    position = double(places)
    given = {"volume": 1e-3, "density": 100.0, "youngs_modulus": 1e3, "poisson_ratio": 0.3}
    return MaterialPoints.create(position, **(given | material))


def march(solver, points, dt, steps, velocity=None, frame=None):
    """All states from the first to the last, on a grid that is large enough."""
    states = [solver.init_state(points, velocity, margin=12, frame=frame)]
    for _ in range(steps):
        states.append(solver.step(states[-1], dt))
    assert not bool(states[-1].lost.any())
    return states
