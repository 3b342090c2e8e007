"""From one state to the next, frame by frame: of one scene, or of several of equal shape in one rollout."""

from __future__ import annotations

import math
import operator
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from typing import NoReturn

import torch
from torch import Tensor, nn

from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying._turns import Turn, in_turn
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.geometry.regions import whereabouts
from gaussian_swaying.kernels.graphs import recorded_key, tensors_in
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.joints import Joints
from gaussian_swaying.mpm.modes import MOST_LEAN, Modes
from gaussian_swaying.mpm.pins import Impulse, PinnedPoints, PinnedRegion, RigidRegion
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, State
from gaussian_swaying.mpm.timestep import MAX_CFL, rounding_speed, stable_limit
from gaussian_swaying.recording.recorder import Recorder
from gaussian_swaying.rendering.passes import PASSES
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.measure import (
    FrameDiagnostics,
    Gauge,
    Measurement,
    RunProgress,
    SimulationDiverged,
    TearingGauge,
    check_spacing,
    measure,
)
from gaussian_swaying.simulation.model import Copy, Edit, Model, edited_points, recolored
from gaussian_swaying.wind.computed_air import AirInBox
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AirLift, Wind, WindForce, carried_mass, with_added_mass
from gaussian_swaying.wind.patches import Patches
from gaussian_swaying.wind.tables import Shelter


class Copies(nn.Module):
    """Copies of an object: a point ``x`` lies at ``A x + b`` in each copy, which feels the wind there.

    Args:
        copies: The copies.
        model: The object; turns are about what its pins hold.
        solver: Its solver.

    Attributes:
        rotation: ``A``, the rotation along the axes of the scene, shape (B, 3, 3), float64.
        offset: ``b`` [scene units], shape (B, 3), float64.
        turn: Rotations from the axes of the object to those of the wind, shape (B, 3, 3), float64.
        shift: Displacements after them [m], shape (B, 3), float64.
        delay: Times by which the wind comes later [s], shape (B,), float64.
    """

    rotation: Tensor
    offset: Tensor

    def __init__(self, copies: Sequence[Copy], model: Model, solver: Solver) -> None:
        super().__init__()
        if model.forces:
            raise ValueError("`copies` cannot have `forces` yet, as these act on one object: remove them.")
        if any(copy.seed is not None for copy in copies) and not isinstance(model.wind, WindField):
            raise ValueError("Expected `copies.seed` null with a wind of your own, which has no seed: use `delay`.")
        if any(copy.turn for copy in copies) and any(solver.gravity[:2]):
            raise ValueError(
                "`copies` with a `turn` need `solver.gravity` along z: each is simulated in its own turned axes."
            )
        self.copies, frame = tuple(copies), model.scene.frame
        eye, axes = torch.eye(3, dtype=torch.float64), frame.rotation
        turn = torch.stack([_turn(copy.turn) for copy in copies])
        shift = torch.tensor([copy.shift for copy in copies], dtype=torch.float64)
        shift = shift + (eye - turn) @ _foot(model.scene, solver.boundaries)
        rotation = eye + axes.T @ (turn - eye) @ axes  # exactly I where the copy is not turned
        offset = (eye - rotation) @ frame.origin + shift @ axes / frame.metres_per_unit
        delay = torch.tensor([copy.delay for copy in copies], dtype=torch.float64)
        values = {"rotation": rotation, "offset": offset, "turn": turn, "shift": shift, "delay": delay}
        for name, value in values.items():
            self.register_buffer(name, value, persistent=False)

    def __len__(self) -> int:
        return len(self.copies)

    def winds(self, wind: Wind) -> Wind | Sequence[Wind]:
        """The wind, with the gusts of each copy."""
        if not isinstance(wind, WindField):
            return [wind] * len(self)
        own = int(wind.seed)
        return wind.with_seeds([
            copy.seed if copy.seed is not None else own + number * (copy.delay == 0)
            for number, copy in enumerate(self.copies)
        ])  # fmt: skip

    def place(self, copy: int, points: Tensor) -> Tensor:
        """Points (..., 3) of the object transformed to a copy [scene units], in float64."""
        return (in_double(points) @ self.rotation[copy].mT + self.offset[copy]).to(points)

    def in_object(self, point: Tensor) -> Tensor:
        """Points of the object that coincide with a scene point (3,) in each copy [scene units], shape (B, 3)."""
        found: Tensor = ((point.to(self.offset) - self.offset)[:, None] @ self.rotation)[:, 0]
        return found


def check_recorder(recorder: Recorder) -> None:
    """Raise ValueError if a recorder writes what runs with copies do not have."""
    wrong = [f"`recorder.{name}`" for name in ("trajectory", "nodes") if getattr(recorder, name)]
    wrong += [f"{render} in `recorder.renders`" for render in recorder.renders if not PASSES[render].alone]
    if wrong:
        raise ValueError(f"`copies` are recorded as pictures only: leave out {', '.join(wrong)}.")


