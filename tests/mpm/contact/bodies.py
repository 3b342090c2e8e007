"""Sheets that touch."""

import torch
from shared import solid

from gaussian_swaying import Contact, MaterialPoints, MPMSolver
from gaussian_swaying.mpm.contact import Surface

SPACING, THICKNESS, APART = 0.02, 0.01, 0.2
DX = 2.2 * SPACING


def sheet(nx, ny, low=(0.0, 0.0, 0.0), dtype=torch.float64, spacing=SPACING, axes=(0, 1), E=2e4):
    place = torch.zeros(nx * ny, 3, dtype=dtype)
    x, y = (torch.arange(n, dtype=dtype) * spacing for n in (nx, ny))
    place[:, axes[0]], place[:, axes[1]] = x.repeat_interleave(ny), y.repeat(nx)
    return solid(place + torch.tensor(low, dtype=dtype), spacing**2 * THICKNESS, E=E)


def _surface(points, contact, normal=(0.0, 0.0, 1.0), spacing=SPACING):
    facing = torch.tensor(normal, dtype=points.position.dtype).expand(points.count, 3)
    return Surface.of_points(points, facing, spacing, THICKNESS, contact)


def scene(points, contact=None, boundaries=(), velocity=None, normal=(0.0, 0.0, 1.0), **settings):
    settings = {"dx": DX} | settings
    solver = MPMSolver(boundaries=boundaries, **settings)
    return solver, solver.init_state(points, velocity, surface=_surface(points, contact, normal))


def layers(count, gap, side=6, shift=0.0, boundaries=(), change=None, dtype=torch.float64, **settings):
    """Sheets that start ``gap`` above each other; at rest they are far apart, so that they share no nodes."""
    points = MaterialPoints.join(
        [sheet(side, side, (shift * (k % 3), shift * (k % 2), APART * k), dtype) for k in range(count)]
    )
    solver, state = scene(points, Contact(), boundaries, **{"gravity": (0, 0, 0)} | settings)
    if change is not None:
        state = solver.init_state(points, surface=change(solver.bound.contact.surface))
    nodes = state.grid.node_positions(state.position)
    layer = ((nodes[:, 2] + APART / 2) / APART).floor().clamp(0, count - 1)
    moved = torch.zeros_like(nodes)
    moved[:, 2] = layer * (gap - APART)
    return solver, solver.bound.read_particles(state, moved, torch.zeros_like(moved))


def march(solver, state, seconds, frame=0.01):
    states = []
    for _ in range(round(seconds / frame)):
        steps = solver.substeps(state, frame)
        state = solver.rollout(state, frame / steps, steps)
        states.append(state)
    return states
