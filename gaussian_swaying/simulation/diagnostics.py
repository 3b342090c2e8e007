"""What a run reports about its own health, and how it ends when it is not."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch

from gaussian_swaying.mpm.linalg import determinant, singular_values
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState


class SimulationDiverged(RuntimeError):  # noqa: N818  (it ends a run the way StopIteration ends a loop)
    """The simulation left the range where its numbers mean anything.

    Attributes:
        time: Simulated time [s].
        particle: Index of the first bad particle, or None if no single one is to blame.
        cause: What was seen.
        remedy: What to change.
    """

    def __init__(self, time: float, particle: int | None, cause: str, remedy: str) -> None:
        self.time, self.particle, self.cause, self.remedy = time, particle, cause, remedy
        who = "" if particle is None else f", particle {particle}"
        super().__init__(f"The simulation diverged at t = {time:.4g} s{who}: {cause}. Remedy: {remedy}.")


@dataclass(frozen=True)
class FrameDiagnostics:
    """Health of the state at the end of a frame, summed over the scenes of a batch.

    Attributes:
        time: Simulated time [s].
        substeps: Substeps of the frame.
        cfl: Largest Courant number of the frame, at its end.
        kinetic: Kinetic energy [J].
        elastic: Elastic energy [J].
        potential: Potential energy of gravity [J].
        lost: Particles that left the grid.
        J_min: Smallest determinant of F.
        J_max: Largest determinant of F.
        stretch_min: Smallest singular value of F.
        stretch_max: Largest singular value of F.
        displacement_mean: Mean distance from rest [m].
        displacement_max: Largest distance from rest [m].
    """

    time: float
    substeps: int
    cfl: float
    kinetic: float
    elastic: float
    potential: float
    lost: int
    J_min: float
    J_max: float
    stretch_min: float
    stretch_max: float
    displacement_mean: float
    displacement_max: float

    def as_dict(self) -> dict[str, float | int]:
        """The fields by name."""
        return asdict(self)


def diagnose(solver: MPMSolver, state: MPMState, substeps: int, dt: float) -> FrameDiagnostics:
    """Measure the health of a state (one GPU synchronisation).

    Args:
        solver: The solver that made the state.
        state: The state at the end of the frame.
        substeps: Substeps of the frame.
        dt: Length of a substep [s].

    Returns:
        The measurements.
    """
    energies = solver.energies(state)
    stretch = singular_values(state.F_total)
    volume = determinant(state.F_total)
    moved = torch.linalg.vector_norm(state.position - solver.points.position, dim=-1)
    values = torch.stack(
        [
            state.time,
            solver.cfl_number(state, dt).double(),
            *(energies[name].sum().double() for name in ("kinetic", "elastic", "potential")),
            state.lost.sum().double(),
            volume.amin().double(),
            volume.amax().double(),
            stretch.amin(),
            stretch.amax(),
            moved.mean().double(),
            moved.amax().double(),
        ]
    ).tolist()
    names = ("time", "cfl", "kinetic", "elastic", "potential", "lost", "J_min", "J_max", "stretch_min", "stretch_max")
    found = dict(zip((*names, "displacement_mean", "displacement_max"), values, strict=True))
    return FrameDiagnostics(substeps=substeps, lost=int(found.pop("lost")), **found)


def check_state(solver: MPMSolver, state: MPMState) -> None:
    """Raise SimulationDiverged if a particle is NaN, infinite, out of the grid or absurdly far away.

    Args:
        solver: The solver that made the state.
        state: The state to look at (one GPU synchronisation).

    Raises:
        SimulationDiverged: Naming time, particle, cause and remedy.
    """
    rest = solver.points.position
    size = float((rest.reshape(-1, 3).amax(0) - rest.reshape(-1, 3).amin(0)).amax().clamp(min=solver.dx))
    finite = (
        torch.isfinite(state.position).all(-1)
        & torch.isfinite(state.velocity).all(-1)
        & torch.isfinite(state.F_elastic).all(-1).all(-1)
    )
    far = torch.linalg.vector_norm(state.position - rest, dim=-1) > 1000 * size
    bad = ~finite | state.lost | far
    if not bool(bad.any()):
        return
    particle = int(bad.reshape(-1).int().argmax())
    time = float(state.time)
    if not bool(finite.reshape(-1)[particle]):
        cause = "its position, velocity or deformation is NaN or infinite"
        remedy = (
            "lower `solver.cfl`"
            if solver.substep is None
            else f"lower `solver.substep` (stable at rest: {solver.stable_substep():.3g} s) or set it to null"
        ) + ", or check the wind and the boundary velocities"
    elif bool(state.lost.reshape(-1)[particle]):
        cause = f"it left the grid ({int(state.lost.sum())} particles did)"
        remedy = "enclose the scene with an EnclosingBox or a Plane, or lower the speeds that carry it away"
    else:
        cause = f"it is more than 1000 object sizes ({size:.3g} m) away from where it started"
        remedy = "pin or enclose the object, or lower `solver.cfl`"
    raise SimulationDiverged(time, particle, cause, remedy)