def _turn(degrees: float) -> Tensor:
    """Rotation about z, shape (3, 3), float64."""
    s, c = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _foot(scene: SimulatedScene, boundaries: Iterable[nn.Module]) -> Tensor:
    """Middle of what the pins hold [m], or of the object, shape (3,), float64."""
    points = scene.points.position.detach().double()
    held = []
    for pin in boundaries:
        if isinstance(pin, PinnedPoints):
            held.append(scene.frame.point_to_sim(pin.at))
        elif isinstance(pin, PinnedRegion):
            held.append(points[pin.region.contains(scene.frame.point_to_scene(points))])
    found = torch.cat(held) if held else points[:0]
    if not len(found):
        return torch.zeros(3, dtype=torch.float64)
    low, high = found.aminmax(dim=0)
    return 0.5 * (low + high)


CFL_SAMPLES = 8  # checks per frame, as material may stiffen and soften again within it
MAX_WIND = 1e6  # m/s; anything above is a mistake and would overflow positions
MAX_GROWTH = 1000  # a frame that takes this many times the substeps of the first ends the run
MAX_SUBSTEPS = 1_000_000  # per frame: hours on a CPU, and minutes on the fastest GPU
MAX_RETRIES = 4  # of a frame
CFL_LIMIT = 0.5  # an adaptive frame that exceeds it is repeated with shorter substeps
ROUNDING_SHARE = 0.5
"""Share of the driving speed that the bound of :func:`rounding_speed` may reach in a second; rounding itself reaches a
tenth of its bound or so."""


