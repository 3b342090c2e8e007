"""Runs substeps with the Triton kernels: buffers, the order of particles, CUDA graphs.

Used by ``MPMSolver`` in place of its torch substep where no gradient is asked for; the torch substep is the definition.
"""

from __future__ import annotations

import math
import os
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from gaussian_swaying._graphs import Repeater, fingerprint
from gaussian_swaying.mpm import transfer_triton as kernels
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.forces import MOST_STEPS, TWIN_NUMBERS, TWIN_VALUES, Force, ForceTwin, added, divide, split
from gaussian_swaying.mpm.laws.triton.body import BodyLaws
from gaussian_swaying.mpm.laws.triton.twin import shared, twin_of
from gaussian_swaying.mpm.state import GridSpec, MPMState

if TYPE_CHECKING:
    from gaussian_swaying.mpm.solver import MPMSolver

MAX_STEPS = MOST_STEPS
"""Substeps whose schedule the buffers hold; longer rollouts are run in parts."""

RESORT = 32
"""Substeps of ``updated`` after which the particles are sorted by cell again."""

MAX_INDEX = 2**31
"""Entries that the kernels, which count with 32 bits, can reach in a buffer."""

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"


def unsupported(solver: MPMSolver) -> str | None:
    """Why these kernels cannot run the solver's material, or None if they can."""
    points = solver.points
    if not (points.position.is_cuda or (INTERPRETED and solver.transfer == "triton")):
        return "it needs a CUDA device"
    if points.position.dtype != torch.float32:
        return f"it computes in float32, and the material is {points.position.dtype}".replace("torch.", "")
    if solver.deterministic and not solver.total_lagrangian:
        return "in the updated formulation its sums have no fixed order, as `deterministic` asks for"
    for law in points.laws:
        if twin_of(law) is None:
            return f"the law {type(law).__name__} has no fused form"
    return None


def made_from(solver: MPMSolver) -> tuple[object, ...]:
    """What the buffers and graphs of a solver rest on besides its points: they hold as long as it is the same."""
    return (solver.stiffness_damping, solver.mls, *fingerprint([*solver._acting, *solver.points.laws]))


