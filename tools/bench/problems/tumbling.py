"""A rigid plate that falls in computed air, in a plane: it flutters from side to side, or tumbles over and over.

Lengths are in that of the plate, and the density of the fluid is 1. The speed is that at which weight and lift balance,
U² = 2 m g / L, which is 1 here. Belmonte, Eisenberg and Moses (1998, Phys. Rev. Lett. 81) let plates fall in a thin
cell: those of a Froude number below 0.67 +- 0.05 flutter, heavier ones tumble. Theirs is the square root of the plate's
mass per mass of fluid in a square of its length.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from bench.problems.air import units_of
from gaussian_swaying.air.flow import LatticeFlow
from gaussian_swaying.air.immersed import give, look

SUBSTEPS = 8
"""Substeps of the plate in a step of the air."""


def falling(
    froude: float, *, cells: int = 24, reynolds: float = 500.0, until: float = 40.0, side: int = 9, tilt: float = 0.3
) -> dict:
    """Let a plate fall in still air; the box moves with its middle.

    In the frame of the box the air is accelerated by as much as the plate is the other way, and comes in through the
    faces with the velocity opposite to the plate's.

    Units: ``until`` [L / U]; ``tilt`` [rad].

    Returns:
        ``turns`` in all, the largest ``swing`` from the level [rad] before a half turn, the mean ``speed`` of the fall
        in the second half [U], and ``angles`` over time with their ``dt``.
    """
    mass = froude**2
    units, weight = units_of(1 / cells, reynolds, 0.07), 0.5  # m g, from U = 1
    flow = LatticeFlow((side * cells, 1, side * cells), units, faces=("open", "periodic", "open"), smagorinsky=0)
    points = 2 * cells
    along = (np.arange(points) + 0.5) / points - 0.5
    inertia, per_depth = mass / 12, units.cell_mass * cells
    now = flow.start([0.0, 0.0, 0.0]).moments
    spare, area = torch.empty_like(now), torch.full((points,), cells / points)
    velocity, spin, angle, angles, falls = np.zeros(2), 0.0, tilt, [], []
    for _ in range(round(until / units.dt)):
        arm = along[:, None] * np.array([math.cos(angle), math.sin(angle)])
        place = torch.zeros(points, 3)
        place[:, [0, 2]] = torch.tensor((arm + side / 2) * cells - 0.5, dtype=torch.float32)
        seen, layer = look(now, area, place, flow.kind)
        air = seen[:, [0, 2]].double().numpy() * units.speed + velocity
        share, dt = layer.double().numpy()[:, None] * per_depth / SUBSTEPS, units.dt / SUBSTEPS
        before, taken = velocity.copy(), np.zeros_like(arm)
        for _ in range(SUBSTEPS):
            push = share * (air - velocity - spin * np.stack([-arm[:, 1], arm[:, 0]], 1))
            taken += push
            velocity = velocity + push.sum(0) / mass + dt * np.array([0.0, -weight / mass])
            spin += float((arm[:, 0] * push[:, 1] - arm[:, 1] * push[:, 0]).sum()) / inertia
            turn = dt * spin
            angle += turn
            arm = arm @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        loss = torch.zeros(points, 3)
        loss[:, [0, 2]] = torch.tensor(taken / (per_depth * units.speed), dtype=torch.float32)
        give(now, loss, place, flow.kind)
        change = (velocity - before) / units.dt
        flow.advance(now, spare, torch.tensor([-velocity[0], 0.0, -velocity[1]]).float(), (-change[0], 0.0, -change[1]))
        now, spare = spare, now
        angles.append(angle)
        falls.append(-velocity[1])
    history = np.array(angles)
    first = np.argmax(np.abs(history) > math.pi) or len(history)
    return {
        "turns": float(abs(history[-1] - history[0]) / (2 * math.pi)), "swing": float(np.abs(history[:first]).max()),
        "speed": float(np.mean(falls[len(falls) // 2 :])), "angles": history, "dt": units.dt,
    }  # fmt: skip
