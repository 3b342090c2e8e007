"""Several simulations of equal shape in one: their states have a batch dimension, so a GPU does all of them at once."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.aero.wind_batch import WindBatch
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.simulation.diagnostics import (
    FrameDiagnostics,
    Gauge,
    Measurement,
    SceneDiagnostics,
    SimulationDiverged,
    measure_scenes,
)
from gaussian_swaying.simulation.parameters import with_values
from gaussian_swaying.simulation.run import Run, splat_checksum
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.simulation.stepping import MAX_GROWTH, MAX_SUBSTEPS, needs_of

M = TypeVar("M", bound=nn.Module)


def variant(first: Simulation, values: Mapping[str, Any], recorder: Recorder, config: str) -> Simulation:
    """A simulation of the same scene with other numbers.

    Args:
        first: A simulation whose :meth:`~Simulation.start` was called; all its other parts are shared.
        values: Values of parameters that may differ within a batch, see
            :mod:`gaussian_swaying.simulation.parameters`.
        recorder: Outputs of a run of it.
        config: Its configuration as YAML.

    Raises:
        ValueError: As :meth:`Simulation.change`.
    """
    other, before = _shallow(first), first.setup
    setup = with_values(before, values)
    other._modules["wind"] = setup.wind.to(first.device)
    if setup.points is not before.points:
        solver = _shallow(first.solver)
        solver.init_state(setup.points, frame=first.scene.frame)
        other._modules["solver"] = solver
    vars(other).update(_wind_force=[], _wind_parts=(), _idle=None, outlook=None, recorder=recorder)
    other.config = config
    return other


def _shallow(module: M) -> M:
    """A copy with the same parts, which can be replaced."""
    other = copy(module)
    vars(other)["_modules"] = dict(vars(module)["_modules"])
    return other


def why_apart(simulation: Simulation) -> str | None:
    """Return the reason why a simulation cannot share a rollout with others; None if it can."""
    wind = simulation.wind
    if not isinstance(wind, WindField) or not wind.uniform:
        return "the wind differs from place to place"
    if simulation.scene.surface_places is not None:
        return "it touches itself or an obstacle"
    if len(simulation.custom_forces) or simulation.editor.edits:
        return "it has custom forces or edits"
    if not simulation.solver.neighbours_fixed:
        return "`solver.formulation` is updated"
    if simulation.wind_force.sums is not None:
        return "its material points have patches of several directions"
    return None


class Together(Simulation):
    """Simulations of equal shape whose states are advanced together, with as many substeps as the fastest one needs.

    Args:
        members: From :func:`variant`, and the simulation that they were made from.

    Raises:
        ValueError: If they cannot be done together.
    """

    def __init__(self, members: Sequence[Simulation]) -> None:
        first = members[0]
        vars(self).update(vars(_shallow(first)))
        reasons = [why for member in members if (why := why_apart(member)) is not None]
        if reasons:
            raise ValueError(f"These runs cannot be simulated together: {reasons[0]}.")
        self.members = list(members)
        winds = WindBatch([member.wind for member in members if isinstance(member.wind, WindField)])
        self._modules["wind"] = winds
        self._modules["solver"] = _shallow(first.solver)
        wind_force = WindForce(self.aero, winds, first.wind_force.normal, first.wind_force.area)
        vars(self).update(_idle=None, _gauge=Gauge(), outlook=None, progress=None, _wind_force=[wind_force])

    @property
    def wind_force(self) -> WindForce:
        """The winds on the patches of every scene."""
        return self._wind_force[0]

    @property
    def forces(self) -> list[Force]:
        """The wind, unless it has no effect."""
        return [] if self.idle else [self.wind_force]

    def start(self) -> MPMState:
        """The states at rest at time zero, shapes (B, P, ·)."""
        points = MaterialPoints.stack([member.solver.points for member in self.members])
        state = self.solver.init_state(points, frame=self.scene.frame)
        self.solver.fused()
        self.most_substeps = min(MAX_GROWTH * self.solver.substeps(state, self.frame_dt), MAX_SUBSTEPS)
        return state

    def measured(
        self,
        end: MPMState,
        steps: int,
        courant: Tensor,
        work: Tensor,
        state: MPMState,
        parts: tuple[object, ...] | None,
    ) -> Measurement:
        """As ``Simulation.measured``, for each scene."""
        more = None
        if self.foresees:
            more = needs_of(self, end, None if self.idle else self.wind_force.samples(end, self.frame_dt / 4, 5))
        return measure_scenes(self.solver, end, steps, courant, state, more)

    def record(
        self, folders: Sequence[Path | None], frames: int, settings: Sequence[Mapping[str, Any]]
    ) -> list[dict[str, Any] | None]:
        """Simulate, draw and record all of them, as ``Simulation.run`` does for one.

        There are no checkpoints: what is interrupted starts again.

        Args:
            folders: Folder of each; None for one that is only simulated.
            frames: Number of frames.
            settings: Further entries of each summary.

        Returns:
            The summaries.

        Raises:
            SimulationDiverged: If one of them diverges.
        """
        with torch.inference_mode():
            return self._record(folders, frames, settings)

    def _record(
        self, folders: Sequence[Path | None], frames: int, settings: Sequence[Mapping[str, Any]]
    ) -> list[dict[str, Any] | None]:
        state = self.start()
        splat, opened, runs = splat_checksum(self), [], dict[int, Run]()
        try:
            for index, (member, folder) in enumerate(zip(self.members, folders, strict=True)):
                if folder is not None:
                    cameras = tuple(member.painter.cameras)
                    member.recorder.open(folder, member.config, False, 1 / self.frame_dt, cameras, alone=False)
                    opened.append(member.recorder)
                    runs[index] = Run(member, frames, splat, member.config)
            begin = time.perf_counter()
            if self.device.type == "cuda" and frames > 1:  # compiles the kernels; the real frame reports an error
                with suppress(SimulationDiverged):
                    self.advance(state)
            startup = (time.perf_counter() - begin) / len(self.members)
            begin = time.perf_counter()
            health: FrameDiagnostics = measure_scenes(self.solver, state, 0, 0.0, state).read()
            for frame in range(frames):
                launched = self.launch(state) if frame + 1 < frames else None
                assert isinstance(health, SceneDiagnostics)
                for index, run in runs.items():
                    if run.recording:
                        run.record(state.scene(index), frame)
                    run.log.append(health.each[index].as_dict())
                if launched is not None:
                    state, health = launched.finish()
            for recorder in opened:
                recorder.wait()
            seconds = (time.perf_counter() - begin) / len(self.members)
            found: list[dict[str, Any] | None] = [None] * len(self.members)
            for index, run in runs.items():
                drawn = sum(value for part, value in run.walls.read(wait=True).items() if part != "writing")
                run.walls.seconds["simulation"] = max(seconds - drawn, 0.0)  # its share of what they took together
                run.walls.seconds["startup"] = startup
                found[index] = run.close("complete", None, state.scene(index), frames, dict(settings[index]))
            return found
        finally:
            for recorder in opened:
                recorder.release()


__all__ = ["Together", "variant", "why_apart"]
