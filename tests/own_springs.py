"""A solver that the package does not know: every point hangs on a spring at its place, in the wind."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying import AeroForce, Material, MaterialPoints, Simulation
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.forces import as_forces, split
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.state import State
from gaussian_swaying.scenes.procedural import FlagScene


@dataclass(frozen=True)
class Settings:
    """Numbers that may change while it runs: a live page, edits and fits find them by these names."""

    gravity: tuple[float, ...]
    damping: float


class Springs(Solver):
    formulation, dx, points = "springs", 0.1, None

    def __init__(
        self,
        dx: float = 0.1,
        gravity: Sequence[float] = (0.0, 0.0, -2.0),
        damping: float = 0.0,
        boundaries: Sequence[Boundary] = (),
    ) -> None:
        super().__init__()
        self.dx, self.settings, self.boundaries = dx, Settings(tuple(gravity), damping), nn.ModuleList(boundaries)

    def like(self, settings: Settings) -> "Springs":
        return Springs(self.dx, settings.gravity, settings.damping, list(self.boundaries))

    def init_state(self, points: MaterialPoints, *, frame: Any = None, surface: Any = None) -> State:
        self.points, x = points, points.position
        self.stiffness = 1e-4 * points.youngs_modulus * points.volume / self.dx**2
        lost = torch.zeros_like(x[..., 0], dtype=torch.bool)
        held = [boundary.particle_mask(x) for boundary in self.framed(frame)]
        self.free = ~torch.stack([lost, *(mask for mask in held if mask is not None)]).any(0)
        F, time = torch.eye(3).expand(*x.shape, 3), torch.zeros((), dtype=torch.float64)
        work, impulse = time.expand(x.shape[:-2]), time.expand(*x.shape[:-2], len(self.boundaries), 3)
        kept = {"lost": lost, "time": time, "work": work, "impulse": impulse}
        return State(position=x, velocity=torch.zeros_like(x), F_elastic=F, F_total=F, **kept)

    def rollout(self, state: State, dt: float, steps: int, forces: Any = None) -> State:
        mass, acting = self.points.mass[..., None], as_forces(forces)
        gravity = state.position.new_tensor(self.gravity)
        sources = [force.during(state.time, dt, steps) for force in acting]
        for k in range(steps):
            x, v, load, drag = state.position, state.velocity, 0.0, 0.0
            for source, force in zip(sources, acting, strict=True):
                more, resistance = split(source(state, k), force, state)
                load, drag = load + more, drag if resistance is None else drag + resistance[..., None]
            pull = self.stiffness[..., None] * (self.points.position - x)
            kick = pull + load + mass * (gravity - self.settings.damping * v)
            v = torch.where(self.free[..., None], v + dt * kick / (mass + dt * drag), 0.0)
            work = state.work + dt * (load * v).sum((-1, -2)).double()
            state = state.replace(position=x + dt * v, velocity=v, time=state.time + dt, substep=dt, work=work)
        return state

    def cells_per_second(self, state: State) -> Tensor:
        return 10 * (self.stiffness / self.points.mass).amax().sqrt()

    def elastic_energy(self, state: State) -> Tensor:
        return 0.5 * (self.stiffness * (state.position - self.points.position).square().sum(-1)).sum(-1)


def flag(solver: Solver) -> Simulation:
    stuff = Material(E=3e4, density=30.0, thickness=0.01)
    return Simulation(FlagScene(spacing=0.05), stuff, solver=solver, wind=[1.0, 2.5, 0.0], aero=AeroForce())
