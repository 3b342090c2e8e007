"""How a simulation gets from one state to the next: the state at rest, edits, substeps, and what a frame needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn

import torch
from torch import Tensor, nn

from gaussian_swaying._turns import Turn, in_turn
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import SpatialWind, WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import rounding_speed
from gaussian_swaying.simulation.diagnostics import (
    FrameDiagnostics,
    Gauge,
    Measurement,
    SimulationDiverged,
    TearingGauge,
    check_spacing,
    measure,
)
from gaussian_swaying.simulation.edits import Edit, SceneEditor
from gaussian_swaying.simulation.launch import Launched, Outlook, needs_of
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
        self._started = 0  # how often; a loop over frames ends when another one begins

    # ---- parts

    @property
    def scene(self) -> SimulatedScene:
        """Gaussians, material points and patches."""
        return self.painter.scene

    @property
    def turn(self) -> Turn:
        """Held by the thread that steps or draws."""
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
        """Whether the wind has no effect; computed again only if a coefficient changed, as it makes the host wait."""
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
            edits: What to change, in this order.

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
            parts: From :func:`~gaussian_swaying.simulation.launch.parts_of`.
        """
        if self._tearing is not None or not self.foresees:
            return measure(self.solver, end, steps, courant, work, self._tearing, state)
        idle = self.idle

        def needs(at: MPMState) -> Tensor:
            return needs_of(self, at, None if idle else self._winds(self.wind_force.foreseen(at), at))

        same = None if parts is None else (idle, self.frame_dt, parts)
        return self._gauge(self.solver, end, steps, courant, work, state, needs, same)

    def give_up(self, state: MPMState, cause: str, remedy: str | None = None) -> NoReturn:
        """Raise SimulationDiverged, naming the particle with the largest deformation."""
        particle = int(state.F_elastic.square().sum((-1, -2)).reshape(-1).argmax())
        if remedy is None:
            field = "solver.cfl" if self.solver.substep is None else "solver.substep"
            remedy = f"lower `{field}`, or weaken the wind or the boundary that drives it"
        raise SimulationDiverged(float(state.time), particle, cause, remedy)

    @property
    def foresees(self) -> bool:
        """Whether the needs of the next frame are measured at the end of a frame, so that the host waits once."""
        simple = self.solver.substep is None and self.solver.stiffness_damping == 0
        return simple and self.solver.has_kernels and self.wind_force.recordable

    @in_turn
    def substeps(self, state: MPMState, parts: tuple[object, ...] | None = None) -> int:
        """How many substeps the next frame takes, for waves in the material and explicit drag on light patches.

        Args:
            state: The state at its start.
            parts: From :func:`~gaussian_swaying.simulation.launch.parts_of`; with it, what is known is not measured.
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
