"""Many variants of one simulation, stepped side by side as a batch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.aero.patches import Patches
from gaussian_swaying.aero.shelter import Shelter
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.formulations.formulation import Settings
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.simulation.parameters import Setup, parameter, with_values
from gaussian_swaying.simulation.simulation import Simulation

SAFETY = 1.15
"""First factor on the wave speed at rest that substeps allow for; a rollout above it is repeated with shorter ones."""
CFL_LIMIT = 0.5
RETRIES = 3
MARGINS = (0, 16, 64)
"""Cells around the grid of ``updated``, one after the other if particles leave it."""

Values = Mapping[str, float]


class SubstepTooLongError(RuntimeError):
    """The material stiffened so much that the substep was not stable."""


@dataclass
class _Group:
    """Variants that differ only in parameters that may differ within a batch."""

    members: list[int]
    solver: MPMSolver
    forces: list[Force]
    state: MPMState


class Ensemble:
    """Variants of a simulation that differ in a few values.

    Variants that differ only in parameters that may differ within a batch are run as one batch; others are run as
    further batches. All take the same substeps, so that their differences come from the values alone.

    Args:
        simulation: The base. Its motion starts from rest at time zero.

    Raises:
        ValueError: If the simulation has parts that cannot be a batch: timed edits, contact, shelter.
    """

    def __init__(self, simulation: Simulation) -> None:
        if simulation.editor.edits:
            raise ValueError("`edits` of the base cannot be fitted through: put their material into `material`.")
        if simulation.scene.surface_places is not None:
            raise ValueError("Contact and obstacles cannot be fitted through yet: set `contact` to null.")
        wind = simulation.wind
        if isinstance(wind, WindField) and any(isinstance(effect, Shelter) for effect in wind.effects):
            raise ValueError("The wind effect Shelter cannot be fitted through: remove it from `wind.effects`.")
        self.simulation = simulation
        self.stiffening = SAFETY

    @torch.no_grad()
    def run(
        self, values: Sequence[Values], times: Sequence[float], careful: bool = True, alike: bool = True
    ) -> Iterator[list[MPMState]]:
        """The states of all variants at each time, in the order of ``values``.

        Args:
            values: For each variant the values that replace those of the base.
            times: Times [s], ascending, from 0 on.
            careful: Raise if a substep was too long; otherwise such a variant may end in NaN.
            alike: Take the same substeps for all, those of the stiffest. If not, variants that need more substeps are
                batches of their own.

        Raises:
            SubstepTooLongError: If the material stiffened too much; ``stiffening`` is raised for the next try.
        """
        setups = [with_values(self.simulation.setup, own) for own in values]
        groups = self._groups(values, setups, alike)
        rates = [self._rate(group) for group in groups]
        if alike:
            rates = [max(rates)] * len(groups)
        now = 0.0
        for time in times:
            if time > now:
                for group, rate in zip(groups, rates, strict=True):
                    self._advance(group, time - now, max(1, math.ceil((time - now) * rate)), careful)
                now = time
            found: list[MPMState | None] = [None] * len(values)
            for group in groups:
                for place, member in enumerate(group.members):
                    found[member] = member_of(group.state, place)
            yield [state for state in found if state is not None]

    def _groups(self, values: Sequence[Values], setups: Sequence[Setup], alike: bool) -> list[_Group]:
        shared: dict[tuple[object, ...], list[int]] = {}
        for number, (own, setup) in enumerate(zip(values, setups, strict=True)):
            apart = [(name, value) for name, value in sorted(own.items()) if not parameter(name).batched]
            shared.setdefault((*apart, 0 if alike else _stiffness_class(setup.points)), []).append(number)
        return [self._group(members, [setups[k] for k in members]) for members in shared.values()]

    def _group(self, members: list[int], setups: list[Setup]) -> _Group:
        first, scene = setups[0], self.simulation.scene
        solver = solver_like(self.simulation.solver, first.solver)
        state = solver.init_state(MaterialPoints.stack([setup.points for setup in setups]), frame=scene.frame)
        forces = list(first.forces)
        if not first.aero.idle:
            winds = [setup.wind for setup in setups]
            forces = [WindForce(first.aero, winds, _repeated(scene.patches, len(members))), *forces]
        return _Group(members, solver, forces, state)

    def _rate(self, group: _Group) -> float:
        """Substeps per second that are stable for all variants of a group, for waves and for explicit drag."""
        solver, state = group.solver, group.state
        rate = float(solver.cells_per_second(state)) * self.stiffening / solver.cfl
        viscous = solver.stiffness_damping
        if viscous > 0:  # the number of substeps that the solver finds for a frame of a second
            rate = max(rate, float(solver.substeps(state, 1.0)) * self.stiffening)
        for force in group.forces:
            if isinstance(force, WindForce) and force.aero.drag_step == "explicit":
                wind = torch.linalg.vector_norm(force.samples(state, 0.25, 9), dim=-1).amax()
                speed = 1.5 * wind.to(state.velocity).expand(state.velocity.shape[:-1])
                rate = max(rate, float(force.aero.rate(speed, force.area, solver.points.mass).amax()))
        return rate

    def _advance(self, group: _Group, time: float, steps: int, careful: bool) -> None:
        solver, before = group.solver, group.state
        for margin in MARGINS:  # a variant may end in NaN, and what leaves the grid gets a larger one
            start = solver.fit_grid(before, time, margin)
            group.state = solver.rollout(start, time / steps, steps, group.forces, check=False)
            if solver.neighbours_fixed or not bool(group.state.lost.any()):
                break
        if careful:
            number = float(solver.cfl_number(group.state, time / steps))
            if not number <= CFL_LIMIT:
                more = min(number / solver.cfl, 4.0) if math.isfinite(number) else 4.0
                self.stiffening *= 1.1 * max(more, 1.0)
                raise SubstepTooLongError(f"The Courant number reached {number:.3g}.")


def solver_like(solver: MPMSolver, settings: Settings) -> MPMSolver:
    """A solver with the same boundaries and other settings."""
    return MPMSolver(
        dx=settings.dx,
        formulation=solver.formulation,
        gravity=settings.gravity,
        damping=settings.damping,
        stiffness_damping=settings.stiffness_damping,
        cfl=solver.cfl,
        max_nodes=settings.max_nodes,
        mls=settings.mls,
        deterministic=settings.deterministic,
        boundaries=list(solver.boundaries),  # type: ignore[arg-type]
        transfer=solver.transfer,
    )


def member_of(state: MPMState, place: int) -> MPMState:
    """The state of one scene of a batch."""
    own = {"time", "grid", "substep"}
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(MPMState) if f.name not in own}
    return state.replace(**{name: value[place] for name, value in fields.items() if isinstance(value, Tensor)})


def _stiffness_class(points: MaterialPoints) -> int:
    """A number that is equal for materials whose fastest waves differ by less than a fifth or so."""
    squared = (points.youngs_modulus * points.volume / points.mass).amax()
    return round(2 * math.log2(float(squared)))


def _repeated(patches: Patches, count: int) -> Patches:
    """The patches of several scenes, one after the other."""
    shift = patches.count * torch.arange(count, device=patches.point.device)
    point = (patches.point + shift[:, None]).reshape(-1)
    return Patches(patches.normal.repeat(count, 1), patches.area.repeat(count), point, patches.count * count)


__all__ = ["Ensemble", "SubstepTooLongError"]
