"""The material point solver: state in, state out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_positive, check_shape, check_vector
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.linalg import matmul3, symmetric_eigenvalues
from gaussian_swaying.mpm.boundaries.boundary import CLOCK, Boundary, Nodes
from gaussian_swaying.mpm.boundaries.impulse import Impulse
from gaussian_swaying.mpm.damping import damped_substep, kelvin_voigt_pk1
from gaussian_swaying.mpm.dispatch import LawDispatch
from gaussian_swaying.mpm.forces import Force, Forces, added, as_forces, divide, split, tensors_of
from gaussian_swaying.mpm.recompute import recompute
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState, bounding_grid
from gaussian_swaying.mpm.timestep import cfl_number, stable_limit, substeps_per_frame, wave_speed
from gaussian_swaying.mpm.transfer import Stencil, bspline_stencil, g2p, gather, scatter, scatter_momentum

if TYPE_CHECKING:
    from gaussian_swaying.mpm.fused import FusedSolver

WatchFunction = Callable[[int], None]
TRANSFERS = ("auto", "torch", "triton")


class MPMSolver(nn.Module):
    """Material point method in two formulations over one set of transfers.

    ``total`` (total Lagrangian MPM; de Vaucorbeil, Nguyen & Hutchinson 2020): stencils at the rest positions, computed
    once; nodal displacement and velocity are the state. For elastic things that keep their neighbours: flags, leaves,
    cords. It cannot tear, and has no transfer dissipation.

    ``updated`` (the paper and PhysGaussian): stencils at the current positions, momentum on the particles (APIC, Jiang
    et al. 2015). For material that flows, mixes or touches itself; plastic laws and fluids need it. A soft sheet tears
    numerically once local stretch times particle spacing nears two cells.

    Args:
        dx: Grid spacing [m].
        formulation: ``total`` or ``updated``.
        gravity: Acceleration [m/s²], z up.
        damping: Rate at which velocities decay [1/s]; 0 for none.
        stiffness_damping: Time [s] by which the stress looks ahead: damps a vibration of circular frequency omega with
            the ratio stiffness_damping * omega / 2, and rigid motion not at all; it shortens the stable substep.
        cfl: Courant number of the adaptive substep, ``dt = cfl dx / (c + |v|)``; up to 0.47 is stable near rest for any
            arrangement of particles and any Poisson's ratio.
        substep: Fixed substep [s] instead of the adaptive one; checked against the stable one.
        max_nodes: Largest grid [nodes]; an object that spreads beyond it is reported instead of eating the memory.
        mls: Stress term and update of F as in MLS-MPM (Hu et al. 2018); only in ``updated``.
        deterministic: On a GPU, sum in a fixed order, so that the same run gives the same bits; slower. On a CPU it is
            so anyway. Gradients on a GPU are not covered.
        boundaries: Boundary conditions, applied in order, impulses first.
        transfer: How substeps are computed. ``torch`` is the definition, on any device and with gradients; ``triton``
            has a whole substep in two kernels on a CUDA device, in float32 and without gradients; ``auto`` takes
            triton where it can.
        compile: Compile stress and transfers with ``torch.compile``. The first substeps then take a minute or so, and
            some again when the grid first changes or gradients are first asked for, but not for another ``dt``. No
            second derivatives, and no ``checkpoint``.

    Example:
        >>> points = MaterialPoints.create(torch.rand(100, 3), volume=1e-3, density=100.0, youngs_modulus=1e4,
        ...                                poisson_ratio=0.3)
        >>> solver = MPMSolver(dx=0.1, gravity=(0, 0, -9.8))
        >>> state = solver.init_state(points)
        >>> state = solver.step(state, dt=1e-3)
        >>> round(state.velocity[:, 2].mean().item(), 4)
        -0.0098
    """

    def __init__(
        self,
        dx: float = 0.02,
        formulation: str = "total",
        gravity: Sequence[float] = (0.0, 0.0, -9.8),
        damping: float = 0.0,
        stiffness_damping: float = 0.0,
        cfl: float = 0.4,
        substep: float | None = None,
        max_nodes: int = 64_000_000,
        mls: bool = False,
        deterministic: bool = False,
        boundaries: Sequence[Boundary] = (),
        transfer: str = "auto",
        compile: bool = False,
    ) -> None:
        super().__init__()
        check_choice("transfer", transfer, TRANSFERS)
        if compile and transfer == "triton":
            raise ValueError("The kernels of `transfer: triton` are compiled anyway: leave out `compile`.")
        check_positive("dx", dx)
        check_choice("formulation", formulation, ("total", "updated"))
        check_positive("damping", damping, allow_zero=True)
        check_positive("stiffness_damping", stiffness_damping, allow_zero=True)
        if mls and formulation != "updated":
            raise ValueError(
                "`mls` is a variant of the updated formulation: set `formulation` to updated, or `mls` to false."
            )
        check_positive("cfl", cfl)
        if substep is not None:
            check_positive("substep", substep)
        check_positive("max_nodes", max_nodes)
        self.dx, self.formulation, self.damping, self.cfl = float(dx), formulation, float(damping), float(cfl)
        self.stiffness_damping, self.mls, self.deterministic = float(stiffness_damping), mls, deterministic
        self.substep, self.max_nodes, self.compiled = substep, int(max_nodes), bool(compile)
        self.transfer = transfer
        self.gravity = check_vector("gravity", gravity)
        # float64 on the device: no copy in a step, full precision in a float64 run
        self.register_buffer("_gravity", torch.tensor(self.gravity, dtype=torch.float64), persistent=False)
        self._gravity: Tensor
        self.boundaries = nn.ModuleList(boundaries)
        # the same in metres; in a tuple, as these copies are no part of the module's state
        self._framed: tuple[Boundary, ...] | None = None
        self._points: MaterialPoints | None = None
        self._laws: LawDispatch | None = None
        self._static: dict[str, Tensor] = {}
        self._stencil: Stencil | None = None
        self._fused: FusedSolver | None = None
        self._fused_obstacle: str | None = None
        self._grid = GridSpec(self.dx, (0, 0, 0), (0, 0, 0))

    # ---- the object at rest

    @property
    def points(self) -> MaterialPoints:
        """The material given to :meth:`init_state`."""
        if self._points is None:
            raise RuntimeError("The solver has no material yet: call `init_state(points)` first.")
        return self._points

    @property
    def laws(self) -> LawDispatch:
        """The laws of the material given to :meth:`init_state`, bound to its particles."""
        if self._laws is None:
            raise RuntimeError("The solver has no material yet: call `init_state(points)` first.")
        return self._laws

    @property
    def stencil(self) -> Stencil:
        """The stencil of the particles at rest, in the ``total`` formulation."""
        if self._stencil is None:
            raise RuntimeError("The solver has no fixed stencil: it is of the total formulation and needs a material.")
        return self._stencil

    @property
    def _acting(self) -> Sequence[Boundary]:
        """The boundary conditions, in metres."""
        return _conditions(self.boundaries) if self._framed is None else self._framed

    @property
    def total_lagrangian(self) -> bool:
        """Whether stencils stay at the rest positions."""
        return self.formulation == "total"

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MPMSolver:
        super()._apply(fn, recurse)
        for boundary in self._framed or ():
            boundary._apply(fn)
        if self._points is not None:
            self._bind(self._points.map(fn))
        return self

    def _bind(self, points: MaterialPoints) -> None:
        """Take the material and compute what never changes: its laws and, in ``total``, stencil and mass."""
        laws = LawDispatch(points)
        if self.total_lagrangian and laws.plastic:
            raise ValueError(
                f"The law {laws.plastic_names[0]} flows, which the total formulation cannot follow: set "
                "`solver.formulation` to updated, or choose an elastic law."
            )
        self._points, self._laws, self._static, self._fused = points, laws, {}, None
        self._fused_obstacle = self._why_not_fused()
        self._stress = self._built(laws.pk1 if self.total_lagrangian else laws.kirchhoff)
        self._scatter_momentum, self._g2p = self._built(scatter_momentum), self._built(g2p)
        static, position, conditions = self._static, points.position, self._acting
        for k, boundary in enumerate(conditions):
            mask = boundary.particle_mask(position.detach())
            if mask is None:
                continue
            static[f"pinned_mass_{k}"] = torch.where(mask, points.mass, 0.0)
            static[f"held_mass_{k}"] = static[f"pinned_mass_{k}"].sum(-1)
            release = boundary.release_time(position.detach())
            if release is not None:
                static[f"release_{k}"] = release
        if not self.total_lagrangian:
            return
        grid = self._bounding_grid(position, margin=0)
        snap = torch.finfo(position.dtype).eps ** 0.5
        stencil = bspline_stencil(position, grid, False, snap, deterministic=self.deterministic, fixed=True)
        mass = scatter(stencil, points.mass[..., None, None])[..., 0]
        self._stencil = stencil
        # sparse products cannot be compiled, and are faster
        sparse = stencil.matrices is not None
        self._scatter = scatter if sparse else self._built(scatter)
        self._gather = gather if sparse else self._built(gather)
        static["node_mass"] = mass
        static["node_inverse_mass"] = _safe_inverse(mass)
        if any(b.needs_position for b in conditions):
            first_moment = scatter(stencil, (points.mass[..., None] * position)[..., None, :])
            static["node_rest"] = first_moment * static["node_inverse_mass"][..., None]
        for k, boundary in enumerate(conditions):
            if f"pinned_mass_{k}" not in static:
                continue
            share = self._share(k, stencil, static["node_inverse_mass"], None)
            threshold = boundary.held_share
            if threshold is not None and not bool((share > threshold).any()):
                count = int((static[f"pinned_mass_{k}"] > 0).sum())
                raise ValueError(
                    f"The pin {k} holds {count} particles but no grid node: none of them has more than "
                    f"{threshold:g} of the mass of a node; enlarge `region` of the {type(boundary).__name__} or lower "
                    "its `held_share`."
                )
            if f"release_{k}" not in static:
                static[f"share_{k}"] = share
        self._grid = grid

    def _built(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A pure function as it is, or compiled; the substep is no argument of any, so that it may change."""
        return torch.compile(function, fullgraph=True) if self.compiled else function

    def _why_not_fused(self) -> str | None:
        """Why the Triton kernels cannot be used, whatever the state; None if they can."""
        if self.transfer == "torch":
            return "`transfer` is torch"
        if self.compiled:
            return "`compile` is set"
        try:
            from gaussian_swaying.mpm import fused
        except ImportError as error:
            obstacle: str | None = f"Triton cannot be imported ({error})"
        else:
            obstacle = fused.unsupported(self)
        if self.transfer == "triton" and obstacle is not None:
            raise ValueError(f"`transfer: triton` cannot be used, as {obstacle}: set it to auto or torch.")
        return obstacle

    def fused(self, *tensors: Tensor | None) -> FusedSolver | None:
        """The Triton substep of this material; None where the torch one is to be used.

        Args:
            tensors: What the substep starts from; if one asks for a gradient, the torch substep is used.

        Raises:
            ValueError: If ``transfer`` is triton and a gradient is asked for.
        """
        if self._fused_obstacle is not None:
            return None
        if torch.is_grad_enabled():
            points = self.points
            own = [points.position, points.mass, points.volume, points.youngs_modulus, points.poisson_ratio]
            held = [t for boundary in self._acting for t in (*boundary.parameters(), *boundary.buffers())]
            if any(t is not None and t.requires_grad for t in (*own, *held, *tensors)):
                if self.transfer == "triton":
                    raise ValueError("`transfer: triton` has no gradients: set it to auto or torch.")
                return None
        from gaussian_swaying.mpm.fused import FusedTotal, FusedUpdated, made_from

        if self._fused is None or self._fused.made_from != made_from(self):
            # ordinary tensors, which may be written within inference mode and without
            with torch.inference_mode(False), torch.no_grad():
                self._fused = (FusedTotal if self.total_lagrangian else FusedUpdated)(self)
        return self._fused

    def _fused_for(self, state: MPMState, forces: Sequence[Force]) -> FusedSolver | None:
        """As :meth:`fused`, for rollouts in some forces; None too if one of them has to be asked in every substep."""
        if not all(force.recordable for force in divide(forces)[1]):
            return None
        asking = [*_tensors(state), *tensors_of(forces)] if torch.is_grad_enabled() else []
        return self.fused(*asking)

    def held_mass(self, k: int, time: Tensor | None) -> Tensor:
        """Mass of the particles that the ``k``-th boundary holds at a time [kg], zero elsewhere, shape (..., P)."""
        mass = self._static[f"pinned_mass_{k}"]
        if time is not None and f"release_{k}" in self._static:
            mass = torch.where(self._static[f"release_{k}"] > time + CLOCK, mass, 0.0)
        return mass

    def _share(self, k: int, stencil: Stencil, inverse_mass: Tensor, time: Tensor | None) -> Tensor:
        """Share of the nodal mass that the particles of a boundary hold, shape (..., G)."""
        return scatter(stencil, self.held_mass(k, time)[..., None, None])[..., 0] * inverse_mass

    def _bounding_grid(self, position: Tensor, margin: int, speed: float = 0.0) -> GridSpec:
        flat = position.detach().reshape(-1, 3)
        low, high = flat.amin(0), flat.amax(0)
        if not bool(torch.isfinite(low).all() & torch.isfinite(high).all()):
            raise _not_finite("position", flat)
        grid = bounding_grid(low, high, self.dx, margin)
        if grid.node_count > self.max_nodes:
            size = [round(v, 3) for v in (high - low).tolist()]
            what = f"The particles span {size} m"
            if 2 * margin * self.dx > max(size):
                what = f"The particles may fly {margin * self.dx:.3g} m to any side within a frame, at {speed:.3g} m/s"
            raise ValueError(
                f"{what}, which takes {grid.node_count:,} grid nodes at dx = {self.dx:g} m, more "
                f"than `max_nodes` = {self.max_nodes:,}: select a smaller region, coarsen `dx` or raise `max_nodes`."
            )
        if max(map(abs, grid.offset)) >= 2**31:
            raise ValueError(
                f"The particles lie up to {float(flat.abs().amax()):.3g} m from the origin, more than 2^31 cells of dx "
                f"= {self.dx:g} m: pin or enclose them, or shift the scene to the origin."
            )
        return grid

    def init_state(
        self,
        points: MaterialPoints,
        velocity: Tensor | None = None,
        margin: int = 4,
        frame: SimFrame | None = None,
    ) -> MPMState:
        """Take the material at rest and return the state at time zero.

        Args:
            points: The material, shapes (..., P, ·).
            velocity: Initial velocity [m/s], shape (..., P, 3); zero if None.
            margin: Cells around the object in the first grid of the ``updated`` formulation.
            frame: The frame from scene units to metres in which the boundaries are given; None if they are in metres.

        Returns:
            The state, on the device and with the type of ``points``.

        Raises:
            TypeError: If ``points`` is not a MaterialPoints.
            ValueError: If a pin holds nothing, the grid is too large, ``velocity`` has another shape, or a plastic law
                or a fluid meets the ``total`` formulation.
        """
        if not isinstance(points, MaterialPoints):
            raise TypeError(f"Expected `points` to be a MaterialPoints, but got {type(points).__name__}.")
        self._framed = None
        if frame is not None:
            self._framed = tuple(b.in_frame(frame) for b in _conditions(self.boundaries))
        self._points = None
        self.to(points.position.device)  # the solver goes where its material is
        self._bind(points)
        position = points.position
        self._check_rounding(position)
        if velocity is None:
            velocity = torch.zeros_like(position)
        check_shape("velocity", velocity, points.count, 3)
        velocity = velocity.expand_as(position)
        identity = torch.eye(3, dtype=position.dtype, device=position.device).repeat(*position.shape[:-1], 1, 1)
        state = MPMState(
            position=position,
            velocity=velocity,
            affine=torch.zeros_like(identity),
            F_elastic=identity,
            F_total=identity,
            lost=torch.zeros(position.shape[:-1], dtype=torch.bool, device=position.device),
            time=torch.zeros((), dtype=torch.float64, device=position.device),
            grid=self._grid if self.total_lagrangian else self._bounding_grid(position, margin),
            internal=self.laws.initial_internal(),
            work=torch.zeros(position.shape[:-2], dtype=torch.float64, device=position.device),
        )
        if not self.total_lagrangian:
            return state
        assert self._stencil is not None
        momentum = scatter(self._stencil, (points.mass[..., None] * velocity)[..., None, :])
        node_velocity = momentum * self._static["node_inverse_mass"][..., None]
        return self._read_particles(state, torch.zeros_like(node_velocity), node_velocity)

    def _check_rounding(self, position: Tensor) -> None:
        """Refuse positions in ``updated`` whose rounding would swallow the way of a substep."""
        farthest = float(position.detach().abs().amax()) if position.numel() else 0.0
        limit = 1e-3 * self.dx / torch.finfo(position.dtype).eps
        if not self.total_lagrangian and farthest > limit:
            raise ValueError(
                f"Expected `position` within {limit:.3g} m of the origin, but got {farthest:.3g} m, where "
                f"{position.dtype} rounds by more than a thousandth of a cell: shift the scene to the origin (SimFrame "
                "does so), or use float64."
            )

    # ---- time

    def stable_substep(self, state: MPMState | None = None) -> float:
        """Longest substep [s] that is stable for any arrangement of particles (one GPU synchronisation)."""
        F, internal = (None, None) if state is None else (state.F_elastic.detach(), state.internal)
        limit = stable_limit(self.points, self.dx, F, internal, spatial=not self.total_lagrangian, laws=self._laws)
        return damped_substep(float(limit.detach().amin()), self._viscous_time(state))

    def substeps(self, state: MPMState, frame_dt: float) -> int:
        """How many equal substeps the next frame of ``frame_dt`` seconds takes (one GPU synchronisation).

        Raises:
            ValueError: If the fixed substep is longer than the stable one, which the message gives.
        """
        if self.substep is not None:
            limit = self.stable_substep(state)
            if self.substep > limit * (1 + 1e-6):
                raise ValueError(
                    f"The fixed `substep` of {self.substep:g} s is longer than the stable one of {limit:.4g} s (at dx "
                    f"= {self.dx:g} m and this material): lower it, or set it to null for the adaptive substep."
                )
            steps = substeps_per_frame(frame_dt, self.substep, exact=True)
            return steps if frame_dt / steps <= limit * (1 + 1e-6) else steps + 1
        longest = self.cfl / max(float(self._cells_per_second(state)), 1e-30)
        return substeps_per_frame(frame_dt, damped_substep(longest, self._viscous_time(state)), exact=False)

    def cfl_number(self, state: MPMState, dt: float) -> Tensor:
        """Largest Courant number ``dt (c + |v|) / dx`` of a substep; in ``total`` without v, as stencils rest.

        With stiffness damping it is that of the undamped substep which is as stable.
        """
        return math.sqrt(dt * dt + 2 * self._viscous_time(state) * dt) * self._cells_per_second(state)

    def _viscous_time(self, state: MPMState | None) -> float:
        """The stiffness damping [s], grown by as much as the viscous stress of a stretched material is stiffer."""
        if self.stiffness_damping == 0 or state is None:
            return self.stiffness_damping
        F = state.F_elastic.detach()
        squared = float(symmetric_eigenvalues(F.mT @ F)[..., 0].amax().clamp(min=1.0))
        return self.stiffness_damping * squared ** (1 if self.total_lagrangian else 2)

    def _cells_per_second(self, state: MPMState) -> Tensor:
        """How many cells the fastest wave crosses in a second."""
        F = state.F_elastic.detach()
        if self._fused_obstacle is None:
            from gaussian_swaying.mpm.fused import largest_speed

            cells = largest_speed(self, state)
            if cells is not None:
                return cells
        speed = wave_speed(self.points, F, state.internal, spatial=not self.total_lagrangian, laws=self._laws)
        return cfl_number(1.0, self.dx, speed, None if self.total_lagrangian else state.velocity).detach()

    def fit_grid(self, state: MPMState, horizon: float, margin: int = 0) -> MPMState:
        """Move and resize the grid of the ``updated`` formulation to the object for the next ``horizon`` seconds.

        Args:
            state: The state now.
            horizon: Time that the grid has to serve [s]; reckoned with twice the present speeds, and gravity.
            margin: Further cells on each side, for what the wind and the boundaries may do.

        Returns:
            The state with its new grid.

        Raises:
            FloatingPointError: If a position or a speed is NaN or infinite.
            ValueError: If the grid would be larger than ``max_nodes``.
        """
        if self.total_lagrangian:
            return state
        speed = float(torch.linalg.vector_norm(state.velocity.detach(), dim=-1).amax())
        if not math.isfinite(speed):
            raise _not_finite("speed", state.velocity.detach().square().sum(-1).reshape(-1, 1))
        reach = (2 * speed + 0.5 * sum(g * g for g in self.gravity) ** 0.5 * horizon) * horizon
        cells = 3 + margin + min(int(reach / self.dx), 1000)
        grid = self._bounding_grid(state.position, cells, speed)
        if not state.position.is_cuda:
            return state.replace(grid=grid)
        # CUDA graphs are recorded for one grid, so it stays as long as it serves
        roomy = grid.with_room(state.grid)
        serves = state.grid.holds(grid) and state.grid.node_count <= 3 * roomy.node_count
        if serves and not margin:  # a margin is asked for where the grid did not serve
            return state
        return state.replace(grid=roomy if roomy.node_count <= self.max_nodes else grid)

    def step(
        self,
        state: MPMState,
        dt: float,
        forces: Forces | None = None,
        force: Tensor | None = None,
        drag: Tensor | None = None,
    ) -> MPMState:
        """Advance by one substep of symplectic Euler; no host synchronisation, no data-dependent shapes.

        Where the substep changes, forces act for the mean of the old and the new one: the velocities stand half a
        substep beside the positions, and the full new one would jolt them (an error of first order, and energy). A
        substep that shrinks to less than a third is the exception: forces then act for twice the new one.

        Args:
            state: The state now.
            dt: Substep [s].
            forces: What pushes the particles, see :meth:`rollout`.
            force: A force on each particle that is known already [N], shape (..., P, 3); it is added to ``forces``.
            drag: By how much that force falls per velocity gained in the substep [kg/s], shape (..., P); a drag that is
                taken so is stable however light the particle (see ``AeroForce.resistance``).

        Returns:
            The state ``dt`` later.
        """
        if force is not None:
            check_shape("force", force, self.points.count, 3)
        if drag is not None:
            check_shape("drag", drag, self.points.count)
        acting = as_forces(forces)
        if acting and force is None and drag is None:
            return self.rollout(state, dt, 1, acting)
        found = [split(part(state), part, state) for part in acting]
        force, drag = added([(force, drag), *found])
        return self._step(state, dt, force, drag)

    def _step(self, state: MPMState, dt: float, force: Tensor | None, drag: Tensor | None) -> MPMState:
        """One substep with a force and a drag that are known."""
        fused = self.fused(*_tensors(state), force, drag)
        if fused is not None:
            return fused.rollout(state, dt, 1, force=force, drag=drag)[0]
        advance = self._step_total if self.total_lagrangian else self._step_updated
        after = advance(state, dt, force, drag)
        return after if force is None else after.replace(work=self._work(state, after, dt, force, drag))

    @torch.no_grad()
    def _work(self, state: MPMState, after: MPMState, dt: float, force: Tensor, drag: Tensor | None) -> Tensor:
        """Work of the external force up to the end of a substep [J].

        It is counted at the mean velocity: exactly what the step adds to the kinetic energy.
        """
        if drag is not None:
            force = force - drag[..., None] * (after.velocity - state.velocity)
        power = torch.linalg.vecdot(force, state.velocity + after.velocity).sum(-1)
        return state.work + (0.5 * self.kick(state, dt)) * power

    def rollout(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Forces | None = None,
        checkpoint: int = 0,
        watch: WatchFunction | None = None,
    ) -> MPMState:
        """Advance by several substeps.

        With the Triton kernels the substeps are replayed from CUDA graphs, and with them the forces: the first that
        has a Triton twin within the kernels, the others in torch. If one of these is not ``recordable``, as functions
        are not, the host goes from substep to substep and asks them all.

        Args:
            state: The state now.
            dt: Substep [s].
            steps: Number of substeps.
            forces: What pushes the particles, one or several that add up: each a ``Force``, such as ``WindForce``, or a
                function of the state that gives the force [N], shape (..., P, 3), or the force and its resistance
                [kg/s], shape (..., P) (``drag`` in :meth:`step`).
            checkpoint: For gradients through long rollouts: keep only every so many states and compute the others again
                in the backward pass; about the square root of ``steps`` needs the least memory. 0 keeps everything.
                The forces must then be the same each time they see the same state.
            watch: Told now and then how many substeps are done, or under way on a GPU; not with ``checkpoint``.

        Returns:
            The state ``steps * dt`` later.
        """
        acting = as_forces(forces)
        fused = self._fused_for(state, acting)
        if fused is not None:
            return fused.rollout(state, dt, steps, acting, watch=watch)[0]
        sources = [force.during(state.time, dt, steps) for force in acting]

        def force_at(state: MPMState, k: int) -> tuple[Tensor | None, Tensor | None]:
            pairs = zip(sources, acting, strict=True)
            return added([split(source(state, k), force, state) for source, force in pairs])

        def advance(state: MPMState, first: int, count: int) -> MPMState:
            for k in range(first, first + count):
                state = self._step(state, dt, *force_at(state, k))
                if watch is not None and checkpoint <= 0:
                    watch(k + 1)
            return state

        if checkpoint <= 0 or not torch.is_grad_enabled():
            return advance(state, 0, steps)
        if self.compiled:
            raise ValueError(
                "Compiled substeps keep what their gradient needs: set `compile` or `checkpoint`, not both."
            )
        for first in range(0, steps, checkpoint):
            count = min(checkpoint, steps - first)
            state = recompute(partial(advance, first=first, count=count), state)
        return state

    def watched_rollout(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Forces | None = None,
        looks: int = 8,
        watch: WatchFunction | None = None,
    ) -> tuple[MPMState, Tensor]:
        """Advance by several substeps and look at the Courant number on the way, as material may stiffen and slacken.

        Args:
            state: The state now.
            dt: Substep [s].
            steps: Number of substeps.
            forces: As in :meth:`rollout`.
            looks: How often to look, evenly, the last time at the end.
            watch: As in :meth:`rollout`.

        Returns:
            The state ``steps * dt`` later, and the largest Courant number seen, a scalar tensor.
        """
        marks = sorted({math.ceil((k + 1) * steps / looks) for k in range(looks)})
        acting = as_forces(forces)
        if self.stiffness_damping == 0:
            fused = self._fused_for(state, acting)
            if fused is not None and fused.watches:
                state, cells = fused.rollout(state, dt, steps, acting, looks=marks, watch=watch)
                return state, dt * cells
        seen = []
        for first, last in pairwise([0, *marks]):
            part = None if watch is None else partial(_told, watch, first)
            state = self.rollout(state, dt, last - first, acting, watch=part)
            seen.append(self.cfl_number(state, dt))
        return state, torch.stack(seen).amax()

    @staticmethod
    def kick(state: MPMState, dt: float) -> float:
        """How long forces act in a substep of ``dt`` [s] (see :meth:`step`)."""
        return min(0.5 * (state.substep + dt), 2 * dt) if state.substep > 0 else dt

    def _step_total(self, state: MPMState, dt: float, force: Tensor | None, drag: Tensor | None) -> MPMState:
        assert self._stencil is not None
        assert state.node_velocity is not None
        displacement = state.node_displacement
        assert displacement is not None
        points, static, laws = self.points, self._static, self.laws
        F = state.F_elastic
        stress = self._stress(F, None)
        if self.stiffness_damping > 0:
            stress = stress + kelvin_voigt_pk1(F, state.affine, laws.mu, laws.lam, self.stiffness_damping)
        stress = stress * points.volume[..., None, None]
        value = torch.zeros_like(state.position) if force is None else force
        node_force = self._scatter(self._stencil, torch.cat([value[..., None, :], -stress.mT], dim=-2))
        inverse_mass = static["node_inverse_mass"][..., None]
        kick, yielding = self.kick(state, dt), None
        if drag is not None:
            resistance = scatter(self._stencil, drag[..., None, None])
            yielding = 1 / (1 + kick * resistance * inverse_mass)
        velocity = self._accelerate(state.node_velocity, node_force * inverse_mass, kick, yielding)
        velocity = torch.where(inverse_mass > 0, velocity, 0.0)
        position = lattice = None
        if "node_rest" in static:
            shift = (state.position - points.position) * points.mass[..., None]
            position = static["node_rest"] + scatter(self._stencil, shift[..., None, :]) * inverse_mass
        if any(b.needs_lattice for b in self._acting):
            lattice = state.grid.node_positions(velocity) + displacement
        inverse = inverse_mass[..., 0]
        share = partial(self._share, stencil=self._stencil, inverse_mass=inverse, time=state.time)
        velocity = self._constrain(velocity, share, position, lattice, state.time, dt)
        state = state.replace(time=state.time + dt, substep=dt)
        return self._read_particles(state, displacement + dt * velocity, velocity)

    def _read_particles(self, state: MPMState, displacement: Tensor, velocity: Tensor) -> MPMState:
        """Particle fields of the ``total`` formulation, interpolated from the nodes."""
        assert self._stencil is not None
        rows = self._gather(torch.cat([displacement, velocity], dim=-1), self._stencil)
        F = rows[..., 1:4, :3].mT + torch.eye(3, dtype=rows.dtype, device=rows.device)
        return state.replace(
            position=self.points.position + rows[..., 0, :3],
            velocity=rows[..., 0, 3:],
            affine=rows[..., 1:4, 3:].mT,
            F_elastic=F,
            F_total=F,
            node_displacement=displacement,
            node_velocity=velocity,
        )

    def _step_updated(self, state: MPMState, dt: float, force: Tensor | None, drag: Tensor | None) -> MPMState:
        points, laws = self.points, self.laws
        stencil = bspline_stencil(state.position, state.grid, gradients=not self.mls, deterministic=self.deterministic)
        F = state.F_elastic
        stress = self._stress(F, state.internal)
        if self.stiffness_damping > 0:
            rate = matmul3(state.affine, F)
            viscous = kelvin_voigt_pk1(F, rate, laws.mu, laws.lam, self.stiffness_damping)
            stress = stress + matmul3(viscous, F.mT)
        kick = self.kick(state, dt)
        impulse = None if force is None else kick * force
        if any(self.gravity):  # here, and not on the nodes, of which most may be empty
            weight = kick * points.mass[..., None] * self._gravity.to(F)
            impulse = weight if impulse is None else impulse + weight
        if drag is not None:
            held = (kick * drag)[..., None] * state.velocity
            impulse = held if impulse is None else impulse + held
        nodes = self._scatter_momentum(
            points.mass,
            state.velocity,
            state.affine,
            impulse,
            kick * points.volume[..., None, None] * stress,
            stencil,
            4.0 / self.dx**2 if self.mls else None,
        )
        inverse_mass = _safe_inverse(nodes[..., 3])[..., None]
        velocity, yielding = nodes[..., :3] * inverse_mass, None
        if drag is not None:
            yielding = 1 / (1 + kick * scatter(stencil, drag[..., None, None]) * inverse_mass)
            velocity = velocity * yielding
        if self.damping > 0:
            velocity = velocity * math.exp(-self.damping * kick)
        position = None
        if any(b.needs_position or b.needs_lattice for b in self._acting):
            position = state.grid.node_positions(velocity).expand_as(velocity)
        share = partial(self._share, stencil=stencil, inverse_mass=inverse_mass[..., 0], time=state.time)
        velocity = self._constrain(velocity, share, position, position, state.time, dt)
        new_velocity, affine, gradient = self._g2p(velocity, stencil, self.dx)
        identity = torch.eye(3, dtype=gradient.dtype, device=gradient.device)
        update = identity + dt * gradient
        F, internal = matmul3(update, F), state.internal
        F_total = F
        if laws.plastic:
            F_total = matmul3(update, state.F_total)
            F, internal = laws.return_map(F, internal, dt)
        return state.replace(
            position=state.position + dt * new_velocity,
            velocity=new_velocity,
            affine=affine,
            F_elastic=F,
            F_total=F_total,
            lost=state.lost | ~stencil.inside,
            time=state.time + dt,
            internal=internal,
            substep=dt,
        )

    def _accelerate(self, velocity: Tensor, acceleration: Tensor, dt: float, yielding: Tensor | None = None) -> Tensor:
        """Apply the given acceleration, gravity and damping to node velocities of the ``total`` formulation.

        ``yielding`` is mass over mass plus implicit drag times ``dt``, shape (..., G, 1).
        """
        if any(self.gravity):
            acceleration = acceleration + self._gravity.to(velocity)
        velocity = velocity + dt * (acceleration if yielding is None else yielding * acceleration)
        if self.damping > 0:
            velocity = velocity * math.exp(-self.damping * dt)
        return velocity

    def _constrain(
        self,
        velocity: Tensor,
        share_of: Callable[[int], Tensor],
        position: Tensor | None,
        lattice: Tensor | None,
        time: Tensor,
        dt: float | Tensor,
    ) -> Tensor:
        """Apply the boundary conditions to node velocities, in order.

        ``share_of(k)`` is the share of the nodal mass that the particles of the ``k``-th one hold, shape (..., G).
        """
        static = self._static
        # what pushes comes before what holds, in whatever order they were given
        for k, boundary in sorted(enumerate(self._acting), key=lambda pair: not isinstance(pair[1], Impulse)):
            share = None
            if f"pinned_mass_{k}" in static:
                share = static[f"share_{k}"] if f"share_{k}" in static else share_of(k)
            threshold = (boundary.held_share or 0.0) if self.total_lagrangian else 0.0
            held_mass = static.get(f"held_mass_{k}")
            velocity = boundary(velocity, Nodes(time, dt, position, lattice, share, threshold, held_mass))
        return velocity

    def energies(self, state: MPMState) -> dict[str, Tensor]:
        """Kinetic, elastic and gravitational energy [J], each of shape (...) over the batch."""
        points = self.points
        if state.node_velocity is not None:
            kinetic = 0.5 * (self._static["node_mass"] * state.node_velocity.square().sum(-1)).sum(-1)
        else:
            # lumped APIC kinetic energy: the affine part carries D = dx²/4 per particle (Jiang et al. 2015)
            spread = 0.25 * self.dx**2 * state.affine.square().sum((-1, -2))
            kinetic = 0.5 * (points.mass * (state.velocity.square().sum(-1) + spread)).sum(-1)
        density = None
        wanted = torch.is_grad_enabled() and (state.F_elastic.requires_grad or self.laws.mu.requires_grad)
        if self._fused_obstacle is None and not wanted:
            from gaussian_swaying.mpm.fused import elastic_energy

            density = elastic_energy(self, state.F_elastic)
        if density is None:
            density = self.laws.energy(state.F_elastic, state.internal)
        height = (state.position * self._gravity.to(state.position)).sum(-1)
        return {
            "kinetic": kinetic,
            "elastic": (points.volume * density).sum(-1),
            "potential": -(points.mass * height).sum(-1),
        }

    def momenta(self, state: MPMState) -> dict[str, Tensor]:
        """Linear [kg m/s] and angular momentum about the origin [kg m²/s], each of shape (..., 3)."""
        if state.node_velocity is not None:
            assert state.node_displacement is not None
            momentum = self._static["node_mass"][..., None] * state.node_velocity
            place = state.grid.node_positions(momentum) + state.node_displacement
            return {"linear": momentum.sum(-2), "angular": torch.linalg.cross(place, momentum, dim=-1).sum(-2)}
        momentum = self.points.mass[..., None] * state.velocity
        # what the affine velocity adds: the antisymmetric part of m C dx²/4 (Jiang et al. 2015)
        spin = state.affine * (self.points.mass * self.dx**2 / 4)[..., None, None]
        own = torch.stack([spin[..., i, j] - spin[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)
        angular = torch.linalg.cross(state.position, momentum, dim=-1) + own
        return {"linear": momentum.sum(-2), "angular": angular.sum(-2)}

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return f"formulation={self.formulation}, dx={self.dx}, gravity={self.gravity}, damping={self.damping}"


def _told(watch: WatchFunction, before: int, done: int) -> None:
    watch(before + done)


def _conditions(modules: nn.ModuleList) -> list[Boundary]:
    return [b for b in modules if isinstance(b, Boundary)]


def _tensors(state: MPMState) -> list[Tensor]:
    """The floating-point fields of a state."""
    fields = [state.position, state.velocity, state.affine, state.F_elastic, state.F_total, state.internal]
    return [t for t in (*fields, state.node_displacement, state.node_velocity) if t is not None]


def _not_finite(name: str, values: Tensor) -> FloatingPointError:
    """The error that names the first particle of which a value (P, ·) is NaN or infinite."""
    first = int((~torch.isfinite(values)).any(-1).int().argmax())
    return FloatingPointError(f"The {name} of particle {first} is NaN or infinite.")


def _safe_inverse(mass: Tensor) -> Tensor:
    """1 / mass where there is any, else 0; its derivative, 1 / mass², stays finite too."""
    floor = torch.finfo(mass.dtype).tiny ** 0.5
    return torch.where(mass > floor, 1 / mass.clamp(min=floor), 0.0)
