"""Sheets that touch."""

import pytest
import torch

from gaussian_swaying import MaterialPoints, MPMSolver
from gaussian_swaying.mpm.contact.surface import Surface

SPACING, THICKNESS = 0.02, 0.01
DX = 2.2 * SPACING


def _sheet(nx, ny, low=(0.0, 0.0, 0.0), dtype=torch.float64, spacing=SPACING, axes=(0, 1), **material):
    """A flat sheet of nx times ny points from a corner on, along two axes."""
    place = torch.zeros(nx * ny, 3, dtype=dtype)
    x, y = (torch.arange(n, dtype=dtype) * spacing for n in (nx, ny))
    place[:, axes[0]], place[:, axes[1]] = x.repeat_interleave(ny), y.repeat(nx)
    given = {"density": 100.0, "youngs_modulus": 2e4, "poisson_ratio": 0.3} | material
    return MaterialPoints.create(place + torch.tensor(low, dtype=dtype), volume=spacing**2 * THICKNESS, **given)


def _surface(points, contact, normal=(0.0, 0.0, 1.0), spacing=SPACING):
    facing = torch.tensor(normal, dtype=points.position.dtype).expand(points.count, 3)
    return Surface.of_points(points, facing, spacing, THICKNESS, contact)


def _scene(points, contact=None, boundaries=(), velocity=None, normal=(0.0, 0.0, 1.0), **settings):
    """A solver in `total` with its contact, and the first state."""
    settings = {"dx": DX, "transfer": "torch"} | settings
    solver = MPMSolver(boundaries=boundaries, **settings)
    return solver, solver.init_state(points, velocity, surface=_surface(points, contact, normal))


def _march(solver, state, seconds, frame=0.01):
    """The states at the end of some frames."""
    states = []
    for _ in range(round(seconds / frame)):
        steps = solver.substeps(state, frame)
        state = solver.rollout(state, frame / steps, steps)
        states.append(state)
    return states


@pytest.fixture
def sheet():
    """A flat sheet."""
    return _sheet


@pytest.fixture
def scene():
    """A solver with contact, and the first state."""
    return _scene


@pytest.fixture
def march():
    """The states at the end of some frames."""
    return _march
