"""A solver that the package does not know: a cloth of masses and springs moves a splat in the wind."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying import AeroForce, Box, Material, MaterialPoints, MPMSolver, PinnedRegion, Simulation
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.forces import as_forces, split
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.state import State
from gaussian_swaying.recording.trajectory import load_trajectory
from gaussian_swaying.scenes.procedural import FlagScene


@dataclass(frozen=True)
class Settings:
    """Numbers that may change while it runs: a live page, edits and fits find them by these names."""

    gravity: tuple[float, ...]
    damping: float


class MassSpringCloth(Solver):
    """Points joined by springs to their nearest neighbours at rest, advanced by symplectic Euler.

    Args:
        dx: Length that it resolves [m]; points are half of it apart.
        gravity: Acceleration [m/s²], z up.
        damping: Rate at which velocities decay [1/s].
        neighbours: Springs of each point.
        boundaries: Pins; what they hold at rest does not move.
    """

    formulation = "mass_spring"

    def __init__(
        self,
        dx: float = 0.05,
        gravity: Sequence[float] = (0.0, 0.0, -9.8),
        damping: float = 0.0,
        neighbours: int = 8,
        boundaries: Sequence[Boundary] = (),
    ) -> None:
        super().__init__()
        self._dx, self.neighbours, self.settings = dx, neighbours, Settings(tuple(gravity), damping)
        self.boundaries = nn.ModuleList(boundaries)

    @property
    def dx(self) -> float:
        """Length that it resolves [m]."""
        return self._dx

    @property
    def points(self) -> MaterialPoints:
        return self._points

    def like(self, settings: Settings) -> "MassSpringCloth":
        return MassSpringCloth(self.dx, settings.gravity, settings.damping, self.neighbours, list(self.boundaries))

    def init_state(self, points: MaterialPoints, *, frame: Any = None, surface: Any = None) -> State:
        self._points, x = points, points.position
        rest = x.reshape(-1, points.count, 3)[0]  # all scenes of a batch have the same points
        count = min(self.neighbours, points.count - 1)
        self.near = nearest_neighbours(rest.double(), count + 1)[1][:, 1:].to(rest.device)
        self.arm = rest[self.near] - rest[:, None]  # (P, n, 3)
        self.length = self.arm.norm(dim=-1)
        # a stretch in all directions stores E V strain^2, as in a membrane; each spring is seen from both ends
        share = points.youngs_modulus * points.volume
        self.stiffness = (share[..., None] + share[..., self.near]) / (count * self.length**2)
        values, axes = torch.linalg.eigh((self.arm.mT @ self.arm).double())  # the first axis is the normal of the sheet
        self.inverse = (axes[..., 1:] / values[..., None, 1:] @ axes[..., 1:].mT).to(rest)
        self.tangents = axes[..., 1:].to(rest)
        self.normal = torch.linalg.cross(self.tangents[..., 0], self.tangents[..., 1])
        held = [boundary.particle_mask(x) for boundary in self.framed(frame)]
        lost = torch.zeros_like(x[..., 0], dtype=torch.bool)
        self.free = ~torch.stack([lost, *(mask for mask in held if mask is not None)]).any(0)
        F = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], 3, 3)
        time = torch.zeros((), dtype=torch.float64, device=x.device)
        impulse = time.expand(*x.shape[:-2], len(self.boundaries), 3)
        return State(
            position=x, velocity=torch.zeros_like(x), F_elastic=F, F_total=F, lost=lost, time=time,
            work=time.expand(x.shape[:-2]), impulse=impulse,
        )  # fmt: skip

    def gradient(self, x: Tensor) -> Tensor:
        """Deformation gradients (..., P, 3, 3): by least squares in the sheet, and its unit normal across it."""
        F = (x[..., self.near, :] - x[..., None, :]).mT @ self.arm @ self.inverse
        a, b = (F @ self.tangents).unbind(-1)
        normal = nn.functional.normalize(torch.linalg.cross(a, b), dim=-1)
        return F + normal[..., :, None] * self.normal[:, None, :]

    def pull(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Force of the springs [N], (..., P, 3), and their stretch [m], (..., P, n)."""
        arm = x[..., self.near, :] - x[..., None, :]
        length = arm.norm(dim=-1)
        stretch = length - self.length
        tension = 0.5 * self.stiffness * stretch / length.clamp(min=1e-9)
        own = tension[..., None] * arm
        force = own.sum(-2)
        back = torch.zeros_like(force).index_add(-2, self.near.reshape(-1), own.flatten(-3, -2))
        return force - back, stretch

    def rollout(self, state: State, dt: float, steps: int, forces: Any = None) -> State:
        mass, acting = self.points.mass[..., None], as_forces(forces)
        gravity = state.position.new_tensor(self.gravity)
        sources = [force.during(state.time, dt, steps) for force in acting]
        for k in range(steps):
            x, v, work = state.position, state.velocity, state.work
            load, drag = torch.zeros_like(x), torch.zeros_like(x[..., 0])
            for source, force in zip(sources, acting, strict=True):
                more, resistance = split(source(state, k), force, state)
                load = load + more
                drag = drag if resistance is None else drag + resistance
            kick = self.pull(x)[0] + load + mass * (gravity - self.settings.damping * v)
            new = torch.where(self.free[..., None], v + dt * kick / (mass + dt * drag[..., None]), 0.0)
            work = work + dt * (load * new).sum((-1, -2)).double()
            x = x + dt * new
            F = self.gradient(x)
            state = state.replace(
                position=x, velocity=new, F_elastic=F, F_total=F, time=state.time + dt, substep=dt, work=work
            )
        return state

    def cells_per_second(self, state: State) -> Tensor:
        """The highest frequency of a point between its springs [1/s]."""
        return (2 * self.stiffness.sum(-1) / self.points.mass).amax().sqrt()

    def elastic_energy(self, state: State) -> Tensor:
        """Energy of the springs [J]; each is seen from both ends."""
        return 0.25 * (self.stiffness * self.pull(state.position)[1] ** 2).sum((-1, -2))


def flag(solver: Solver) -> Simulation:
    return Simulation(
        FlagScene(spacing=0.05),
        Material(E=3e4, density=30.0, thickness=0.01),
        solver=solver,
        wind=[1.0, 2.5, 0.0],
        aero=AeroForce(),
    )


def main(output: Path, frames: int = 25) -> float:
    pins = [PinnedRegion(Box([None, None, None], [0.06, None, None]))]
    options = {"dx": 0.1, "gravity": (0.0, 0.0, 0.0), "damping": 2.0, "boundaries": pins}
    places = []
    for name, solver in (("springs", MassSpringCloth(**options)), ("mpm", MPMSolver(**options))):
        flag(solver).run(output / name, frames, progress=False)
        places.append([load_trajectory(output / name / "trajectory.npz", k)[0] for k in (0, frames - 1)])
    way = (places[1][1] - places[1][0]).norm(dim=-1).mean()
    apart = float((places[0][1] - places[1][1]).norm(dim=-1).mean() / way)
    print(f"The cloth of springs ends {apart:.0%} of the way from the material points.")
    return apart
