"""The material point solver: state in, state out.

Nothing that is checked before the substeps makes the host wait, and the end is one wait for all checks together.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable, Sequence
from itertools import pairwise
from numbers import Real
from typing import Any, Literal

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as recomputed

from gaussian_swaying._checks import check_like, check_positive, check_shape, check_vector
from gaussian_swaying._fixed import Fixed, FixedList, assign, count_change
from gaussian_swaying._live import SIZE, live_numbers
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.damping import damped_substep
from gaussian_swaying.mpm.dispatch import LawDispatch
from gaussian_swaying.mpm.embedded import EmbeddedInGrid, EmbeddedPoints
from gaussian_swaying.mpm.forces import Force, Forces, FunctionForce, added, as_forces, split, tensors_of
from gaussian_swaying.mpm.formulation import Formulation, Settings, flowing
from gaussian_swaying.mpm.modes import Modes, why_not_modes
from gaussian_swaying.mpm.protocol import Solver, WatchFunction
from gaussian_swaying.mpm.run import Run
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.mpm.timestep import check_pace, fixed_substeps, look_marks, substeps_per_frame, work_done
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.mpm.total_adjoint import TotalAdjoint
from gaussian_swaying.mpm.updated import Updated, UpdatedRun

FORMULATIONS: dict[str, type[Formulation]] = {kind.name: kind for kind in (Total, Updated, Modes)}
RUNS: dict[str, type[Run]] = {"total": TotalAdjoint, "updated": UpdatedRun}
"""What runs each in kernels."""


class MPMSolver(Fixed, Solver):
    """Material point method in three formulations over one set of transfers.

    ``total`` (total Lagrangian MPM; de Vaucorbeil, Nguyen & Hutchinson 2020): stencils at the rest positions, computed
    once; nodal displacement and velocity are the state. Use it for elastic objects whose particles keep their
    neighbours: flags, leaves, cords. It cannot model tearing and has no transfer dissipation.

    ``modes`` (:mod:`~gaussian_swaying.mpm.modes`): up to 80 modes of ``total`` at rest, warped, each
    stepped exactly. Use it for what is held and sways by less than some 40 % of its size, however stiff: plants, trees,
    lamps. It takes 4 to 16 substeps a frame; nothing may touch or fold.

    ``updated`` (the paper and PhysGaussian): stencils at the current positions, momentum on the particles (APIC, Jiang
    et al. 2015). Use it for material that flows, mixes or touches itself; plastic laws and fluids need it. A soft sheet
    tears numerically once local stretch times particle spacing approaches two cells.

    Args:
        dx: Grid spacing [m].
        formulation: ``total``, ``updated``, ``modes`` or ``auto``, which becomes ``modes`` where that will do,
            ``updated`` where something flows, and ``total`` otherwise; ``why`` says why.
        gravity: Acceleration [m/s²], z up.
        damping: Rate at which velocities decay [1/s]; 0 for none.
        stiffness_damping: Time constant of the stiffness damping [s]. A vibration of circular frequency omega is damped
            with the ratio stiffness_damping * omega / 2; rigid motion is not damped. It shortens the stable substep.
        cfl: Courant number of the adaptive substep, ``dt = cfl dx / (c + |v|)``; up to 0.47 is stable near rest for any
            arrangement of particles and any Poisson's ratio.
        substep: Fixed substep [s] instead of the adaptive one; checked against the stable one.
        deterministic: On a GPU, sum in a fixed order, so that repeated runs give the same bits; slower. On a CPU the
            order is always fixed. Gradients on a GPU are not covered.
        pivot: Whether the two main modes have the frequency of the softer one, as those of a thing that hangs or stands
            on a pivot, whatever its shape; only in ``modes``.
        boundaries: Boundary conditions, applied in order, impulses first.
        transfer: Code that computes substeps. ``torch`` is the reference and works on any device and with all
            gradients; ``kernels`` runs a whole substep in a few compiled kernels, in float32 on a CUDA device and in
            both precisions on a CPU, with gradients in ``total`` by the first state, stiffness, mass, wind and
            coefficients; ``auto`` uses the kernels where possible.

    Example:
        >>> points = MaterialPoints.create(torch.rand(100, 3), volume=1e-3, density=100.0, youngs_modulus=1e4,
        ...                                poisson_ratio=0.3)
        >>> solver = MPMSolver(dx=0.1, gravity=(0, 0, -9.8))
        >>> state = solver.init_state(points)
        >>> state = solver.step(state, dt=1e-3)
        >>> round(state.velocity[:, 2].mean().item(), 4)
        -0.0098
    """

    live_as = "solver"
    live = live_numbers(gravity={"kind": "vector"}, damping=SIZE, stiffness_damping=SIZE)

    def __init__(
        self,
        dx: float = 0.02,
        formulation: Literal["total", "updated", "modes", "auto"] = "total",
        *,
        gravity: Sequence[float] = (0.0, 0.0, -9.8),
        damping: float = 0.0,
        stiffness_damping: float = 0.0,
        cfl: float = 0.4,
        substep: float | None = None,
        deterministic: bool = False,
        pivot: bool = False,
        boundaries: Sequence[Boundary] = (),
        transfer: Literal["auto", "torch", "kernels"] = "auto",
    ) -> None:
        super().__init__()
        check_positive("cfl", cfl)
        if substep is not None:
            check_positive("substep", substep)
        gravity = check_vector("gravity", gravity)
        self.settings = Settings(dx, gravity, damping, stiffness_damping, deterministic, pivot)
        self.automatic, self.why = formulation == "auto", ""
        self.formulation: Literal["total", "updated", "modes", "auto"] = "total" if self.automatic else formulation
        self._no_modes: str | None = None
        self._decided = False
        self.transfer: Literal["auto", "torch", "kernels"] = transfer
        self.cfl, self.substep = float(cfl), substep
        if pivot and formulation != "modes":
            raise ValueError("`pivot` joins two modes: set `formulation` to modes, or `pivot` to false.")
        self.boundaries = FixedList(boundaries)
        # the same in metres; in a tuple, because these copies do not belong to the module's state
        self._framed: tuple[Boundary, ...] | None = None
        self._bound: Formulation | None = None
        self._kernels: Any = None
        self._obstacle: str | None = None

    # ---- settings

    @property
    def dx(self) -> float:
        """Grid spacing [m]."""
        return self.settings.dx

    @property
    def damping(self) -> float:
        """Rate at which velocities decay [1/s]."""
        return self.settings.damping

    @property
    def stiffness_damping(self) -> float:
        """Time constant of the stiffness damping [s]."""
        return self.settings.stiffness_damping

    @property
    def deterministic(self) -> bool:
        """True if sums on a GPU have a fixed order."""
        return self.settings.deterministic

    @property
    def neighbours_fixed(self) -> bool:  # type: ignore[override]
        """True if particles keep their neighbours from the rest state: they cannot tear, flow or leave the grid."""
        return self.formulation != "updated"

    # ---- the object at rest

    @property
    def may_choose(self) -> bool:
        """True if the formulation is ``auto`` and not chosen yet; the next material decides."""
        return self.automatic and not self._decided

    @property
    def bound(self) -> Formulation:
        """The formulation, bound to the material given to :meth:`init_state`."""
        if self._bound is None:
            raise RuntimeError("The solver has no material yet: call `init_state(points)` first.")
        return self._bound

    @property
    def points(self) -> MaterialPoints:
        """The material given to :meth:`init_state`."""
        return self.bound.points

    @property
    def laws(self) -> LawDispatch:
        """The laws of the material given to :meth:`init_state`, bound to its particles."""
        return self.bound.laws

    def prepare(self) -> None:
        """Make the kernels, if they are used; their errors are raised here."""
        _ = self.kernels

    def restiffen(self, youngs_modulus: Tensor, poisson_ratio: Tensor) -> bool:
        points = dataclasses.replace(self.points, youngs_modulus=youngs_modulus, poisson_ratio=poisson_ratio)
        bound = self.bound.restiffened(points)
        if bound is None:
            return False
        if self._kernels is not None:
            with torch.inference_mode(False), torch.no_grad():
                self._kernels.restiffen(bound)
        self._bound = bound
        count_change(self)
        return True

    def like(self, settings: Settings) -> MPMSolver:
        """A solver with the same boundaries and other numbers, without a material.

        Args:
            settings: The numbers.
        """
        return MPMSolver(
            **dataclasses.asdict(settings),
            formulation="auto" if self.automatic else self.formulation,
            cfl=self.cfl,
            substep=self.substep,
            boundaries=self.framed(None),
            transfer=self.transfer,
        )

    def embedded(self, place: Tensor, arm: Tensor | None, nodes: Tensor | None = None) -> EmbeddedPoints | None:
        """In ``total`` places are read from the nodes, each with its own stencil, or with given nodes (27, M)."""
        return EmbeddedInGrid(place, arm, nodes) if self.neighbours_fixed else None

    def continued(self, other: Solver, state: MPMState, start: MPMState) -> MPMState | None:
        """The motion of another solver as a state of this one, such as the same body with other pins.

        Args:
            other: The solver that made ``state``.
            state: Its state now.
            start: The state at rest of this solver.

        Returns:
            The state; None if one of them is not ``total``, the grids differ, or a node has mass that had none, as it
            did not move.
        """
        if not isinstance(other, MPMSolver):
            return None
        before, after = other.bound, self.bound
        if not (isinstance(before, Total) and isinstance(after, Total)) or state.grid != start.grid:
            return None
        if bool(((after.node_inverse_mass > 0) & (before.node_inverse_mass == 0)).any()):
            return None
        moved = start.replace(time=state.time, substep=state.substep, work=state.work)
        if isinstance(after, Modes):  # what of the motion its modes can show
            return after.shown(moved, *after.amplitudes(state.replace(modal=None)))
        return after.read_particles(moved, *state.nodal)

    def describe(self, state: MPMState) -> dict[str, Any]:
        """Formulation and grid, for the summary of a run."""
        grid = {"dx_m": self.dx, "resolution": list(state.grid.resolution)}
        return {"formulation": self.formulation} | ({"why": self.why} if self.automatic else {}) | {"grid": grid}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MPMSolver:
        super()._apply(fn, recurse)
        for boundary in self._framed or ():
            boundary._apply(fn)
        if self._bound is not None:
            surface = self.bound.surface
            self._bind(self.points.map(fn), None if surface is None else surface.map(fn))
        return self

    def _bind(self, points: MaterialPoints, surface: Surface | None) -> None:
        self._bound = self._kernels = None
        boundaries = self._framed or self.framed(None)
        if self.may_choose:
            formulation, why = self._choice(points, boundaries, surface)
            assign(self, formulation=formulation, why=why)
        bound = FORMULATIONS[self.formulation](points, boundaries, self.settings, surface)
        self._obstacle = self._why_not_kernels(bound)
        self._bound = bound
        count_change(self)

    def _choice(
        self, points: MaterialPoints, boundaries: Sequence[Boundary], surface: Surface | None
    ) -> tuple[Literal["total", "updated", "modes"], str]:
        if (flows := flowing(points)) is not None:
            return "updated", f"the law {flows} flows"
        why = self._no_modes or why_not_modes(points, boundaries, surface)
        return ("modes", "it is held, and nothing touches or folds") if why is None else ("total", why.split(": ")[0])

    def choose(self, *, anew: bool) -> None:
        """Let ``auto`` choose anew with the next material, or keep its choice."""
        self._decided = not anew
        self._no_modes = None if anew else self._no_modes

    def rule_out_modes(self, why: str) -> None:
        """Make ``auto`` take ``total`` instead of ``modes`` from the next :meth:`init_state` on."""
        self._no_modes = why

    def _why_not_kernels(self, bound: Formulation) -> str | None:
        """Return the reason why no kernels are used, if so; ValueError if none can be, but ``transfer`` is kernels."""
        if self.transfer == "torch":
            return "`transfer` is torch"
        obstacle: str | None = f"the {bound.name} formulation has no kernels"
        if bound.name in RUNS:
            obstacle = RUNS[bound.name].unsupported(bound, interpret=self.transfer == "kernels")
        if self.transfer == "kernels" and obstacle is not None:
            raise ValueError(f"`transfer: kernels` cannot be used, because {obstacle}: set it to auto or torch.")
        return obstacle

    @property
    def exact(self) -> bool:
        """True for ``modes``, whose substeps are exact and whose drag is implicit."""
        return isinstance(self._bound, Modes)

    @property
    def has_kernels(self) -> bool:
        """True if the substep of the kernels is used where no gradient is needed."""
        return self._bound is not None and self._obstacle is None

    @property
    def kernels(self) -> Any:
        """The ``mpm.run.Run`` of this material, made when it is first asked for; None where torch runs all substeps."""
        if self._kernels is None and self.has_kernels:
            # ordinary tensors, which can be written inside and outside inference mode
            with torch.inference_mode(False), torch.no_grad():
                self._kernels = RUNS[self.bound.name](self.bound)
        return self._kernels

    def _wanted(self, *tensors: Tensor | None) -> bool:
        asking = (*self.bound.tensors(), *tensors)
        return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in asking)

    def init_state(
        self,
        points: MaterialPoints,
        velocity: Tensor | None = None,
        margin: int = 4,
        frame: SimFrame | None = None,
        surface: Surface | None = None,
    ) -> MPMState:
        """Take the material at rest and return the state at time zero.

        Args:
            points: The material, shapes (..., P, ·).
            velocity: Initial velocity [m/s], shape (..., P, 3); zero if None.
            margin: Cells around the object in the first grid of the ``updated`` formulation.
            frame: Transform from scene units to metres, for boundaries in scene units; None if they are in metres.
            surface: Contact samples of the surface; None for the material points, which then touch obstacles only.

        Returns:
            The state, with the device and dtype of ``points``.

        Raises:
            TypeError: If ``points`` is not a MaterialPoints, or ``velocity`` has another dtype.
            ValueError: If there are no points, a pin holds nothing, the grid is too large, ``velocity`` has the wrong
                shape or is not finite, or a plastic law or a fluid is used with the ``total`` formulation.
        """
        if not isinstance(points, MaterialPoints):
            raise TypeError(f"Expected `points` to be a MaterialPoints, but got {type(points).__name__}.")
        if velocity is None:
            velocity = torch.zeros_like(points.position)
        _check_rest(points, velocity)
        self._framed = None if frame is None else tuple(self.framed(frame))
        self._bound = None
        self.to(points.position.device)  # the solver moves to the device of its material
        self._bind(points, surface)
        return self.bound.first_state(velocity.expand_as(points.position), margin)

    # ---- time

    def stable_substep(self, state: MPMState | None = None) -> float:
        """Longest substep [s] that is stable for any arrangement of particles (one GPU synchronisation)."""
        return self.bound.stable_substep(state)

    def substeps(self, state: MPMState, frame_dt: float, cells: float | None = None) -> int:
        """Return the number of equal substeps of the next frame of ``frame_dt`` seconds (one GPU synchronisation).

        In ``updated``, obstacles count as moving material does, so that they meet every node on their way.

        Args:
            state: The state now.
            frame_dt: Length of the frame [s].
            cells: The result of :meth:`cells_per_second`, if it is known; then the host need not wait.

        Raises:
            ValueError: If the fixed substep is longer than the stable one, or takes an obstacle over nodes.
        """
        exact = self.bound.frame_steps(frame_dt)
        if exact is not None and self.substep is None:
            return exact
        driven = self.bound.obstacle_cells(state, frame_dt)
        if self.substep is not None:
            check_pace(self.substep, driven, "solver.substep")
            return fixed_substeps(frame_dt, self.substep, self.stable_substep(state), self.dx)
        longest = self.cfl / max(float(self.cells_per_second(state)) if cells is None else cells, driven, 1e-30)
        return substeps_per_frame(frame_dt, damped_substep(longest, self.bound.viscous_time(state)), exact=False)

    def cfl_number(self, state: MPMState, dt: float) -> Tensor:
        """Largest Courant number ``dt (c + |v|) / dx`` of a substep; in ``total`` without v, as stencils do not move.

        With stiffness damping it is the number of the undamped substep that is equally stable.
        """
        return math.sqrt(dt * dt + 2 * self.bound.viscous_time(state) * dt) * self.cells_per_second(state)

    def cells_per_second(self, state: MPMState) -> Tensor:
        """Return the cells that the fastest wave crosses per second, a scalar tensor; in a kernel if there is one."""
        watches = self.has_kernels and self.kernels.watches
        return self.kernels.largest_speed(state) if watches else self.bound.cells_per_second(state)

    def fit_grid(self, state: MPMState, horizon: float, margin: int = 0) -> MPMState:
        """Fit the grid of the ``updated`` formulation to the object for the next ``horizon`` seconds.

        Args:
            state: The state now.
            horizon: Time for which the grid must be large enough [s]; estimated from twice the current speeds and
                gravity.
            margin: Extra cells on each side, for motion caused by the wind and the boundaries.

        Raises:
            FloatingPointError: If a position or a speed is NaN or infinite.
            ValueError: If the grid would be larger than ``MAX_NODES``.
        """
        return self.bound.fit_grid(state, horizon, margin)

    def step(
        self,
        state: MPMState,
        dt: float,
        forces: Forces | None = None,
        force: Tensor | None = None,
        drag: Tensor | None = None,
    ) -> MPMState:
        """Advance by one substep of symplectic Euler; no host synchronisation, no data-dependent shapes.

        When the substep changes, forces act for the mean of the old and the new one: velocities are half a substep away
        from the positions, and the full new substep would cause a first-order error and change the energy. If the
        substep shrinks to less than a third, forces act for twice the new one instead.

        Args:
            state: The state now.
            dt: Substep [s].
            forces: Forces on the particles, see :meth:`rollout`.
            force: A force on each particle that is already known [N], shape (..., P, 3); it is added to ``forces``.
            drag: Decrease of that force per unit of velocity gained in the substep [kg/s], shape (..., P); drag that is
                passed this way is stable for particles of any mass (see ``AeroForce.resistance``).

        Returns:
            The state ``dt`` later.

        Raises:
            TypeError: As in :meth:`rollout`.
            ValueError: As in :meth:`rollout`; on a GPU, the next rollout finds what is wrong with the new state.
        """
        _check_begin(self.bound, state, dt, 1)
        _check_load(self.bound, force, drag)
        acting = as_forces(forces)
        if force is not None or drag is not None:

            def step(_: Any) -> Any:
                return force, drag

            acting = (FunctionForce(step), *acting)
        return self.rollout(state, dt, 1, acting, check=not state.position.is_cuda)

    def rollout(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Forces | None = None,
        checkpoint: int = 0,
        watch: WatchFunction | None = None,
        check: bool = True,
    ) -> MPMState:
        """Advance by several substeps.

        With the kernels, substeps and forces are replayed from recordings: forces with a device function run inside the
        kernels, the others in torch. If one of these others is not ``recordable`` (plain functions are not), the host
        runs the substeps one by one and calls every force.

        Args:
            state: The state now.
            dt: Substep [s].
            steps: Number of substeps.
            forces: Forces on the particles, one or several that are summed: each is a ``Force``, such as ``WindForce``,
                or a function of the state that returns the force [N], shape (..., P, 3), or the force and its
                resistance [kg/s], shape (..., P) (``drag`` in :meth:`step`).
            checkpoint: For gradients through long rollouts: keep one state per this many substeps and recompute the
                others in the backward pass; a value near the square root of ``steps`` needs the least memory. 0 keeps
                everything in torch, and lets the kernels choose. With checkpoints, forces must return the same values
                each time they are called with the same state.
            watch: Called from time to time with the number of substeps that are done, or queued on a GPU; not with
                ``checkpoint``.
            check: Whether to check the length of the substep, and the state at the end (one GPU synchronisation).
                Without, ``state.lost`` says what left the grid, and what diverged is NaN.

        Returns:
            The state ``steps * dt`` later.

        Raises:
            TypeError: If the state is not an MPMState, ``dt`` is not a number or ``steps`` not a whole one.
            ValueError: If ``dt`` or ``steps`` is out of range, if the state is not of this solver, if a value that was
                given is NaN or infinite, or if a particle left the grid of ``updated``; see :meth:`fit_grid`.
            FloatingPointError: If a particle became NaN or infinite.
        """
        acting, steps = as_forces(forces), _check_begin(self.bound, state, dt, steps, check)
        wanted = self._wanted(*state.tensors(), *tensors_of(acting))
        if isinstance(self.bound, Modes):
            end = self.bound.rollout(state, dt, steps, acting, watch)
        elif self.has_kernels and not wanted and all(map(self._replayed, acting)):
            end = self.kernels.rollout(state, dt, steps, acting, watch=watch)[0]
        elif self.has_kernels and wanted and (why := self.kernels.why_no_gradient(state, acting)) is None:
            end = self.kernels.rollout_with_gradient(state, dt, steps, acting, checkpoint, watch)
        elif self.transfer == "kernels" and wanted:
            raise ValueError(f"`transfer: kernels` has no gradients here, because {why}: set it to auto or torch.")
        else:
            end = self._one_by_one(state, dt, steps, acting, checkpoint, watch)
        if check:
            _check_end(self.bound, state, end, dt, steps, acting)
        return end

    @staticmethod
    def _replayed(force: Force) -> bool:
        """True if the host need not call a force in every substep."""
        return force.recordable or force.device_function() is not None

    def _one_by_one(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        acting: Sequence[Force],
        checkpoint: int,
        watch: WatchFunction | None,
    ) -> MPMState:
        """Substeps between which the host calls the forces, in kernels or, where gradients are wanted, in torch."""
        sources = [force.during(state.time, dt, steps) for force in acting]

        def advance(state: MPMState, first: int, count: int) -> MPMState:
            for k in range(first, first + count):
                pairs = zip(sources, acting, strict=True)
                force, drag = added([split(source(state, k), force, state) for source, force in pairs])
                if self.has_kernels and not self._wanted(*state.tensors(), force, drag):
                    state = self.kernels.rollout(state, dt, 1, force=force, drag=drag)[0]
                elif self.transfer == "kernels":
                    raise ValueError("`transfer: kernels` has no gradients here: set it to auto or torch.")
                else:
                    after = self.bound.step(state, dt, force, drag)
                    done = None if force is None else work_done(state, after, dt, force, drag)
                    state = after if done is None else after.replace(work=done)
                if watch is not None and checkpoint <= 0:
                    watch(k + 1)
            return state

        if checkpoint <= 0 or not torch.is_grad_enabled():
            return advance(state, 0, steps)
        for first in range(0, steps, checkpoint):
            count = min(checkpoint, steps - first)
            state = recomputed(advance, state, first, count, use_reentrant=False, preserve_rng_state=False)
        return state

    def watched_rollout(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Forces | None = None,
        looks: int = 8,
        watch: WatchFunction | None = None,
        check: bool = True,
    ) -> tuple[MPMState, Tensor]:
        """Advance by several substeps and check the Courant number on the way, as material may stiffen or soften.

        Args:
            state: The state now.
            dt: Substep [s].
            steps: Number of substeps.
            forces: As in :meth:`rollout`.
            looks: Number of checks, about evenly spaced, the last one at the end; fewer in short rollouts.
            watch: As in :meth:`rollout`.
            check: As in :meth:`rollout`, which names the errors.

        Returns:
            The state ``steps * dt`` later, and the largest Courant number seen, a scalar tensor.
        """
        acting, steps = as_forces(forces), _check_begin(self.bound, state, dt, steps, check)
        marks, end, seen = [steps] if self.exact else look_marks(steps, looks), state, []
        wanted = self._wanted(*state.tensors(), *tensors_of(acting))
        replayed = self.has_kernels and not wanted and all(map(self._replayed, acting))
        if replayed and self.stiffness_damping == 0 and self.kernels.watches:
            end, cells = self.kernels.rollout(state, dt, steps, acting, looks=marks, watch=watch)
            seen.append(dt * cells)
        else:
            for first, last in pairwise([0, *marks]):
                part = None if watch is None else lambda done, before=first: watch(before + done)
                end = self.rollout(end, dt, last - first, acting, watch=part, check=False)
                seen.append(self.cfl_number(end, dt))
        if check:
            _check_end(self.bound, state, end, dt, steps, acting)
        return end, torch.stack(seen).amax()

    def elastic_energy(self, state: MPMState) -> Tensor:
        """Elastic energy [J], that of bending included, shape (...) over the batch; in a kernel if there is one."""
        known = self.bound.elastic(state)
        if known is not None:
            return known
        F, kernels = state.F_elastic, self.has_kernels and not self._wanted(state.F_elastic)
        density = self.kernels.energy(F) if kernels else None
        if density is None:
            density = self.laws.energy(F, state.internal)
        return (self.points.volume * density).sum(-1) + self.bound.sheet_energy(state)

    def energies(self, state: MPMState) -> dict[str, Tensor]:
        """Kinetic, elastic and gravitational energy [J], each of shape (...) over the batch."""
        height = (state.position * self.bound.gravity.to(state.position)).sum(-1)
        return {
            "kinetic": self.bound.kinetic(state),
            "elastic": self.elastic_energy(state),
            "potential": -(self.points.mass * height).sum(-1),
        }

    def momenta(self, state: MPMState) -> dict[str, Tensor]:
        """Linear [kg m/s] and angular momentum about the origin [kg m²/s], each of shape (..., 3)."""
        return dict(zip(("linear", "angular"), self.bound.momenta(state), strict=True))


def _check_begin(bound: Formulation, state: MPMState, dt: float, steps: int, limit: bool = True) -> int:
    """Check the arguments of a rollout."""
    _check_state(bound, state)
    if isinstance(dt, bool) or not isinstance(dt, Real):
        raise TypeError(f"Expected `dt` to be a number of seconds, but got {type(dt).__name__}.")
    try:
        count = operator.index(steps)
    except TypeError:
        raise TypeError(f"Expected `steps` to be a whole number, but got {steps!r}.") from None
    if count < 0:
        raise ValueError(f"Expected `steps` not to be negative, but got {count}.")
    check_positive("dt", float(dt))
    if limit and dt > bound.longest_substep:
        raise ValueError(
            f"Expected `dt` of at most {bound.longest_substep:.3g} s, as no longer substep is stable with this "
            f"material and grid, but got {float(dt):g} s: `solver.substeps(state, time)` says how many substeps a time "
            "takes."
        )
    return count


def _check_state(bound: Formulation, state: MPMState) -> None:
    """Raise TypeError or ValueError unless a state is one of this body on this grid; the host does not wait."""
    if not isinstance(state, MPMState):
        raise TypeError(f"Expected `state` to be an MPMState, but got {type(state).__name__}.")
    points, nodes = bound.points, state.node_displacement
    wrong = None
    if state.position.shape != points.position.shape:
        wrong = f"it has positions {tuple(state.position.shape)} instead of {tuple(points.position.shape)}"
    elif (nodes is not None) != bound.neighbours_fixed:
        wrong = f"it is not one of the {bound.name} formulation"
    elif state.grid.dx != bound.settings.dx or (bound.neighbours_fixed and state.grid != bound.first_grid(0)):
        wrong = "it has another grid"
    elif state.impulse.shape[-2] != len(bound.kinds):
        wrong = f"it has {state.impulse.shape[-2]} boundaries instead of {len(bound.kinds)}"
    if wrong is not None:
        raise ValueError(f"Expected `state` to be one of this solver, from its `init_state` or a rollout, but {wrong}.")
    for name in ("position", "velocity"):
        check_like(f"{name} of the state", getattr(state, name), points.position)


def _check_rest(points: MaterialPoints, velocity: Tensor) -> None:
    """Raise TypeError or ValueError unless there is material, and its velocity (..., P, 3) fits it and is finite."""
    if points.count == 0 or points.mass.numel() == 0:
        raise ValueError("Expected `points` with at least one point, but got none.")
    check_shape("velocity", velocity, points.count, 3)
    check_like("velocity", velocity, points.position)
    finite = torch.isfinite(velocity)
    if not bool(finite.all()):
        raise ValueError(f"Expected `velocity` to be finite, but that of particle {_first(~finite)} is not.")


def _check_load(bound: Formulation, force: Tensor | None, drag: Tensor | None) -> None:
    """Raise TypeError or ValueError unless a force [N] (..., P, 3) and its resistance (..., P) fit the body."""
    points = bound.points
    if force is not None:
        check_shape("force", force, points.count, 3)
        check_like("force", force, points.position)
    if drag is not None:
        check_shape("drag", drag, points.count)
        check_like("drag", drag, points.position)


@torch.no_grad()
def _check_end(
    bound: Formulation,
    before: MPMState,
    after: MPMState,
    dt: float,
    steps: int,
    forces: Sequence[Force],
) -> None:
    """Raise an error if the state after a rollout is not valid (one GPU synchronisation).

    Args:
        forces: The forces that acted; called once more, for the first substep, if something is NaN.
    """
    check_pace(dt, bound.obstacle_cells(before, steps * dt), "dt")
    fields = {"position": after.position, "velocity": after.velocity, "deformation": after.F_elastic.flatten(-2)}
    sound = torch.stack([*(torch.isfinite(field).all() for field in fields.values()), ~after.lost.any()])
    if bool(sound.all()):
        return
    finite = sound.tolist()[:3]
    if all(finite):
        raise ValueError(
            f"Particle {_first(after.lost[..., None])} left the grid ({int(after.lost.sum())} particles did), where "
            f"nothing acts on it: call `solver.fit_grid(state, {steps * dt:g})` before the rollout, with a `margin` of "
            "some cells if the wind or a boundary drives the material."
        )
    given: list[tuple[str, Tensor | None]] = [("position of particle", before.position)]
    given += [
        ("velocity of particle", before.velocity),
        ("displacement of node", before.node_displacement),
        ("velocity of node", before.node_velocity),
    ]
    given += _loads(forces, before, dt, steps)
    for name, value in given:
        if value is not None and not bool(torch.isfinite(value).all()):
            bad = ~torch.isfinite(value if value.dim() > before.lost.dim() else value[..., None])
            raise ValueError(f"Expected finite values, but the {name} {_first(bad)} is NaN or infinite.")
    name = next(name for name, fine in zip(fields, finite, strict=True) if not fine)
    raise FloatingPointError(
        f"The {name} of particle {_first(~torch.isfinite(fields[name]))} became NaN or infinite within the rollout: "
        f"lower `dt` (stable at rest: {bound.stable_substep(None):.3g} s), or check the forces and the boundaries."
    )


def _loads(forces: Sequence[Force], state: MPMState, dt: float, steps: int) -> list[tuple[str, Tensor | None]]:
    found: list[tuple[str, Tensor | None]] = []
    for force in forces:
        name = getattr(getattr(force, "function", None), "__name__", type(force).__name__)
        value, drag = split(force.during(state.time, dt, steps)(state, 0), force, state)
        found += [(f"force of {name} on particle", value), (f"resistance of {name} of particle", drag)]
    return found


def _first(bad: Tensor) -> int:
    return int(bad.flatten(0, -2).any(-1).int().argmax())
