r"""Contact of the surface with obstacles and with itself, in the ``total`` formulation.

A contact sample (``place`` in the code) is a row :math:`w` of constant weights on the nodes, of mass :math:`m_i`: it is
at :math:`X + \sum_i w_i u_i` and moves with :math:`\sum_i w_i v_i`. An impulse :math:`j` at it changes the nodes by
:math:`w_i j / m_i`. A constraint :math:`k` has a normal :math:`n`, a gap :math:`d` and two samples, or one sample and
an obstacle. Its relative velocity along the normal after the substep must satisfy

.. math:: v_n \ge -d / \Delta t \quad (d > 0), \qquad v_n \ge \min(0.01\,|d| / \Delta t,\; 0.004\,\Delta x / \Delta t)
          \quad (d \le 0),

so that a gap closes at most to zero within a substep, and an overlap is removed in some substeps, at no more than one
per cent of the wave speed (the substep is 0.4 of the time in which a wave crosses a cell). The impulse only pushes
(:math:`\lambda \ge 0`), and Coulomb's friction is at most :math:`\mu\lambda` against the sliding velocity.

The impulses are found by Jacobi's iteration, all at once, with Nesterov's momentum (Mazhar et al. 2015, "Using
Nesterov's method to accelerate multibody dynamics with friction and contact"), so that a pile of n layers takes of
order n iterations. The step of a constraint is one over the sum of the absolute values of its row in
:math:`A = J M^{-1} J^T`, so the iteration cannot overshoot (Gershgorin): for a lone sample it is the mass that the
sample really has, and for a whole area in contact the mass of the area. With :math:`c` constraints at each sample the
sum is bounded by :math:`\sum_i |w_i| s_i / m_i`, :math:`s_i = \sum |w_i| c`, without forming A.

Two samples touch if one lies above the disc of the other. With :math:`a` the way from one to the other, the normal is
:math:`\sum (a \cdot n)\,n` over the discs above which the other lies, normalised: it needs no orientation of
the normals :math:`n`, and for an edge that meets a face it is the normal of the face. Kernels do all this
(:mod:`~gaussian_swaying.mpm.contact_kernels`).

Friction that sticks yields a little: with step :math:`\alpha` and friction :math:`j_t` it leaves the slip
:math:`v_t = -c\,j_t / \alpha`, c = ``CREEP`` (Todorov 2014, "Convex and analytically-invertible dynamics with contacts
and constraints", regularises friction so). The iterations are never finished, and with momentum they overshoot: k of
them leave the share :math:`r_k(\lambda)` of the slip of a mode that one step reduces by :math:`\lambda`. Where it is
negative, friction has pushed the material instead of holding it, in every substep again. What is left with c is
:math:`(c + \lambda\,r_k(\lambda + c)) / (c + \lambda)`. From c = 0.01 on it is nowhere negative, after any number of
iterations.

The two samples of a pair get opposite impulses, so momentum is conserved to round-off; angular momentum up to the
torque of an impulse times the shift of the two samples along the surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape
from gaussian_swaying._fixed import fixed
from gaussian_swaying.kernels.language import INTERPRETED
from gaussian_swaying.kernels.launch import MAX_INDEX, lanes, launch
from gaussian_swaying.mpm import contact_kernels as kernels
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.device_functions import DeviceFunction, Packed
from gaussian_swaying.mpm.forces import MOST_STEPS
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints
from gaussian_swaying.mpm.transfer import bspline_stencil
from gaussian_swaying.mpm.virtual_nodes import coordinates, point_with_nodes

MOST_ITERATIONS = 100
"""For the impulses of a substep: two or three are made where sheets touch, and 16 are enough for a pile of eight."""

APART = 2.0
"""Samples closer than this at rest [cells] are neighbours: they share nodes, and a fold cannot be sharper."""


@fixed
@dataclass(frozen=True)
class Contact:
    """Contact of the material with itself: between the layers of a sheet, and between objects.

    It cannot be changed, as the surface keeps the thickness that it was made with: make another simulation.

    Args:
        thickness: Distance that two surfaces keep [m]; null for the thickness of the material at each place. Obstacles
            are kept at half of it.
        friction: Coulomb coefficient.

    Raises:
        ValueError: If a number is out of range.
    """

    thickness: float | None = None
    friction: float = 0.3

    def __post_init__(self) -> None:
        if self.thickness is not None:
            check_positive("contact.thickness", self.thickness)
        check_positive("contact.friction", self.friction, allow_zero=True)


@dataclass(frozen=True, slots=True)
class Surface:
    """Contact samples of the surface, which touch obstacles and each other: discs around them cover it.

    Attributes:
        place: Rest positions [m], shape (C, 3).
        normal: Unit normals at rest, of either sign, shape (C, 3).
        radius: Radii of the discs [m], shape (C,).
        thickness: Distance that two surfaces keep [m], shape (C,).
        read: Rest position at which the motion of each is interpolated [m], shape (C, 3): the sample itself, or one
            close to it if some of its nodes have no mass.
        contact: Contact of the surface with itself; None if only obstacles count.
        near: The material point that each belongs to, shape (C,); the nearest one if None.
    """

    place: Tensor
    normal: Tensor
    radius: Tensor
    thickness: Tensor
    read: Tensor
    contact: Contact | None = None
    near: Tensor | None = None

    def __post_init__(self) -> None:
        check_shape("place", self.place, "C", 3)
        for name in ("normal", "read"):
            check_shape(name, getattr(self, name), len(self.place), 3)
        for name in ("radius", "thickness"):
            check_shape(name, getattr(self, name), len(self.place))

    @classmethod
    def of_points(
        cls,
        points: MaterialPoints,
        normal: Tensor | None = None,
        spacing: float = 0.0,
        thickness: float = 0.0,
        contact: Contact | None = None,
    ) -> Surface:
        """The material points as a surface.

        Args:
            normal: Normals of the sheet at its points, shape (P, 3); needed for contact with itself.
            spacing: Distance of neighbouring points [m]; discs reach 0.75 of it.
            thickness: Distance that two surfaces keep [m], unless ``contact`` has one.
        """
        place = points.position.detach().reshape(-1, 3)
        if contact is not None and (normal is None or spacing <= 0 or points.position.dim() > 2):
            raise ValueError(
                "Contact of a surface with itself needs one scene, and `normal` and `spacing` of its points."
            )
        h = thickness if contact is None or contact.thickness is None else contact.thickness
        full = place.new_full((len(place),), 1.0)
        facing = torch.zeros_like(place) if normal is None else normal.to(place)
        own = torch.arange(points.count, device=place.device).repeat(len(place) // points.count)
        return cls(place, facing, 0.75 * spacing * full, h * full, place, contact, own)

    def map(self, function: Callable[[Tensor], Tensor]) -> Surface:
        place, normal, read = (function(field) for field in (self.place, self.normal, self.read))
        near = None if self.near is None else self.near.to(place.device)
        return Surface(place, normal, function(self.radius), function(self.thickness), read, self.contact, near)


class ContactStage:
    """The contact samples of a body on its grid.

    Args:
        surface: The contact samples.
        boundaries: The boundaries of the body; those that are obstacles act here.
        kinds: Kind of each boundary (``Boundary.hold_kind``).
        grid: The nodes.
        inverse_mass: Their inverse mass [1/kg], 0 for a node without mass, shape (..., G).
        points: With virtual nodes, the first node of the cell of each material point and its nodes, over all scenes.

    Raises:
        ValueError: If a sample has no material.
    """

    def __init__(
        self,
        surface: Surface,
        boundaries: Sequence[Boundary],
        kinds: Sequence[str],
        grid: GridSpec,
        inverse_mass: Tensor,
        points: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self.surface, self.contact, self.grid, self.dx = surface, surface.contact, grid, grid.dx
        self.obstacles = [(k, b) for k, b in enumerate(boundaries) if kinds[k] == "surface" and isinstance(b, Obstacle)]
        self.iterations = MOST_ITERATIONS
        self.inverse_mass = inverse_mass.detach().reshape(-1)
        self.scenes = len(self.inverse_mass) // grid.node_count
        each = len(surface.place) // self.scenes
        read = surface.read.reshape(self.scenes, each, 3) if self.scenes > 1 else surface.read
        stencil = bspline_stencil(read, grid, False, torch.finfo(read.dtype).eps ** 0.5)
        if not bool(stencil.inside.all()):
            raise ValueError("A contact sample lies outside the material: give samples on the simulated points.")
        basis = stencil.basis  # (C, 4, 27)
        self.node = stencil.node
        self.corner: Tensor | None = None
        if points is not None:
            self.node = self._nodes(stencil.first, *points)
            self.corner = coordinates(stencil.first % grid.node_count, grid)
        self.first, self.fraction = stencil.first, stencil.fraction
        self.weight = basis[:, 0] + ((surface.place - surface.read)[:, :, None] * basis[:, 1:4]).sum(1)
        self.reach = self.apart = 0.0
        if self.contact is not None:
            widest, thickest = float(surface.radius.amax()), float(surface.thickness.amax())
            self.reach = math.hypot(widest, thickest)
            self.apart = max(APART * self.dx, 3 * thickest)

    def _nodes(self, first: Tensor, point_first: Tensor, point_node: Tensor) -> Tensor:
        near, many = self.surface.near, len(point_first) // self.scenes
        if near is None:
            raise ValueError("Contact of a body with `attached` parts needs `near` in its Surface.")
        number = torch.arange(self.scenes).repeat_interleave(len(first) // self.scenes)
        belongs = near.cpu() + many * number
        host = point_with_nodes(first.cpu(), belongs, point_first.cpu(), point_node.cpu(), self.grid)
        if bool((host < 0).any()):
            k = int((host < 0).int().argmax())
            raise ValueError(f"The contact sample {k} lies in a cell without material of its piece: move its `read`.")
        return point_node.T[host.to(point_node.device)]


ROOM, SLOTS = 64, 16
"""Initial number of entries for the candidates of a contact sample, and for its constraints."""

MOST_ENTRIES = MAX_INDEX // 2
"""Most entries of a buffer of candidates or constraints."""

PUSH, PUSH_CELLS = 0.01, 0.004
"""Share of an overlap that a substep removes, and the most of it [cells]."""

SLACK = 0.02
"""Gap up to which a constraint counts as acting [cells]."""

TOLERANCE = 5e-5
"""Violation of a constraint within a substep at which the impulses are good enough [cells]."""

REACHES, SURE, LONGEST = 3.0, 1.5, 64
"""Least margin of the lists, in reaches of a contact; motion for which they are made, relative to that of the rollout
before; most substeps for which they are used."""

BLOCK, TALL = 64, 16
"""Samples, and nodes, of a program at a time: small ones, so that few places in contact keep many programs busy."""

WIDE, WIDE_SEARCH = 8, 4
"""Candidates of a contact sample that are tested together, in a substep and when lists are made (8 there would spill).
"""

PER_PROCESSOR = 8
"""Programs on each multiprocessor; all of them must run at once."""

LIGHT = 0.01
"""A node of a smaller weight hardly moves any sample, however far it moves itself: see :func:`_carries`."""

_LAUNCH: dict[str, Any] = {"num_warps": 2, "maxnreg": 128}


class ContactRun:
    """Contact of a body with buffers at fixed addresses, so that substeps can be recorded.

    If the buffers were too small, or the nodes moved farther than the lists are good for, :meth:`fits` finds that after
    the rollout, and the next one has larger buffers, or makes lists more often.

    Args:
        stage: The contact of the body.
        fields: Displacement and velocity of the nodes, shape (nodes, 8), which the kernels change.
        active: The nodes that have mass, int32.

    Attributes:
        room: Number of entries for the candidates of each sample.
        slots: Number of entries for the constraints of each sample.
        margin: Distance beyond contact within which pairs are listed [m].
        interval: Substeps after which lists are made again.
        used: Most substeps for which they are used in this rollout.
    """

    def __init__(self, stage: ContactStage, fields: Tensor, active: Tensor) -> None:
        self.stage = stage
        self.fields, self.active, self.device = fields, active, fields.device
        surface = stage.surface
        self.places = len(surface.place)
        self.position = torch.zeros_like(surface.place)
        self.rest, self.facing = surface.place.T.contiguous(), surface.normal.T.contiguous()
        self.radius, self.thickness = surface.radius.contiguous(), surface.thickness.contiguous()
        self.virtual, self.fraction = stage.corner is not None, stage.fraction.contiguous()
        self.base = (stage.node.T if self.virtual else stage.first).int().contiguous()
        self.corner = self.base if stage.corner is None else stage.corner.T.int().contiguous()
        arm = surface.place - surface.read
        self.arms = bool((arm != 0).any())
        self.arm = arm.T.contiguous()
        # all weights of a node are together, in the order of the samples
        real = stage.inverse_mass[stage.node] > 0
        node, order = stage.node[real].sort(stable=True)
        self.touched, sizes = (part.int() for part in torch.unique_consecutive(node, return_counts=True))
        ends = sizes.cumsum(0)
        self.entry_start = torch.cat([ends.new_zeros(1), ends]).int()
        self.entry_place = real.nonzero()[:, 0][order].int()
        self.entry_weight = (stage.weight * stage.inverse_mass[stage.node])[real][order].contiguous()
        self.carries = _carries(stage.node, stage.weight, len(fields))[active.long()]
        many, walls = self.places, len(stage.obstacles)
        self.walls = walls
        whole: dict[str, Any] = {"dtype": torch.int32}
        self.before, self.motion = self._zeros(len(active), 3), self._zeros(1)
        self.last = (1 << max(many - 1, 0).bit_length()) - 1
        self.table = torch.arange(self.last + int(kernels.COLUMNS.value) + 2, device=self.device).int()
        self.hashes, self.order, self.near, self.many = (self._zeros(many, **whole) for _ in range(4))
        self.start, self.low, self.limit = torch.zeros_like(self.table), self._zeros(3), self._zeros(1)
        self.cells, self.ordered = self._zeros(4, many), self._zeros(4, many)
        self.total = self._zeros(len(fields))
        self.row, self.moving, self.impulse = self._zeros(many, 8), self._zeros(many, 4), self._zeros(many, 8)
        self.peak = self._zeros(4, int(kernels.MOST_PROGRAMS.value))
        self.gate, self.status = self._zeros(1, **whole), self._zeros(8, **whole)
        self.interval, self.used = 4, 1
        self._take_margin(0.0)
        self.wall_gap, self.wall_valid = self._zeros(max(walls, 1), many), self._zeros(max(walls, 1), many)
        self.wall_normal, self.wall_drive = self._zeros(max(walls, 1), many, 3), self._zeros(max(walls, 1), many, 3)
        self.pressed = self._zeros(max(walls, 1), many, 3)
        self.pressed_sum = self._zeros(max(walls, 1), many, 3, dtype=torch.float64)
        self.marked = self._zeros(len(fields), **whole)
        self.within = self.status[int(kernels.WITHIN.value)]
        self.friction = fields.new_tensor([float(b.friction) for _, b in stage.obstacles] or [0.0])
        windows = [obstacle.window for _, obstacle in stage.obstacles]
        self.windows = torch.tensor(windows, dtype=torch.float64, device=self.device)
        like: dict[str, Any] = {"dtype": fields.dtype, "device": self.device}
        functions = [obstacle.device_function() for _, obstacle in stage.obstacles]
        self.solids: list[tuple[Packed, list[DeviceFunction]] | None] = [
            None if one is None else (Packed(torch.Size([1]), like, fixed=True), [one]) for one in functions
        ]
        """For each obstacle its numbers; None for one that runs in torch."""
        self.programs = self._programs()
        self.take_room(*((ROOM, SLOTS) if stage.contact is not None else (1, walls)))

    def _zeros(self, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        return torch.zeros(shape, dtype=dtype or self.fields.dtype, device=self.device)

    def _programs(self) -> int:
        if INTERPRETED or self.device.type != "cuda":
            return 1
        room = PER_PROCESSOR * torch.cuda.get_device_properties(self.device).multi_processor_count
        needed = max(-(-max(self.places, len(self.active)) // BLOCK), -(-len(self.touched) // TALL))
        return max(1, min(room, needed, int(kernels.MOST_PROGRAMS.value)))

    def take_room(self, room: int, slots: int) -> None:
        """Allocate the buffers whose size depends on crowding; if that fails, keep the old ones."""
        places, planes = self.places, int(kernels.PLANES.value)
        for needed in (kernels.NEEDED_ROOM, kernels.NEEDED_SLOTS):
            self.status[int(needed.value)] = 0  # what a refused rollout needed says nothing about the next one
        if max(room, planes * slots) * places > MOST_ENTRIES:
            raise ValueError(
                f"A contact sample is close to {max(room, slots):,} others: the material has collapsed; lower "
                "`contact.thickness`, or coarsen `solver.dx`."
            )
        self.room, self.slots = room, slots
        self.candidates = self._zeros(places, self.room, dtype=torch.int32)
        self.other = self._zeros(self.slots, places, dtype=torch.int32)
        self.data = self._zeros(planes, self.slots, places)

    def _take_margin(self, margin: float) -> None:
        self.margin = max(REACHES * self.stage.reach, margin)
        self.limit.fill_(self.stage.reach + SLACK * self.stage.dx + self.margin)

    @property
    def key(self) -> tuple[object, ...]:
        return (self.room, self.slots, self.data.data_ptr(), self.candidates.data_ptr())

    @property
    def pairs(self) -> int:
        """Pairs that are listed; the host waits."""
        return int(self.status[int(kernels.LISTED.value)]) // 2

    @property
    def rounds(self) -> int:
        """Iterations of all substeps so far; the host waits."""
        return int(self.status[int(kernels.ROUNDS.value)])

    def fits(self) -> bool:
        """True if lists were complete and buffers large enough since :meth:`take`; if not, enlarge them (host waits).

        Lists are made for the motion of the substeps before, and a bit more.
        """
        if self.stage.contact is None:  # the room is exact
            return True
        _, room, slots, *_ = self.status.tolist()
        moved, fits = float(self.motion), True
        if moved < 1e9:  # a run that diverges is not repeated
            fits, step = moved <= self.margin, SURE * max(moved / self.used, 1e-9)
            self._take_margin(step)
            self.interval = min(LONGEST, int(self.margin / step))
        if room <= self.room and slots <= self.slots:
            return fits
        self.take_room(max(self.room, 1 << (room - 1).bit_length()), max(self.slots, 1 << (slots - 1).bit_length()))
        return False

    def due(self, steps: int) -> range:
        self.used = min(steps, self.interval)
        return range(0, steps if self.stage.contact is not None and self.places else 0, self.interval)

    def make_lists(self, _: int = 1) -> None:
        """List candidate pairs, valid until a node moves by half the margin; recordable."""
        stage, places, block = self.stage, self.places, lanes(self.device, BLOCK, 1)
        self._read()
        self.low.copy_(self.position.amin(0))
        self.status[int(kernels.LISTED.value)].zero_()
        every, one = max(places, len(self.active)), lanes(self.device, BLOCK)
        launch(kernels.contact_cells, (-(-every // one),))(
            self.fields, self.active, len(self.active), self.before, self.position, self.low, self.limit, self.cells,
            self.hashes, places, self.last, BLOCK=one, num_warps=2,
        )  # fmt: skip
        cells, order = self.hashes.sort(stable=True)
        self.order.copy_(order)
        torch.index_select(self.cells, 1, order, out=self.ordered)
        torch.searchsorted(cells, self.table, out_int32=True, out=self.start)
        launch(kernels.contact_lists, (-(-places // block),))(
            self.position, self.rest, self.base, self.corner, self.low, self.limit, self.start, self.order,
            self.ordered, self.candidates, self.near, self.many, self.impulse, self.status, places, self.room,
            stage.apart, stage.reach, self.last, VIRTUAL=self.virtual, BLOCK=block,
            WIDE=lanes(self.device, WIDE_SEARCH), **_LAUNCH,
        )  # fmt: skip

    def _read(self) -> None:
        stage, block = self.stage, lanes(self.device, BLOCK, 1)
        _, ny, nz = stage.grid.resolution
        launch(kernels.contact_positions, (-(-self.places // block),))(
            self.fields, self.base, self.fraction, self.arm, self.rest, self.places, self.position, self.moving,
            self.status, ny * nz, nz, 1 / stage.dx, ARMS=self.arms, VIRTUAL=self.virtual, BLOCK=block, num_warps=4,
        )  # fmt: skip

    def take(self, time: Tensor, dt: Tensor, steps: int) -> None:
        """Begin a rollout: bring the tables of the obstacles up to date; not recorded.

        Args:
            time: Time at its start [s], scalar float64 tensor.
            dt: Substep [s], scalar float64 tensor.
        """
        self.motion.zero_()
        for solid in self.solids:
            if solid is not None:
                solid[0].take(solid[1], MOST_STEPS)
                solid[0].begin(time, dt, steps)

    def add_taken(self, taken: Tensor) -> None:
        """Add what each boundary took since ``pressed_sum`` was zero [N s], to (scenes, B, 3), float64."""
        scenes = self.stage.scenes
        for k, (number, _) in enumerate(self.stage.obstacles):
            taken[:, number] -= self.pressed_sum[k].view(scenes, self.places // scenes, 3).sum(1)

    def apply(self, schedule: Tensor, first_step: Tensor, offset: int, time: Tensor, dt: Tensor) -> None:
        """Change the velocities of the nodes by the impulses of a substep; can be recorded.

        Args:
            time: Time now [s], scalar float64 tensor.
            dt: Substep [s], scalar float64 tensor.
        """
        stage = self.stage
        if self.places == 0:
            return
        pairs, walls, dx = stage.contact is not None, self.walls, stage.dx
        _, ny, nz = stage.grid.resolution
        strides = (ny * nz, nz, 1 / dx)
        now = (schedule, first_step, offset, *strides)
        where = (self.fields, self.base, self.fraction, self.arm, self.rest)
        block, one = lanes(self.device, BLOCK, 1), lanes(self.device, BLOCK)
        options: dict[str, Any] = {
            "ARMS": self.arms, "VIRTUAL": self.virtual, "BLOCK": block, "TALL": lanes(self.device, TALL, 1), **_LAUNCH
        }  # fmt: skip
        if self.programs > 1:
            options["launch_cooperative_grid"] = True
        if walls:
            self._read()
            for k, (solid, (_, obstacle)) in enumerate(zip(self.solids, stage.obstacles, strict=True)):
                if solid is not None:
                    packed = solid[0]
                    launch(kernels.obstacle_places, (-(-self.places // one),))(
                        self.position, self.moving, self.thickness, self.wall_gap[k], self.wall_normal[k],
                        self.wall_drive[k], self.wall_valid[k], self.within, self.places, self.windows[k],
                        packed.buffer, packed.rows, time, dt, SLACK * dx, first_step, offset,
                        SOLIDS=packed.layout, BLOCK=one, num_warps=4,
                    )  # fmt: skip
                    continue
                gap, normal, drive = obstacle.touch(self.position, time, dt)
                self.wall_gap[k].copy_(gap - 0.5 * self.thickness)
                self.wall_normal[k].copy_(normal)
                self.wall_drive[k].copy_(drive)
                self.wall_valid[k].copy_(obstacle.active(time).expand(self.places))
                self.within.fill_(1)
        launch(kernels.contact_solve, (self.programs,))(
            *where, self.facing, self.radius, self.thickness, self.places, self.candidates, self.near, self.room,
            self.wall_gap, self.wall_normal, self.wall_drive, self.wall_valid, self.friction, self.pressed,
            self.pressed_sum, self.row, self.moving, self.many, self.other, self.data, self.slots, self.impulse,
            self.touched, self.entry_start, self.entry_place, self.entry_weight, self.marked, self.total,
            len(self.touched), self.active, self.carries, self.before, len(self.active), self.motion, self.peak,
            self.gate, self.status, *now, stage.reach, SLACK * dx, PUSH,
            PUSH_CELLS * dx, TOLERANCE * dx, 0.0 if stage.contact is None else stage.contact.friction,
            stage.iterations, PAIRS=pairs, WALLS=walls, WIDE=WIDE, **options,
        )  # fmt: skip


def _carries(node: Tensor, weight: Tensor, nodes: int) -> Tensor:
    r"""Return a factor for each node; no contact sample moves farther than the largest factor times the node's motion.

    A node whose support barely reaches the material has almost no mass, and stress may move it by metres, which moves
    no sample. With :math:`s_i` the largest weight of a node at any sample, and :math:`r_i = \min(1, s_i /` LIGHT
    :math:`)`, a sample moves by at most :math:`\sum_i |w_i| |u_i| \le \max_i (C r_i |u_i|)`, where C is the largest sum
    of :math:`|w_i| / r_i` of a place: at most 1.27 if no weight is negative.

    Args:
        node: Nodes of each sample, shape (C, 27).
        weight: Their weights, shape (C, 27).

    Returns:
        Shape (nodes,).
    """
    size = weight.abs()
    largest = size.new_zeros(nodes).scatter_reduce_(0, node.reshape(-1), size.reshape(-1), "amax")
    share = (largest / LIGHT).clamp(max=1.0)
    return share * (size / share[node].clamp(min=1e-30)).sum(1).amax() if len(node) else share
