"""Roles of the Gaussians of a run: simulated, carried, held or pushed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.simulation.simulation import Simulation


@dataclass(frozen=True)
class Roles:
    """Masks of Gaussians, shape (N,).

    Attributes:
        simulated: Those selected by region and opacity.
        carried: Faint and loose ones that follow them.
        pinned: Simulated ones that a condition holds.
        pushed: Simulated ones that an impulse pushes.
        names: The kind of each condition and the number of its particles, in words.
    """

    simulated: Tensor
    carried: Tensor
    pinned: Tensor
    pushed: Tensor
    names: list[str]


def classify(simulation: Simulation) -> Roles:
    """Sort the Gaussians into simulated, carried, held and pushed ones."""
    scene = simulation.scene
    simulated, carried, pinned, pushed = (torch.zeros(len(scene.model.means), dtype=torch.bool) for _ in range(4))
    index = scene.simulated.cpu()
    carried[scene.carried.cpu()] = True
    simulated[index], carried[index] = True, False
    where = scene.frame.point_to_sim(scene.model.means.detach()[scene.simulated].double()).to(
        scene.points.position.dtype
    )
    names = []
    for boundary in conditions(simulation):
        moved = boundary.in_frame(scene.frame)
        mask = moved.particle_mask(scene.points.position)
        name = type(boundary).__name__
        if mask is None:
            names.append(name)
            continue
        own = moved.particle_mask(where)
        assert own is not None
        (pushed if boundary.held_share is None else pinned)[index[own.cpu()]] = True
        names.append(f"{name}: {int(mask.sum()):,} particles")
    return Roles(simulated, carried, pinned, pushed, names)


def conditions(simulation: Simulation) -> list[Boundary]:
    """The boundary conditions of a run, in scene units."""
    return [b for b in simulation.solver.boundaries if isinstance(b, Boundary)]
