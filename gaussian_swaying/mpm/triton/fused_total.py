"""Runs the ``total`` substep and its adjoint with their kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels.graphs import RECORDED
from gaussian_swaying.kernels.language import triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.forces import Force, divide, tensors_of
from gaussian_swaying.mpm.pins import InKernels, PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import kick_time
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.mpm.transfer import gather, shifts
from gaussian_swaying.mpm.triton import adjoint_kernels
from gaussian_swaying.mpm.triton import total_kernels as kernels
from gaussian_swaying.mpm.triton.fused import INTERPRETED, MAX_STEPS, Fused, Part, at_home, check_indices
from gaussian_swaying.mpm.triton.fused_contact import FusedContact

# time per particle for a number of lanes per cell, relative to 32 lanes, on an H200
_LANE_COST = {4: 1.5, 8: 1.0, 16: 1.0, 32: 1.0, 64: 0.85}

# least number of pieces that `total` cuts its cells into: about the number of warps that an H200 runs at once
_PROGRAMS = 2048

_BENT = 4
"""Cells of a program that bends sheets, on a GPU; measured."""

REGISTERS = 128
"""Most registers of a thread of the particles' kernel: spilling some is worth it, because more warps run at once."""


class FusedTotal(Fused):
    """Substeps of the ``total`` formulation; everything but the nodal fields is constant.

    Args:
        bound: The formulation, bound to its material.
    """

    fixed_order = True
    bound: Total

    def __init__(self, bound: Total) -> None:
        super().__init__(bound)
        points, stencil, grid = bound.points, bound.stencil, bound.grid
        self.grid = grid
        # with virtual nodes a cell is cut by the copies of its nodes that the particles have
        unit = stencil.cell
        order = torch.argsort(unit, stable=True)
        cells, sizes = torch.unique_consecutive(unit[order], return_counts=True)
        self.virtual = stencil.nodes is not None
        self.cell_nodes = cells.new_zeros(27, 0).int()
        """The nodes of each cell, shape (27, cells), where they are not those of the lattice."""
        if stencil.nodes is not None:
            example = order[sizes.cumsum(0) - sizes]
            cells, self.cell_nodes = stencil.first[example], stencil.nodes[:, example].int().contiguous()
        self.order, self.cells = order.int(), len(cells)
        ends = sizes.cumsum(0)
        self.cell_start = torch.cat([ends.new_zeros(1), ends]).int()
        self.cell_node = cells.int()
        self.cell_scene = (cells // grid.node_count).int()
        self.particle_cell = torch.repeat_interleave(torch.arange(self.cells, device=self.device), sizes).int()
        self.fraction = stencil.fraction[:, order].contiguous()
        rows = [points.volume, bound.laws.mu, bound.laws.lam, points.mass]
        self.material = torch.stack([row.reshape(-1) for row in rows])[:, order].contiguous()
        self.law = self.law[order].contiguous()
        self.values = torch.zeros(0, self.count, **self.like)
        self.rest = points.position.contiguous()
        inverse = bound.node_inverse_mass.reshape(-1)
        active = (inverse > 0).nonzero()[:, 0]
        self.active, self.inverse_mass = active.int(), inverse[active].contiguous()
        self.damped = bound.node_damping is not None
        self.rates = self.inverse_mass if bound.node_damping is None else bound.node_damping.reshape(-1)[active]
        if self.virtual:
            rank = torch.zeros(len(inverse), dtype=torch.long, device=self.device)
            rank[active] = torch.arange(len(active), device=self.device)
            self.source = _sources_of(self.cell_nodes.long(), rank, inverse > 0)
        else:
            place = torch.full((len(inverse),), self.cells, dtype=torch.int32, device=self.device)
            place[cells] = torch.arange(self.cells, dtype=torch.int32, device=self.device)
            below = [active - shift for shift in shifts(grid).tolist()]
            self.source = _sources(
                torch.stack([torch.where(b >= 0, place[b.clamp(min=0)], self.cells) for b in below]), self.cells
            )
        self.fields = torch.zeros(len(inverse), 8, **self.like)
        self.displacement, self.velocity = self.fields[:, :4], self.fields[:, 4:]
        self.lanes = lanes(self.device, _lanes(sizes))
        self._cut(sizes)
        nodes = (*points.position.shape[:-2], grid.node_count, 3)
        vector, matrix = points.position.shape, torch.Size((*points.position.shape, 3))
        self.shapes = {"position": vector, "velocity": vector, "affine": matrix, "F": matrix}
        self.shapes |= {"displacement": torch.Size(nodes), "node_velocity": torch.Size(nodes)}
        self.room = sum(map(_padded, self.shapes.values()))
        """Entries of a buffer for all fields of a state."""
        self.found = torch.zeros(self.room if self.count <= RECORDED else 0, **self.like)
        self.taken_and_done = torch.zeros(self.impulse.numel() + self.scenes, dtype=torch.float64, device=self.device)
        pins = (PinnedRegion, PinnedPoints)
        self.plain = all(
            kind == "surface" or (type(b) in pins and b.always)
            for b, kind in zip(bound.boundaries, bound.kinds, strict=True)
        )
        """True if the kernels apply all boundaries but obstacles, which are contact."""
        self.position = bound.needs_position
        self.lattice = bound.node_positions(self.rest) if bound.needs_lattice else None
        self._take_sheets()
        self._take_pins()
        self.touching = None if bound.contact is None else FusedContact(bound, self.fields, self.active)
        self.shift = torch.zeros(len(inverse) if self.position else 0, 4, **self.like)
        # a CPU sums the cells around a node by a kernel of its own (`total_join`), without the last row of each of the
        # 27, which is of no cell
        joined = self.source[:, : None if lanes(self.device, 0) else 0]
        self.source_counts = (joined % (self.cells + 1) != self.cells).sum(0, dtype=torch.int32)
        self.joined = torch.zeros(joined.shape[1], 8, **self.like)
        self.alone = torch.arange(len(self.joined), dtype=torch.int32, device=self.device)
        self._partial: dict[tuple[int, int, str], Tensor] = {}
        width = 8 if self.position else 4
        check_indices(max(8 * len(inverse), 27 * (self.pieces + 1) * width, 27 * len(active)))

    @property
    def launches(self) -> bool:
        return self.plain and (self.touching is None or None not in self.touching.solids)

    def _take_sheets(self) -> None:
        """The sheets that bend by themselves: the normals of their points, and their matrices."""
        bending = self.bound.bending
        self.bent, self.normals = 0, self.fraction
        if bending is None:
            return
        self.normals = self.bound.normal.reshape(-1, 3)[self.order.long()].T.contiguous()
        place = torch.empty(self.count, dtype=torch.long, device=self.device)
        place[self.order.long()] = self.particle_cell.long()
        self.bent, self.bent_cell = len(bending.node), place[bending.example].int()
        self.bent_node = bending.node.int().contiguous()
        rows = torch.nn.functional.pad(bending.rows(), (0, 5))
        self.rank, self.curving = rows.shape[1], rows.contiguous()
        check_indices(self.curving.numel())

    def _bend(self, fields: Tensor, partial: Tensor, width: int) -> None:
        block = lanes(self.device, _BENT, 1)
        launch(kernels.total_bend, (-(-self.bent // block),))(
            self.bent_cell, self.bent_node, self.curving, fields, partial, self.bent, self.cells,
            WIDTH=width, RANK=self.rank, BLOCK=block, num_warps=1,
        )  # fmt: skip

    def _take_pins(self) -> None:
        """Collect the nodes and points that pins without a time window hold."""
        bound, active = self.bound, self.active.long()
        owner = torch.full((self.bound.node_mass.numel(),), -1, device=self.device)
        for k in reversed(range(len(bound.held)) if self.plain else ()):  # the first pin takes the momentum
            pin = bound.held[k]
            if bound.on_nodes[k]:
                assert pin is not None
                assert pin.share is not None
                owner = torch.where((pin.share > pin.threshold).reshape(-1), k, owner)
        owner = owner[active]
        self.held = (owner >= 0).to(torch.int8)
        # momentum taken from each held node, and a row of zeros
        self.taken = torch.zeros(len(active) + 1, 4, **self.like)
        scene = active // self.grid.node_count
        self.own_nodes = [_by_scene((owner == k).nonzero()[:, 0], scene, self.scenes) for k in range(len(bound.held))]
        self.points: InKernels | None = None
        if self.plain and bound.pinned is not None:
            self.points = bound.pinned.in_kernels(self.like["dtype"])
            check_indices(self.points.push.numel())
            self.residual = torch.zeros(2, self.points.node.shape[1], 4, **self.like)  # now, and its sum

    def _cut(self, sizes: Tensor) -> None:
        """Cut crowded cells into pieces: otherwise a body of few cells has too few programs to fill a GPU."""
        programs = lanes(self.device, _PROGRAMS, 1)
        most = self.lanes * max(1, -(-self.count // (self.lanes * programs)))
        counts = -(-sizes // most)
        first = counts.cumsum(0) - counts
        cell = torch.repeat_interleave(torch.arange(self.cells, device=self.device), counts)
        self.pieces = len(cell)
        within = torch.arange(self.pieces, device=self.device) - first[cell]
        self.piece_start = torch.cat([self.cell_start[cell] + most * within, self.cell_start[-1:]]).int()
        self.piece_node, self.piece_scene = self.cell_node[cell].contiguous(), self.cell_scene[cell].contiguous()
        self.piece_nodes = self.cell_nodes[:, cell if self.virtual else cell[:0]].contiguous()
        self.first_piece = torch.cat([first, first.new_tensor([self.pieces])]).int()

    def _take_values(self, values: Tensor) -> None:
        if len(self.values) < values.shape[1]:
            self.values = torch.zeros(values.shape[1], self.count, **self.like)
        self.values[: values.shape[1]].copy_(values[self.order.long()].T)

    def sums(self, rows: int, width: int, use: str = "") -> Tensor:
        """Buffer for the sums of each cell or piece of a cell, with a row of zeros at the end."""
        if (rows, width, use) not in self._partial:
            self._partial[rows, width, use] = torch.zeros(27, rows + 1, width, **self.like)
        return self._partial[rows, width, use]

    def join_pieces(self, pieces: Tensor, cells: Tensor, width: int) -> None:
        block = lanes(self.device, 8, 1)
        launch(kernels.total_pieces, (-(-self.cells // block), 27))(
            pieces, cells, self.first_piece, self.cells, self.pieces, WIDTH=width, BLOCK=block, num_warps=1
        )

    def _run(self, state: MPMState, part: Part) -> dict[str, Any]:
        fastest = self.speed.clone()
        while True:
            changes = self._run_once(state, part)
            if self.touching is None or self.touching.fits():
                return changes
            self.speed.copy_(fastest)  # again, with more room
            self.time.copy_(state.time)

    def _run_once(self, state: MPMState, part: Part) -> dict[str, Any]:
        for to, value in zip((self.displacement, self.velocity), state.nodal, strict=True):
            to[:, :3].copy_(value.reshape(-1, 3))
        options = part.options
        if self.touching is not None:
            self.touching.take(self.time, self.dt, part.steps)

        def begin(_: int) -> None:
            self.begin(len(self.schedule) - 2, part.loaded)
            more = [] if self.touching is None or not self.touching.walls else [self.touching.pressed_sum]
            for buffer in (self.taken, self.impulse, *more, *([] if self.points is None else [self.residual])):
                buffer.zero_()

        key = (part.loaded, self.places(), part.key)
        self.repeater.run(1, ("begin", *key), begin, part.key is not None)
        same = (*options.values(), *(() if self.touching is None else self.touching.key))
        done = 0
        due, touching = range(0), self.touching
        if touching is not None:
            due = touching.due(part.steps)
        for mark in sorted({*part.looks, part.steps, *due}):
            self.repeat(mark - done, same, lambda offset: self.substep(offset, options))
            done = mark
            if mark in part.looks:
                self.repeater.run(1, "look", lambda _: self._look(), launches=True)
            if mark in due and touching is not None:
                self.repeater.run(1, ("lists", *touching.key, touching.margin), touching.make_lists)
        if self.count > RECORDED:
            found = torch.empty(self.room, **self.like)
            self._read(found, part)
            return self._fields(found, self.taken_and_done.clone(), part)
        self.repeater.run(1, ("read", part.loaded, options["IMPLICIT"]), lambda _: self._read(self.found, part))
        return self._fields(self.found.clone(), self.taken_and_done.clone(), part)

    def _look(self) -> None:
        _, ny, nz = self.grid.resolution
        block = lanes(self.device, 128)
        launch(kernels.total_look, (-(-self.count // block),))(
            self.fraction, self.material, self.normals, self.count, self.particle_cell, self.cell_node, self.cell_nodes,
            self.cells, self.fields, self.speed,
            ny * nz, nz, 1 / self.grid.dx, WAVE=self.wave, BLOCK=block, VIRTUAL=self.virtual,
            SHEETS=self.bent > 0, num_warps=4,
        )  # fmt: skip

    def substep(self, offset: int, options: dict[str, Any]) -> None:
        """Launch one substep, ``offset`` after the first one."""
        if self.asked:
            self._push()
        width = 8 if self.position else 4
        partial = self.sums(self.pieces, width)
        _, ny, nz = self.grid.resolution
        per_program = lanes(self.device, max(1, 32 // self.lanes), 1)
        launch(kernels.total_particles, (-(-self.pieces // per_program),))(
            self.fraction, self.material, self.normals, self.law, self.law_table, self.values, self.force_in, self.load,
            self.order, self.count, self.piece_start, self.piece_node, self.piece_scene, self.pieces, self.piece_nodes,
            self.fields, partial,
            self.schedule, self.loads.vectors, self.scenes, self.loads.tables.buffer, self.first_step, offset,
            ny * nz, nz, *self.grid.offset, self.grid.node_count, self.grid.dx, 1 / self.grid.dx,
            self.settings.stiffness_damping,
            **options, POSITION=self.position, WIDTH=width, CELLS=per_program, LANES=self.lanes,
            VIRTUAL=self.virtual, WIDE=self.device.type == "cuda" and not INTERPRETED, SHEETS=self.bent > 0,
            num_warps=1, maxnreg=REGISTERS,
        )  # fmt: skip
        if self.pieces > self.cells:
            pieces, partial = partial, self.sums(self.cells, width)
            self.join_pieces(pieces, partial, width)
        if self.bent:
            self._bend(self.fields, partial, width)
        nodes, block = len(self.active), lanes(self.device, 16, 1)
        source, sources = self.source, len(self.source)
        if block == 1:
            launch(kernels.total_join, (nodes,))(source, self.source_counts, nodes, partial, self.joined, WIDTH=width)
            source, sources, partial = self.alone, 1, self.joined
        held = self.plain and any(self.bound.on_nodes)
        moves = self.plain and self.touching is None
        launch(kernels.total_nodes, (-(-nodes // block),))(
            self.active, source, sources, self.inverse_mass, self.rates, self.held, nodes, partial,
            self.fields, self.shift, self.schedule, self.first_step, offset, *self.gravity, self.taken,
            IMPLICIT=options["IMPLICIT"], POSITION=self.position, WIDTH=width,
            HELD=moves and held, MOVE=moves, DAMPED=self.damped, BLOCK=block,
            SOURCES=triton.next_power_of_2(sources), num_warps=2,
        )  # fmt: skip
        if self.touching is not None:
            self.touching.apply(self.schedule, self.first_step, offset, self.time, self.dt)
        if self.plain and not moves:
            launch(kernels.total_end, (-(-nodes // block),))(
                self.active, self.inverse_mass, self.held, nodes, self.fields, self.schedule, self.first_step, offset,
                self.taken, HELD=held, BLOCK=block, num_warps=4,
            )  # fmt: skip
        if self.points is not None:
            self._hold_points(self.points, offset)
        if not self.plain:
            self._constrain()
        if not self.plain or self.asked or (self.touching is not None and self.touching.walls):
            self.pass_time()

    def _hold_points(self, points: InKernels, offset: int) -> None:
        """Stop the held points: their velocities, then those of the nodes around them."""
        rows, block = points.node.shape[1], lanes(self.device, 4, 1)
        launch(kernels.total_rows, (-(-rows // block),))(
            points.node, points.weight, rows, self.fields, self.residual, BLOCK=block, num_warps=1
        )
        nodes, block = len(points.affected), lanes(self.device, 2, 1)
        launch(kernels.total_hold, (-(-nodes // block),))(
            points.affected, points.scene, points.push, self.residual, nodes, points.push.shape[1], self.fields,
            self.schedule, self.first_step, offset, BLOCK=block, ROWS=lanes(self.device, 128), num_warps=1,
        )  # fmt: skip

    def _impulse(self) -> Tensor:
        """Reaction impulse on each boundary in this part of the rollout, shape of ``impulse``; in a fixed order."""
        total = self.impulse.reshape(self.scenes, -1, 3).clone()
        if any(self.bound.on_nodes) and self.plain:
            for k, nodes in enumerate(self.own_nodes):
                total[:, k] += self.taken[nodes, :3].sum(1, dtype=torch.float64)
        if self.touching is not None:
            self.touching.add_taken(total)
        if self.points is not None:
            held = self.residual[1, :, :3].double().reshape(self.scenes, 1, -1, 3)
            total += (self.points.share[..., None] * held).sum(2)  # a product of matrices depends on threads
        return total.reshape(self.impulse.shape)

    def _constrain(self) -> None:
        bound, inverse = self.bound, self.bound.node_inverse_mass
        shape = (*inverse.shape, 3)
        # nodes without mass keep no velocity from a boundary
        velocity = torch.where(inverse[..., None] > 0, self.velocity[:, :3].reshape(shape), 0.0)
        position = lattice = None
        if bound.node_rest is not None:
            position = bound.node_rest + self.shift[:, :3].reshape(shape)
        if self.lattice is not None:
            lattice = self.lattice + self.displacement[:, :3].reshape(shape)
        displacement = self.displacement[:, :3].reshape(shape)
        velocity, taken = bound.hold(velocity, displacement, position, lattice, self.time, self.dt)
        self.impulse.add_(taken)
        self.velocity[:, :3].copy_(velocity.reshape(-1, 3))
        self.displacement.addcmul_(self.velocity, self.dt.to(self.velocity.dtype))

    def _read(self, found: Tensor, part: Part) -> None:
        """Write all fields of the state into ``found``; also the reaction impulses and the work of the load."""
        to = self._views(found)
        kick, implicit = self.schedule[0, 3:], part.options["IMPLICIT"]
        self._read_into(to["position"], to["velocity"], to["affine"], to["F"], kick, part.loaded, implicit)
        to["displacement"].view(-1, 3).copy_(self.displacement[:, :3])
        to["node_velocity"].view(-1, 3).copy_(self.velocity[:, :3])
        taken = self.impulse.numel()
        self.taken_and_done[:taken].copy_(self._impulse().reshape(-1))
        if part.loaded:
            self.taken_and_done[taken:].copy_(self._work().reshape(-1))

    def _views(self, found: Tensor) -> dict[str, Tensor]:
        views, first = {}, 0
        for name, shape in self.shapes.items():
            views[name] = found[first : first + shape.numel()].view(shape)
            first += _padded(shape)
        return views

    def _fields(self, found: Tensor, taken_and_done: Tensor, part: Part) -> dict[str, Any]:
        """Return the fields that :meth:`_read` wrote, by the names of the state."""
        views, taken = self._views(found), self.impulse.numel()
        F, work = views["F"], {"work": taken_and_done[taken:].view(self.bound.points.mass.shape[:-1])}
        return {
            **{name: views[name] for name in ("position", "velocity", "affine", "node_velocity")},
            "node_displacement": views["displacement"],
            "F_elastic": F,
            "F_total": F,
            "impulse": taken_and_done[:taken].view(self.impulse.shape),
            **(work if part.loaded else {}),
        }

    def _read_into(
        self, position: Tensor, velocity: Tensor, affine: Tensor, F: Tensor, kick: Tensor, work: bool, implicit: bool
    ) -> None:
        """Compute the particle fields from the nodes, and complete the work of forces that acted for ``kick``."""
        _, ny, nz = self.grid.resolution
        block = lanes(self.device, 128)
        launch(kernels.total_read, (-(-self.count // block),))(
            self.fraction, self.material, self.normals, self.load, self.order, self.rest, self.count,
            self.particle_cell, self.cell_node, self.cell_nodes, self.cells, self.fields, kick,
            position, velocity, affine, F,
            ny * nz, nz, 1 / self.grid.dx,
            WORK=work, IMPLICIT=implicit, BLOCK=block, VIRTUAL=self.virtual, SHEETS=self.bent > 0, num_warps=4,
        )  # fmt: skip

    def _look_at(self) -> MPMState:
        shape = self.bound.points.position.shape
        position, velocity = (self._room(name, *shape) for name in ("position", "velocity"))
        affine, F = (self._room(name, *shape, 3) for name in ("affine", "F"))
        self._read_into(position, velocity, affine, F, self.schedule, False, False)
        lost = self._room("lost", *shape[:-1], dtype=torch.bool)
        nodes = self.displacement[:, :3].reshape(self.shapes["displacement"])
        return MPMState(
            position=position,
            velocity=velocity,
            affine=affine,
            F_elastic=F,
            F_total=F,
            lost=lost,
            time=self.time,
            grid=self.grid,
            node_displacement=nodes,
        )


def _padded(shape: torch.Size) -> int:
    """Entries of a field in a buffer with several, each of which starts at a multiple of 16 bytes."""
    return -(-shape.numel() // 4) * 4


def _sources(cell: Tensor, cells: int) -> Tensor:
    """Rows of the sums that each node adds, shape (most of a node, nodes).

    A node of a sheet has far fewer than 27 cells with particles around it.

    Args:
        cell: The cell in each of the 27 places around each node, shape (27, nodes); ``cells`` where there is none.
        cells: Number of cells.
    """
    none = cell == cells
    most = int((~none).sum(0).amax()) if none.shape[1] else 0  # material too light has no nodes
    first = none.byte().argsort(dim=0, stable=True)[:most]  # in the order of the places
    return (first * (cells + 1) + cell.gather(0, first)).int()


def _sources_of(nodes: Tensor, rank: Tensor, has_mass: Tensor) -> Tensor:
    """As :func:`_sources`, for cells whose nodes are not those of the lattice.

    Args:
        nodes: The nodes of each cell, shape (27, cells).
        rank: Place of each node among those with mass, shape (all nodes,).
        has_mass: Which nodes have mass, shape (all nodes,).
    """
    cells = nodes.shape[1]
    place, cell = has_mass[nodes].nonzero().unbind(1)  # in the order of the places
    row, to = place * (cells + 1) + cell, rank[nodes[place, cell]]
    order = to.argsort(stable=True)
    row, to = row[order], to[order]
    many = to.bincount(minlength=int(has_mass.sum()))
    within = torch.arange(len(to), device=to.device) - (many.cumsum(0) - many)[to]
    found = to.new_full((int(many.max()) if len(many) else 0, len(many)), cells)  # a row of zeros
    found[within, to] = row
    return found.int()


def _lanes(sizes: Tensor) -> int:
    """Return the number of lanes per cell (one synchronisation).

    It gives the least total work, empty lanes included. A small body takes as long as its slowest program, so there it
    is large enough that no program has to go through its cells twice.
    """
    lanes, most = list(_LANE_COST), sizes.amax()[None]
    costs = torch.stack([(-(-sizes // n)).sum() * n for n in lanes])
    *work, largest = torch.cat([costs, most]).tolist()
    for n in lanes:
        if largest <= n and len(sizes) <= _PROGRAMS * max(1, 32 // n):
            return n
    return min(zip(lanes, work, strict=True), key=lambda pair: pair[1] * _LANE_COST[pair[0]])[0]


def _by_scene(nodes: Tensor, scene: Tensor, scenes: int) -> Tensor:
    """The nodes of each scene as rows, for sums in a fixed order, filled up with the place after the last node.

    Args:
        nodes: Places among the active nodes, which are sorted by scene, shape (n,).
        scene: Scene of each active node.
        scenes: Number of scenes.
    """
    counts = scene[nodes].bincount(minlength=scenes)
    rows = torch.full((scenes, int(counts.amax()) if len(nodes) else 0), len(scene), device=nodes.device)
    rank = torch.arange(len(nodes), device=nodes.device) - (counts.cumsum(0) - counts)[scene[nodes]]
    rows[scene[nodes], rank] = nodes
    return rows


class DifferentiableTotal(FusedTotal):
    """Rollouts with gradients: a backward pass in kernels, which shares the buffers and graphs of the substeps.

    The forward pass keeps displacement and velocity of the nodes every so many substeps. The backward pass runs each
    segment again, now keeping them in every substep, and then its adjoint. What the kernels do not cover is left to
    torch's autograd, which is the reference.
    """

    made = 0
    """Number of times that the buffers of a backward pass were made."""

    def _prepare(self) -> None:
        """Make the buffers of a backward pass."""
        self.nodes, self.place = len(self.active), self.active.long()
        self.force_bar = torch.zeros_like(self.fields)
        self.bars, self.mass_bar, self.material_bar, self.history, self.shares = (
            torch.zeros(*shape, **self.like)
            for shape in ((self.nodes, 8), (self.nodes,), (3, self.count), (0, self.nodes, 8), (0, self.pieces, 8))
        )
        self.stiffness_bar = torch.zeros(self.bent, 27, 32, **self.like)
        self.last = torch.zeros_like(self.first_step)
        self.made = 1
        self._take_rows()

    def _take_rows(self) -> None:
        """The held points as dense matrices: what rows push, and their weights on the nodes that they move."""
        points, pinned = self.points, self.bound.pinned
        if points is None or pinned is None:
            return
        place = torch.full((self.bound.node_mass.numel(),), -1, dtype=torch.int32, device=self.device)
        place[self.place] = torch.arange(self.nodes, dtype=torch.int32, device=self.device)
        self.affected, self.scene = place[points.affected.long()].contiguous(), points.scene
        self.push = points.push.T.contiguous()
        self.weight = pinned.C[0].mT[pinned.real].to(self.push).contiguous()
        self.weight_bar = torch.zeros_like(self.weight)
        self.row_bar = torch.zeros(points.node.shape[1], 4, **self.like)
        self.multipliers = self.row_history = torch.zeros(0, len(self.row_bar), 4, **self.like)

    # ---- forward

    def why_no_gradient(self, state: MPMState, forces: Sequence[Force]) -> str | None:
        """Return the reason why gradients of a rollout need torch's autograd; None if the kernels compute them."""
        bound = self.bound
        points = bound.points
        if not self.plain or self.touching is not None:
            return "boundaries other than pins that hold all the time, and contact, have no backward kernels"
        device_function = forces[0].device_function() if forces else None
        if len(forces) > 1 or (forces and device_function is None):
            return "only one force with a device function has a backward kernel"
        if device_function is not None and device_function.adjoint is None:
            return f"this {type(forces[0]).__name__} has no backward kernel"
        free = [points.mass, points.volume, points.youngs_modulus, points.poisson_ratio, points.bending]
        fixed = [t for t in bound.tensors() if not any(t is other for other in free)]
        fixed += (
            []
            if device_function is None
            else [t for t in tensors_of(forces) if any(t is source for source in device_function.sources)]
        )
        fixed += [t for law in points.laws for t in (*law.parameters(), *law.buffers())]
        if any(t.requires_grad for t in fixed):
            return "a gradient by rest positions, patches, boundaries or numbers of a law needs torch"
        nodal = (state.node_displacement, state.node_velocity)
        if any(t is not None and t.requires_grad for t in nodal):
            return (
                None if not any(_own(t, nodal) for t in state.tensors()) else "particle fields are inputs of their own"
            )
        if any(t.requires_grad for t in state.tensors()):
            return "particle fields require gradients, but the nodal ones do not"
        return None

    def rollout_with_gradient(
        self,
        state: MPMState,
        dt: float,
        steps: int,
        forces: Sequence[Force],
        checkpoint: int,
        watch: Callable[[int], None] | None,
    ) -> MPMState:
        """As ``MPMSolver.rollout``; gradients reach nodal fields, stiffness, mass, volume, wind and coefficients."""
        if steps == 0:
            return state
        if not self.made:
            with torch.inference_mode(False), torch.no_grad():
                self._prepare()
        run = _Run(self, state, dt, steps, segment(steps, checkpoint, self.nodes), tuple(forces), watch)
        vectors = numbers = None
        if forces:
            (device_function,) = divide(forces)[1]
            vectors = device_function.per_substep.take(state.time, torch.full_like(state.time, dt), steps)
            numbers = torch.as_tensor(device_function.numbers.take())
        bound = self.bound
        laws, points, pinned = bound.laws, bound.points, bound.pinned
        displacement, velocity = _Rollout.apply(
            run, *state.nodal, laws.mu, laws.lam, points.volume,
            bound.node_inverse_mass, None if pinned is None else pinned.C,
            None if bound.bending is None else bound.bending.stiffness, vectors, numbers,
        )  # fmt: skip
        end = run.state
        rows = gather(torch.cat([displacement, velocity], dim=-1), bound.stencil)
        return bound.in_shape(bound.with_rows(end, displacement, velocity, rows))

    def forward(self, run: _Run) -> tuple[Tensor, ...]:
        """Run all segments and keep the state at the start of each; the nodal fields at the end."""
        for first in range(0, run.steps, run.every):
            count = min(run.every, run.steps - first)
            run.starts.append(torch.stack([value.reshape(-1, 3)[self.place] for value in run.state.nodal], dim=1))
            run.kicks.append(kick_time(run.state, run.dt))
            run.state = self.rollout(run.state, run.dt, count, run.forces)[0]
            if run.watch is not None:
                run.watch(first + count)
        return tuple(value.clone() for value in run.state.nodal)

    # ---- backward

    def backward(
        self, run: _Run, bars: Sequence[Tensor], vectors: Tensor | None, numbers: Tensor | None, needs: dict[str, bool]
    ) -> dict[str, Tensor]:
        """Gradients by the inputs of :class:`_Rollout`, by name, from those by the nodal fields at the end."""
        loaded = len(run.forces) > 0
        self.asked = ()
        self.options = self.options_for(divide(run.forces)[1])
        if numbers is not None:
            self.loads.tables.buffer[: len(numbers)].copy_(numbers)
        self._make_room(run.every, loaded)
        self.width = 8 if loaded or self.options["VISCOUS"] else 4
        self.partial = self.sums(self.cells, self.width, "adjoint")
        for buffer in (
            self.bars,
            self.force_bar,
            self.mass_bar,
            self.material_bar,
            self.stiffness_bar,
            self.partial,
            self.fields,
        ):
            buffer.zero_()
        for k, bar in enumerate(bars):
            self.bars[:, 4 * k : 4 * k + 3] = bar.reshape(-1, 3)[self.place]
        shares = loaded and (needs["vectors"] or needs["numbers"])
        material = any(needs[name] for name in ("mu", "lam", "volume"))
        self.flags = {"MATERIAL": material, "SHARES": shares, "MASS": needs["inverse_mass"], "WEIGHTS": needs["weight"]}
        self.flags["BENDING"] = needs["stiffness"]
        if self.points is not None:
            self.weight_bar.zero_()
        vector_bars: list[Tensor] = []
        number_bar = torch.zeros(3, dtype=torch.float64, device=self.device)
        for n in reversed(range(len(run.starts))):
            first = n * run.every
            count = min(run.every, run.steps - first)
            if vectors is not None:
                self.loads.write(0, vectors[first : first + count])
            self.schedule[: count + 2].copy_(self.table(run.kicks[n], run.dt, count), non_blocking=True)
            self._segment(run.starts[n], count)
            if shares:
                by_vector, by_numbers = self._shared(count)
                vector_bars.append(by_vector)
                number_bar += by_numbers
        self._nodes_back(0, SUM=True, PUSH=False, FINISH=False)
        bound, found = self.bound, {}
        for k, (name, bar) in enumerate(zip(_INPUTS, bars, strict=False)):
            all_nodes = bar.reshape(-1, 3) if k == 0 else torch.zeros_like(bar).reshape(-1, 3)
            own = self.bars[:, 4 * k : 4 * k + 3].to(bar)
            found[name] = all_nodes.index_copy(0, self.place, own).reshape(bar.shape)
        sorted_back = torch.empty_like(self.material_bar)
        sorted_back[:, self.order.long()] = self.material_bar
        for name, row in zip(("mu", "lam", "volume"), sorted_back, strict=True):
            found[name] = row.reshape(bound.points.mass.shape)
        inverse = bound.node_inverse_mass
        mass = torch.zeros(inverse.numel(), **self.like).index_copy(0, self.place, self.mass_bar)
        found["inverse_mass"] = mass.reshape(inverse.shape)
        found["stiffness"] = self.stiffness_bar[:, :, :27]
        if self.points is not None and bound.pinned is not None:
            weight = torch.zeros_like(bound.pinned.C)
            weight[0].mT[bound.pinned.real] = self.weight_bar.to(weight)
            found["weight"] = weight
        if vectors is not None and numbers is not None and vector_bars:
            by_vectors = torch.cat(vector_bars[::-1])
            by_vectors = by_vectors.reshape(vectors.shape) if vectors.ndim > 2 else by_vectors.sum(1)
            found["vectors"] = by_vectors.to(vectors)
            found["numbers"] = torch.nn.functional.pad(number_bar, (0, len(numbers) - 3)).to(numbers)
        return found

    def _segment(self, start: Tensor, count: int) -> None:
        self.fields.view(-1, 2, 4)[:, :, :3].index_copy_(0, self.place, start)
        self.first_step.zero_()

        def again(offset: int) -> None:
            self._keep(offset)
            self.substep(offset, self.options)

        def back(offset: int) -> None:
            self._node_stages(offset)
            self._particles_back(offset)

        key = (*self.options.values(), *self.flags.values(), self.made)
        self.repeat(count, ("again", *key), again)
        self._keep(0)
        if self.flags["WEIGHTS"]:
            self._find_multipliers(count)
        self.last.fill_(count - 1)
        self.first_step.zero_()
        self.repeat(count, ("back", *key), back)

    def _make_room(self, every: int, loaded: bool) -> None:
        """Make the buffers for a segment; recorded graphs contain their addresses, so new buffers are counted."""
        if len(self.history) < every + 1:
            self.made += 1
            self.history = torch.zeros(every + 1, self.nodes, 8, **self.like)
            if self.points is not None:
                rows = len(self.row_bar)
                self.row_history, self.multipliers = (torch.zeros(every + 1, rows, 4, **self.like) for _ in range(2))
        if loaded and len(self.shares) < every:
            self.made += 1
            self.shares = torch.zeros(every, self.pieces, 8, **self.like)

    def _find_multipliers(self, count: int) -> None:
        pinned = self.bound.pinned
        assert pinned is not None
        W = pinned.W[0]
        rates = self.row_history[1 : count + 1].reshape(count, *W.shape[:2], 4).double()
        found = torch.einsum("sij,csjx->csix", W.mT @ W, rates)
        self.multipliers[:count].copy_(found.reshape(count, -1, 4))

    def _keep(self, offset: int) -> None:
        block = lanes(self.device, 512)
        launch(adjoint_kernels.keep_nodes, (triton.cdiv(8 * self.nodes, block),))(
            self.active, self.nodes, self.fields, self.history, self.first_step, offset, BLOCK=block, num_warps=4
        )
        if self.flags["WEIGHTS"]:
            rows = len(self.row_bar)
            launch(adjoint_kernels.keep_rows, (triton.cdiv(4 * rows, block),))(
                self.residual, rows, self.row_history, self.first_step, offset, BLOCK=block, num_warps=4
            )

    def _node_stages(self, offset: int) -> None:
        if self.points is None:
            self._nodes_back(offset, SUM=True, PUSH=True, FINISH=True)
            return
        self._nodes_back(offset, SUM=True, PUSH=True, FINISH=False)
        nodes, rows = len(self.affected), self.push.shape[0]
        launch(adjoint_kernels.rows_adjoint, (len(self.row_bar),))(
            self.affected, self.scene, self.push, self.bars, self.row_bar, nodes, rows,
            BLOCK=lanes(self.device, min(1024, triton.next_power_of_2(nodes))), num_warps=4,
        )  # fmt: skip
        block = lanes(self.device, 8, 1)
        launch(adjoint_kernels.hold_adjoint, (triton.cdiv(nodes, block),))(
            self.affected, self.scene, self.weight, self.row_bar, nodes, rows, self.bars,
            self.weight_bar, self.multipliers, len(self.row_bar), self.inverse_mass, self.history, self.nodes,
            self.first_step, offset, self.last, WEIGHTS=self.flags["WEIGHTS"], BLOCK=block,
            ROWS=lanes(self.device, 64), num_warps=2,
        )  # fmt: skip
        self._nodes_back(offset, SUM=False, PUSH=False, FINISH=True)

    def _nodes_back(self, offset: int, **stages: bool) -> None:
        block = lanes(self.device, 64, 1)
        launch(adjoint_kernels.nodes_adjoint, (triton.cdiv(self.nodes, block),))(
            self.active, self.source, len(self.source), self.inverse_mass, self.rates, self.held, self.nodes,
            self.partial,
            self.fields, self.force_bar, self.history, self.bars, self.mass_bar,
            self.schedule, self.first_step, offset, self.last, *self.gravity,
            **stages, VELOCITY=self.width == 8, HELD=any(self.bound.on_nodes), MASS=self.flags["MASS"],
            DAMPED=self.damped, WIDTH=self.width, BLOCK=block,
            SOURCES=triton.next_power_of_2(len(self.source)), num_warps=4,
        )  # fmt: skip

    def _particles_back(self, offset: int) -> None:
        options, flags = self.options, self.flags
        per_program = lanes(self.device, max(1, 32 // self.lanes), 1)
        _, ny, nz = self.grid.resolution
        cut = self.pieces > self.cells
        to = self.sums(self.pieces, self.width, "adjoint pieces") if cut else self.partial
        launch(adjoint_kernels.particles_adjoint, (triton.cdiv(self.pieces, per_program),))(
            self.fraction, self.material, self.normals, self.law, self.law_table, self.values, self.count,
            self.piece_start, self.piece_node, self.piece_scene, self.pieces, self.piece_nodes,
            self.fields, self.force_bar, to, self.material_bar, self.shares,
            self.loads.vectors, self.scenes, self.loads.tables.buffer, self.first_step, offset, self.last,
            ny * nz, nz, 1 / self.grid.dx, self.settings.stiffness_damping,
            LAWS=self.laws, MULTI=options["MULTI"], FORCES=options["FORCES"], VISCOUS=options["VISCOUS"],
            MATERIAL=flags["MATERIAL"], SHARES=flags["SHARES"], WIDTH=self.width, CELLS=per_program, LANES=self.lanes,
            VIRTUAL=self.virtual, SHEETS=self.bent > 0, num_warps=1,
            **({"maxnreg": REGISTERS} if self.lanes == 64 else {}),
        )  # fmt: skip
        if cut:
            self.join_pieces(to, self.partial, self.width)
        if self.bent:
            self._bend(self.force_bar, self.partial, self.width)  # its matrix is symmetric
            if flags["BENDING"]:
                launch(adjoint_kernels.bend_adjoint, (self.bent, 27))(
                    self.bent_node, self.fields, self.force_bar, self.stiffness_bar, num_warps=1
                )

    def _shared(self, count: int) -> tuple[Tensor, Tensor]:
        """Gradients by the vectors of a segment (count, scenes, 3) and by the numbers (3,), summed over particles."""
        rows = self.shares[:count]
        if self.scenes == 1:
            total = rows.sum(1, keepdim=True, dtype=torch.float64)
        else:  # pieces are sorted by scene
            scenes = torch.arange(self.scenes + 1, dtype=torch.int32, device=self.device)
            border = torch.searchsorted(self.piece_scene, scenes)
            total = torch.nn.functional.pad(rows.cumsum(1, dtype=torch.float64), (0, 0, 1, 0))
            total = total[:, border[1:]] - total[:, border[:-1]]
        return total[..., :3], total[..., 4:7].sum((0, 1))


@dataclass
class _Run:
    """Data of one rollout that its backward pass needs.

    Attributes:
        kernels: What computes it.
        state: The state at its start, and then that at its end, without gradient.
        dt: Substep [s].
        steps: Number of substeps.
        every: Substeps of a segment.
        forces: The force, if any.
        watch: See ``MPMSolver.rollout``.
        starts: Displacement and velocity of the active nodes at the start of each segment, shape (nodes, 2, 3).
        kicks: Time for which forces act in the first substep of each segment [s].
    """

    kernels: DifferentiableTotal
    state: MPMState
    dt: float
    steps: int
    every: int
    forces: tuple[Force, ...]
    watch: Callable[[int], None] | None
    starts: list[Tensor] = field(default_factory=list)
    kicks: list[float] = field(default_factory=list)


_INPUTS = (
    "displacement",
    "velocity",
    "mu",
    "lam",
    "volume",
    "inverse_mass",
    "weight",
    "stiffness",
    "vectors",
    "numbers",
)


class _Rollout(torch.autograd.Function):
    """Nodal fields after a rollout, from those before it and from what it depends on."""

    @staticmethod
    def forward(ctx: Any, run: _Run, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        ctx.run = run
        ctx.given = [None if value is None else value.detach() for value in inputs[-2:]]
        return run.kernels.forward(run)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        needs = dict(zip(_INPUTS, ctx.needs_input_grad[1:], strict=True))
        with at_home(ctx.run.kernels.bars):
            found = ctx.run.kernels.backward(ctx.run, bars, *ctx.given, needs)
        return None, *(found.get(name) if needs[name] else None for name in _INPUTS)


def segment(steps: int, checkpoint: int, nodes: int) -> int:
    """Substeps of a segment: as asked for, else about the square root of all, or more if they fit in 128 MiB.

    It is a multiple of what a graph repeats.
    """
    if checkpoint > 0:
        return min(checkpoint, MAX_STEPS, steps)
    fitting = min(2**22 // nodes, MAX_STEPS)  # 32 bytes for each node and substep
    return min(16 * max(1, round(steps**0.5 / 16), fitting // 16), MAX_STEPS, steps)


def _own(tensor: Tensor, nodal: tuple[Tensor | None, ...]) -> bool:
    """True if a field of particles is a leaf that requires a gradient, and not a nodal field."""
    return tensor.requires_grad and tensor.is_leaf and not any(tensor is t for t in nodal)
