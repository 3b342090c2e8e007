"""Stepping of a simulation from one state to the next: the state at rest, edits, substeps, and their number."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor, nn

from gaussian_swaying._graphs import fingerprint, tensors_in
from gaussian_swaying._turns import Turn, in_turn
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import SpatialWind, WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import MAX_CFL, rounding_speed
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.simulation.diagnostics import (
    FrameDiagnostics,
    Gauge,
    Measurement,
    SimulationDiverged,
    TearingGauge,
    check_spacing,
    diagnose,
    measure,
)
from gaussian_swaying.simulation.edits import Edit, SceneEditor
from gaussian_swaying.simulation.frame import Frame
from gaussian_swaying.simulation.painter import Painter
from gaussian_swaying.simulation.progress import RunProgress
from gaussian_swaying.simulation.scene import SimulatedScene

CFL_SAMPLES = 8  # checks per frame, as material may stiffen and soften again within it
MAX_WIND = 1e6  # m/s; anything above is a mistake and would overflow positions
MAX_GROWTH = 1000  # a frame that takes this many times the substeps of the first ends the run
MAX_SUBSTEPS = 1_000_000  # per frame: hours on a CPU, and minutes on the fastest GPU

ROUNDING_SHARE = 0.5
"""Share of the driving speed that the bound of :func:`rounding_speed` may reach in a second; rounding itself reaches a
tenth of its bound or so."""


MAX_RETRIES = 4  # of a frame
CFL_LIMIT = 0.5  # an adaptive frame that exceeds it is repeated with shorter substeps


class Stepping(nn.Module):
    """The part of a :class:`~gaussian_swaying.simulation.simulation.Simulation` that changes its state.

    The constructor of the simulation sets the components.
    """

    painter: Painter
    solver: MPMSolver
    wind: WindField | SpatialWind
    aero: AeroForce
    custom_forces: nn.ModuleList
    editor: SceneEditor
    frame_dt: float
    recorder: Recorder
    config: str | property

    def __init__(self) -> None:
        super().__init__()
        self.most_substeps = MAX_SUBSTEPS
        self.outlook: Outlook | None = None  # on the next frame
        self.progress: RunProgress | None = None  # of the current run
        self._wind_force: list[WindForce] = []  # in a list, so that it is not part of the module's state
        self._wind_parts: tuple[object, ...] = ()
        self._idle: tuple[tuple[object, ...], bool] | None = None
        self._tearing: TearingGauge | None = None
        self._gauge = Gauge()
        self.files: list[Path] = []  # what the last run wrote
        self.resumable: tuple[Path, int] | None = None  # the checkpoint of the last run, and its frame
        self._started = 0  # how often; a loop over frames ends when another one begins

    # ---- parts

    @property
    def scene(self) -> SimulatedScene:
        """Gaussians, material points and patches."""
        return self.painter.scene

    @property
    def turn(self) -> Turn:
        """The lock of the thread that steps or draws."""
        return self.painter.turn

    @property
    def device(self) -> torch.device:
        """Device of the components."""
        return self.painter.device

    @property
    def wind_force(self) -> WindForce:
        """The wind on the patches of the scene."""
        parts = (self.aero, self.wind, self.scene.patches)
        if not self._wind_force or any(a is not b for a, b in zip(parts, self._wind_parts, strict=True)):
            with torch.inference_mode(False), torch.no_grad():  # it outlives the call
                self._wind_force, self._wind_parts = [WindForce(*parts)], parts
        return self._wind_force[0]

    @property
    def idle(self) -> bool:
        """True if the wind has no effect; computed again only if a coefficient changed, as it makes the host wait."""
        aero = self.aero
        key = (aero, aero.air_density, *(0 if c.is_inference() else c._version for c in (aero.C_D, aero.C_F, aero.C_L)))
        if self._idle is None or self._idle[0] != key:
            self._idle = (key, aero.idle)
        return self._idle[1]

    @property
    def forces(self) -> list[Force]:
        """The forces on the particles besides gravity: the wind, unless it has no effect, and the custom forces."""
        custom = [force for force in self.custom_forces if isinstance(force, Force)]
        return custom if self.idle else [self.wind_force, *custom]

    def flows(self) -> Tensor:
        """Flows of the wind without gusts [m/s], shape (K, 3); those of a spatial wind are at the particles."""
        if isinstance(self.wind, WindField):
            return self.wind.flows
        position = self.scene.points.position
        return self.wind_force.air(torch.zeros((), dtype=torch.float64, device=position.device), position)

    # ---- at rest

    @in_turn
    def start(self) -> MPMState:
        """The state at rest at time zero, with the edits of that time applied.

        Raises:
            ValueError: If a pin holds nothing, the grid is too large or a fixed substep is too long, now or after one
                of the edits; if the material is so stiff that rounding shakes it.
        """
        editor, frame = self.editor, self.scene.frame
        self._started += 1
        editor.reset()
        for later in (moment for moment in editor.times if moment > 0):  # refuse impossible edits now
            self._edit(editor.due(0.0))
            self._edit(editor.due(later), flowed=True)
            rehearsed = self.solver.init_state(self.scene.points, frame=frame, surface=self.scene.surface_places)
            self.solver.fused()
            self.solver.substeps(rehearsed, self.frame_dt)
        editor.reset()
        self._edit(editor.due(0.0))
        state = self.solver.init_state(self.scene.points, frame=frame, surface=self.scene.surface_places)
        self._idle = None  # coefficients may have changed
        check_spacing(self.solver)
        self.solver.fused()  # errors of its kernels are raised here
        at_rest = self.solver.substeps(state, self.frame_dt)
        if at_rest > MAX_SUBSTEPS:
            remedy = "soften it (`material.E`, `material.nu`), raise its density or `solver.dx`, or shorten `frame_dt`"
            if self.solver.substep is not None:
                remedy = "raise `solver.substep`, set it to null for the longest that is stable, or shorten `frame_dt`"
            raise ValueError(
                f"A frame of {self.frame_dt:g} s would take {at_rest:,} substeps with this material and grid, more "
                f"than the limit of {MAX_SUBSTEPS:,}: {remedy}."
            )
        self._check_rounding(state, self.frame_dt / at_rest)
        self.most_substeps = min(MAX_GROWTH * at_rest, MAX_SUBSTEPS)
        self._tearing = None if self.solver.neighbours_fixed else TearingGauge(self.solver)
        return state

    def _check_rounding(self, state: MPMState, dt: float) -> None:
        """Raise ValueError if rounding moves the material at rest nearly as fast as wind and gravity do."""
        drive = math.hypot(*self.solver.gravity)  # for a second
        if not self.idle:
            drive = max(drive, float(torch.linalg.vector_norm(self.flows().detach(), dim=-1).amax()))
        speed, dtype = float(self.solver.cells_per_second(state)) * self.solver.dx, state.position.dtype
        shaken = rounding_speed(speed, dt, 1.0 / dt, self.solver.dx, dtype)
        if drive > 0 and shaken > ROUNDING_SHARE * drive:
            raise ValueError(
                f"Rounding to {str(dtype).removeprefix('torch.')} may shake this stiff material by {shaken:.2g} m/s "
                f"within a second, more than {ROUNDING_SHARE:g} of what drives it (wind, or gravity for a second, of "
                f"{drive:.2g} m/s): lower `material.E` or `material.nu`, or set `dtype` to float64."
            )

    # ---- edits

    @in_turn
    def edit(self, state: MPMState, *edits: Edit) -> MPMState:
        """Change material or colour now, between two frames; the time of the edits is ignored.

        The solver is set up again for the new material, including its kernels and CUDA graphs. Positions, velocities
        and deformations stay, so momentum changes with the mass and elastic energy with the stiffness.

        Args:
            state: The current state.
            edits: The changes, in this order.

        Returns:
            The state from which the run continues.

        Raises:
            ValueError: If a region contains nothing, or a plastic law is used in the ``total`` formulation.
        """
        before = self.editor.snapshot()
        try:
            return self._take(state, self._edit(edits, flowed=True))
        except Exception:  # nothing stays half changed
            self.editor.restore(before)
            self.solver.init_state(self.scene.points, frame=self.scene.frame, surface=self.scene.surface_places)
            raise

    def _edit(self, edits: Sequence[Edit], flowed: bool = False) -> Tensor | None:
        """Change the scene; returns which particles (P,) got another law, None if the material is the same."""
        changed = [self.editor.apply(edit, flowed) for edit in edits]
        changed = [part for part, edit in zip(changed, edits, strict=True) if edit.of_material]
        return torch.stack(changed).any(0) if changed else None

    def _take(self, state: MPMState, changed: Tensor | None) -> MPMState:
        """Bind the solver to the material of the scene; ``changed`` as from :meth:`_edit`."""
        if changed is None:
            return state
        scene = self.scene
        start = self.solver.init_state(scene.points, frame=scene.frame, surface=scene.surface_places).internal
        if start is not None and state.internal is not None:
            start = torch.where(changed, start, state.internal)
        state = state.replace(internal=start)
        self.solver.fused()
        self.most_substeps = max(
            self.most_substeps, min(MAX_GROWTH * self.solver.substeps(state, self.frame_dt), MAX_SUBSTEPS)
        )
        if self._tearing is not None:
            elastic = self.solver.laws.elastic_particles()
            if elastic is not None:  # particles that flowed apart before are not torn
                self._tearing.elastic = elastic if self._tearing.elastic is None else elastic & self._tearing.elastic
        return state

    @in_turn
    def edit_due(self, state: MPMState, resumed: bool = False) -> MPMState:
        """Apply the edits up to the time of a state; a resumed state contains them already."""
        if not self.editor.edits:  # the host need not wait for the time
            return state
        edits = self.editor.due(float(state.time) + 1e-3 * self.frame_dt)
        edited = self._take(state, self._edit(edits, flowed=True))
        return state if resumed else edited

    # ---- a frame

    @in_turn
    def advance(self, state: MPMState) -> tuple[MPMState, FrameDiagnostics]:
        """Advance by one frame.

        If the material stiffens so much that the substep was too long, the frame is thrown away and repeated with a
        shorter one. If a particle outruns the grid of the ``updated`` formulation, the frame is repeated on a larger
        grid.

        Args:
            state: The state at the start of the frame.

        Returns:
            The state at its end, and its diagnostics.

        Raises:
            SimulationDiverged: If the simulation diverges in the frame.
        """
        return self.launch(state).finish()

    @in_turn
    def launch(self, state: MPMState) -> Launched:
        """Pass a frame to the device; ``launch(state).finish()`` is :meth:`advance`, and the host can work between.

        Args:
            state: The state at the start of the frame.

        Returns:
            The frame. An error of it is raised by its ``finish``.
        """
        if not self.idle:
            self.wind_force.refresh(state)
        return Launched(self, state)

    def measured(
        self,
        end: MPMState,
        steps: int,
        courant: Tensor,
        work: Tensor,
        state: MPMState,
        parts: tuple[object, ...] | None,
    ) -> Measurement:
        """Start the measurements of a frame from ``state`` to ``end``, and of what the next one needs.

        Args:
            end: The state at its end.
            steps: Its substeps.
            courant: Its largest Courant number.
            work: Work of the wind in it [J].
            state: The state at its start.
            parts: From :func:`~gaussian_swaying.simulation.stepping.parts_of`.
        """
        if self._tearing is not None or not self.foresees:
            return measure(self.solver, end, steps, courant, work, self._tearing, state)
        idle = self.idle

        def needs(at: MPMState) -> Tensor:
            return needs_of(self, at, None if idle else self._winds(self.wind_force.foreseen(at), at))

        same = None if parts is None else (idle, self.frame_dt, parts)
        return self._gauge(self.solver, end, steps, courant, work, state, needs, same)

    def frames_from(
        self, state: MPMState, first: int, count: int, drawn: torch.cuda.Stream | None = None
    ) -> Iterator[Frame]:
        """The frames from number ``first`` up to ``count``.

        Args:
            state: The state at rest from :meth:`start` if ``first`` is 0, otherwise the state of the frame before.
            first: Number of the first frame.
            count: Number of frames of the whole run.
            drawn: A stream on which the frames are drawn and recorded. The next frame is then simulated at the same
                time, so that the GPU does not wait for the host, and what is assigned between two frames applies from
                the next but one on.
        """
        return self._loop(self._started, state, first, count, drawn)

    def _loop(
        self, started: int, state: MPMState, first: int, count: int, drawn: torch.cuda.Stream | None
    ) -> Iterator[Frame]:
        launched: Launched | None = None
        for index in range(first, count):
            with self.turn:
                if self._started != started:
                    raise RuntimeError(
                        "This simulation was started again, so the earlier loop over its frames cannot go on: finish "
                        "one loop before the next, or make a Simulation for each."
                    )
                if index == 0:
                    health = diagnose(self.solver, state, 0, 0.0)
                else:
                    if launched is None:
                        self._begin(index)
                    state, health = self.advance(state) if launched is None else launched.finish()
                    if drawn is not None:  # the frame before may still be drawn from memory that is now free
                        torch.cuda.current_stream(self.device).wait_stream(drawn)
                    state = self.edit_due(state)
                if drawn is not None and index + 1 < count:
                    drawn.wait_stream(torch.cuda.current_stream(self.device))
                    self._begin(index + 1)
                    launched = self.launch(state)
                frame = Frame(self, index, state, health, self.editor.version)
            yield frame

    def _begin(self, index: int) -> None:
        if self.progress is not None:
            self.progress.begin(index)

    @in_turn
    def wind_pressure(self, state: MPMState) -> Tensor:
        """Force of the wind per area of the Gaussians as they are now [Pa], shape (N,); 0 for those without wind."""
        scene = self.scene
        if self.idle:
            return scene.on_gaussians(torch.zeros_like(scene.in_wind, dtype=state.position.dtype))
        move, F = scene.follow.motion(state)
        normal, area = deform_patch(F, scene.rest_facing.to(F), F.new_ones(len(F)))
        place = scene.frame.point_to_sim(scene.model.means[scene.moving].double()).to(move) + move
        wind = self.wind_force.air(state.time, place)
        force = self.aero(wind, scene.follow.velocity(state), normal, torch.ones_like(area))
        return scene.on_gaussians(torch.where(scene.in_wind, torch.linalg.vector_norm(force, dim=-1), 0.0))

    def force_scale(self) -> float:
        """Force per area [Pa] that the wind's flow, without gusts, can exert on a patch at rest; 1 in still air."""
        speed = float(torch.linalg.vector_norm(self.flows().detach(), dim=-1).amax())
        coefficients = float(torch.stack([self.aero.C_D, self.aero.C_F, self.aero.C_L]).detach().abs().sum())
        return 0.5 * self.aero.air_density * speed**2 * coefficients or 1.0

    def give_up(self, state: MPMState, cause: str, remedy: str | None = None) -> NoReturn:
        """Raise SimulationDiverged, naming the particle with the largest deformation."""
        particle = int(state.F_elastic.square().sum((-1, -2)).reshape(-1).argmax())
        if remedy is None:
            field = "solver.cfl" if self.solver.substep is None else "solver.substep"
            remedy = f"lower `{field}`, or weaken the wind or the boundary that drives it"
        raise SimulationDiverged(float(state.time), particle, cause, remedy)

    @property
    def foresees(self) -> bool:
        """True if the needs of the next frame are measured at the end of a frame, so that the host waits once."""
        simple = self.solver.substep is None and self.solver.stiffness_damping == 0
        return simple and self.solver.has_kernels and self.wind_force.recordable

    @in_turn
    def substeps(self, state: MPMState, parts: tuple[object, ...] | None = None) -> int:
        """Return the number of substeps of the next frame, from waves in the material and drag on light patches.

        Args:
            state: The state at its start.
            parts: From :func:`~gaussian_swaying.simulation.stepping.parts_of`; with it, what is known is not measured.
        """
        if self.outlook is not None and self.outlook.holds(state, parts):
            cells, rate, blowing = self.outlook.needs
        else:
            winds = None if self.idle else self._winds(self.wind_force, state)
            cells, rate, blowing = needs_of(self, state, winds).tolist()
        steps = self.solver.substeps(state, self.frame_dt, cells)
        if not (math.isfinite(rate) and blowing < MAX_WIND):
            cause = f"the wind of {blowing:.3g} m/s, or its drag, is NaN or infinite or beyond {MAX_WIND:g} m/s"
            self.give_up(state, cause, "check the flow and the modulations of the wind")
        return steps if self.aero.drag_step == "semi_implicit" else max(steps, int(rate * self.frame_dt) + 1)

    def _winds(self, force: WindForce, state: MPMState) -> Tensor:
        """Velocities of the air in the frame that starts with a state [m/s], shape (5, ...)."""
        return force.samples(state, self.frame_dt / 4, 5)

    def _roll(self, state: MPMState, steps: int) -> tuple[MPMState, Tensor]:
        """The state some substeps later, and the largest Courant number on the way."""
        progress = self.progress
        watch = None if progress is None else lambda done: progress.substep(done, steps)
        # the end of a frame is checked with its measurements, as each check makes the host wait
        return self.solver.watched_rollout(
            state, self.frame_dt / steps, steps, self.forces, CFL_SAMPLES, watch, check=False
        )


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
    """The numbers that decide how many substeps the next frame takes, read with the measurements of this one.

    Args:
        state: The state at the end of the frame.
        needs: The numbers of :func:`needs_of`.
        parts: The result of :func:`parts_of` when they were measured.
    """

    def __init__(self, state: MPMState, needs: list[float], parts: tuple[object, ...] | None) -> None:
        self.needs, self._parts = needs, parts
        self._read = [weakref.ref(tensor) for tensor in _read(state)]

    def holds(self, state: MPMState, parts: tuple[object, ...] | None) -> bool:
        """True if the frame starts from this state and nothing changed since; ``parts`` is the result of now."""
        same = all(known() is tensor for known, tensor in zip(self._read, _read(state), strict=False))
        return same and self._parts is not None and self._parts == parts


def _read(state: MPMState) -> list[Tensor]:
    """Return the fields of a state that the needs depend on."""
    found = (state.F_elastic, state.internal, state.velocity, state.time)
    return [tensor for tensor in found if tensor is not None]


def parts_of(simulation: Stepping) -> tuple[object, ...] | None:
    """Return the key of all that the needs depend on besides the state; None if changes cannot be detected.

    That is so for tensors of inference mode, and for tensors on another device than the simulation.
    """
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
    """True if an error was raised by this package, and not by code that it called."""
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    return place is not None and str(place.tb_frame.f_globals.get("__name__")).startswith("gaussian_swaying.")
