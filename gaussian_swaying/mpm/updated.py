"""The ``updated`` formulation: stencils at the current positions, momentum on the particles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import matmul3, polar_rotation
from gaussian_swaying.geometry.rigid import centre
from gaussian_swaying.kernels.launch import LANES, lanes, launch, wide
from gaussian_swaying.mpm import updated_kernels as kernels
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.colliders import KINDS, Wall, solids_of
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.damping import kelvin_voigt_pk1
from gaussian_swaying.mpm.device_functions import Packed
from gaussian_swaying.mpm.formulation import (
    MAX_NODES,
    Formulation,
    Pinned,
    Settings,
    not_finite,
    pinned_share,
    safe_inverse,
)
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.run import MAX_STEPS, Part, Run, check_indices
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints, MPMState
from gaussian_swaying.mpm.timestep import kick_time
from gaussian_swaying.mpm.transfer import bspline_stencil, g2p, scatter, scatter_momentum


class Updated(Formulation):
    """The paper's formulation: APIC (Jiang et al. 2015) on a moving grid.

    Args:
        points: See :class:`Formulation`.
        boundaries: See there.
        settings: Numbers and switches of the solver.
        surface: See :class:`Formulation`.
    """

    name = "updated"
    neighbours_fixed = False
    viscous_power = 2

    def __init__(
        self, points: MaterialPoints, boundaries: Sequence[Boundary], settings: Settings, surface: Surface | None = None
    ) -> None:
        super().__init__(points, boundaries, settings, surface)
        if points.damping is not None:
            raise ValueError(
                "`damping` of material points, which `material.damping_ratio` sets, needs `solver.formulation: total`: "
                "use `solver.damping`, one rate for all of the material."
            )
        if points.bending is not None:
            raise ValueError(
                "`bending` of material points, which `material.bending` sets, needs `solver.formulation: total`: leave "
                "it out, or use `scene.layers: 3`."
            )
        if surface is not None and surface.contact is not None:
            raise ValueError(
                "`contact` needs particles that keep their neighbours, which the updated formulation does not have: "
                "leave out `contact`, as its material meets itself on the grid, or set `solver.formulation` to total."
            )

    def first_grid(self, margin: int) -> GridSpec:
        """The grid around the body at rest; ValueError if rounding would lose the motion of a substep."""
        position, dx = self.points.position, self.settings.dx
        farthest = float(position.detach().abs().amax()) if position.numel() else 0.0
        limit = 1e-3 * dx / torch.finfo(position.dtype).eps
        if farthest > limit:
            raise ValueError(
                f"Expected `position` within {limit:.3g} m of the origin, but got {farthest:.3g} m, where "
                f"{position.dtype} rounds by more than a thousandth of a cell: shift the scene to the origin (SimFrame "
                "does this), or use float64."
            )
        return self.bounding_grid(position, margin)

    def fit_grid(self, state: MPMState, horizon: float, margin: int) -> MPMState:
        """The state with a grid large enough for ``horizon`` seconds at twice the current speeds, with gravity."""
        dx, gravity = self.settings.dx, self.settings.gravity
        speed = float(torch.linalg.vector_norm(state.velocity.detach(), dim=-1).amax())
        if not math.isfinite(speed):
            raise not_finite("speed", state.velocity.detach().square().sum(-1).reshape(-1, 1))
        reach = (2 * speed + 0.5 * sum(g * g for g in gravity) ** 0.5 * horizon) * horizon
        cells = 3 + margin + min(int(reach / dx), 1000)
        grid = self.bounding_grid(state.position, cells, speed)
        if not state.position.is_cuda:
            return state.replace(grid=grid)
        # CUDA graphs are recorded for one grid, so keep it as long as it is large enough
        roomy = grid.with_room(state.grid)
        serves = state.grid.holds(grid) and state.grid.node_count <= 3 * roomy.node_count
        if serves and not margin:  # callers give a margin if the grid was too small
            return state
        return state.replace(grid=roomy if roomy.node_count <= MAX_NODES else grid)

    def step(self, state: MPMState, dt: float, force: Tensor | None, drag: Tensor | None) -> MPMState:
        """One substep: momenta to the nodes, their new velocity, and back to the particles, which move with it."""
        points, laws, settings = self.points, self.laws, self.settings
        stencil = bspline_stencil(state.position, state.grid, deterministic=settings.deterministic)
        F = state.F_elastic
        stress = laws.kirchhoff(F, state.internal)
        if settings.stiffness_damping > 0:
            rate = matmul3(state.affine, F)
            viscous = kelvin_voigt_pk1(F, rate, laws.mu, laws.lam, settings.stiffness_damping)
            stress = stress + matmul3(viscous, F.mT)
        kick = kick_time(state, dt)
        impulse = None if force is None else kick * force
        if any(settings.gravity):  # here and not on the nodes, because most nodes may be empty
            weight = kick * points.mass[..., None] * self.gravity.to(F)
            impulse = weight if impulse is None else impulse + weight
        if drag is not None:
            held = (kick * drag)[..., None] * state.velocity
            impulse = held if impulse is None else impulse + held
        nodes = scatter_momentum(
            points.mass, state.velocity, state.affine, impulse, kick * points.volume[..., None, None] * stress, stencil
        )
        inverse_mass = safe_inverse(nodes[..., 3])[..., None]
        velocity = nodes[..., :3] * inverse_mass
        if drag is not None:
            velocity = velocity * (1 / (1 + kick * scatter(stencil, drag[..., None, None]) * inverse_mass))
        velocity = self.decay(velocity, kick)
        position = None
        if self.needs_position or self.needs_lattice:
            position = state.grid.node_positions(velocity).expand_as(velocity)
        share = partial(pinned_share, stencil=stencil, inverse_mass=inverse_mass[..., 0], time=state.time)
        velocity, taken = self.constrain(velocity, nodes[..., 3], share, position, position, state.time, dt)
        new_velocity, affine, gradient = g2p(velocity, stencil)
        identity = torch.eye(3, dtype=gradient.dtype, device=gradient.device)
        update = identity + dt * gradient
        F, internal = matmul3(update, F), state.internal
        F_total = F
        if laws.plastic:
            F_total = matmul3(update, state.F_total)
            F, internal = laws.return_map(F, internal, dt)
        after = state.replace(
            position=state.position + dt * new_velocity,
            velocity=new_velocity,
            affine=affine,
            F_elastic=F,
            F_total=F_total,
            lost=state.lost | ~stencil.inside,
            time=state.time + dt,
            internal=internal,
            substep=dt,
            impulse=state.impulse + taken,
        )
        return self.in_shape(after)

    def in_shape(self, state: MPMState) -> MPMState:
        """The state with the particles of rigid parts exactly where these are: c + R (X - C), with R as their F."""
        rest = in_double(self.points.position)
        for k in self.rigid:
            held = self.pinned[k]
            assert held is not None
            own, mass = (held.mass > 0)[..., None], in_double(held.mass)
            whole, before = mass.sum(-1)[..., None, None], centre(rest, mass)
            mean = (mass[..., None, None] * in_double(state.F_total)).sum(-3) / whole.clamp(min=1e-300)
            rotation = polar_rotation(mean)
            place = centre(in_double(state.position), mass) + (rest - before) @ rotation.mT
            F = rotation.to(state.F_total)[..., None, :, :]
            total = torch.where(own[..., None], F, state.F_total)
            same = state.F_elastic is state.F_total
            state = state.replace(
                position=torch.where(own, place.to(state.position), state.position),
                F_elastic=total if same else torch.where(own[..., None], F, state.F_elastic),
                F_total=total,
            )
        return state

    def kinetic(self, state: MPMState) -> Tensor:
        """Energy of the particles; the affine part adds dx²/4 of its square (lumped APIC energy; Jiang et al. 2015)."""
        spread = 0.25 * self.settings.dx**2 * state.affine.square().sum((-1, -2))
        return 0.5 * (self.points.mass * (state.velocity.square().sum(-1) + spread)).sum(-1)

    def momenta(self, state: MPMState) -> tuple[Tensor, Tensor]:
        mass = self.points.mass
        momentum = mass[..., None] * state.velocity
        # contribution of the affine velocity: the antisymmetric part of m C dx²/4 (Jiang et al. 2015)
        spin = state.affine * (mass * self.settings.dx**2 / 4)[..., None, None]
        own = torch.stack([spin[..., i, j] - spin[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)
        angular = torch.linalg.cross(state.position, momentum, dim=-1) + own
        return momentum.sum(-2), angular.sum(-2)


SHARES = 16
"""Shares of the particles that are added to grids of their own on a CPU; the sums depend on it."""

SPAN = 8
"""Nodes of a span: whether it is empty is noted, on a CPU."""

CHUNK = 256
"""Spans on which a program sums the grids of the shares."""

LEAST, MOST = 4, 64
"""Fewest and most substeps between two sorts of the particles by cell."""


FIRST_CROSSING = 1e-3
"""Cells that a particle enters in a substep, where nothing moves or nothing was measured."""


class UpdatedRun(Run):
    """Substeps of the ``updated`` formulation; particles are sorted by cell at the start of each part.

    Args:
        bound: The formulation, bound to its material.
    """

    fixed_order = False

    def __init__(self, bound: Formulation) -> None:
        super().__init__(bound)
        self.atomic = lanes(self.device, 32) == 32
        """True if particles are added to the grid atomically; else in a fixed order."""
        points, laws = bound.points, bound.laws
        self.plastic = len(self.laws.flows) > 0
        self.internal = laws.initial_internal() is not None
        rows = [points.mass, points.volume, laws.mu, laws.lam, self.law]
        self.constants = torch.stack([row.reshape(-1).to(**self.like) for row in rows], dim=1)
        self.moving = torch.zeros(0, self.count, **self.like)
        self._take_values(self.constants[:, :0])
        self.scene = torch.arange(self.count, device=self.device) // max(self.particles, 1)
        self.order = torch.arange(self.count, dtype=torch.int32, device=self.device)
        self.momentum = torch.zeros(0, 4, **self.like)
        self.velocity = torch.zeros(0, 4, **self.like)
        self.inverse_mass = torch.zeros(0, **self.like)
        self.weight = torch.zeros(0, **self.like)
        self.node_position: Tensor | None = None
        boundaries = bound.boundaries
        pins = {k: held for k, held in enumerate(bound.pinned) if held and _pins(boundaries[k], held)}
        parts = solids_of(boundaries, pins)
        solids = [part for part, _ in parts or []]
        self.solids = Packed(torch.Size([1]), self.like, fixed=True)
        self.own_solids = [found for one in solids if (found := one.device_function()) is not None]
        self.kinds = tuple(KINDS.index(one.kind if isinstance(one, Wall) else "separate") for one in solids)
        pins = pins if parts is not None else {}
        self.pinned = [(held.mass > 0).reshape(-1).to(torch.int8) for held in pins.values()]
        """For each pin, the particles that it holds."""
        windows = [one.window for one in (*solids, *(boundaries[k] for k in pins))]
        self.windows = torch.tensor(windows, dtype=torch.float64, device=self.device).reshape(-1)
        """First and last time of each solid, and then of each pin."""
        turns = [(k, n) for n, (_, k) in enumerate(parts or [])] + [(k, -1 - n) for n, k in enumerate(pins)]
        self.turns = tuple(sorted(turns, key=lambda turn: turn[0]))
        """Solids and pins in order: the number of the boundary, and that of the solid, or -1 less that of the pin."""
        self.marks_of_pins = torch.zeros(len(pins), 0, dtype=torch.int32, device=self.device)
        """The last substep in which each pin held each node, counted from 1."""
        self.clock = torch.zeros(2, dtype=torch.float64, device=self.device)  # time at step 0, substep [s]
        self.crowd = crowd_of(points.position, bound.settings.dx)
        self.wide = wide(self.device)
        self.crossing = FIRST_CROSSING  # how many cells a particle enters in a substep; measured by the rollouts
        self._measured = torch.zeros(1, pin_memory=self.device.type == "cuda")
        self._copied: torch.cuda.Event | None = None
        self.filled = torch.zeros(0, dtype=torch.int32, device=self.device)
        self.place = torch.zeros(2, self.count, dtype=torch.int32, device=self.device)  # cell, rank in it
        self.grid = GridSpec(bound.settings.dx, (0, 0, 0), (0, 0, 0))
        many = 0 if self.atomic else self.count
        self.parts = torch.zeros(many, kernels.PART.value, **self.like)
        self.part_node = torch.zeros(many, dtype=torch.int32, device=self.device)
        self.shares = torch.zeros(0, **self.like)
        self.marks, self.occupied = (torch.zeros(0, dtype=torch.int8, device=self.device) for _ in range(2))
        self.pressed = torch.zeros(0, dtype=torch.float64, device=self.device)

    def _take_values(self, values: Tensor) -> None:
        self.constants = torch.cat([self.constants[:, :5], values.to(**self.like)], dim=1)
        rows = (40 if self.plastic else 31) + values.shape[1]
        if rows > len(self.moving):
            check_indices(rows * self.count)
            self.moving = torch.zeros(rows, self.count, **self.like)
            self.spare = (self.moving[:0],) * 3  # for a sort: rows, order, work
            self.repeater.forget()

    @property
    def node_block(self) -> int:
        return lanes(self.device, 256, SPAN)

    @property
    def launches(self) -> bool:
        return not self._acting

    def _take_grid(self, grid: GridSpec, width: int) -> None:
        nodes = grid.node_count * self.scenes
        check_indices(nodes * width)
        if nodes > len(self.velocity) or width != self.momentum.shape[1]:
            room = max(len(self.velocity), 1 << (nodes - 1).bit_length() if nodes < 1 << 20 else nodes + nodes // 8)
            held = room if self._acting else 0
            self.repeater.forget()  # free their memory before allocating more
            with torch.inference_mode(False):  # they can be written inside and outside inference mode
                self.momentum = torch.zeros(room, width, **self.like)
                self.velocity = torch.zeros(room, 4, **self.like)
                self.inverse_mass, self.weight = (torch.zeros(held, **self.like) for _ in range(2))
                spans = 0 if self.atomic else -(-room // SPAN)
                self.shares = torch.empty(SHARES * spans * SPAN * width, **self.like)
                self.marks = torch.zeros(spans * SHARES, dtype=torch.int8, device=self.device)
                self.occupied = torch.zeros(spans, dtype=torch.int8, device=self.device)
                check_indices(len(self.pinned) * room)  # marks have a sign
                self.marks_of_pins = torch.zeros(len(self.pinned), room, dtype=torch.int32, device=self.device)
        if grid != self.grid:
            self.repeater.forget()  # they read the node positions
            self.grid, self.node_position = grid, None
            slots = 1 if self.scenes == 1 else self.node_block // grid.node_count + 2
            programs = -(-nodes // self.node_block) if self.turns else 0
            with torch.inference_mode(False):
                pressed = torch.zeros(programs, slots, len(self.bound.boundaries), 3, dtype=torch.float64)
                self.pressed = pressed.to(self.device)
            if self._acting and (self.bound.needs_position or self.bound.needs_lattice):
                self.node_position = grid.node_positions(self.velocity)

    def _run(self, state: MPMState, part: Part) -> dict[str, Any]:
        steps, options, looks, real = part.steps, part.options, part.looks, self.like["dtype"]
        self.begin(steps, part.loaded)
        self._take_grid(state.grid, 8 if options["IMPLICIT"] else 4)
        self.impulse.zero_()
        self.pressed.zero_()
        self.marks_of_pins.zero_()
        self.clock.copy_(torch.stack([self.time, self.dt]))
        self.solids.take(self.own_solids, MAX_STEPS)
        self.solids.begin(self.time, self.dt, steps)
        self._load(state)
        if not self.atomic:
            self._measured.copy_(self._crossing(state.velocity.double()))
        self._start(options)
        done, every = 0, self._sorted_for()
        for mark in sorted({*looks, *range(every, steps, every), steps}):
            ends = mark == steps or mark % every == 0
            self._several(mark - done - (1 if ends else 0), options)
            if ends:  # the end of a substep without the start of the next
                self._nodes(0, options)
                self._particles(1, options, gather=True, scatter=False)
                self.first_step.add_(1)
                if mark < steps:
                    self._sort()
                    self._start(options)
            if mark in looks:
                self._look()
            done = mark
        self._measure_crossing()
        if self.turns:
            self.impulse.add_(self._pressed().view_as(self.impulse))
        found = self._read(lambda name, *shape, dtype=None: torch.empty(shape, **self.like | {"dtype": dtype or real}))
        return {**found, "impulse": self.impulse, **({"work": self._work()} if part.loaded else {})}

    def _sorted_for(self) -> int:
        """Return the number of substeps between sorts, from the speed at the end of the last finished rollout.

        Where sums have an order, which the sorts decide, the speed is that at the start: a run that is resumed has it.
        """
        if self._copied is None or self._copied.query():
            self.crossing = float(self._measured) or FIRST_CROSSING
        return sorted_for(self.crowd, self.crossing, self.count)

    def _measure_crossing(self) -> None:
        if not self.atomic:
            return
        self._measured.copy_(self._crossing(self.moving[12:15]), non_blocking=True)
        if self.device.type == "cuda":
            self._copied = torch.cuda.Event()
            self._copied.record()

    def _crossing(self, velocity: Tensor) -> Tensor:
        moved = velocity.abs().mean() * 3 * self.dt.to(velocity.dtype) / self.settings.dx
        return moved.nan_to_num(0.0, 0.0)[None]

    @property
    def _acting(self) -> bool:
        return len(self.bound.boundaries) > 0 and not self.turns

    def _pressed(self) -> Tensor:
        """Sum of what the programs of the nodes took, for each scene, shape (scenes, B, 3)."""
        if self.scenes == 1:
            return self.pressed.sum((0, 1))[None]
        slots = self.pressed.shape[1]
        first = torch.arange(len(self.pressed), device=self.device) * self.node_block // self.grid.node_count
        found = self.pressed.new_zeros(self.scenes + slots, *self.pressed.shape[2:])
        for k in range(slots):
            found.index_add_(0, first + k, self.pressed[:, k])
        return found[: self.scenes]

    def _start(self, options: dict[str, Any]) -> None:
        if self.asked:
            self._push()
        self._particles(0, options, gather=False, scatter=True)

    def _sort(self) -> None:
        if not self.atomic:
            order = torch.argsort(self._keys(self.moving[:3].T), stable=True)
            self.moving.copy_(self.moving[:, order])
            self.order.copy_(self.order[order])
            self.load[0].copy_(self.load[0, order])
            return
        grid, block = self.grid, lanes(self.device, 128)
        nx, ny, nz = grid.resolution
        cells = self.scenes * (nx + 1) * (ny + 1) * (nz + 1)
        if len(self.filled) < cells:
            self.filled = torch.zeros(cells, dtype=torch.int32, device=self.device)
        if len(self.spare[0]) == 0:
            self.spare = torch.zeros_like(self.moving), torch.zeros_like(self.order), torch.zeros_like(self.load[0])
        filled, (cell, rank) = self.filled[:cells].zero_(), self.place
        programs = (-(-self.count // block),)
        launch(kernels.updated_count, programs)(
            self.moving, self.order, self.count, *grid.offset, *grid.resolution, grid.dx, self.particles, filled, cell,
            rank, BLOCK=block, num_warps=4,
        )  # fmt: skip
        launch(kernels.updated_sort, programs)(
            self.moving, self.order, self.load[0], self.count, cell, rank, filled.cumsum(0, dtype=torch.int32),
            *self.spare, ROWS=len(self.moving), BLOCK=block, num_warps=4,
        )  # fmt: skip
        rows, order, work = self.spare
        self.load[0].copy_(work)  # of a batch, it follows its particle; the forces are zero here
        self.spare, self.moving, self.order = (self.moving, self.order, work), rows, order

    def _keys(self, position: Tensor, given: bool = False) -> Tensor:
        """Numbers of the cells of particles at (N, 3), in the order of the buffers or as ``given``."""
        (ox, oy, oz), (nx, ny, nz) = self.grid.offset, self.grid.resolution
        x, y, z = (position / self.grid.dx - 0.5).floor_().int().unbind(-1)
        key = ((x - ox).clamp(0, nx) * (ny + 1) + (y - oy).clamp(0, ny)) * (nz + 1) + (z - oz).clamp(0, nz)
        if self.scenes > 1:
            scene = self.scene if given else self.scene[self.order]
            key = key + scene * ((nx + 1) * (ny + 1) * (nz + 1))
        return key

    def _load(self, state: MPMState) -> None:
        self.momentum.zero_()  # an interrupted part may have left values
        self.marks.zero_()
        self.order.copy_(torch.argsort(self._keys(state.position.reshape(-1, 3), given=True), stable=not self.atomic))
        block = lanes(self.device, 128)
        programs = (-(-self.count // block),)
        internal = state.internal is not None
        launch(kernels.updated_load, programs)(
            self.order, state.position.contiguous(), state.velocity.contiguous(), state.affine.contiguous(),
            state.F_elastic.contiguous(), state.F_total.contiguous(), state.lost.contiguous(),
            state.internal.contiguous() if state.internal is not None else self.load, self.constants, self.moving,
            self.count, PLASTIC=self.plastic, INTERNAL=internal, VALUES=self.constants.shape[1] - 5, BLOCK=block,
            num_warps=4,
        )  # fmt: skip

    def _several(self, steps: int, options: dict[str, Any]) -> None:
        key = (*options.values(), self.grid, self.moving.data_ptr())
        self.repeat(steps, key, lambda offset: self.substep(offset, options))

    def _look(self) -> None:
        block = lanes(self.device, 128)
        launch(kernels.updated_look, (-(-self.count // block),))(
            self.moving, self.count, self.speed, WAVE=self.wave, BLOCK=block, num_warps=4
        )

    def substep(self, offset: int, options: dict[str, Any]) -> None:
        self._nodes(offset, options)
        if self.asked:  # the forces need the end of a substep before the next one starts
            self._particles(offset + 1, options, gather=True, scatter=False)
            self._push()
            self._particles(offset + 1, options, gather=False, scatter=True)
        else:
            self._particles(offset + 1, options, gather=True, scatter=True)

    def _particles(self, offset: int, options: dict[str, Any], gather: bool, scatter: bool) -> None:
        grid, settings = self.grid, self.settings
        block = lanes(self.device, 32)
        launch(kernels.updated_particles, (-(-self.count // block),))(
            self.moving, self.order, self.load, self.count,
            self.momentum, self.velocity, self.schedule, self.loads.rows, self.scenes, self.loads.buffer,
            self.first_step, offset, self.law_table, self.force_in, *grid.offset, *grid.resolution, grid.dx,
            1 / grid.dx, settings.stiffness_damping, self.particles, self.parts, self.part_node,
            **options, PLASTIC=self.plastic, WIDTH=self.momentum.shape[1], GATHER=gather,
            SCATTER=scatter, ATOMIC=self.atomic, WIDE=self.wide, BLOCK=block, num_warps=1,
        )  # fmt: skip
        if scatter and not self.atomic:
            self._scatter(options["IMPLICIT"])

    def _scatter(self, implicit: bool) -> None:
        nodes, width, dx = self.grid.node_count * self.scenes, self.momentum.shape[1], self.grid.dx
        _, ny, nz = self.grid.resolution
        spans = -(-nodes // SPAN)
        launch(kernels.updated_scatter, (SHARES,))(
            self.parts, self.part_node, self.shares, self.marks, self.count, spans, ny * nz, nz, dx, 1 / dx,
            SHARES=SHARES, SPAN=SPAN, IMPLICIT=implicit, WIDTH=width, BLOCK=LANES,
        )  # fmt: skip
        launch(kernels.updated_join, (-(-spans // CHUNK),))(
            self.shares, self.marks, self.occupied, self.momentum, nodes, spans,
            SHARES=SHARES, SPAN=SPAN, CHUNK=CHUNK, WIDTH=width,
        )  # fmt: skip

    def _nodes(self, offset: int, options: dict[str, Any]) -> None:
        grid, nodes = self.grid, self.grid.node_count * self.scenes
        block = self.node_block
        acting, (_, ny, nz), solids = self._acting, grid.resolution, self.solids
        if not acting:
            rows = lanes(self.device, 128)
            for pinned, marks in zip(self.pinned, self.marks_of_pins, strict=True):
                launch(kernels.updated_pin, (-(-self.count // rows),))(
                    self.moving, self.order, pinned, marks, self.count, *grid.offset, *grid.resolution, grid.dx,
                    self.particles, self.first_step, offset, BLOCK=rows, num_warps=4,
                )  # fmt: skip
        launch(kernels.updated_nodes, (-(-nodes // block),))(
            self.momentum, self.velocity, self.inverse_mass, self.occupied, nodes, self.schedule, self.first_step,
            offset, *self.gravity, self.windows, solids.buffer, solids.rows, self.clock,
            self.pressed, self.pressed.shape[1], self.marks_of_pins, self.marks_of_pins.shape[1],
            *grid.offset, ny, nz, grid.node_count, grid.dx, IMPLICIT=options["IMPLICIT"], WIDTH=self.momentum.shape[1],
            KEEP=acting, TURNS=() if acting else self.turns, BOUNDARIES=len(self.bound.boundaries),
            SOLIDS=solids.layout, KINDS=self.kinds, SCENES=self.scenes > 1, SPARSE=not (self.atomic or acting),
            BLOCK=block, num_warps=4,
        )  # fmt: skip
        if acting:
            self._constrain()
        if acting or self.asked:
            self.pass_time()

    def _constrain(self) -> None:
        grid = self.grid
        nodes = grid.node_count * self.scenes
        shape = (*self.bound.points.position.shape[:-2], grid.node_count)
        velocity = self.velocity[:nodes, :3].reshape(*shape, 3)
        position = self.node_position
        if position is not None:
            position = position.expand_as(velocity)
        inverse = self.inverse_mass[:nodes].reshape(shape)
        mass = torch.where(inverse > 0, 1 / inverse, 0.0)
        velocity, taken = self.bound.constrain(velocity, mass, self._share, position, position, self.time, self.dt)
        self.impulse.add_(taken)
        self.velocity[:nodes, :3].copy_(velocity.reshape(-1, 3))

    def _share(self, held: Pinned) -> Tensor:
        """Share of the nodal mass that the particles of a boundary hold, shape (..., G)."""
        grid, mass = self.grid, held.mass_at(self.time)
        nodes = grid.node_count * self.scenes
        weight = self.weight[:nodes].zero_()
        block = lanes(self.device, 128)
        launch(kernels.pin_mass, (-(-self.count // block) if self.atomic else 1,))(
            self.moving, self.order, mass.contiguous(), weight, self.count, *grid.offset, *grid.resolution, grid.dx,
            self.particles, BLOCK=block, num_warps=4,
        )  # fmt: skip
        shape = (*mass.shape[:-1], grid.node_count)
        return (weight * self.inverse_mass[:nodes]).reshape(shape)

    def _read(self, room: Callable[..., Tensor]) -> dict[str, Any]:
        shape = self.bound.points.position.shape
        fields: dict[str, Any] = {name: room(name, *shape) for name in ("position", "velocity")}
        fields |= {name: room(name, *shape, 3) for name in ("affine", "F_elastic")}
        fields["F_total"] = room("F_total", *shape, 3) if self.plastic else fields["F_elastic"]
        fields["lost"] = room("lost", *shape[:-1], dtype=torch.bool)
        fields["internal"] = room("internal", *shape[:-1]) if self.internal else None
        block = lanes(self.device, 128)
        launch(kernels.updated_read, (-(-self.count // block),))(
            self.order, self.moving, self.count, *list(fields.values())[:-1],
            fields["internal"] if self.internal else self.load,
            PLASTIC=self.plastic, INTERNAL=self.internal, BLOCK=block, num_warps=4,
        )  # fmt: skip
        return fields

    def _look_at(self) -> MPMState:
        return MPMState(**self._read(self._room), time=self.time, grid=self.grid)


def _pins(boundary: Boundary, held: Pinned) -> bool:
    return type(boundary) is PinnedRegion and held.release is None and not boundary.moves


def crowd_of(position: Tensor, dx: float) -> float:
    """Points in the cell of a point at rest, on average (one synchronisation).

    Args:
        position: Rest positions [m], shape (..., P, 3).
    """
    flat = position.reshape(-1, *position.shape[-2:])[0]
    sizes = torch.unique(torch.floor(flat / dx - 0.5).int(), dim=0, return_counts=True)[1].double()
    return float(sizes.square().sum() / max(len(flat), 1))


def sorted_for(crowd: float, crossing: float, count: int) -> int:
    r"""Number of substeps between sorts that costs the least time.

    As the order gets stale, particles in a row no longer share their cell, and more atomic sums meet: the time of a
    substep grows with their share. Together with the time of the sorts it is least after :math:`\sqrt{S / r}` substeps,
    with the rate r at which particles enter other cells. S suits a cube with eight points in a cell, turning, on an
    H100: an eighth, a quarter and half of the interval were slower. A cell with fewer points gains less from the order;
    one with more belongs to a sheet, whose neighbours cross into other cells together; how far the interval should grow
    there is not measured.
    A small body waits for the host, not for sums.
    """
    crowd = max(crowd, 1.0)
    best = math.sqrt(6.4 / max(crossing, 1e-9)) * max(8 / crowd, math.sqrt(crowd / 8))
    least = min(max(round(2e6 / max(count, 1)), LEAST), 32)
    return int(min(max(round(best), least), MOST))
