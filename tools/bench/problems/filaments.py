"""Filaments in a flow in a plane: flags whose flapping is published, with the exchange of momentum of computed air.

The filament is a chain of points with stiff springs and Bernoulli's bending energy, so that only the exchange is
judged, not the package's solver. Lengths are in its length, speeds in that of the flow, and the density of the fluid is
1: a mass ratio is the mass of the filament per mass of fluid in a square of its length, and a bending stiffness is per
rho U² L³.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from bench.problems.air import WIND, _frequency, units_of
from gaussian_swaying import AeroForce, Simulation, WindField
from gaussian_swaying.aero.computed_air import ComputedAir
from gaussian_swaying.aero.wind import FlowKey
from gaussian_swaying.air.flow import FlowState, LatticeFlow
from gaussian_swaying.air.immersed import give, look
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.material import Material
from gaussian_swaying.simulation.scene import Scene

STRETCH = 400.0
"""Stiffness of the springs per rho U² L: the filament stretches by some thousandths."""


@dataclass
class Filament:
    """A chain in the x-z plane.

    Attributes:
        place: Of its points, shape (N, 2).
        velocity: Of its points, shape (N, 2).
        mass: Of a point, per depth.
        bending: Stiffness.
        gravity: Along x.
        held: ``hinge``, ``clamp`` or ``tail``: its first point held, with its slope, or its last one with its slope.
    """

    place: np.ndarray
    velocity: np.ndarray
    mass: np.ndarray
    bending: float
    gravity: float
    held: str

    @classmethod
    def straight(
        cls, points: int, mass_ratio: float, bending: float, tilt: float, gravity: float = 0.0, held: str = "hinge"
    ) -> Filament:
        """A straight one from the origin, tilted against the flow [rad]."""
        along = np.linspace(0, 1, points)[:, None]
        mass = np.full(points, mass_ratio / (points - 1))
        mass[[0, -1]] *= 0.5
        place = along * np.array([math.cos(tilt), math.sin(tilt)])
        if held == "clamp":  # only the slope at the clamp is along the flow
            place = np.concatenate([along, math.tan(tilt) * along**2], 1)
        if held == "tail":
            place = np.concatenate([along, math.tan(tilt) * (1 - along) ** 2], 1)
        return cls(place, np.zeros_like(place), mass, bending, gravity, held)

    def forces(self) -> np.ndarray:
        """Elastic forces and weight, per depth, shape (N, 2)."""
        ds = 1 / (len(self.place) - 1)
        step = np.diff(self.place, axis=0)
        length = np.sqrt((step**2).sum(1, keepdims=True))
        pull = STRETCH * (length / ds - 1) * step / length
        force = np.zeros_like(self.place)
        force[:-1] += pull
        force[1:] -= pull
        chain = self.place
        if self.held == "clamp":
            chain = np.concatenate([chain[:1] - np.array([[ds, 0.0]]), chain])
        elif self.held == "tail":
            chain = np.concatenate([chain, chain[-1:] + np.array([[ds, 0.0]])])
        bend = -self.bending / ds**3 * (chain[:-2] - 2 * chain[1:-1] + chain[2:])
        moment = np.zeros_like(chain)
        moment[:-2] += bend
        moment[1:-1] -= 2 * bend
        moment[2:] += bend
        force += moment[1:] if self.held == "clamp" else moment[:-1] if self.held == "tail" else moment
        force[:, 0] += self.mass * self.gravity
        return force

    def advance(self, air: np.ndarray, layer: np.ndarray, dt: float) -> np.ndarray:
        """Take a step in as many substeps as it needs (symplectic Euler).

        Returns:
            Momentum that its points take from the air, per depth, shape (N, 2).
        """
        ds = 1 / (len(self.place) - 1)
        fastest = 2 * math.sqrt(STRETCH / ds / self.mass[1])  # of a spring between two points
        fastest = max(fastest, 4 / ds**2 * math.sqrt(self.bending / (self.mass[1] / ds)))
        substeps = max(math.ceil(dt * fastest / 0.8), 1)
        step, taken = dt / substeps, np.zeros_like(self.place)
        share = layer / substeps
        rate = (self.mass * share / (self.mass + share))[:, None]
        anchor = -1 if self.held == "tail" else 0
        for _ in range(substeps):
            push = rate * (air - self.velocity)
            taken += push
            self.velocity += (step * self.forces() + push) / self.mass[:, None]
            self.velocity[anchor] = 0
            self.place += step * self.velocity
        return taken


def flap(
    filaments: list[Filament],
    at: list[tuple[float, float]],
    *,
    cells: int = 24,
    reynolds: float = 200.0,
    until: float = 30.0,
    length: float = 7.0,
    height: float = 6.0,
    before: float = 2.0,
    lattice_speed: float = 0.1,
) -> dict:
    """Filaments in a uniform flow along x.

    Returns:
        ``tips``: the free end of each across the flow over time, shape (T, F); ``drags`` and ``dt``; and ``flow``
        with its ``state`` at the end.
    """
    h, units = 1 / cells, units_of(1 / cells, reynolds, lattice_speed)
    flow = LatticeFlow(
        (round(length * cells), 1, round(height * cells)), units, faces=("open", "periodic", "open"), smagorinsky=0
    )
    now = flow.start([1.0, 0.0, 0.0]).moments
    spare = torch.empty_like(now)
    counts = [len(one.place) for one in filaments]
    per_depth = units.cell_mass / h  # the slab is a cell deep
    spacing = [np.full(n, 1 / (n - 1)) for n in counts]
    area = torch.tensor(np.concatenate(spacing) / h, dtype=torch.float32)
    origin = np.concatenate(
        [np.broadcast_to([x + before, z + height / 2], (n, 2)) for n, (x, z) in zip(counts, at, strict=True)]
    )
    tips, drags = [], []
    for _ in range(round(until / units.dt)):
        place = np.concatenate([one.place for one in filaments]) + origin
        flat = torch.zeros(len(place), 3)
        flat[:, [0, 2]] = torch.tensor(place / h - 0.5, dtype=torch.float32)
        air, layer = look(now, area, flat, flow.kind)
        speeds = air[:, [0, 2]].double().numpy() * units.speed
        layers = layer.double().numpy() * per_depth
        parts = np.cumsum(counts)[:-1]
        pushes = [
            one.advance(u, m, units.dt)
            for one, u, m in zip(filaments, np.split(speeds, parts), np.split(layers, parts), strict=True)
        ]
        taken = torch.zeros(len(place), 3)
        taken[:, [0, 2]] = torch.tensor(np.concatenate(pushes) / (per_depth * units.speed), dtype=torch.float32)
        give(now, taken, flat, flow.kind)
        drags.append([push[:, 0].sum() / units.dt for push in pushes])
        tips.append([one.place[0 if one.held == "tail" else -1, 1] for one in filaments])
        flow.advance(now, spare, WIND)
        now, spare = spare, now
    return {
        "tips": torch.tensor(np.array(tips)), "drags": torch.tensor(np.array(drags)), "dt": units.dt,
        "state": FlowState(now), "flow": flow,
    }  # fmt: skip


def measured(found: dict, which: int = 0) -> dict[str, float]:
    """Amplitude from peak to peak, frequency, and mean drag coefficient of a filament over the second half of a run."""
    half = len(found["tips"]) // 2
    tip, drag = found["tips"][half:, which], found["drags"][half:, which]
    return {
        "amplitude": float(tip.max() - tip.min()), "frequency": _frequency(tip, found["dt"]),
        "drag": 2 * float(drag.mean()), "mean": float(tip.mean()),
    }  # fmt: skip


def flag(mass_ratio: float, bending: float, reynolds: float, *, tilt: float = 0.1, held: str = "clamp", **box) -> dict:
    """A flag in a flow; see :func:`measured`."""
    points = 2 * box.get("cells", 24) + 1
    found = flap(
        [Filament.straight(points, mass_ratio, bending, tilt, held=held)], [(0.0, 0.0)], reynolds=reynolds, **box
    )
    return measured(found)


def square_flag(cells: int = 20, until: float = 24.0, width: int = 4, device: str = "cpu") -> dict:
    """A square flag in three dimensions, as a sheet of the package: Re 200, mass ratio 1, bending stiffness 0.0001.

    Published: an amplitude from peak to peak of 0.78 and a frequency of 0.26 (Huang and Sung 2010, J. Fluid Mech. 653),
    0.81 and 0.27 (Tian and others 2014, J. Comput. Phys. 258), of the middle of the free edge.

    Units: ``until`` [sides over speed]; ``width`` [sides].
    """
    points = 2 * math.ceil(0.6 * cells)  # closer than the cells, and two to a cell of the grid
    simulation = Simulation(
        Scene(generator=FlagScene(width=1.0, height=1.0, spacing=1 / points), layers=1),
        Material(E=1e5, nu=0.3, density=100.0, thickness=0.01, bending=1e-4),
        solver=MPMSolver(
            dx=2 / points,
            gravity=[0.0, 0.0, 0.0],
            boundaries=[PinnedRegion(Box([None, None, None], [0.7 / points, None, None]))],
        ),
        wind=WindField(schedule=[FlowKey(0.0, [1.0, 0.3, 0.0]), FlowKey(1.0, [1.0, 0.0, 0.0])]),
        aero=AeroForce(air_density=1.0),
        air=ComputedAir(
            [-1.5, -width / 2, -1.0],
            [4.5, width / 2, 1.0],
            max(6, width) * cells,
            viscosity=1 / 200,
            smagorinsky=0,
            speed=1.2,
        ),
        frame_dt=0.05,
        device=device,
    )
    stepper, tips = simulation.stepper, []
    state = stepper.start()
    tip = (state.position - state.position.new_tensor([0.5, 0.0, 0.0])).norm(dim=-1).argmin()
    for _ in range(round(until / 0.05)):
        state, _ = stepper.advance(state)
        tips.append(state.position[tip, 1])
    last = torch.stack(tips[2 * len(tips) // 3 :]).cpu()
    return {"amplitude": float(last.max() - last.min()), "frequency": _frequency(last, 0.05)}