class Stepper:
    """Advances a state by frames, with as many substeps as it needs: of one scene, or of several as a batch.

    A frame whose substep was too long, as the material stiffened, is repeated with shorter ones; one whose particles
    outran the grid of ``updated`` with a larger grid. The scenes of a batch have the same Gaussians, coefficients of
    the wind's force and custom forces; winds and materials may differ. All take the substeps of the fastest.

    Args:
        solver: The solver.
        models: Scene, material and drivers; or those of each scene of a batch.
        turn: Lock of the thread that steps; its own if None.
        copies: Copies of the one scene, which are then the scenes of a batch; None for the scene alone.
        lenient: Whether a scene of a batch may diverge: it then ends in NaN, and the others go on.

    Attributes:
        model: Scene, material and drivers; those of the first scene of a batch, without the places of copies.
        models: The models of all scenes now; :meth:`take` changes them.
        starts: How often it was started.
        lift: Takes the weight of carried air off the points (``aero.added_mass``); None if there is none.
        progress: Shows how far a frame is, if there is one.
        most_substeps: A frame that needs more ends the run.

    Raises:
        ValueError: If the models cannot be a batch, see :func:`why_not_batched`.
    """

    def __init__(
        self,
        solver: Solver,
        models: Model | Sequence[Model],
        *,
        turn: Turn | None = None,
        copies: Copies | None = None,
        lenient: bool = False,
    ) -> None:
        self.batched, self.copies = copies is not None or not isinstance(models, Model), copies
        self.model = models if isinstance(models, Model) else models[0]
        self.models = self._spread(models) if isinstance(models, Model) else tuple(models)
        reasons = [why for model in self.models if self.batched and (why := why_not_batched(model)) is not None]
        if reasons:
            raise ValueError(f"These cannot be simulated as a batch: {reasons[0]}.")
        self.solver, self.lenient, self.turn = solver, lenient, turn or Turn()
        self.most_substeps, self.starts = MAX_SUBSTEPS, 0
        self.outlook: Outlook | None = None  # on the next frame
        self.progress: RunProgress | None = None  # of the current run
        self._steps = 1  # of the last frame
        self._wind_force: tuple[tuple[object, ...], WindForce] | None = None
        self._idle: tuple[tuple[object, ...], bool] | None = None
        self._joints: tuple[tuple[object, ...], Joints] | None = None
        self._materials: dict[tuple[int, int, float], tuple[MaterialPoints, Tensor, MaterialPoints]] = {}
        self._bound: tuple[MaterialPoints, ...] = ()
        self._rest: State | None = None
        self.lift: AirLift | None = None
        self._air: AirInBox | None = None
        self._tearing: TearingGauge | None = None
        self._gauge = Gauge()

    def __repr__(self) -> str:
        return f"Stepper({self.scene}, {self.solver})"

    # ---- what acts

    def _spread(self, model: Model) -> tuple[Model, ...]:
        return (model,) * (1 if self.copies is None else len(self.copies))

    @property
    def scene(self) -> SimulatedScene:
        return self.model.scene

    @property
    def frame_dt(self) -> float:
        """Length of a frame [s]."""
        return self.model.frame_dt

    @property
    def device(self) -> torch.device:
        return self.scene.identity.device

    @property
    def wind_force(self) -> WindForce:
        first = self.models[0]
        parts = (first.aero, first.scene.patches, *(model.wind for model in self.models))
        if self._wind_force is None or any(a is not b for a, b in zip(self._wind_force[0], parts, strict=True)):
            with torch.inference_mode(False), torch.no_grad():  # it outlives the call
                self._wind_force = parts, self._wind_on()
        return self._wind_force[1]

    def _wind_on(self) -> WindForce:
        first, winds, places = self.models[0], [model.wind for model in self.models], None
        alone = WindForce(first.aero, first.wind, first.scene.patches)
        if not self.batched:
            return alone
        wind: Wind | Sequence[Wind] = WindField.together(winds) or winds
        if self.copies is not None:
            wind, places = self.copies.winds(first.wind), self.copies.to(self.device)
        if alone.sums is None:
            return WindForce(first.aero, wind, alone.normal, alone.area, places)
        return WindForce(first.aero, wind, _repeated(first.scene.patches, len(winds)), places=places)

    @property
    def materials(self) -> tuple[MaterialPoints, ...]:
        """Material of each scene for the solver, with the mass of carried air."""
        known, self._materials, found = self._materials, {}, []
        for model in self.models:
            points, patches, aero = model.points, model.scene.patches, model.aero
            if aero.carried == 0:
                found.append(points)
                continue
            key = (id(points), id(patches.area), aero.carried)  # both are kept, so no new object gets their numbers
            entry = known.get(key) or self._materials.get(key)
            if entry is None:
                with torch.inference_mode(False), torch.enable_grad():  # it outlives the call
                    entry = points, patches.area, with_added_mass(points, patches, aero)
            self._materials[key] = entry
            found.append(entry[2])
        return tuple(found)

    @property
    def joints(self) -> list[Force]:
        """Force of the joints between parts, or None; rebuilt when the material changes."""
        joints = self.scene.joints
        if not joints:
            return []
        key = self.materials
        if self._joints is None or any(a is not b for a, b in zip(self._joints[0], key, strict=True)):
            with torch.inference_mode(False), torch.no_grad():  # it outlives the call
                longest = min(float(stable_limit(points, self.solver.dx).amin()) for points in key)
                made = [Joints(points, joints, longest) for points in {id(points): points for points in key}.values()]
                for name in ("stiffness", "turning"):  # as soft as the lightest scene of a batch needs it
                    assign(made[0], **{name: torch.stack([getattr(one, name) for one in made]).amin(0)})
                self._joints = key, made[0]
        return [self._joints[1]]

    @property
    def idle(self) -> bool:
        """True if the wind has no effect; computed again only if a coefficient changed, as it makes the host wait."""
        aero = self.model.aero
        key = (aero, aero.air_density, *(0 if c.is_inference() else c._version for c in (aero.C_D, aero.C_F, aero.C_L)))
        if self._idle is None or self._idle[0] != key:
            self._idle = (key, aero.idle)
        return self._idle[1]

    @property
    def forces(self) -> list[Force]:
        """The forces on the particles besides gravity: the wind, unless it has no effect, joints and custom forces.

        The lift of carried air is one of them. The force of computed air is not among them; :meth:`roll` adds it.
        """
        custom = [*([] if self.lift is None else [self.lift]), *self.joints, *self.model.forces]
        return custom if self.idle or self.model.air is not None else [self.wind_force, *custom]

    @property
    def air(self) -> AirInBox | None:
        """The computed air, if there is any; made by :meth:`start`."""
        return self._air

    def air_at(self, state: State, place: Tensor) -> Tensor:
        """Velocity of the air at places [m/s]: that of the computed air, or else that of the wind.

        Args:
            place: Places [m], shape (P, 3).

        Returns:
            Broadcastable to (P, 3).
        """
        if self._air is not None and state.air is not None:
            return self._air.velocity_at(state.air, place)
        return self.wind_force.air(state.time, place)

    def flows(self) -> Tensor:
        """Mean flows of the wind [m/s], shape (K, 3); of a spatial wind, at the particles."""
        winds = [model.wind for model in (self.models if self.copies is None else [self.model])]
        flows = [wind.flows for wind in winds if isinstance(wind, WindField)]
        if len(flows) == len(winds):
            return torch.cat(flows)
        position = self.model.points.position
        position = position.expand(len(self.models), *position.shape) if self.batched else position
        air = self.wind_force.air(torch.zeros((), dtype=torch.float64, device=position.device), position)
        return air.reshape(-1, 3)

    @in_turn
    def wind_pressure(self, state: State) -> Tensor:
        """Force of the wind per area of the Gaussians as they are now [Pa], shape (N,); 0 for those without wind."""
        scene = self.scene
        if self.idle:
            return scene.on_gaussians(torch.zeros_like(scene.in_wind, dtype=state.position.dtype))
        move, F = scene.follow.motion(state)
        normal, area = deform_patch(F, scene.rest_facing.to(F), F.new_ones(len(F)))
        place = scene.frame.point_to_sim(in_double(scene.model.means[scene.moving])).to(move) + move
        wind = self.air_at(state, place)
        force = self.model.aero(wind, scene.follow.velocity(state), normal, torch.ones_like(area))
        return scene.on_gaussians(torch.where(scene.in_wind, torch.linalg.vector_norm(force, dim=-1), 0.0))

    def force_scale(self) -> float:
        """Largest force per area [Pa] of the wind without gusts on a patch at rest; 1 in still air."""
        aero = self.model.aero
        speed = float(torch.linalg.vector_norm(self.flows().detach(), dim=-1).amax())
        coefficients = float(torch.stack([aero.C_D, aero.C_F, aero.C_L]).detach().abs().sum())
        return 0.5 * aero.air_density * speed**2 * coefficients or 1.0

    # ---- at rest

    @in_turn
    def start(self) -> State:
        self.starts += 1
        if isinstance(self.solver, MPMSolver):
            self.solver.choose(anew=True)
        state = self.bind()
        if isinstance(self.solver, MPMSolver):
            self.solver.choose(anew=False)
        self._idle = None  # coefficients may have changed
        check_spacing(self.solver)
        self.solver.prepare()
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
        state = self._with_air(state)
        _warn_falling(self.solver)
        return state

    def _with_air(self, state: State) -> State:
        model = self.model
        if model.air is None:
            self._air = None
            return state
        with torch.inference_mode(False), torch.no_grad():
            still = None
            if model.air.still_walls:
                low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (model.air.low, model.air.high))
                still = model.scene.still_distance(low, high, 2 * model.air.cells)
            self._air = AirInBox(
                model.air, self.wind_force, self.solver, model.scene.frame, self.frame_dt, state, still
            )
            return state.replace(air=self._air.start(state.time))

    def rehearse(self) -> None:
        """Raise the errors that starting with the present model would raise."""
        rehearsed = self.bind()
        self.solver.prepare()
        self.solver.substeps(rehearsed, self.frame_dt)

    def _restiffened(self) -> bool:
        before, now, stiffness = self._bound, self.materials, ("youngs_modulus", "poisson_ratio")
        others = [field.name for field in fields(MaterialPoints) if field.name not in stiffness]
        if len(before) != len(now) or any(
            getattr(a, name) is not getattr(b, name) for a, b in zip(before, now, strict=True) for name in others
        ):
            return False
        each = [[getattr(points, name) for points in now] for name in stiffness]
        if not self.solver.restiffen(*(torch.stack(values) if self.batched else values[0] for values in each)):
            return False
        self._bound = now
        return True

    def bind(self) -> State:
        scene, self._bound = self.scene, self.materials
        points = MaterialPoints.stack(self._bound) if self.batched else self._bound[0]
        state: State = self.solver.init_state(points, frame=scene.frame, surface=scene.surface_places)
        if isinstance(self.solver, MPMSolver) and isinstance(self.solver.bound, Modes):
            why = self._why_not_modes(self.solver.bound)
            if why is not None:
                self.solver.rule_out_modes(why)
                state = self.solver.init_state(points, frame=scene.frame, surface=scene.surface_places)
        self.lift, self._rest = None, state
        if any(model.aero.carried for model in self.models) and any(self.solver.gravity):
            with torch.inference_mode(False), torch.no_grad():  # it outlives the call
                air = [carried_mass(model.scene.patches, model.aero) for model in self.models]
                mass = torch.stack(air) if self.batched else air[0]
                self.lift = AirLift(mass.to(points.mass), self.solver.gravity)
        return state

    def _why_not_modes(self, bound: Modes) -> str | None:
        """Why ``auto`` cannot take the modes that it chose; ValueError if they were given and cannot move the scene."""
        if self.scene.joints:
            if not self.solver.automatic:
                raise ValueError("Modes know no joints of parts: set `solver.formulation` to total.")
            return "parts are joined"
        lean = self._lean(bound) if self.solver.may_choose else 0.0
        return f"it leans by {lean:.0%} of its size, more than modes can show" if lean > MOST_LEAN else None

    def _lean(self, bound: Modes) -> float:
        first, flows = self.model, self.flows().detach()
        strongest = WindField(flows[flows.norm(dim=-1).argmax()])
        state = bound.leaning(WindForce(first.aero, strongest, _repeated(first.scene.patches, len(self.models))))
        rest = bound.points.position
        side = (rest.amax(-2) - rest.amin(-2)).amax()
        moved = (state.position - rest).norm(dim=-1).flatten()
        return float(moved.topk(max(1, len(moved) // 10)).values.mean() / side)

    def _check_rounding(self, state: State, dt: float) -> None:
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

    # ---- other values

    @in_turn
    def take(self, model: Model, running: bool = False) -> State | None:
        """Go on with another material, wind or forces; the solver is bound again only if its part has changed.

        Returns:
            The state at rest if the solver was bound again.
        """
        for part in (model.wind, model.aero, *model.forces):
            part.to(self.device)
        before, self.model, self.models = self.model, model, self._spread(model)
        if model.solver is not before.solver:
            assign(self.solver, settings=model.solver)
        kept = len(self._bound) == len(self.models) and all(map(operator.is_, self._bound, self.materials))
        if not running or (kept and model.solver is before.solver):
            return None
        if model.solver is not before.solver or not self._restiffened():
            self.bind()
            self.solver.prepare()
        rest = self._rest
        steps = min(MAX_GROWTH * self.solver.substeps(rest, self.frame_dt), MAX_SUBSTEPS)
        self.most_substeps = max(self.most_substeps, steps)
        if self._tearing is not None:
            elastic = self.solver.points.elastic
            if elastic is not None:  # particles that flowed apart before are not torn
                self._tearing.elastic = elastic if self._tearing.elastic is None else elastic & self._tearing.elastic
        return rest

    # ---- a frame

    @in_turn
    def advance(self, state: State) -> tuple[State, FrameDiagnostics]:
        return self.launch(state).finish()

    @in_turn
    def launch(self, state: State, steps: int | None = None) -> Launched:
        """Start computing a frame; ``launch(state).finish()`` is :meth:`advance`, and the host may work between.

        Args:
            steps: Number of substeps, as several batches that are compared take; those that it needs if None.

        Returns:
            The frame. An error of it is raised by its ``finish``.
        """
        if not self.idle:
            self.wind_force.refresh(state)
        return Launched(self, state, steps)

    def measured(
        self,
        end: State,
        steps: int,
        courant: Tensor,
        state: State,
        parts: tuple[object, ...] | None,
    ) -> Measurement:
        """Start measuring the frame from ``state`` to ``end``, and what the next frame needs."""
        idle, ahead = self.idle, self._tearing is None and self.foresees

        def needs(at: State) -> Tensor:
            return needs_of(self, at, None if idle else self._winds(self.wind_force.foreseen(at), at))

        if not ahead:
            return measure(self.solver, end, steps, courant, self._tearing, state, lift=self.lift)
        same = None if parts is None else (idle, self.frame_dt, parts)
        return self._gauge(self.solver, end, steps, courant, state, needs, same, self.lift)

    def at_first(self, state: State) -> Measurement:
        """Start measuring a state that no frame led to, such as the first."""
        return measure(self.solver, state, 0, 0.0, lift=self.lift)

    def give_up(self, state: State, cause: str, remedy: str | None = None) -> NoReturn:
        particle = int(state.F_elastic.square().sum((-1, -2)).reshape(-1).argmax())
        if remedy is None:
            field = "solver.cfl" if self.solver.substep is None else "solver.substep"
            remedy = f"lower `{field}`, or weaken the wind or the boundary that drives it"
        raise SimulationDiverged(float(state.time), particle, cause, remedy)

    @property
    def foresees(self) -> bool:
        """True if the next frame's needs are measured with this frame, so that the host waits once."""
        simple = self.solver.substep is None and self.solver.stiffness_damping == 0
        return simple and self.solver.has_kernels and self.wind_force.recordable

    @in_turn
    def substeps(self, state: State, parts: tuple[object, ...] | None = None) -> int:
        """Return the number of substeps of the next frame, from waves in the material and drag on light patches."""
        if self.solver.exact:
            return self.solver.substeps(state, self.frame_dt)
        if self.outlook is not None and self.outlook.holds(state, parts):
            cells, rate, blowing = self.outlook.needs
        else:
            winds = None if self.idle else self._winds(self.wind_force, state)
            cells, rate, blowing = needs_of(self, state, winds).tolist()
        if self.lenient and not all(map(math.isfinite, (cells, rate, blowing))):
            return self._steps  # of the frame before, as one of the scenes has diverged
        steps = self.solver.substeps(state, self.frame_dt, cells)
        if not (math.isfinite(rate) and blowing < MAX_WIND):
            aero = self.model.aero
            bad = [name for name in ("C_D", "C_F", "C_L") if not bool(getattr(aero, name).isfinite())]
            if bad:
                value = float(getattr(aero, bad[0]).detach())
                self.give_up(state, f"`aero.{bad[0]}` is {value:g}", "set it to a finite number")
            cause = f"the wind of {blowing:.3g} m/s, or its drag, is NaN or infinite or beyond {MAX_WIND:g} m/s"
            self.give_up(state, cause, "check the flow and the modulations of the wind")
        explicit = self.model.aero.drag_step != "semi_implicit" and self.model.air is None
        self._steps = max(steps, int(rate * self.frame_dt) + 1) if explicit else steps
        if self._air is not None:
            self._steps = -(-self._steps // self._air.steps) * self._air.steps
        return self._steps

    def _winds(self, force: WindForce, state: State) -> Tensor:
        """Velocities of the air in the frame that starts with a state [m/s], shape (5, ...)."""
        return force.samples(state, self.frame_dt / 4, 5)

    def roll(self, state: State, steps: int, margin: int = 0) -> tuple[State, Tensor]:
        """Advance by one frame without checks; returns the state and the largest Courant number of the frame."""
        progress, fitted = self.progress, self.solver.fit_grid(state, self.frame_dt, margin)
        watch = None if progress is None else lambda done: progress.substep(done, steps)
        if self._air is not None:
            return self._roll_with_air(fitted, steps, watch)
        # the end of a frame is checked with its measurements, as each check makes the host wait
        return self.solver.watched_rollout(
            fitted, self.frame_dt / steps, steps, self.forces, CFL_SAMPLES, watch, check=False
        )

    def _roll_with_air(self, state: State, substeps: int, watch: Callable[[int], None] | None) -> tuple[State, Tensor]:
        air = self._air
        assert air is not None
        if state.air is None or air.frame_dt != self.frame_dt:
            raise ValueError("computed air has one length of the frame: start the simulation again for another one")
        if any(tensor.requires_grad for tensor in state.tensors()):
            raise ValueError("computed air has no gradients: set `air` to null")
        air.take(self.wind_force)
        end, moments, courant = air.roll(self.solver, state, state.air, substeps, self.forces, CFL_SAMPLES, watch)
        return end.replace(air=moments), courant


def stepper_of(model: Model) -> Stepper:
    """The stepper shared by a model and all models made from it."""
    if "stepper" not in model.shared:
        model.shared["stepper"] = Stepper(model.method.like(model.solver), model)
    stepper: Stepper = model.shared["stepper"]
    if stepper.model is not model:
        try:
            stepper.take(model, running=stepper.starts > 0)
        except Exception:
            model.shared.clear()  # it has half of the model
            raise
    return stepper


def start(model: Model) -> State:
    """The state of a model at rest, at time zero; raises as :meth:`Stepper.start`."""
    return stepper_of(model).start()


def step(model: Model, state: State) -> State:
    """Advance by one frame, with as many substeps as are stable.

    A function of its arguments, through which gradients reach numbers of the model and the state. Models that differ in
    numbers share what does not depend on them, so ``model.at("wind.speed", 9)`` may be another one in every frame.

    Args:
        state: The state now, of :func:`start`, of this function, or of the simulation.

    Raises:
        SimulationDiverged: If no substep is stable.
    """
    stepper = stepper_of(model)
    if stepper.starts == 0:  # the state is that of another stepper
        stepper.start()
    return stepper.advance(state)[0]


class Launched:
    """A frame whose work is passed to the device; the host waits for it in :meth:`finish`, once.

    Args:
        stepper: The stepper.
        before: The state at the start of the frame.
        steps: Number of substeps; those that it needs if None.
    """

    def __init__(self, stepper: Stepper, before: State, steps: int | None = None) -> None:
        self._stepper, self._before = stepper, before
        self._error: Exception | None = None
        try:
            with self._explained():
                self._parts = None if stepper.solver.exact else parts_of(stepper)
                self.steps = stepper.substeps(before, self._parts) if steps is None else steps
                self._end, self._measurement = self._launch(0)
        except Exception as error:  # `finish` raises it
            self._error = error

    def finish(self) -> tuple[State, FrameDiagnostics]:
        """Wait, and repeat the frame where its substep was too long or its grid too small.

        Returns:
            The state at the end of the frame, and its diagnostics; those of the scenes of a batch are in :attr:`each`.
        """
        if self._error is not None:
            raise self._error
        stepper, solver, margin = self._stepper, self._stepper.solver, 0
        with stepper.turn, self._explained():
            for retry in range(MAX_RETRIES + 1):
                cfl, outrun = self._measurement.cfl, self._measurement.outran
                too_long = solver.substep is None and not cfl <= max(CFL_LIMIT, 1.25 * solver.cfl)
                too_long = too_long and (math.isfinite(cfl) or not stepper.lenient)
                if retry == MAX_RETRIES or not (outrun or too_long):
                    break
                if outrun:
                    margin = 4 * max(margin, 4)
                if too_long:
                    growth = cfl / solver.cfl if math.isfinite(cfl) else 4.0
                    self.steps = int(self.steps * min(growth * 1.1, 4.0)) + 1
                self._end, self._measurement = self._launch(margin)
        found = self._measurement.read(check=not stepper.lenient)
        if not (cfl <= MAX_CFL or stepper.lenient):
            cause = f"the Courant number of the frame is {cfl:.3g}, and above {MAX_CFL:g} no substep is stable"
            stepper.give_up(self._end, cause)
        if self._measurement.more:
            stepper.outlook = Outlook(self._end, self._measurement.more, self._parts)
        return self._end, found

    @property
    def each(self) -> tuple[FrameDiagnostics, ...]:
        return self._measurement.each()

    def _launch(self, margin: int) -> tuple[State, Measurement]:
        stepper, before, steps = self._stepper, self._before, self.steps
        if steps > stepper.most_substeps:
            cause = f"a frame would take {steps:,} substeps, more than the limit of {stepper.most_substeps:,}"
            stepper.give_up(before, cause, "weaken the wind or the boundary that drives the particle")
        end, courant = stepper.roll(before, steps, margin)
        return end, stepper.measured(end, steps, courant, before, self._parts)

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
            cause, own, remedy = str(error).rstrip(".").rpartition(": ")
            self._stepper.give_up(self._before, cause if own else remedy, remedy if own else None)


class Outlook:
    """The numbers that decide how many substeps the next frame takes, read with the measurements of this one.

    Args:
        state: The state at the end of the frame.
        needs: The numbers of :func:`needs_of`.
        parts: The result of :func:`parts_of` when they were measured.
    """

    def __init__(self, state: State, needs: list[float], parts: tuple[object, ...] | None) -> None:
        self.needs, self._parts = needs, parts
        self._read = [weakref.ref(tensor) for tensor in _read(state)]

    def holds(self, state: State, parts: tuple[object, ...] | None) -> bool:
        """True if the next frame starts from this state and ``parts`` is unchanged."""
        same = all(known() is tensor for known, tensor in zip(self._read, _read(state), strict=False))
        return same and self._parts is not None and self._parts == parts


def _read(state: State) -> list[Tensor]:
    found = (state.F_elastic, state.internal, state.velocity, state.time)
    return [tensor for tensor in found if tensor is not None]


def parts_of(stepper: Stepper) -> tuple[object, ...] | None:
    """Key of all that the needs of a frame depend on besides the state; None if changes cannot be detected.

    That is so for tensors of inference mode, and for tensors on another device than the simulation.
    """
    wind = stepper.wind_force
    tensors = tensors_in([wind])
    if any(tensor.is_inference() or tensor.device != stepper.device for tensor in tensors):
        return None
    made = {id(tensor) for tensor in wind.refreshed()}  # from the state, in every frame
    versions = tuple(tensor._version for tensor in tensors if id(tensor) not in made)
    return (*recorded_key([stepper.solver, wind]), versions)


def needs_of(stepper: Stepper, state: State, winds: Tensor | None) -> Tensor:
    """Cells that the fastest wave crosses per second; rate of the drag [1/s] and speed of the wind [m/s]; float64.

    Args:
        winds: Air velocities during the frame [m/s], shape (K, ...), from ``WindForce.samples``; None if the wind has
            no effect.
    """
    cells = in_double(stepper.solver.cells_per_second(state))
    if winds is None:
        return torch.stack([cells, *cells.new_zeros(2)])
    wind = torch.linalg.vector_norm(winds, dim=-1).amax().to(state.velocity.dtype)
    speed = wind + torch.linalg.vector_norm(state.velocity, dim=-1)
    fastest = stepper.model.aero.rate(speed, stepper.wind_force.area, stepper.solver.points.mass).amax()
    return torch.stack([cells, in_double(fastest), in_double(wind)])


def why_not_batched(model: Model) -> str | None:
    """Return the reason why a scene cannot be one of a batch; None if it can."""
    wind = model.wind
    if model.air is not None:
        return "the air is computed for one scene at a time; set `air` to null"
    if isinstance(wind, WindField) and any(isinstance(effect, Shelter) for effect in wind.effects):
        return "the wind has a Shelter, which depends on the motion of one scene; remove it from `wind.effects`"
    if model.scene.surface_places is not None:
        return "the object touches itself or an obstacle; set `contact` to null, and remove the obstacles"
    return None


def _repeated(patches: Patches, count: int) -> Patches:
    shift = patches.count * torch.arange(count, device=patches.point.device)
    point = (patches.point + shift[:, None]).reshape(-1)
    return Patches(patches.normal.repeat(count, 1), patches.area.repeat(count), point, patches.count * count)


def _raised_here(error: BaseException) -> bool:
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    return place is not None and str(place.tb_frame.f_globals.get("__name__")).startswith("gaussian_swaying.")


def _warn_falling(solver: Solver) -> None:
    falls = isinstance(solver, MPMSolver) and any(solver.gravity)
    if falls and all(isinstance(part, Impulse | RigidRegion) for part in solver.boundaries):
        warnings.warn(
            "Nothing holds the object and nothing lies below it, so it falls: add a pin to `solver.boundaries` (in "
            "Python `hold`, which may be auto), or an Obstacle as the ground, or set `solver.gravity` to "
            "[0, 0, 0].",
            UserWarning,
            stacklevel=3,
        )


class SceneEditor:
    """Applies edits to the scene of a stepper, in order of their times, and can undo them.

    Args:
        stepper: The stepper; its scene and material are changed.
        edits: The edits. Those with the same time are applied in the given order, so that later entries win.

    Raises:
        ValueError: If the region of an edit contains nothing that it could change.
    """

    def __init__(self, stepper: Stepper, edits: Sequence[Edit] = ()) -> None:
        self.stepper = stepper
        self.edits = sorted(edits, key=lambda edit: edit.time)
        self.applied = 0
        self.version = 0  # counts the changes of colour
        self.unedited: SimulatedScene | None = None  # as it was before its first edit, if there was one
        for edit in self.edits:
            self.reach(edit)

    @property
    def scene(self) -> SimulatedScene:
        return self.stepper.scene

    def start(self) -> State:
        """The state at rest at time zero, with the edits of that time applied."""
        self.reset()
        for later in (moment for moment in self.times if moment > 0):  # refuse impossible edits now
            self.apply(self.due(0.0))
            self.apply(self.due(later), flowed=True)
            self.stepper.rehearse()
        self.reset()
        self.apply(self.due(0.0))
        return self.stepper.start()

    def edit(self, state: State, edits: Sequence[Edit]) -> State:
        """Apply edits now, whatever their time; all or nothing."""
        before = self.stepper.model, self.unedited, self.version
        try:
            return self._go_on(state, edits)
        except Exception:
            model, self.unedited, self.version = before
            self.stepper.take(model)
            self.stepper.bind()
            raise

    def edit_due(self, state: State, resumed: bool = False) -> State:
        """Apply the edits up to the time of a state; a resumed state contains them already."""
        if not self.edits:  # the host need not wait for the time
            return state
        edited = self._go_on(state, self.due(float(state.time) + 1e-3 * self.stepper.frame_dt))
        return state if resumed else edited

    def _go_on(self, state: State, edits: Sequence[Edit]) -> State:
        rest = self.apply(edits, flowed=True, running=True)
        if rest is None:
            return state
        start = rest.internal
        if start is not None and state.internal is not None:
            fresh = torch.zeros_like(self.scene.points.mass, dtype=torch.bool)
            for edit in edits:
                fresh |= self.reach(edit)[0] & (edit.law is not None)
            start = torch.where(fresh, start, state.internal)
        return state.replace(internal=start)

    # ---- the scene

    @property
    def times(self) -> list[float]:
        return sorted({edit.time for edit in self.edits})

    def reach(self, edit: Edit) -> tuple[Tensor, Tensor]:
        """Masks of the particles (P,) and Gaussians (N,) that an edit changes."""
        scene, region, means = self.scene, edit.region, self.scene.model.means.detach()
        given = (scene.points.youngs_modulus, scene.points.poisson_ratio, scene.points.mass)
        if edit.of_material and any(value.requires_grad for value in given):
            raise ValueError(
                "`edits` of the material would lose the gradient of `material`: leave them out, or give the material "
                "without a gradient."
            )
        if region is None:
            particles = torch.ones_like(scene.points.mass, dtype=torch.bool)
            gaussians = torch.zeros_like(means[:, 0], dtype=torch.bool).index_fill(0, scene.moving, True)
        else:
            particles = region.contains(scene.frame.point_to_scene(scene.points.position).to(means.dtype))
            gaussians = region.contains(means)
        particles, gaussians = particles & edit.of_material, gaussians & (edit.color is not None)
        for wanted, found, what in (
            (edit.of_material, particles, "simulated Gaussian"),
            (edit.color is not None, gaussians, "Gaussian"),
        ):
            if region is not None and wanted and not bool(found.any()):
                between, hint = whereabouts(region, means[scene.moving], scene.frame.rotation)
                raise ValueError(
                    f"The region {region!r} of `edits` at {edit.time:g} s holds no {what}: those that move lie "
                    f"{between}; {hint or 'move or enlarge it'}."
                )
        return particles, gaussians

    def reset(self) -> None:
        self.applied = 0
        if self.unedited is not None:
            scene, self.unedited = self.unedited.to(self.stepper.device), None
            self.version += 1
            self.stepper.take(self.stepper.model.replace(scene=scene))

    def due(self, time: float) -> list[Edit]:
        """Return the edits up to a time [s] that were not yet applied, and mark them as applied."""
        found = [edit for edit in self.edits[self.applied :] if edit.time <= time]
        self.applied += len(found)
        return found

    def apply(self, edits: Sequence[Edit], flowed: bool = False, running: bool = False) -> State | None:
        scene = self.scene
        if edits and self.unedited is None:
            self.unedited = scene
        for edit in edits:
            particles, gaussians = self.reach(edit)
            with torch.inference_mode(False), torch.no_grad():
                if edit.of_material:
                    scene = changed(scene, points=edited_points(scene.points, particles, edit, flowed))
                if edit.color is not None:
                    sh = recolored(scene.model.sh.detach(), gaussians, edit.color, edit.detail)
                    scene = changed(scene, model=changed(scene.model, sh0=sh[:, :1].clone(), shN=sh[:, 1:].clone()))
                    self.version += 1
        return self.stepper.take(self.stepper.model.replace(scene=scene), running)
