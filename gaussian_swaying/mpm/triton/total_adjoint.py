"""Gradients through rollouts of the ``total`` formulation, with kernels for the backward pass.

The forward pass is that of :class:`~gaussian_swaying.mpm.triton.fused_total.FusedTotal`, which keeps displacement and
velocity of the nodes every so many substeps. The backward pass runs each segment again, now keeping them in every
substep, and then its adjoint. What the kernels do not cover is left to torch's autograd, which is the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.kernels.language import triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.forces import Force, tensors_of
from gaussian_swaying.mpm.formulations.formulation import Formulation
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.timestep import kick_time
from gaussian_swaying.mpm.transfer import gather
from gaussian_swaying.mpm.triton import adjoint_kernels as kernels
from gaussian_swaying.mpm.triton.fused import MAX_STEPS, Adjoint, at_home
from gaussian_swaying.mpm.triton.fused_total import REGISTERS, FusedTotal
from gaussian_swaying.mpm.twins import Twin

Watch = Callable[[int], None] | None


@dataclass
class _Run:
    """Data of one rollout that its backward pass needs.

    Attributes:
        state: The state at its start.
        dt: Substep [s].
        steps: Number of substeps.
        every: Substeps of a segment.
        forces: The force, if any.
        watch: See ``MPMSolver.rollout``.
        starts: Displacement and velocity of the active nodes at the start of each segment, shape (nodes, 2, 3).
        kicks: Time for which forces act in the first substep of each segment [s].
        end: The state at its end, without gradient.
    """

    state: MPMState
    dt: float
    steps: int
    every: int
    forces: tuple[Force, ...]
    watch: Watch
    starts: list[Tensor] = field(default_factory=list)
    kicks: list[float] = field(default_factory=list)
    end: MPMState | None = None


@dataclass(frozen=True)
class _Pass:
    """The gradients that the kernels of one backward pass compute, and the buffers in which they sum.

    Attributes:
        options: Of the kernels of the forward pass.
        flags: Which gradients are wanted: MATERIAL, SHARES, MASS and WEIGHTS.
        partial: Sums of the cells, with 27 rows per cell.
        width: Columns of ``partial``; eight if there are gradients by nodal velocities.
    """

    options: dict[str, Any]
    flags: dict[str, bool]
    partial: Tensor
    width: int

    @property
    def key(self) -> tuple[object, ...]:
        return (*self.options.values(), *self.flags.values())


class TotalAdjoint:
    """The backward pass of the substeps of a :class:`FusedTotal`, whose buffers and graphs it shares.

    Args:
        fused: The substeps.
    """

    def __init__(self, fused: FusedTotal) -> None:
        self.fused, self.device = fused, fused.device
        nodes = len(fused.active)
        self.nodes, self.active = nodes, fused.active.long()

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(*shape, **self.fused.like)

        self.force_bar = torch.zeros_like(fused.fields)
        self.bars = zeros(nodes, 8)
        self.mass_bar = zeros(nodes)
        self.found = zeros(3, fused.count)
        self.last = torch.zeros(1, dtype=torch.int32, device=self.device)
        self.rooms = 0
        self.history = zeros(0, nodes, 8)
        self.shares = zeros(0, fused.pieces, 8)
        self._take_rows()

    def _take_rows(self) -> None:
        """The held points as dense matrices: what rows push, and their weights on the nodes that they move."""
        points = self.fused.points
        if points is None:
            return
        place = torch.full((self.fused.bound.node_mass.numel(),), -1, dtype=torch.int32, device=self.device)
        place[self.active] = torch.arange(self.nodes, dtype=torch.int32, device=self.device)
        own = place[points.affected.long()]
        massive = (own >= 0).nonzero()[:, 0]  # others never move
        self.affected, self.scene = own[massive].contiguous(), points.scene[massive].contiguous()
        self.push = points.push[massive].T.contiguous()
        rows = points.push.shape[1]
        where = torch.full_like(place, len(massive)).index_copy(
            0, points.affected.long()[massive], torch.arange(len(massive), dtype=torch.int32, device=self.device)
        )
        row = (torch.arange(points.node.shape[1], device=self.device) % rows).expand_as(points.node)
        weight = torch.zeros(len(massive) + 1, rows, **self.fused.like)
        weight.index_put_((where[points.node.long()].long(), row), points.weight, accumulate=True)
        self.weight = weight[:-1].contiguous()
        self.weight_bar = torch.zeros_like(self.weight)
        self.entry = (where[points.node.long()].long(), row)
        self.residual = torch.zeros(points.node.shape[1], 4, **self.fused.like)
        self.multipliers = self.row_history = torch.zeros(0, len(self.residual), 4, **self.fused.like)

    # ---- forward

    def rollout(
        self, state: MPMState, dt: float, steps: int, forces: Sequence[Force], checkpoint: int, watch: Watch
    ) -> MPMState:
        """As ``MPMSolver.rollout``; gradients reach nodal fields, stiffness, mass, volume, wind and coefficients."""
        bound = self.fused.bound
        assert state.node_displacement is not None
        assert state.node_velocity is not None
        if steps == 0:
            return state
        run = _Run(state, dt, steps, segment(steps, checkpoint, self.nodes), tuple(forces), watch)
        vectors = numbers = None
        if forces:
            twin = _twin(forces[0])
            vectors = twin.per_substep.take(state.time, torch.full_like(state.time, dt), steps)
            numbers = torch.as_tensor(twin.numbers.take())
        laws, points, holds = bound.body.laws, bound.body.points, bound.point_holds
        displacement, velocity = _Rollout.apply(
            self, run, state.node_displacement, state.node_velocity, laws.mu, laws.lam, points.volume,
            bound.node_inverse_mass, None if holds is None else holds.weight, vectors, numbers,
        )  # fmt: skip
        end, run.end = run.end, None
        assert end is not None
        rows = gather(torch.cat([displacement, velocity], dim=-1), bound.stencil)
        return bound.with_rows(end, displacement, velocity, rows)

    def forward(self, run: _Run) -> tuple[Tensor, Tensor]:
        """Run all segments and keep the state at the start of each; the nodal fields at the end."""
        state = run.state
        for first in range(0, run.steps, run.every):
            count = min(run.every, run.steps - first)
            run.starts.append(self._compact(state))
            run.kicks.append(kick_time(state, run.dt))
            state = self.fused.rollout(state, run.dt, count, run.forces)[0]
            if run.watch is not None:
                run.watch(first + count)
        run.end = state
        assert state.node_displacement is not None
        assert state.node_velocity is not None
        return state.node_displacement.clone(), state.node_velocity.clone()

    def _compact(self, state: MPMState) -> Tensor:
        """Displacement and velocity of the active nodes, shape (nodes, 2, 3)."""
        assert state.node_displacement is not None
        assert state.node_velocity is not None
        both = (value.reshape(-1, 3)[self.active] for value in (state.node_displacement, state.node_velocity))
        return torch.stack(list(both), dim=1)

    # ---- backward

    def backward(
        self,
        run: _Run,
        displacement: Tensor,
        velocity: Tensor,
        vectors: Tensor | None,
        numbers: Tensor | None,
        needs: dict[str, bool],
    ) -> dict[str, Tensor]:
        """Gradients by the inputs of :class:`_Rollout`, by name, from those by the nodal fields at the end."""
        fused, nodes = self.fused, self.nodes
        loaded = len(run.forces) > 0
        fused.asked = ()
        options = fused.options_for([_twin(force) for force in run.forces])
        if numbers is not None:
            fused.tables.buffer[: len(numbers)].copy_(numbers)
        self._make_room(run.every, loaded)
        self.bars.zero_()
        self.bars.view(nodes, 2, 4)[:, 0, :3] = displacement.reshape(-1, 3)[self.active]
        self.bars.view(nodes, 2, 4)[:, 1, :3] = velocity.reshape(-1, 3)[self.active]
        width = 8 if loaded or options["VISCOUS"] else 4
        partial = self.sums(width)
        for buffer in (self.force_bar, self.mass_bar, self.found, partial, fused.fields):
            buffer.zero_()
        material = any(needs[name] for name in ("mu", "lam", "volume"))
        shares = loaded and (needs["vectors"] or needs["numbers"])
        flags = {"MATERIAL": material, "SHARES": shares, "MASS": needs["inverse_mass"], "WEIGHTS": needs["weight"]}
        asked = _Pass(options, flags, partial, width)
        if fused.points is not None:
            self.weight_bar.zero_()
        vector_bars: list[Tensor] = []
        number_bar = torch.zeros(3, dtype=torch.float64, device=self.device)
        for n in reversed(range(len(run.starts))):
            first = n * run.every
            count = min(run.every, run.steps - first)
            if vectors is not None:
                fused.write_substeps(0, vectors[first : first + count])
            fused.schedule[: count + 2].copy_(fused.table(run.kicks[n], run.dt, count), non_blocking=True)
            self._segment(run.starts[n], count, asked)
            if shares:
                by_vector, by_numbers = self._shared(count)
                vector_bars.append(by_vector)
                number_bar += by_numbers
        self._nodes(0, asked, SUM=True, PUSH=False, FINISH=False)
        return self._found(run, displacement, vectors, numbers, vector_bars, number_bar)

    def _segment(self, start: Tensor, count: int, asked: _Pass) -> None:
        fused = self.fused
        fused.fields.view(-1, 2, 4)[:, :, :3].index_copy_(0, self.active, start)
        fused.first_step.zero_()

        def again(offset: int) -> None:
            self._keep(offset, asked)
            fused.substep(offset, asked.options)

        def back(offset: int) -> None:
            self._node_stages(offset, asked)
            self._particles(offset, asked)

        key = (*asked.key, self.rooms)
        fused.repeat(count, ("again", *key), again)
        self._keep(0, asked)
        if asked.flags["WEIGHTS"]:
            self._find_multipliers(count)
        self.last.fill_(count - 1)
        fused.first_step.zero_()
        fused.repeat(count, ("back", *key), back)

    def _make_room(self, every: int, loaded: bool) -> None:
        """Make the buffers for a segment; recorded graphs contain their addresses, so new buffers are counted."""
        if len(self.history) < every + 1:
            self.rooms += 1
            self.history = torch.zeros(every + 1, self.nodes, 8, **self.fused.like)
            if self.fused.points is not None:
                rows = len(self.residual)
                self.row_history, self.multipliers = (
                    torch.zeros(every + 1, rows, 4, **self.fused.like) for _ in range(2)
                )
        if loaded and len(self.shares) < every:
            self.rooms += 1
            self.shares = torch.zeros(every, self.fused.pieces, 8, **self.fused.like)

    def sums(self, width: int) -> Tensor:
        """The buffer that nodes sum over; that of the pieces, if cells are cut, is one of ``FusedTotal``."""
        rows = self.fused.cells
        return self.fused.sums(rows, width, "adjoint")

    def _find_multipliers(self, count: int) -> None:
        holds = self.fused.bound.point_holds
        assert holds is not None
        W = holds.whitening[0]
        rates = self.row_history[1 : count + 1].reshape(count, holds.scenes, holds.rows, 4).double()
        found = torch.einsum("sij,csjx->csix", W.mT @ W, rates)
        self.multipliers[:count].copy_(found.reshape(count, -1, 4))

    def _keep(self, offset: int, asked: _Pass) -> None:
        fused, block = self.fused, lanes(self.fused.device, 512)
        launch(kernels.keep_nodes, (triton.cdiv(8 * self.nodes, block),))(
            fused.active, self.nodes, fused.fields, self.history, fused.first_step, offset, BLOCK=block, num_warps=4
        )
        if asked.flags["WEIGHTS"]:
            rows = len(self.residual)
            launch(kernels.keep_rows, (triton.cdiv(4 * rows, block),))(
                fused.residual, rows, self.row_history, fused.first_step, offset, BLOCK=block, num_warps=4
            )

    def _node_stages(self, offset: int, asked: _Pass) -> None:
        fused = self.fused
        if fused.points is None:
            self._nodes(offset, asked, SUM=True, PUSH=True, FINISH=True)
            return
        self._nodes(offset, asked, SUM=True, PUSH=True, FINISH=False)
        nodes, rows = len(self.affected), self.push.shape[0]
        launch(kernels.rows_adjoint, (len(self.residual),))(
            self.affected, self.scene, self.push, self.bars, self.residual, nodes, rows,
            BLOCK=lanes(fused.device, min(1024, triton.next_power_of_2(nodes))), num_warps=4,
        )  # fmt: skip
        block = lanes(fused.device, 8, 1)
        launch(kernels.hold_adjoint, (triton.cdiv(nodes, block),))(
            self.affected, self.scene, self.weight, self.residual, nodes, rows, self.bars,
            self.weight_bar, self.multipliers, len(self.residual), fused.inverse_mass, self.history, self.nodes,
            fused.first_step, offset, self.last, WEIGHTS=asked.flags["WEIGHTS"], BLOCK=block,
            ROWS=lanes(fused.device, 64), num_warps=2,
        )  # fmt: skip
        self._nodes(offset, asked, SUM=False, PUSH=False, FINISH=True)

    def _nodes(self, offset: int, asked: _Pass, **stages: bool) -> None:
        fused, block = self.fused, lanes(self.fused.device, 64, 1)
        launch(kernels.nodes_adjoint, (triton.cdiv(self.nodes, block),))(
            fused.active, fused.source, len(fused.source), fused.inverse_mass, fused.rates, fused.held, self.nodes,
            asked.partial,
            fused.fields, self.force_bar, self.history, self.bars, self.mass_bar,
            fused.schedule, fused.first_step, offset, self.last, *fused.gravity,
            **stages, VELOCITY=asked.width == 8, HELD=any(fused.bound.on_nodes), MASS=asked.flags["MASS"],
            DAMPED=fused.damped, WIDTH=asked.width, BLOCK=block,
            SOURCES=triton.next_power_of_2(len(fused.source)), num_warps=4,
        )  # fmt: skip

    def _particles(self, offset: int, asked: _Pass) -> None:
        fused, options, flags = self.fused, asked.options, asked.flags
        per_program = lanes(fused.device, max(1, 32 // fused.lanes), 1)
        _, ny, nz = fused.grid.resolution
        cut = fused.pieces > fused.cells
        to = fused.sums(fused.pieces, asked.width, "adjoint pieces") if cut else asked.partial
        launch(kernels.particles_adjoint, (triton.cdiv(fused.pieces, per_program),))(
            fused.fraction, fused.material, fused.law, fused.law_table, fused.values, fused.count,
            fused.piece_start, fused.piece_node, fused.piece_scene, fused.pieces,
            fused.fields, self.force_bar, to, self.found, self.shares,
            fused.vectors, fused.scenes, fused.tables.buffer, fused.first_step, offset, self.last,
            ny * nz, nz, 1 / fused.grid.dx, fused.settings.stiffness_damping,
            LAWS=fused.laws, MULTI=options["MULTI"], FORCES=options["FORCES"], VISCOUS=options["VISCOUS"],
            MATERIAL=flags["MATERIAL"], SHARES=flags["SHARES"], WIDTH=asked.width, CELLS=per_program, LANES=fused.lanes,
            num_warps=1, **({"maxnreg": REGISTERS} if fused.lanes == 64 else {}),
        )  # fmt: skip
        if cut:
            fused.join_pieces(to, asked.partial, asked.width)

    # ---- what it found

    def _shared(self, count: int) -> tuple[Tensor, Tensor]:
        """Gradients by the vectors of a segment (count, scenes, 3) and by the numbers (3,), summed over particles."""
        fused = self.fused
        rows = self.shares[:count]
        if fused.scenes == 1:
            total = rows.sum(1, keepdim=True, dtype=torch.float64)
        else:  # pieces are sorted by scene
            scenes = torch.arange(fused.scenes + 1, dtype=torch.int32, device=self.device)
            border = torch.searchsorted(fused.piece_scene, scenes)
            total = torch.nn.functional.pad(rows.cumsum(1, dtype=torch.float64), (0, 0, 1, 0))
            total = total[:, border[1:]] - total[:, border[:-1]]
        return total[..., :3], total[..., 4:7].sum((0, 1))

    def _found(
        self,
        run: _Run,
        displacement: Tensor,
        vectors: Tensor | None,
        numbers: Tensor | None,
        vector_bars: list[Tensor],
        number_bar: Tensor,
    ) -> dict[str, Tensor]:
        """All gradients, in the shapes of the inputs."""
        fused, bound = self.fused, self.fused.bound
        batch = bound.body.points.mass.shape
        result = {}
        both = self.bars.view(self.nodes, 2, 4)[:, :, :3]
        flat = displacement.reshape(-1, 3)
        result["displacement"] = flat.index_copy(0, self.active, both[:, 0].to(flat)).reshape(displacement.shape)
        result["velocity"] = torch.zeros_like(flat).index_copy(0, self.active, both[:, 1].to(flat))
        result["velocity"] = result["velocity"].reshape(displacement.shape)
        sorted_back = torch.empty_like(self.found)
        sorted_back[:, fused.order.long()] = self.found
        for name, row in zip(("mu", "lam", "volume"), sorted_back, strict=True):
            result[name] = row.reshape(batch)
        inverse = bound.node_inverse_mass
        mass = torch.zeros(inverse.numel(), **self.fused.like).index_copy(0, self.active, self.mass_bar)
        result["inverse_mass"] = mass.reshape(inverse.shape)
        if fused.points is not None and bound.point_holds is not None:
            padded = torch.nn.functional.pad(self.weight_bar, (0, 0, 0, 1))
            weight = bound.point_holds.weight
            result["weight"] = padded[self.entry].T.reshape(weight.shape).to(weight)
        if vectors is not None and numbers is not None and vector_bars:
            own = torch.cat(vector_bars[::-1])
            own = own.reshape(vectors.shape) if vectors.ndim > 2 else own.sum(1)
            result["vectors"] = own.to(vectors)
            result["numbers"] = torch.nn.functional.pad(number_bar, (0, len(numbers) - 3)).to(numbers)
        return result


_INPUTS = ("displacement", "velocity", "mu", "lam", "volume", "inverse_mass", "weight", "vectors", "numbers")


class _Rollout(torch.autograd.Function):
    """Nodal fields after a rollout, from those before it and from what it depends on."""

    @staticmethod
    def forward(ctx: Any, adjoint: TotalAdjoint, run: _Run, *inputs: Tensor | None) -> tuple[Tensor, Tensor]:
        ctx.adjoint, ctx.run = adjoint, run
        ctx.vectors, ctx.numbers = (None if value is None else value.detach() for value in inputs[-2:])
        return adjoint.forward(run)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, displacement: Tensor, velocity: Tensor) -> tuple[Tensor | None, ...]:
        needs = dict(zip(_INPUTS, ctx.needs_input_grad[2:], strict=True))
        with at_home(ctx.adjoint.bars):
            found = ctx.adjoint.backward(ctx.run, displacement, velocity, ctx.vectors, ctx.numbers, needs)
        return None, None, *(found.get(name) if needs[name] else None for name in _INPUTS)


def segment(steps: int, checkpoint: int, nodes: int) -> int:
    """Substeps of a segment: as asked for, else about the square root of all, or more if they fit in 128 MiB.

    It is a multiple of what a graph repeats.
    """
    if checkpoint > 0:
        return min(checkpoint, MAX_STEPS, steps)
    fitting = min(2**22 // nodes, MAX_STEPS)  # 32 bytes for each node and substep
    return min(16 * max(1, round(steps**0.5 / 16), fitting // 16), MAX_STEPS, steps)


def why_not(fused: FusedTotal, state: MPMState, forces: Sequence[Force]) -> str | None:
    """Return the reason why gradients of a rollout need torch's autograd; None if the kernels compute them."""
    bound = fused.bound
    points = bound.body.points
    if not fused.plain or fused.touching is not None:
        return "boundaries other than pins that hold all the time, and contact, have no backward kernels"
    if fused.bent:
        return "sheets of one layer that bend have no backward kernels"
    if fused.virtual:
        return "virtual nodes have no backward kernels"
    if any(derivative is None for derivative in fused.laws.adjoints):
        return "a law has no backward kernel (`LawFunctions.adjoint`)"
    twin = forces[0].twin() if forces else None
    if len(forces) > 1 or (forces and twin is None):
        return "only one force with a Triton twin has a backward kernel"
    if twin is not None and twin.adjoint is None:
        return f"this {type(forces[0]).__name__} has no backward kernel"
    free = [points.mass, points.volume, points.youngs_modulus, points.poisson_ratio]
    fixed = [t for t in bound.body.tensors() if not any(t is other for other in free)]
    fixed += [] if twin is None else [t for t in tensors_of(forces) if any(t is source for source in twin.sources)]
    fixed += [t for law in points.laws for t in (*law.parameters(), *law.buffers())]
    if any(t.requires_grad for t in fixed):
        return "a gradient by rest positions, patches, boundaries or numbers of a law needs torch"
    nodal = (state.node_displacement, state.node_velocity)
    if any(t is not None and t.requires_grad for t in nodal):
        return None if not any(_own(t, nodal) for t in state.tensors()) else "particle fields are inputs of their own"
    if any(t.requires_grad for t in state.tensors()):
        return "particle fields require gradients, but the nodal ones do not"
    return None


def _twin(force: Force) -> Twin:
    twin = force.twin()
    assert twin is not None
    return twin


def _own(tensor: Tensor, nodal: tuple[Tensor | None, ...]) -> bool:
    """True if a field of particles is a leaf that requires a gradient, and not a nodal field."""
    return tensor.requires_grad and tensor.is_leaf and not any(tensor is t for t in nodal)


class DifferentiableTotal(FusedTotal):
    """A :class:`FusedTotal` whose rollouts have gradients in kernels."""

    def __init__(self, bound: Formulation) -> None:
        super().__init__(bound)
        self._adjoint: TotalAdjoint | None = None

    def adjoint(self, state: MPMState, forces: Sequence[Force]) -> tuple[Adjoint | None, str]:
        """The rollouts with gradients, or None and why there are none."""
        why = why_not(self, state, forces)
        if why is not None:
            return None, why
        if self._adjoint is None:
            with torch.inference_mode(False), torch.no_grad():
                self._adjoint = TotalAdjoint(self)
        return self._adjoint, ""
