"""Runs the ``total`` substep with its kernels."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels.graphs import RECORDED
from gaussian_swaying.kernels.language import triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm import total_kernels as kernels
from gaussian_swaying.mpm.contact_run import ContactRun
from gaussian_swaying.mpm.pins import InKernels, PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.run import INTERPRETED, Fused, Part, check_indices
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.total import Total
from gaussian_swaying.mpm.transfer import shifts

# time per particle for a number of lanes per cell, relative to 32 lanes, on an H200
_LANE_COST = {4: 1.5, 8: 1.0, 16: 1.0, 32: 1.0, 64: 0.85}

# least number of pieces that `total` cuts its cells into: about the number of warps that an H200 runs at once
_PROGRAMS = 2048

_BENT = 4
"""Cells of a program that bends sheets, on a GPU; measured."""

REGISTERS = 128
"""Most registers of a thread of the particles' kernel: spilling some is worth it, because more warps run at once."""


class TotalRun(Fused):
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
        self.touching = None if bound.contact is None else ContactRun(bound, self.fields, self.active)
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
            self.schedule, self.loads.rows, self.scenes, self.loads.buffer, self.first_step, offset,
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
