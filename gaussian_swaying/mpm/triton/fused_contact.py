"""Runs contact in the substep of ``total`` with its kernels; the lists are made in torch, from time to time."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gaussian_swaying.mpm.contact.solve import PUSH, PUSH_CELLS, SLACK
from gaussian_swaying.mpm.contact.stage import AHEAD, ARM, TOLERANCE, ContactStage, Lists
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.triton import contact_kernels as kernels
from gaussian_swaying.mpm.triton import obstacle_kernels
from gaussian_swaying.mpm.triton.obstacles import Solids
from gaussian_swaying.mpm.triton.obstacles import known as is_known

if TYPE_CHECKING:
    from gaussian_swaying.mpm.formulations.total import Total

FEWEST, MOST = 4, 64
"""Fewest iterations of a substep; most substeps between two looks at the lists."""

LEAST_ROOM = 256
"""Least room of a list."""

BLOCK = 16
"""Places of a program."""


@dataclass(frozen=True, slots=True)
class Buffers:
    """Lists and constraints with room for more; an index of -1 stands for nothing.

    Attributes:
        place: The listed places, shape (A,), int32.
        first: Rows of the first places: of the pairs, then of the places near each obstacle, shape (K,), int32.
        second: Rows of the second places, -1 for an obstacle, shape (K,), int32.
        near: For each obstacle, the part of ``first`` with the places near it.
        position, normal, moving, impulse: Of the places, shape (A, 3).
        count, mobility: Of the places, shape (A,).
        facing, drive, applied, found: Of the constraints, shape (K, 3).
        gap, valid, friction: Of the constraints, shape (K,).
        pairs: Room for pairs.
    """

    place: Tensor
    first: Tensor
    second: Tensor
    near: list[slice]
    position: Tensor
    normal: Tensor
    moving: Tensor
    impulse: Tensor
    count: Tensor
    mobility: Tensor
    facing: Tensor
    drive: Tensor
    applied: Tensor
    found: Tensor
    gap: Tensor
    valid: Tensor
    friction: Tensor
    pairs: int

    @property
    def room(self) -> tuple[int, ...]:
        """Sizes of its lists."""
        return (len(self.place), self.pairs, *(part.stop - part.start for part in self.near))


def room_for(entries: int) -> int:
    """Room for some entries, a power of two."""
    return max(LEAST_ROOM, 1 << max(entries - 1, 0).bit_length())


class FusedContact:
    """Contact of a body with buffers that stay where they are, so that substeps can be recorded.

    Args:
        bound: The formulation, bound to its material, with a contact.
        fields: Displacement and velocity of the nodes, shape (nodes, 8), which the kernels change.

    Attributes:
        every: Substeps until the lists must be looked at again.
        rounds: Iterations in each substep.
    """

    def __init__(self, bound: Total, fields: Tensor) -> None:
        assert bound.contact is not None
        stage = bound.contact
        self.stage: ContactStage = stage
        self.fields = fields
        surface = stage.surface
        self.rest, self.facing = surface.place.contiguous(), surface.normal.contiguous()
        self.radius, self.thickness = surface.radius.contiguous(), surface.thickness.contiguous()
        self.node, self.weight = stage.node.int().contiguous(), stage.weight.contiguous()
        self.inverse = (stage.weight * stage.inverse_mass[stage.node]).contiguous()
        self.slope = stage.slope.contiguous()
        self.total = torch.zeros(len(fields), device=fields.device)
        most = stage.iterations
        self.theta = torch.ones(most + 2, device=fields.device)
        self.turned = torch.zeros(most + 2, device=fields.device)
        self.rounds, self.every = min(2 * FEWEST, most), 1
        self.buffers: Buffers | None = None
        self._lists: Lists | None = None
        touched = [obstacle for _, obstacle in stage.obstacles if is_known(obstacle)]
        self.solids = Solids([(obstacle, 0) for obstacle in touched], fields.device, steps=1)
        self.numbers = [touched.index(o) if is_known(o) else None for _, o in stage.obstacles]
        """Which of the solids each obstacle is; None for one that runs in torch."""
        self.late = 0
        """How often points moved farther between two looks than the lists allow."""

    @property
    def key(self) -> tuple[object, ...]:
        """What recorded substeps depend on."""
        buffers = self.buffers
        return () if buffers is None else (self.rounds, buffers.place.data_ptr(), *buffers.room)

    def look(self, state: MPMState, dt: float) -> None:
        """Bring the lists, the iterations and the time of the next look up to date; the host waits.

        Args:
            state: The state of the particles now, with the displacement of the nodes.
            dt: Substep [s].
        """
        stage = self.stage
        self.solids.take()
        position, velocity = state.position.reshape(-1, 3), state.velocity.reshape(-1, 3)
        known = self._lists
        if known is not None:
            far = float((position - known.before).square().sum(-1).amax()) ** 0.5
            if 2 * ARM * far > known.margin * (1 + 1e-6):
                self.late += 1
                if self.late == 1:
                    warnings.warn(
                        "Points moved farther than contact had looked ahead, so some may have passed through each "
                        "other: lower `solver.cfl`.",
                        stacklevel=2,
                    )
            self._adapt(dt)
        stage.update(state, dt, MOST / 4)
        lists = stage.lists
        if lists is None:
            self.every = 1
            return
        if lists is not self._lists:
            self._take(lists)
        step = dt * float(velocity.square().sum(-1).amax()) ** 0.5
        left = lists.margin
        if known is lists:
            left -= 2 * ARM * float((position - lists.before).square().sum(-1).amax()) ** 0.5
        ahead = left / max(1.5 * (2 * ARM * step + lists.fastest * dt), 1e-30)
        self.every = max(1, min(MOST, math.floor(min(ahead, MOST)) - int(AHEAD)))

    def _adapt(self, dt: float) -> None:
        """Change the number of iterations if the last substep violated a constraint by much, or by little."""
        held = self.buffers
        if held is None or len(held.first) == 0:
            return
        self._read(held)
        first, second = held.first.long(), held.second.long()
        other = torch.where((second >= 0)[:, None], held.moving[second.clamp(min=0)], 0.0)
        along = ((held.moving[first.clamp(min=0)] - other - held.drive) * held.facing).sum(-1)
        overlap = (-held.gap * PUSH).clamp(max=PUSH_CELLS * self.stage.dx)
        lacking = torch.where(held.gap > 0, -held.gap, overlap) - dt * along
        worst = float(torch.where((held.valid > 0) & (first >= 0), lacking, 0.0).amax())
        tolerance = TOLERANCE * self.stage.dx
        if worst > tolerance:
            self.rounds = min(2 * self.rounds, self.stage.iterations)
        elif worst < 0.1 * tolerance:
            self.rounds = max(self.rounds // 2, min(FEWEST, self.stage.iterations))

    def _take(self, lists: Lists) -> None:
        """Fill the buffers with new lists; make larger ones if needed."""
        self._lists = lists
        sizes = (len(lists.place), len(lists.first), *map(len, lists.walls))
        held = self.buffers
        if held is None or any(size > room for size, room in zip(sizes, held.room, strict=True)):
            held = self.buffers = self._make([room_for(size) for size in sizes])
        held.place.fill_(-1)
        held.first.fill_(-1)
        held.second.fill_(-1)
        held.valid.zero_()
        held.place[: sizes[0]] = lists.place.int()
        held.first[: sizes[1]] = lists.first.int()
        held.second[: sizes[1]] = lists.second.int()
        for part, near in zip(held.near, lists.walls, strict=True):
            held.first[part.start : part.start + len(near)] = near.int()

    def _make(self, room: list[int]) -> Buffers:
        device, stage = self.fields.device, self.stage
        places, pairs, *walls = room
        ends = [pairs + sum(walls[: k + 1]) for k in range(len(walls))]
        near = [slice(end - size, end) for end, size in zip(ends, walls, strict=True)]
        held = pairs + sum(walls)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        friction = zeros(held)
        if stage.contact is not None:
            friction[:pairs] = stage.contact.friction
        for part, (_, obstacle) in zip(near, stage.obstacles, strict=True):
            friction[part] = obstacle.friction
        whole = {"dtype": torch.int32}
        return Buffers(
            place=zeros(places, **whole),
            first=zeros(held, **whole),
            second=zeros(held, **whole),
            near=near,
            **{name: zeros(places, 3) for name in ("position", "normal", "moving", "impulse")},
            **{name: zeros(places) for name in ("count", "mobility")},
            **{name: zeros(held, 3) for name in ("facing", "drive", "applied", "found")},
            **{name: zeros(held) for name in ("gap", "valid")},
            friction=friction,
            pairs=pairs,
        )

    def _read(self, held: Buffers) -> None:
        rows = len(held.place)
        kernels.contact_read[(-(-rows // BLOCK),)](
            held.place, self.node, self.weight, held.count, self.fields, held.moving, rows, BLOCK=BLOCK, num_warps=4
        )

    def apply(self, schedule: Tensor, first_step: Tensor, offset: int, time: Tensor, dt: Tensor, taken: Tensor) -> None:
        """Change the velocities of the nodes by the impulses of a substep; can be recorded.

        Args:
            schedule: Times of the substeps.
            first_step: Number of the first substep.
            offset: Number of this one after it.
            time: Time now [s], scalar float64 tensor.
            dt: Substep [s], scalar float64 tensor.
            taken: What each boundary took [N s], shape (scenes, B, 3), float64; it is added to.
        """
        held, stage = self.buffers, self.stage
        if held is None:
            return
        places, constraints, block, wide = len(held.place), len(held.first), BLOCK, 128
        each, all_of = (-(-places // block),), (-(-constraints // wide),)
        kernels.contact_places[each](
            held.place, self.rest, self.facing, self.node, self.weight, self.slope, self.fields, held.position,
            held.normal, held.moving, held.count, held.impulse, places, NORMALS=stage.contact is not None, BLOCK=block,
            num_warps=4,
        )  # fmt: skip
        if stage.contact is not None:
            kernels.contact_pairs[(-(-held.pairs // wide),)](
                held.first, held.second, held.place, self.radius, self.thickness, held.position, held.normal,
                held.facing, held.gap, held.valid, held.pairs, BLOCK=wide, num_warps=4,
            )  # fmt: skip
        self.solids.prepare(time, dt, 1)
        for part, number, (_, obstacle) in zip(held.near, self.numbers, stage.obstacles, strict=True):
            if number is not None:
                solids = self.solids
                row_of, whole, window, pose, grids = solids.of(number)
                obstacle_kernels.obstacle_places[(-(-(part.stop - part.start) // wide),)](
                    held.first[part], held.place, held.position, self.thickness, held.gap[part], held.facing[part],
                    held.drive[part], held.valid[part], part.stop - part.start, row_of, whole, window, pose, grids,
                    time, KIND=solids.kinds[number], MOVES=solids.moves[number], BLOCK=wide, num_warps=4,
                )  # fmt: skip
                continue
            row = held.first[part].long()
            real, row = row >= 0, row.clamp(min=0)
            gap, normal, drive = obstacle.touch(held.position[row], time, dt)
            half = 0.5 * self.thickness[held.place[row].long().clamp(min=0)]
            held.gap[part].copy_(gap - half)
            held.facing[part].copy_(normal)
            held.drive[part].copy_(drive)
            held.valid[part].copy_(real & obstacle.active(time))
        now = (schedule, first_step, offset)
        kernels.contact_acting[all_of](
            held.first, held.second, held.moving, held.drive, held.facing, held.gap, held.valid, held.applied,
            held.found, held.count, *now, SLACK * stage.dx, constraints, BLOCK=wide, num_warps=4,
        )  # fmt: skip
        self.total.zero_()
        self.turned.zero_()
        kernels.contact_spread[each](
            held.place, self.node, self.inverse, held.count, self.total, places, BLOCK=block, num_warps=4
        )
        kernels.contact_mobility[each](
            held.place, self.node, self.weight, held.count, self.total, held.mobility, places, BLOCK=block, num_warps=4
        )
        for k in range(self.rounds):
            if k > 0:
                self._read(held)
            kernels.contact_impulses[all_of](
                held.first, held.second, held.moving, held.drive, held.facing, held.gap, held.friction, held.valid,
                held.mobility, held.applied, held.found, held.impulse, self.theta, self.turned, *now, PUSH,
                PUSH_CELLS * stage.dx, constraints, k, LAST=k == self.rounds - 1, BLOCK=wide, num_warps=4,
            )  # fmt: skip
            kernels.contact_push[each](
                held.place, self.node, self.inverse, held.count, held.impulse, self.fields, places, BLOCK=block,
                num_warps=4,
            )  # fmt: skip
        for part, (k, _) in zip(held.near, stage.obstacles, strict=True):
            pressed = torch.where((held.valid[part] > 0)[:, None], held.found[part], 0.0)
            if stage.scenes == 1:
                taken[0, k] -= pressed.sum(0, dtype=torch.float64)
            else:
                scene = stage.scene[held.place[held.first[part].long().clamp(min=0)].long().clamp(min=0)]
                taken[:, k].index_add_(0, scene, -pressed.double())
