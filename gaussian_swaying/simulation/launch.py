"""A frame that is passed to the device, and what the host reads at its end."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gaussian_swaying._graphs import fingerprint, tensors_in
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import MAX_CFL
from gaussian_swaying.simulation.diagnostics import FrameDiagnostics, Measurement

if TYPE_CHECKING:
    from gaussian_swaying.simulation.stepping import Stepping

MAX_RETRIES = 4
CFL_LIMIT = 0.5  # an adaptive frame that exceeds it is repeated with shorter substeps


class Launched:
    """A frame whose work is passed to the device; the host waits for it in :meth:`finish`, once.

    Args:
        simulation: The simulation.
        before: The state at the start of the frame.
    """

    def __init__(self, simulation: Stepping, before: MPMState) -> None:
        self._simulation, self._before = simulation, before
        self._error: Exception | None = None
        try:
            with self._explained():
                self._parts = parts_of(simulation)
                self._steps = simulation.substeps(before, self._parts)
                self._end, self._measurement = self._launch(0)
        except Exception as error:  # `finish` raises it
            self._error = error

    def finish(self) -> tuple[MPMState, FrameDiagnostics]:
        """Wait, and repeat the frame where its substep was too long or its grid too small.

        Returns:
            The state at the end of the frame, and its diagnostics.

        Raises:
            SimulationDiverged: If the simulation diverged in the frame.
        """
        if self._error is not None:
            raise self._error
        simulation, solver, margin = self._simulation, self._simulation.solver, 0
        with simulation.turn, self._explained():
            for retry in range(MAX_RETRIES + 1):
                cfl, outrun = self._measurement.cfl, self._measurement.outran
                too_long = solver.substep is None and not cfl <= max(CFL_LIMIT, 1.25 * solver.cfl)
                if retry == MAX_RETRIES or not (outrun or too_long):
                    break
                if outrun:
                    margin = 4 * max(margin, 4)
                if too_long:
                    growth = cfl / solver.cfl if math.isfinite(cfl) else 4.0
                    self._steps = int(self._steps * min(growth * 1.1, 4.0)) + 1
                self._end, self._measurement = self._launch(margin)
        found = self._measurement.read(check=True)
        if not cfl <= MAX_CFL:
            cause = f"the Courant number of the frame is {cfl:.3g}, and above {MAX_CFL:g} no substep is stable"
            simulation.give_up(self._end, cause)
        if self._measurement.more:
            simulation.outlook = Outlook(self._end, self._measurement.more, self._parts)
        return self._end, found

    def _launch(self, margin: int) -> tuple[MPMState, Measurement]:
        simulation, before, steps = self._simulation, self._before, self._steps
        if steps > simulation.most_substeps:
            cause = f"a frame would take {steps:,} substeps, more than the limit of {simulation.most_substeps:,}"
            simulation.give_up(before, cause, "weaken the wind or the boundary that drives the particle")
        end, courant = simulation._roll(simulation.solver.fit_grid(before, simulation.frame_dt, margin), steps)
        work = (end.work - before.work).sum()
        return end, simulation.measured(end, steps, courant, work, before, self._parts)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn errors of this package into SimulationDiverged.

        They are: a fixed substep that became too long, a grid that grew beyond its limit, a position that is NaN.
        """
        try:
            yield
        except (FloatingPointError, ValueError) as error:
            if not _raised_here(error):  # by a custom wind, force or boundary
                raise
            self._simulation.give_up(self._before, str(error).rstrip("."))


class Outlook:
    """What decides how many substeps the next frame takes, read with the measurements of this one.

    Args:
        state: The state at the end of the frame.
        needs: The numbers of :func:`needs_of`.
        parts: What :func:`parts_of` said when they were measured.
    """

    def __init__(self, state: MPMState, needs: list[float], parts: tuple[object, ...] | None) -> None:
        self.needs, self._parts = needs, parts
        self._read = [weakref.ref(tensor) for tensor in _read(state)]

    def holds(self, state: MPMState, parts: tuple[object, ...] | None) -> bool:
        """Whether the frame starts from this state, with nothing changed since; ``parts`` is what they are now."""
        same = all(known() is tensor for known, tensor in zip(self._read, _read(state), strict=False))
        return same and self._parts is not None and self._parts == parts


def _read(state: MPMState) -> list[Tensor]:
    """What the needs depend on in a state."""
    found = (state.F_elastic, state.internal, state.velocity, state.time)
    return [tensor for tensor in found if tensor is not None]


def parts_of(simulation: Stepping) -> tuple[object, ...] | None:
    """What the needs depend on besides the state; None if that cannot be told, or if it is on another device."""
    wind = simulation.wind_force
    tensors = tensors_in([wind])
    if any(tensor.is_inference() or tensor.device != simulation.device for tensor in tensors):
        return None
    made = {id(tensor) for tensor in wind.refreshed()}  # from the state, in every frame
    versions = tuple(tensor._version for tensor in tensors if id(tensor) not in made)
    return (simulation.solver.bound, fingerprint([wind]), versions)


def needs_of(simulation: Stepping, state: MPMState, winds: Tensor | None) -> Tensor:
    """Cells that the fastest wave crosses per second; rate of the drag [1/s] and speed of the wind [m/s]; float64.

    Args:
        simulation: The simulation.
        state: The state at the start of a frame.
        winds: Air velocities during the frame [m/s], shape (K, ...), from ``WindForce.samples``; None if the wind has
            no effect.
    """
    cells = simulation.solver.cells_per_second(state).double()
    if winds is None:
        return torch.stack([cells, *cells.new_zeros(2)])
    wind = torch.linalg.vector_norm(winds, dim=-1).amax().to(state.velocity.dtype)
    speed = wind + torch.linalg.vector_norm(state.velocity, dim=-1)
    fastest = simulation.aero.rate(speed, simulation.wind_force.area, simulation.solver.points.mass).amax()
    return torch.stack([cells, fastest.double(), wind.double()])


def _raised_here(error: BaseException) -> bool:
    """Whether an error was raised by this package, and not by code that it called."""
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    return place is not None and str(place.tb_frame.f_globals.get("__name__")).startswith("gaussian_swaying.")
