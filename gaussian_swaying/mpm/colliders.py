"""What the material cannot enter or leave: planes, boxes, and rigid obstacles that may move.

The distance from a solid is one device function (:mod:`~gaussian_swaying.geometry.distance`), which torch runs on
tensors and the kernels call. The numbers of each solid begin with its gap, its friction and the place of its centre
(3). One that moves has :data:`POSE` numbers of each substep: those of ``keyed_path.rigid_motion``, and zeros.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Container, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying._fixed import FixedList, assign, changed
from gaussian_swaying.geometry.distance import DistanceGrid, distance_at, half_space_distance
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath, fastest, keys_before, rigid_motion, rigid_motions
from gaussian_swaying.geometry.linalg import vectors
from gaussian_swaying.geometry.linalg_triton import add3, axpy3, dot3, matvec, read, transpose
from gaussian_swaying.geometry.regions import Box, HalfSpace, Region
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.kernels.derive import Memory, on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch, replaces
from gaussian_swaying.mpm.boundary import Boundary, Nodes
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers

KINDS = ("sticky", "slip", "separate")
POSE = tl.constexpr(32)


@triton.jit
def touch(x, numbers, rows, step, mask, SOLIDS: tl.constexpr, w: tl.constexpr):
    """Distance to solid w less its gap, its normal, and its velocity, at places x."""
    MOVES: tl.constexpr = SOLIDS.per_substep[w][1] > 0
    own_numbers = numbers + SOLIDS.numbers[w][0]
    pose = own_numbers + 2
    if MOVES:
        pose = rows + step * SOLIDS.width + SOLIDS.per_substep[w][0]
    x = add3(x, -1.0, read(pose, 0, 3))
    own = x
    if MOVES:
        own = matvec(transpose(read(pose, 3, 9)), x)
    shape = read(own_numbers, 5, SOLIDS.numbers[w][1] - 5)
    OPTIONS: tl.constexpr = SOLIDS.options[w]
    distance, normal = SOLIDS.functions[w](own, shape, numbers + SOLIDS.tables[w], mask, OPTIONS)
    zero = x[0] * 0
    drive = (zero, zero, zero)
    if MOVES:
        normal = matvec(read(pose, 3, 9), normal)
        drive = add3(matvec(read(pose, 12, 9), x), 1.0, read(pose, 21, 3))
    return distance - tl.load(own_numbers), normal, drive


@triton.jit
def stopped(v, n, kind: tl.constexpr, friction):
    """Velocity in contact with a plane at rest; ``kind`` is a number of ``KINDS``."""
    along = dot3(v, n)
    removed = tl.where(kind == 2, tl.minimum(along, 0.0), along)
    t = add3(v, -along, n)
    speed = tl.maximum(tl.sqrt(dot3(t, t)), 1.1754944e-38)
    left = tl.where(friction > 0, tl.maximum(1 - friction * tl.abs(removed) / speed, 0.0), 1.0)
    left = tl.where(kind == 0, 0.0, left)
    rest = tl.where(kind == 0, 0.0, along - removed)
    return axpy3(left, t, rest, n)


@triton.jit
def stop_nodes(
    v, x, numbers, rows, step, mask, SOLIDS: tl.constexpr, w: tl.constexpr, KIND: tl.constexpr
):  # fmt: skip
    """Velocity of nodes at x in contact with solid w, and which of them are; KIND of ``KINDS``."""
    friction = tl.load(numbers + SOLIDS.numbers[w][0] + 1)
    distance, n, own = touch(x, numbers, rows, step, mask, SOLIDS, w)
    if SOLIDS.per_substep[w][1] > 0:
        held = stopped(add3(v, -1.0, own), n, KIND, friction)
        held = add3(held, 1.0, own)
    else:
        held = stopped(v, n, KIND, friction)
    return held, distance <= 0


@triton.jit
def acts(window, now):
    """True if a solid acts at a time, given its start and end."""
    now = now + 1e-9  # boundary.CLOCK
    return (now >= tl.load(window)) & (now < tl.load(window + 1))


def plane_velocity(velocity: Tensor, normal: Tensor, kind: str, friction: float) -> Tensor:
    """Velocity of nodes in contact with a plane at rest.

    Args:
        velocity: Node velocity [m/s], shape (..., 3).
        normal: Unit normal, pointing to the free side, shape (..., 3).
        kind: ``sticky`` (no motion), ``slip`` (no motion along the normal), ``separate`` (no motion into the plane).
        friction: Coulomb coefficient: the tangential speed falls by at most ``friction`` times the normal speed that
            the contact removes.

    Returns:
        Shape (..., 3).
    """
    v, n = velocity.unbind(-1), normal.to(velocity).unbind(-1)
    return torch.stack(on_tensors(stopped)(v, n, KINDS.index(kind), friction), -1)


class Wall(Boundary):
    """A half space that particles cannot enter, or a box that they cannot leave; it acts on grid nodes.

    Args:
        shape: A ``HalfSpace`` that they cannot enter, or a ``Box`` that they cannot leave, in scene units; a null in
            its corners leaves that side open.
        kind: ``sticky``, ``slip`` or ``separate`` (see :func:`plane_velocity`).
        friction: Coulomb friction coefficient of ``slip`` and ``separate``.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True
    point: Tensor
    normal: Tensor

    def __init__(
        self,
        shape: Region,
        kind: str = "separate",
        friction: float = 0.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        check_choice("kind", kind, KINDS)
        check_positive("friction", friction, allow_zero=True)
        self.shape, self.kind, self.friction = shape, kind, float(friction)
        if not isinstance(shape, HalfSpace | Box):
            raise ValueError(f"Expected `shape` of the Wall to be a HalfSpace or a Box, but got {shape!r}.")
        planes = []
        for axis, unit in enumerate(torch.eye(3).tolist()):
            for corner, way in ((shape.min, 1.0), (shape.max, -1.0)) if isinstance(shape, Box) else ():
                if math.isfinite(corner[axis]):
                    side = HalfSpace([corner[axis] * part for part in unit], [way * part for part in unit])
                    planes.append(Wall(side, kind, friction, start, end))
        self.planes = FixedList(planes)
        if isinstance(shape, HalfSpace):
            n = torch.tensor(shape.normal, dtype=torch.float64)
            self.register_buffer("point", torch.tensor(shape.point, dtype=torch.float64))
            self.register_buffer("normal", n / n.norm())

    @property
    def sides(self) -> Sequence[Wall]:
        """Its planes: those of a box, or itself."""
        return list(self.planes) or [self]  # type: ignore[arg-type]

    def in_frame(self, frame: SimFrame) -> Wall:
        """The wall in metres, z up."""
        if self.planes:
            return changed(self, planes=FixedList(p.in_frame(frame) for p in self.planes))  # type: ignore[operator]
        normal = frame.direction_to_sim(self.normal).clone()
        return self.copy_in(frame, point=frame.point_to_sim(self.point), normal=normal)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        for plane in self.planes:
            velocity = plane(velocity, nodes)
        if self.planes:
            return velocity
        assert nodes.position is not None
        behind = ((nodes.position - self.point.to(velocity)) * self.normal.to(velocity)).sum(-1) <= 0
        stopped = plane_velocity(velocity, self.normal, self.kind, self.friction)
        return torch.where((behind & self.active(nodes.time))[..., None], stopped, velocity)

    def device_function(self) -> DeviceFunction:
        """The device function of a half space; a box has one for each plane."""
        if self.planes:
            return DeviceFunction(None, parts=tuple(plane.device_function() for plane in self.planes))  # type: ignore[operator]
        solid = DeviceFunction(half_space_distance, numbers=Numbers(3, lambda: self.normal), sources=(self,))
        return _placed(solid, 0.0, self.friction, self.point)


class VelocityBox(Boundary):
    """Gives the nodes inside a region, which travels with it, a prescribed velocity.

    Args:
        region: Region in which the nodes are driven, in scene units.
        velocity: Velocity [m/s], z up.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    velocity: Tensor

    def __init__(
        self,
        region: Region,
        velocity: Sequence[float],
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        self.region, self.recordable = region, region.recordable
        self.register_buffer("velocity", torch.tensor(check_vector("velocity", velocity), dtype=torch.float64))

    def in_frame(self, frame: SimFrame) -> VelocityBox:
        """The box with its region evaluated in metres."""
        return self.copy_in(frame)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        where = nodes.position - (self.velocity * (nodes.time - self.start)).to(nodes.position)
        inside = self.region.contains(where) & self.active(nodes.time)
        return torch.where(inside[..., None], self.velocity.to(velocity), velocity)


class Obstacle(Boundary):
    """A rigid body, fixed or moving, that the material cannot enter, with Coulomb friction.

    In ``total`` it stops contact samples of the body's surface, at the obstacle's own surface
    (:mod:`~gaussian_swaying.mpm.contact`). In ``updated`` it stops grid nodes, as a ``Wall`` does, so the gap is up to
    a cell wide.

    Args:
        shape: A ``Sphere``, ``Box``, ``Capsule``, ``HalfSpace`` or ``Mesh``, in scene units, or ``StillGaussians``.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        rotation: Rotation about its middle, as axis times angle [degrees], in scene axes.
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True
    center: Tensor
    keys: Tensor
    numbers: Tensor
    table: Tensor

    def __init__(
        self,
        shape: Region,
        friction: float = 0.3,
        gap: float = 0.0,
        rotation: Sequence[float] = (0.0, 0.0, 0.0),
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        check_positive("friction", friction, allow_zero=True)
        check_positive("gap", gap, allow_zero=True)
        self.shape, self.friction, self.gap, self.path = shape, float(friction), float(gap), path
        self.rotation = check_vector("rotation", rotation)
        self.register_buffer("center", torch.tensor(shape.middle or (0.0, 0.0, 0.0), dtype=torch.float64))
        for name, value in {"keys": (path or KeyedPath([0.0])).keys(), **self._solid(None)}.items():
            self.register_buffer(name, value)

    def _solid(self, frame: SimFrame | None) -> dict[str, Tensor]:
        axes = rotation_of(torch.deg2rad(torch.tensor(self.rotation, dtype=torch.float64)))
        unit, axes = (1.0, axes) if frame is None else (frame.metres_per_unit, frame.rotation @ axes)
        numbers, table = self.shape.solid(unit, axes)
        return {"numbers": numbers, "table": table}

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The obstacle in metres, z up."""
        if self.shape.middle is None:
            return copy.copy(self)
        tensors = self._solid(frame)
        if self.path is not None:
            tensors["keys"] = self.path.keys(frame)
        return self.copy_in(frame, center=frame.point_to_sim(self.center), **tensors)

    def take(self, found: DistanceGrid) -> None:
        """Set the grid of distances from ``StillGaussians``, in metres, z up."""
        assign(self, numbers=found.numbers(torch.eye(3)), table=found.values)

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """``surface``: it acts on the surface where particles keep their neighbours, otherwise on ``nodes``."""
        return "surface" if neighbours_fixed else "nodes"

    def device_function(self) -> DeviceFunction | None:
        """The distance function of its shape, with the numbers that :func:`touch` reads."""
        if not len(self.numbers):
            return None
        numbers = Numbers(len(self.numbers), lambda: self.numbers)
        table = Numbers(self.table.numel(), lambda: self.table)
        solid = DeviceFunction(type(self.shape).distance, numbers=numbers, table=table, sources=(self,))
        placed = _placed(solid, self.gap, self.friction, self.center)
        return placed if self.still else replace(placed, per_substep=Numbers(POSE.value, self._poses))

    def _poses(self, time: Tensor, dt: Tensor, steps: int) -> Tensor:
        """The numbers of :meth:`motion` at the start of some substeps, shape (steps, POSE)."""
        if not replaces((time,), None):
            found = self.motion(time + dt * torch.arange(steps, device=time.device), dt)
            return torch.nn.functional.pad(torch.cat([part.reshape(steps, -1) for part in found], 1), (0, 8))
        rows, block = time.new_zeros(steps, POSE.value), lanes(time.device, 64)
        launch(rigid_motions, (-(-steps // block),))(
            self.keys, len(self.keys) - 1, self.center, time, dt, rows, steps, BLOCK=block, num_warps=2
        )
        return rows

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance from its surface and the gradient of it, at rest; in torch.

        Args:
            place: Places relative to its centre [m], shape (..., 3).

        Returns:
            Distances [m], negative inside, shape (...), and unit vectors (..., 3).
        """
        if not len(self.numbers):
            raise RuntimeError(
                "StillGaussians have no Gaussians yet: give them to a Simulation, which knows the scene."
            )
        return distance_at(type(self.shape).distance, place, self.numbers, self.table)

    @property
    def still(self) -> bool:
        """True if it never moves."""
        return self.path is None

    def fastest(self, farthest: float, start: float = -math.inf, end: float = math.inf) -> float:
        """Upper bound of its speed [m/s] within ``farthest`` [m] of its centre, between two times [s]."""
        start, end = max(start, self.start), min(end, self.end)
        if not start < end:
            return 0.0
        shifts, turns = (fastest(self.keys[:, 0], part, start, end) for part in self.keys[:, 1:].split(3, 1))
        return shifts + (turns * farthest if turns else 0.0)

    def motion(self, time: Tensor, dt: float | Tensor) -> tuple[Tensor, ...]:
        """Its centre [m] (..., 3), rotation (..., 3, 3) and velocity field at times [s].

        The velocity [m/s] is a matrix (..., 3, 3) times the offset, and that of the centre (..., 3). It takes each
        place of the obstacle to where it is ``dt`` later.
        """
        now, later = (keys_before(self.keys, moment) for moment in (time, time + dt))
        found = vectors(on_tensors(rigid_motion)(Memory(self.keys), now, later, time, dt, self.center.unbind()))
        here, turn, spin, speed = found.split([3, 9, 9, 3], -1)
        return here, turn.unflatten(-1, (3, 3)), spin.unflatten(-1, (3, 3)), speed

    def touch(self, place: Tensor, time: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distance from the obstacle, its normal, and its velocity at places.

        Args:
            place: Places [m], shape (..., 3).
            time: Time now [s], scalar float64 tensor.
            dt: Substep [s]; the velocity takes each place of the obstacle to where it is ``dt`` later.

        Returns:
            Distance less the ``gap`` [m], shape (...), normal out of the obstacle and velocity [m/s], shape (..., 3).
        """
        here, turn, spin, speed = (part.to(place) for part in self.motion(time, dt))
        arm = place - here
        distance, normal = self.distance(arm @ turn)
        return distance - self.gap, normal @ turn.mT, arm @ spin.mT + speed

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        distance, normal, own = self.touch(nodes.position, nodes.time, nodes.dt)
        stopped = own + plane_velocity(velocity - own, normal, "separate", self.friction)
        return torch.where(((distance <= 0) & self.active(nodes.time))[..., None], stopped, velocity)


def _placed(solid: DeviceFunction, gap: float, friction: float, centre: Tensor) -> DeviceFunction:
    def numbers() -> Tensor:
        shape = torch.as_tensor(own.take()).to(centre)
        return torch.cat([centre.new_tensor([gap, friction]), centre, shape.reshape(-1)])

    own = solid.numbers
    return replace(solid, numbers=Numbers(5 + own.count, numbers))


Solid = Wall | Obstacle


def solids_of(boundaries: Sequence[Boundary], pins: Container[int] = ()) -> list[tuple[Solid, int]] | None:
    """All solids with the indices of their boundaries; None if a boundary has no device function."""
    others = [(one, k) for k, one in enumerate(boundaries) if k not in pins]
    if any(boundary.device_function() is None for boundary, _ in others):
        return None
    solids = [(part, k) for one, k in others for part in one.modules() if isinstance(part, Solid)]
    return [(part, k) for part, k in solids if isinstance(part, Obstacle) or not part.planes]