class FusedSolver(ABC):
    """Substeps of one solver with its material.

    Args:
        solver: Bound to its material; see :func:`unsupported`.
    """

    def __init__(self, solver: MPMSolver) -> None:
        points = solver.points
        self.solver = cast("MPMSolver", weakref.proxy(solver))  # or they would keep each other, and the memory, alive
        self.device, self.made_from = points.position.device, made_from(solver)
        self.particles = points.count
        self.count = points.mass.numel()
        self.scenes = self.count // max(self.particles, 1)
        self.laws = BodyLaws(points.laws)
        self.law_table = torch.tensor(self.laws.table, device=self.device)
        self.law = torch.zeros(self.count, dtype=torch.int32, device=self.device)
        if points.law_index is not None:
            self.law = points.law_index.reshape(-1).int()
        self.first_step = torch.zeros(1, dtype=torch.int32, device=self.device)
        self.schedule = torch.zeros(MAX_STEPS + 2, kernels.SCHEDULE, device=self.device)
        self.vectors = torch.zeros(MAX_STEPS, self.scenes, 3, device=self.device)
        self.numbers = torch.zeros(TWIN_NUMBERS, device=self.device)
        self.load = torch.zeros(8, self.count, device=self.device)
        self.force_in = torch.zeros(0, 4, device=self.device)
        self.wave = shared(points.laws, "wave")
        self.watches = self.wave is not None
        """Whether rollouts can look at the speed of waves."""
        self.speed = torch.zeros(1, device=self.device)
        self.time = torch.zeros((), dtype=torch.float64, device=self.device)
        self.dt = torch.zeros((), dtype=torch.float64, device=self.device)
        self.gravity = [float(g) for g in solver.gravity]
        self._values_of: list[tuple[Tensor, int | None]] = []
        self.asked: tuple[Force, ...] = ()
        """The forces of the present rollout that are asked in torch, in every substep."""
        self._resist: tuple[object, bool] = ((), False)
        self._seen: dict[str, Tensor] = {}
        self.repeater = Repeater(self.device)

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        """Nothing to copy or pickle: a solver makes its buffers and graphs anew."""
        return _nothing, ()

    def rollout(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Sequence[Force] = (),
        force: Tensor | None = None,
        drag: Tensor | None = None,
        looks: Sequence[int] = (),
        watch: Callable[[int], None] | None = None,
    ) -> tuple[MPMState, Tensor]:
        """Advance by ``steps`` substeps of ``dt`` [s], with some forces or one that stays (see ``MPMSolver.step``).

        Args:
            state: The state now.
            dt: Substep [s].
            steps: Number of substeps.
            forces: Forces of which all but the first with a twin are recordable.
            force: Force [N], shape (..., P, 3), or None; only without ``forces``.
            drag: Its resistance [kg/s], shape (..., P), or None.
            looks: After which substeps to look at the speed of waves, if ``watches``.
            watch: Told how many substeps have been handed to the GPU, each time the buffers are full.

        Returns:
            The state, and how many cells the fastest wave crosses in a second at any look [1/s] (zero without looks).
        """
        with _at_home(self.speed):
            self.speed.zero_()
            fused, self.asked = divide(forces)
            twin = None if fused is None else fused.twin()
            if twin is not None:
                self._take_twin(twin)
            options: dict[str, Any] = {
                "LAWS": self.laws,
                "MULTI": len(self.law_table) > 1,
                "VISCOUS": self.solver.stiffness_damping > 0,
                "TWIN": None if twin is None else twin.function,
                "OPTIONS": None if twin is None else twin.options,
                "FORCE": len(self.asked) > 0 or force is not None or drag is not None,
                "IMPLICIT": drag is not None or (twin is not None and twin.implicit) or self._resists(state),
            }
            if options["FORCE"]:
                if len(self.force_in) < self.count:  # the first time that it is needed
                    self.force_in = torch.zeros(self.count, 4, device=self.device)
                self.force_in.zero_()
                self._fill(force, drag)
            for first in range(0, steps, MAX_STEPS):
                part = min(steps - first, MAX_STEPS)
                marks = [look - first for look in looks if first < look <= first + part]
                before = state.work
                state = self._advance(state, dt, part, twin, options, marks)
                if force is None and not forces:  # a drag alone does no work that counts
                    state = state.replace(work=before)
                if watch is not None:
                    watch(first + part)
            return state, self.speed[0] / self.solver.dx

    def _advance(
        self, state: MPMState, dt: float, steps: int, twin: ForceTwin | None, options: dict[str, Any], looks: list[int]
    ) -> MPMState:
        """As many substeps as the buffers hold."""
        solver = self.solver
        kick = solver.kick(state, dt)
        decay = [math.exp(-solver.damping * t) for t in (kick, dt)]
        rows = [[0.0, dt, 1.0, 0.0], [kick, dt, decay[0], 0.0], *[[dt, dt, decay[1], 0.0]] * steps]
        self.schedule[: steps + 2].copy_(_upload(rows, self.device), non_blocking=True)
        self.first_step.zero_()
        self.time.copy_(state.time)
        self.dt.fill_(dt)
        if twin is not None:
            vectors = twin.vectors(self.time, self.dt, steps)
            self.vectors[:steps].copy_(vectors.reshape(steps, -1, 3).expand(-1, self.scenes, -1))
        loaded = twin is not None or options["FORCE"]
        if loaded:
            self.load.zero_()
        changes = self._run(state, steps, options, looks)
        if loaded:
            changes["work"] = state.work + self._work().reshape(self.solver.points.mass.shape[:-1])
        return state.replace(time=state.time + steps * dt, substep=dt, **changes)

    def _take_twin(self, twin: ForceTwin) -> None:
        """Take the numbers of a twin, and its values of the particles where they are other ones."""
        self.numbers[: len(twin.numbers)].copy_(twin.numbers)
        sources = [(t, None if t.is_inference() else t._version) for t in twin.sources]
        known = zip(self._values_of, sources, strict=False)
        if not self._values_of or any(a is not b or v is None or v != w for (a, v), (b, w) in known):
            self._values_of = sources
            values = twin.values()
            self._take_values(values.expand(*self.solver.points.mass.shape, values.shape[-1]).flatten(0, -2))

    # ---- forces in torch

    def _fill(self, force: Tensor | None, drag: Tensor | None) -> None:
        """Put a force and its resistance into the buffer that the kernels read."""
        points = self.solver.points
        if force is not None:
            self.force_in[:, :3].copy_(force.expand_as(points.position).reshape(-1, 3))
        if drag is not None:
            self.force_in[:, 3].copy_(drag.expand_as(points.mass).reshape(-1))

    def _ask(self, state: MPMState) -> tuple[Tensor | None, Tensor | None]:
        """The sum of the forces in torch and that of their resistances."""
        return added([split(force(state), force, state) for force in self.asked])

    def _asked_key(self) -> tuple[object, ...]:
        """What recorded forces rest on; the forces themselves are in it, so that nothing else takes their place."""
        return (self.asked, fingerprint(self.asked)) if self.asked else ()

    def _resists(self, state: MPMState) -> bool:
        """Whether a force in torch gives a resistance, from asking each once."""
        key = self._asked_key()
        if key != self._resist[0]:
            self._resist = key, self._ask(state)[1] is not None
        return self._resist[1]

    def _push(self) -> None:
        """Let the forces in torch look at the particles as they are in the buffers now, and fill theirs."""
        self._fill(*self._ask(self._look_at()))

    def _room(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """A buffer for a field of the particles, which stays where it is: graphs write to it and read from it."""
        if name not in self._seen:
            self._seen[name] = torch.zeros(shape, dtype=dtype, device=self.device)
        return self._seen[name]

    @abstractmethod
    def _look_at(self) -> MPMState:
        """The state of the particles in the buffers."""

    @abstractmethod
    def _take_values(self, values: Tensor) -> None:
        """Take the values of a twin, shape (N, n)."""

    @abstractmethod
    def _run(self, state: MPMState, steps: int, options: dict[str, Any], looks: list[int]) -> dict[str, Any]:
        """Take the state into the buffers, run the substeps, and give the fields of the state after them."""

    @abstractmethod
    def _work(self) -> Tensor:
        """Work of the load in each scene [J], shape (scenes,), float64."""

    def _repeat(self, steps: int, key: Any, body: Callable[[int], None]) -> None:
        """Run ``body(offset)``, one substep, for each offset, from graphs where there are any.

        The first time a key is seen the substeps run as they are, which compiles what is not yet compiled; the second
        time they are recorded.
        """

        def several(count: int) -> None:
            for offset in range(count):
                body(offset)
            self.first_step.add_(count)

        recordable = all(boundary.recordable for boundary in self.solver._acting)
        self.repeater.run(steps, (key, self._asked_key()), several, recordable)


class FusedTotal(FusedSolver):
    """Substeps of the ``total`` formulation; everything but the nodal fields is constant."""

    def __init__(self, solver: MPMSolver) -> None:
        super().__init__(solver)
        points, stencil, static = solver.points, solver.stencil, solver._static
        grid = solver._grid
        self.grid = grid
        first = stencil.first
        order = torch.argsort(first, stable=True)
        cells, sizes = torch.unique_consecutive(first[order], return_counts=True)
        self.order, self.cells = order.int(), len(cells)
        ends = sizes.cumsum(0)
        self.cell_start = torch.cat([ends.new_zeros(1), ends]).int()
        self.cell_node = cells.int()
        self.cell_scene = (cells // grid.node_count).int()
        self.particle_cell = torch.repeat_interleave(torch.arange(self.cells, device=self.device), sizes).int()
        # the place in the cell, from the slope of the first weight, (f - 1.5) / dx
        self.fraction = (1.5 + stencil.factors[1, :, 0] * grid.dx)[:, order].contiguous()
        rows = [points.volume, solver.laws.mu, solver.laws.lam, points.mass]
        self.material = torch.stack([row.reshape(-1) for row in rows])[:, order].contiguous()
        self.law = self.law[order].contiguous()
        self.values = torch.zeros(TWIN_VALUES, self.count, device=self.device)
        self.rest = points.position.contiguous()
        inverse = static["node_inverse_mass"].reshape(-1)
        active = (inverse > 0).nonzero()[:, 0]
        self.active, self.inverse_mass = active.int(), inverse[active].contiguous()
        place = torch.full((len(inverse),), self.cells, dtype=torch.int32, device=self.device)
        place[cells] = torch.arange(self.cells, dtype=torch.int32, device=self.device)
        _, ny, nz = grid.resolution
        shifts = [(i * ny + j) * nz + k for i in range(3) for j in range(3) for k in range(3)]
        below = [active - shift for shift in shifts]
        self.source = torch.stack([torch.where(b >= 0, place[b.clamp(min=0)], self.cells) for b in below])
        self.fields = torch.zeros(len(inverse), 8, device=self.device)
        self.displacement, self.velocity = self.fields[:, :4], self.fields[:, 4:]
        self.lanes = _lanes(sizes)
        self._cut(sizes)
        acting = solver._acting
        self.plain = all(type(b) is PinnedRegion and b.start <= 0 and b.end == math.inf for b in acting)
        self.position = any(b.needs_position for b in acting)
        self.lattice = grid.node_positions(self.rest) if any(b.needs_lattice for b in acting) else None
        held = torch.zeros(len(inverse), dtype=torch.bool, device=self.device)
        if self.plain:
            for k, boundary in enumerate(acting):
                held |= (static[f"share_{k}"] > (boundary.held_share or 0.0)).reshape(-1)
        self.held = held[active].to(torch.int8)
        self.shift = torch.zeros(len(inverse) if self.position else 0, 4, device=self.device)
        self._partial: dict[tuple[int, int], Tensor] = {}
        width = 8 if self.position else 4
        _check_indices(max(8 * len(inverse), 27 * (self.pieces + 1) * width, 27 * len(active)))

    def _cut(self, sizes: Tensor) -> None:
        """Cut crowded cells into pieces: a body of few cells would else have too few programs to fill a GPU."""
        most = self.lanes * max(1, -(-self.count // (self.lanes * _PROGRAMS)))
        counts = -(-sizes // most)
        first = counts.cumsum(0) - counts
        cell = torch.repeat_interleave(torch.arange(self.cells, device=self.device), counts)
        self.pieces = len(cell)
        within = torch.arange(self.pieces, device=self.device) - first[cell]
        self.piece_start = torch.cat([self.cell_start[cell] + most * within, self.cell_start[-1:]]).int()
        self.piece_node, self.piece_scene = self.cell_node[cell].contiguous(), self.cell_scene[cell].contiguous()
        self.first_piece = torch.cat([first, first.new_tensor([self.pieces])]).int()

    def _take_values(self, values: Tensor) -> None:
        self.values[: values.shape[1]].copy_(values[self.order.long()].T)

    def _sums(self, rows: int, width: int) -> Tensor:
        """Buffer of the sums of each cell or piece of one, with a row of zeros behind the last."""
        if (rows, width) not in self._partial:
            self._partial[rows, width] = torch.zeros(27, rows + 1, width, device=self.device)
        return self._partial[rows, width]

    def _run(self, state: MPMState, steps: int, options: dict[str, Any], looks: list[int]) -> dict[str, Any]:
        assert state.node_displacement is not None
        assert state.node_velocity is not None
        self.displacement[:, :3].copy_(state.node_displacement.reshape(-1, 3))
        self.velocity[:, :3].copy_(state.node_velocity.reshape(-1, 3))
        done = 0
        for mark in sorted({*looks, steps}):
            self._repeat(mark - done, tuple(options.values()), lambda offset: self._substep(offset, options))
            done = mark
            if mark in looks:
                self._look()
        return self._read(state, steps, options)

    def _look(self) -> None:
        _, ny, nz = self.grid.resolution
        block = 128
        kernels.total_look[(-(-self.count // block),)](
            self.fraction, self.material, self.count, self.particle_cell, self.cell_node, self.fields, self.speed,
            ny * nz, nz, 1 / self.grid.dx, WAVE=self.wave, BLOCK=block, num_warps=4,
        )  # fmt: skip

    def _substep(self, offset: int, options: dict[str, Any]) -> None:
        solver = self.solver
        if self.asked:
            self._push()
        width = 8 if self.position else 4
        partial = self._sums(self.pieces, width)
        _, ny, nz = self.grid.resolution
        per_program = max(1, 32 // self.lanes)
        kernels.total_particles[(-(-self.pieces // per_program),)](
            self.fraction, self.material, self.law, self.law_table, self.values, self.force_in, self.load, self.order,
            self.count, self.piece_start, self.piece_node, self.piece_scene, self.pieces,
            self.fields, partial,
            self.schedule, self.vectors, self.scenes, self.numbers, self.first_step, offset,
            ny * nz, nz, 1 / self.grid.dx, solver.stiffness_damping,
            **options, POSITION=self.position, WIDTH=width, CELLS=per_program, LANES=self.lanes, num_warps=1,
            **_REGISTERS.get(self.lanes, {}),
        )  # fmt: skip
        if self.pieces > self.cells:
            pieces, partial = partial, self._sums(self.cells, width)
            kernels.total_pieces[(-(-self.cells // 8), 27)](
                pieces, partial, self.first_piece, self.cells, self.pieces, WIDTH=width, BLOCK=8, num_warps=1
            )
        block = 64
        nodes = len(self.active)
        kernels.total_nodes[(-(-nodes // block),)](
            self.active, self.source, self.inverse_mass, self.held, nodes, self.cells, partial,
            self.fields, self.shift, self.schedule, self.first_step, offset, *self.gravity,
            IMPLICIT=options["IMPLICIT"], POSITION=self.position, WIDTH=width,
            HELD=self.plain and len(solver._acting) > 0, MOVE=self.plain, BLOCK=block, num_warps=2,
        )  # fmt: skip
        if not self.plain:
            self._constrain()
        if not self.plain or self.asked:
            self.time.add_(self.dt)

    def _constrain(self) -> None:
        """Boundary conditions that the kernels do not know, and the displacements after them."""
        solver, static = self.solver, self.solver._static
        shape = (*static["node_inverse_mass"].shape, 3)
        inverse = static["node_inverse_mass"]
        # nodes without mass forget what a boundary gave them
        velocity = torch.where(inverse[..., None] > 0, self.velocity[:, :3].reshape(shape), 0.0)
        position = lattice = None
        if self.position:
            position = static["node_rest"] + self.shift[:, :3].reshape(shape)
        if self.lattice is not None:
            lattice = self.lattice + self.displacement[:, :3].reshape(shape)
        velocity = solver._constrain(
            velocity, lambda k: solver._share(k, solver.stencil, inverse, self.time), position, lattice, self.time,
            self.dt,
        )  # fmt: skip
        self.velocity[:, :3].copy_(velocity.reshape(-1, 3))
        self.displacement.addcmul_(self.velocity, self.dt.float())

    def _read(self, state: MPMState, steps: int, options: dict[str, Any]) -> dict[str, Any]:
        shape = state.position.shape
        position, velocity = (torch.empty(shape, device=self.device) for _ in range(2))
        affine, F = (torch.empty(*shape, 3, device=self.device) for _ in range(2))
        loaded = options["TWIN"] is not None or options["FORCE"]
        self._read_into(position, velocity, affine, F, self.schedule[steps], loaded, options["IMPLICIT"])
        nodes = (*self.solver._static["node_inverse_mass"].shape, 3)
        return {
            "position": position,
            "velocity": velocity,
            "affine": affine,
            "F_elastic": F,
            "F_total": F,
            "node_displacement": self.displacement[:, :3].reshape(nodes).contiguous(),
            "node_velocity": self.velocity[:, :3].reshape(nodes).contiguous(),
        }

    def _read_into(
        self, position: Tensor, velocity: Tensor, affine: Tensor, F: Tensor, row: Tensor, work: bool, implicit: bool
    ) -> None:
        """Particle fields from the nodes, and the end of the work of the substep of a row of the schedule."""
        _, ny, nz = self.grid.resolution
        block = 128
        kernels.total_read[(-(-self.count // block),)](
            self.fraction, self.load, self.order, self.rest, self.count, self.particle_cell, self.cell_node,
            self.fields, row, position, velocity, affine, F,
            ny * nz, nz, 1 / self.grid.dx,
            WORK=work, IMPLICIT=implicit, BLOCK=block, num_warps=4,
        )  # fmt: skip

    def _look_at(self) -> MPMState:
        shape = self.solver.points.position.shape
        position, velocity = (self._room(name, *shape) for name in ("position", "velocity"))
        affine, F = (self._room(name, *shape, 3) for name in ("affine", "F"))
        self._read_into(position, velocity, affine, F, self.schedule, False, False)
        lost = self._room("lost", *shape[:-1], dtype=torch.bool)
        return MPMState(position, velocity, affine, F, F, lost, self.time, self.grid)

    def _work(self) -> Tensor:
        # cells are sorted by scene
        return self.load[0].reshape(self.scenes, self.particles).sum(1, dtype=torch.float64)


class FusedUpdated(FusedSolver):
    """Substeps of the ``updated`` formulation; particles are sorted by cell at the start of each part."""

    def __init__(self, solver: MPMSolver) -> None:
        super().__init__(solver)
        points = solver.points
        self.plastic = len(self.laws.flows) > 0
        self.internal = solver.laws.initial_internal() is not None
        _check_indices(44 * self.count)
        self.moving = torch.zeros(44 if self.plastic else 35, self.count, device=self.device)
        self.constants = torch.zeros(self.count, 9, device=self.device)
        rows = [points.mass, points.volume, solver.laws.mu, solver.laws.lam, self.law]
        self.constants[:, :5] = torch.stack([row.reshape(-1).float() for row in rows], dim=1)
        self.scene = torch.arange(self.count, device=self.device) // max(self.particles, 1)
        self.order = torch.arange(self.count, dtype=torch.int32, device=self.device)
        self.momentum = torch.zeros(0, 4, device=self.device)
        self.velocity = torch.zeros(0, 4, device=self.device)
        self.inverse_mass = torch.zeros(0, device=self.device)
        self.weight = torch.zeros(0, device=self.device)
        self.node_position: Tensor | None = None
        self.grid = GridSpec(solver.dx, (0, 0, 0), (0, 0, 0))

    def _take_values(self, values: Tensor) -> None:
        self.constants[:, 5 : 5 + values.shape[1]] = values

    def _take_grid(self, grid: GridSpec, width: int) -> None:
        """Make room for a grid, and forget the graphs of another one."""
        nodes = grid.node_count * self.scenes
        _check_indices(nodes * width)
        if nodes > len(self.velocity) or width != self.momentum.shape[1]:
            room = max(len(self.velocity), 1 << (nodes - 1).bit_length() if nodes < 1 << 20 else nodes + nodes // 8)
            held = room if len(self.solver._acting) else 0
            self.repeater.forget()  # before there is need of their memory
            with torch.inference_mode(False):  # they may be written within inference mode and without
                self.momentum = torch.zeros(room, width, device=self.device)
                self.velocity = torch.zeros(room, 4, device=self.device)
                self.inverse_mass, self.weight = (torch.zeros(held, device=self.device) for _ in range(2))
        if grid != self.grid:
            self.repeater.forget()  # they read the node positions
            self.grid, self.node_position = grid, None
            if any(b.needs_position or b.needs_lattice for b in self.solver._acting):
                self.node_position = grid.node_positions(self.velocity)

    def _run(self, state: MPMState, steps: int, options: dict[str, Any], looks: list[int]) -> dict[str, Any]:
        self._take_grid(state.grid, 8 if options["IMPLICIT"] else 4)
        fields: dict[str, Any] = {}
        marks = sorted({*looks, *range(RESORT, steps, RESORT), steps})
        load, done = True, 0
        for mark in marks:
            if load:
                self._load(state.replace(**fields))
                if self.asked:
                    self._push()
                self._particles(0, options, gather=False, scatter=True)
            sort = mark == steps or mark % RESORT == 0
            self._several(mark - done - (1 if sort else 0), options)
            if sort:  # the end of a substep without the start of the next
                self._nodes(0, options)
                self._particles(1, options, gather=True, scatter=False)
                self.first_step.add_(1)
                fields = self._read(state)
            if mark in looks:
                self._look()
            load, done = sort, mark
        return fields

    def _load(self, state: MPMState) -> None:
        """Sort the particles by cell and take their fields."""
        self.momentum.zero_()  # whatever a part that was broken off has left
        grid = state.grid
        place = (state.position.reshape(-1, 3) / grid.dx - 0.5).floor_().int()
        (ox, oy, oz), (nx, ny, nz) = grid.offset, grid.resolution
        x, y, z = place.unbind(-1)
        key = ((x - ox).clamp(0, nx) * (ny + 1) + (y - oy).clamp(0, ny)) * (nz + 1) + (z - oz).clamp(0, nz)
        if self.scenes > 1:
            key = key + self.scene * ((nx + 1) * (ny + 1) * (nz + 1))
        order = torch.argsort(key)
        if self.scenes > 1:  # the work done so far follows its particle; the forces are zero here
            self.load[0].copy_(self.load[0][torch.argsort(self.order)][order])
        self.order.copy_(order)
        block = 128
        programs = (-(-self.count // block),)
        internal = state.internal is not None
        kernels.updated_load[programs](
            self.order, state.position.contiguous(), state.velocity.contiguous(), state.affine.contiguous(),
            state.F_elastic.contiguous(), state.F_total.contiguous(), state.lost.contiguous(),
            state.internal.contiguous() if state.internal is not None else self.load, self.constants, self.moving,
            self.count, PLASTIC=self.plastic, INTERNAL=internal, BLOCK=block, num_warps=4,
        )  # fmt: skip

    def _several(self, steps: int, options: dict[str, Any]) -> None:
        """Substeps from the start of one to the start of another."""
        self._repeat(steps, (*options.values(), self.grid), lambda offset: self._substep(offset, options))

    def _look(self) -> None:
        block = 128
        kernels.updated_look[(-(-self.count // block),)](
            self.moving, self.count, self.speed, WAVE=self.wave, BLOCK=block, num_warps=4
        )

    def _substep(self, offset: int, options: dict[str, Any]) -> None:
        self._nodes(offset, options)
        if self.asked:  # the forces look at the end of a substep before the next one starts
            self._particles(offset + 1, options, gather=True, scatter=False)
            self._push()
            self._particles(offset + 1, options, gather=False, scatter=True)
        else:
            self._particles(offset + 1, options, gather=True, scatter=True)

    def _particles(self, offset: int, options: dict[str, Any], gather: bool, scatter: bool) -> None:
        grid, solver = self.grid, self.solver
        kernels.updated_particles[(-(-self.count // 32),)](
            self.moving, self.order, self.load, self.count,
            self.momentum, self.velocity, self.schedule, self.vectors, self.scenes, self.numbers, self.first_step,
            offset, self.law_table, self.force_in, *grid.offset, *grid.resolution, grid.dx, 1 / grid.dx,
            solver.stiffness_damping, self.particles,
            **options, PLASTIC=self.plastic, MLS=solver.mls, WIDTH=self.momentum.shape[1], GATHER=gather,
            SCATTER=scatter, num_warps=1,
        )  # fmt: skip

    def _nodes(self, offset: int, options: dict[str, Any]) -> None:
        grid, solver = self.grid, self.solver
        nodes = grid.node_count * self.scenes
        block = 256
        acting = solver._acting
        kernels.updated_nodes[(-(-nodes // block),)](
            self.momentum, self.velocity, self.inverse_mass, nodes, self.schedule, self.first_step, offset,
            *self.gravity, IMPLICIT=options["IMPLICIT"], WIDTH=self.momentum.shape[1], KEEP=len(acting) > 0,
            BLOCK=block, num_warps=4,
        )  # fmt: skip
        if acting:
            self._constrain()
        if acting or self.asked:
            self.time.add_(self.dt)

    def _constrain(self) -> None:
        """Boundary conditions on the velocities of the nodes."""
        grid, solver = self.grid, self.solver
        nodes = grid.node_count * self.scenes
        shape = (*solver.points.position.shape[:-2], grid.node_count)
        velocity = self.velocity[:nodes, :3].reshape(*shape, 3)
        position = self.node_position
        if position is not None:
            position = position.expand_as(velocity)
        velocity = solver._constrain(velocity, self._share, position, position, self.time, self.dt)
        self.velocity[:nodes, :3].copy_(velocity.reshape(-1, 3))

    def _share(self, k: int) -> Tensor:
        """Share of the nodal mass that the particles of a boundary hold, shape (..., G)."""
        grid, static = self.grid, self.solver._static
        mass = self.solver.held_mass(k, self.time)
        nodes = grid.node_count * self.scenes
        weight = self.weight[:nodes].zero_()
        block = 128
        kernels.pin_mass[(-(-self.count // block),)](
            self.moving, self.order, mass.contiguous(), weight, self.count, *grid.offset, *grid.resolution, grid.dx,
            self.particles, BLOCK=block, num_warps=4,
        )  # fmt: skip
        shape = (*static[f"pinned_mass_{k}"].shape[:-1], grid.node_count)
        return (weight * self.inverse_mass[:nodes]).reshape(shape)

    def _read(self, state: MPMState) -> dict[str, Any]:
        position, velocity = (torch.empty(state.position.shape, device=self.device) for _ in range(2))
        affine, F = (torch.empty(state.F_elastic.shape, device=self.device) for _ in range(2))
        F_total = torch.empty_like(F) if self.plastic else F
        lost = torch.empty(state.lost.shape, dtype=torch.bool, device=self.device)
        internal = None if state.internal is None else torch.empty(state.internal.shape, device=self.device)
        return self._read_into(position, velocity, affine, F, F_total, lost, internal)

    def _read_into(
        self,
        position: Tensor,
        velocity: Tensor,
        affine: Tensor,
        F: Tensor,
        F_total: Tensor,
        lost: Tensor,
        internal: Tensor | None,
    ) -> dict[str, Any]:
        """The rows of the particles as fields of the state."""
        block = 128
        kernels.updated_read[(-(-self.count // block),)](
            self.order, self.moving, self.count, position, velocity, affine, F, F_total, lost,
            self.load if internal is None else internal,
            PLASTIC=self.plastic, INTERNAL=internal is not None, BLOCK=block, num_warps=4,
        )  # fmt: skip
        return {
            "position": position,
            "velocity": velocity,
            "affine": affine,
            "F_elastic": F,
            "F_total": F_total,
            "lost": lost,
            "internal": internal,
        }

    def _look_at(self) -> MPMState:
        shape = self.solver.points.position.shape
        position, velocity = (self._room(name, *shape) for name in ("position", "velocity"))
        affine, F = (self._room(name, *shape, 3) for name in ("affine", "F"))
        F_total = self._room("F_total", *shape, 3) if self.plastic else F
        lost = self._room("lost", *shape[:-1], dtype=torch.bool)
        internal = self._room("internal", *shape[:-1]) if self.internal else None
        fields = self._read_into(position, velocity, affine, F, F_total, lost, internal)
        return MPMState(**fields, time=self.time, grid=self.grid)

    def _work(self) -> Tensor:
        # whatever the order within a scene, the particles are sorted by scene
        return self.load[0].reshape(self.scenes, self.particles).sum(1, dtype=torch.float64)


def largest_speed(solver: MPMSolver, state: MPMState) -> Tensor | None:
    """Cells per second as ``MPMSolver`` needs them for the Courant number, in one kernel; None for other laws."""
    points, laws, spatial = solver.points, solver.laws, not solver.total_lagrangian
    wave = shared(points.laws, "wave")
    if wave is None:
        return None
    out = torch.zeros(1, device=points.position.device)
    count, block = points.mass.numel(), 128
    density = points.mass / points.volume
    with torch.cuda.device_of(out):
        kernels.largest_speed[(-(-count // block),)](
            state.F_elastic.contiguous(), density.contiguous(), laws.mu.contiguous(), laws.lam.contiguous(),
            state.velocity.contiguous(), out, count, WAVE=wave, SPATIAL=spatial, BLOCK=block, num_warps=4,
        )  # fmt: skip
    return out[0] / solver.dx


def elastic_energy(solver: MPMSolver, F: Tensor) -> Tensor | None:
    """Energy density [J/m³] in one kernel, shape (..., P); None for other laws."""
    energy = shared(solver.points.laws, "energy")
    if energy is None:
        return None
    out = torch.empty(F.shape[:-2], device=F.device)
    block = 128
    with torch.cuda.device_of(out):
        kernels.elastic_energy[(-(-out.numel() // block),)](
            F.contiguous(), solver.laws.mu.contiguous(), solver.laws.lam.contiguous(), out, out.numel(), ENERGY=energy,
            BLOCK=block, num_warps=4,
        )  # fmt: skip
    return out


@contextmanager
def _at_home(buffer: Tensor) -> Iterator[None]:
    """The device of a buffer, where Triton is to launch, and ordinary tensors, which may be written in any mode."""
    with torch.cuda.device_of(buffer), torch.inference_mode(False), torch.no_grad():
        yield


def _check_indices(entries: int) -> None:
    if entries > MAX_INDEX:
        raise ValueError(
            f"The Triton kernels reach {MAX_INDEX:,} entries of a buffer, and this body or grid takes {entries:,}: set "
            "`solver.transfer` to torch."
        )


def _nothing() -> None:
    """What stands for a FusedSolver in a copy."""


def _upload(rows: list[list[float]], device: torch.device) -> Tensor:
    """A small table on the device, without making the host wait."""
    table = torch.tensor(rows, dtype=torch.float32)
    return table.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else table


# time of a particle with so many lanes to a cell, relative to 32, on an H200
_LANE_COST = {4: 1.5, 8: 1.0, 16: 1.0, 32: 1.0, 64: 0.85}

# pieces into which `total` cuts particles at least, where its cells are too few: about the warps that an H200 holds
_PROGRAMS = 2048

# more warps at once are worth the spilled registers
_REGISTERS = {64: {"maxnreg": 128}}


def _lanes(sizes: Tensor) -> int:
    """Lanes per cell for which all cells have the least to do, full lanes or not (one synchronisation)."""
    lanes = list(_LANE_COST)
    work = torch.stack([(-(-sizes // n)).sum() * n for n in lanes]).tolist()
    return min(zip(lanes, work, strict=True), key=lambda pair: pair[1] * _LANE_COST[pair[0]])[0]


__all__ = ["FusedSolver", "FusedTotal", "FusedUpdated", "elastic_energy", "largest_speed", "unsupported"]
