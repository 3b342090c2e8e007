"""What the material cannot enter or leave: planes, boxes, and rigid obstacles that may move.

The distance from a solid is one device function (:mod:`~gaussian_swaying.geometry.distance`), which torch runs on
tensors and the kernels call. The numbers of each solid begin with its gap, its friction and the place of its centre
(3). One that moves has :data:`POSE` numbers of each substep: place of the centre (3), rotation (9), and the velocity of
what is at an offset from the centre: a matrix (9) and the velocity of the centre (3).
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
from gaussian_swaying.geometry.distance import (
    DistanceGrid,
    ball_distance,
    box_distance,
    capsule_distance,
    distance_at,
    grid_distance,
    half_space_distance,
)
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath, between, fastest
from gaussian_swaying.geometry.linalg_triton import add3, dot3, matvec, read, transpose
from gaussian_swaying.geometry.meshes import mesh_distance, read_mesh
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.boundary import Boundary, Nodes
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers

KINDS = ("sticky", "slip", "separate")
POSE = tl.constexpr(24)


@triton.jit
def touch(x, numbers, rows, step, mask, SOLIDS: tl.constexpr, w: tl.constexpr):
    """Distance from solid w less its gap, its normal, and its velocity at places x."""
    MOVES: tl.constexpr = SOLIDS.per_substep[w][1] > 0
    own_numbers = numbers + SOLIDS.numbers[w][0]
    pose = own_numbers + 2
    if MOVES:
        pose = rows + step * SOLIDS.width + SOLIDS.per_substep[w][0]
    x = (x[0] - tl.load(pose), x[1] - tl.load(pose + 1), x[2] - tl.load(pose + 2))
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
        drive = matvec(read(pose, 12, 9), x)
        drive = (drive[0] + tl.load(pose + 21), drive[1] + tl.load(pose + 22), drive[2] + tl.load(pose + 23))
    return distance - tl.load(own_numbers), normal, drive


@triton.jit
def stopped(v, n, kind: tl.constexpr, friction):
    """Velocity in contact with a plane at rest; ``kind`` is a number of ``KINDS``."""
    along = dot3(v, n)
    removed = tl.where(kind == 2, tl.minimum(along, 0.0), along)
    t = (v[0] - along * n[0], v[1] - along * n[1], v[2] - along * n[2])
    speed = tl.maximum(tl.sqrt(dot3(t, t)), 1.1754944e-38)
    left = tl.where(friction > 0, tl.maximum(1 - friction * tl.abs(removed) / speed, 0.0), 1.0)
    left = tl.where(kind == 0, 0.0, left)
    rest = tl.where(kind == 0, 0.0, along - removed)
    return left * t[0] + rest * n[0], left * t[1] + rest * n[1], left * t[2] + rest * n[2]


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
    """True if a solid acts at a time, from its first and last time."""
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


class Plane(Boundary):
    """A half space that particles cannot enter.

    Args:
        point: A point of the plane, in scene units.
        normal: Normal towards the free side, in scene axes.
        kind: ``sticky``, ``slip`` or ``separate`` (see :func:`plane_velocity`).
        friction: Coulomb friction coefficient of ``slip`` and ``separate``.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True

    def __init__(
        self,
        point: Sequence[float],
        normal: Sequence[float],
        kind: str = "separate",
        friction: float = 0.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        check_choice("kind", kind, KINDS)
        check_positive("friction", friction, allow_zero=True)
        self.kind, self.friction = kind, float(friction)
        n = torch.tensor(check_vector("normal", normal), dtype=torch.float64)
        if float(n.norm()) == 0:
            raise ValueError("Expected `normal` of the plane not to be zero.")
        self.register_buffer("point", torch.tensor(check_vector("point", point), dtype=torch.float64))
        self.register_buffer("normal", n / n.norm())
        self.point: Tensor
        self.normal: Tensor

    def in_frame(self, frame: SimFrame) -> Plane:
        """The plane in metres, z up."""
        normal = frame.direction_to_sim(self.normal).clone()
        return self.copy_in(frame, point=frame.point_to_sim(self.point), normal=normal)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        behind = ((nodes.position - self.point.to(velocity)) * self.normal.to(velocity)).sum(-1) <= 0
        stopped = plane_velocity(velocity, self.normal, self.kind, self.friction)
        return torch.where((behind & self.active(nodes.time))[..., None], stopped, velocity)

    def device_function(self) -> DeviceFunction:
        solid = DeviceFunction(half_space_distance, numbers=Numbers(3, lambda: self.normal), sources=(self,))
        return _placed(solid, 0.0, self.friction, self.point)


class EnclosingBox(Boundary):
    """Six planes that keep the particles inside an axis-aligned box.

    Args:
        min: Smallest corner, in scene units.
        max: Largest corner, in scene units.
        kind: ``sticky``, ``slip`` or ``separate``.
        friction: Coulomb friction coefficient of ``slip`` and ``separate``.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True

    def __init__(
        self,
        min: Sequence[float],
        max: Sequence[float],
        kind: str = "separate",
        friction: float = 0.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        low, high = check_vector("min", min), check_vector("max", max)
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"Expected `min` of the box to be below `max` on every axis, but got {low} and {high}.")
        planes = []
        for axis in range(3):
            direction = [0.0, 0.0, 0.0]
            direction[axis] = 1.0
            planes.append(Plane(low, direction, kind, friction, start, end))
            planes.append(Plane(high, [-d for d in direction], kind, friction, start, end))
        self.planes = FixedList(planes)

    def in_frame(self, frame: SimFrame) -> EnclosingBox:
        """The box in metres, z up."""
        return changed(self, planes=FixedList(p.in_frame(frame) for p in self.planes))  # type: ignore[operator]

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        for plane in self.planes:
            velocity = plane(velocity, nodes)
        return velocity

    def device_function(self) -> DeviceFunction:
        """Nothing but that of each plane."""
        return DeviceFunction(None, parts=tuple(plane.device_function() for plane in self.planes))  # type: ignore[operator]


class VelocityBox(Boundary):
    """Gives the nodes inside a region a prescribed velocity.

    Args:
        region: Region in which the nodes are driven, in scene units.
        velocity: Velocity [m/s], z up.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
        travels: Whether the region moves with ``velocity`` from ``start`` on; otherwise it stays where it is.
    """

    needs_position = True

    def __init__(
        self,
        region: Region,
        velocity: Sequence[float],
        start: float = 0.0,
        end: float | None = None,
        travels: bool = False,
    ) -> None:
        super().__init__(start, end)
        self.region, self.recordable, self.travels = region, region.recordable, bool(travels)
        self.register_buffer("velocity", torch.tensor(check_vector("velocity", velocity), dtype=torch.float64))
        self.velocity: Tensor

    def in_frame(self, frame: SimFrame) -> VelocityBox:
        """The box with its region evaluated in metres."""
        return self.copy_in(frame)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        where = nodes.position
        if self.travels:
            where = where - (self.velocity * (nodes.time - self.start)).to(where)
        inside = self.region.contains(where) & self.active(nodes.time)
        return torch.where(inside[..., None], self.velocity.to(velocity), velocity)


class Obstacle(Boundary):
    """A rigid body, fixed or moving, that the material cannot enter, with Coulomb friction.

    In ``total`` it stops contact samples of the body's surface, at the obstacle's own surface
    (:mod:`~gaussian_swaying.mpm.contact`). In ``updated`` it stops grid nodes, as a ``Plane`` does, so the gap is up to
    a cell wide.

    Args:
        center: Origin of its own axes at rest, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True

    def __init__(
        self,
        center: tuple[float, ...],
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        check_positive("friction", friction, allow_zero=True)
        check_positive("gap", gap, allow_zero=True)
        self.friction, self.gap, self.path = float(friction), float(gap), path
        self.register_buffer("center", torch.tensor(center, dtype=torch.float64))
        times, moves, turns = KeyedPath([0.0]).keys() if path is None else path.keys()
        for name, value in (("times", times), ("shifts", moves), ("turns", turns)):
            self.register_buffer(name, value)
        self.center: Tensor
        self.times: Tensor
        self.shifts: Tensor
        self.turns: Tensor

    def in_metres(self, frame: SimFrame, **tensors: Tensor) -> Obstacle:
        """A copy with its centre and path in metres, and with some tensors replaced."""
        if self.path is not None:
            _, moves, turns = self.path.keys(frame)
            tensors |= {"shifts": moves, "turns": turns}
        return self.copy_in(frame, center=frame.point_to_sim(self.center), **tensors)

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """``surface``: it acts on the surface where particles keep their neighbours, otherwise on ``nodes``."""
        return "surface" if neighbours_fixed else "nodes"

    def solid(self) -> DeviceFunction:
        """The device function of its distance at rest, and its numbers; a subclass has this or :meth:`distance`."""
        raise NotImplementedError(f"{type(self).__name__} has neither `solid` nor `distance`.")

    def device_function(self) -> DeviceFunction | None:
        """That of :meth:`solid`, with what :func:`touch` reads."""
        placed = _placed(self.solid(), self.gap, self.friction, self.center)
        return placed if self.still else replace(placed, per_substep=Numbers(POSE.value, self._poses))

    def _poses(self, time: Tensor, dt: Tensor, steps: int) -> Tensor:
        """The numbers of :meth:`motion` at the start of some substeps, shape (steps, 24)."""
        found = self.motion(time + dt * torch.arange(steps, device=time.device), dt)
        return torch.cat([part.reshape(steps, -1) for part in found], 1)

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance from its surface and the gradient of it, at rest; in torch.

        Args:
            place: Places relative to its centre [m], shape (..., 3).

        Returns:
            Distances [m], negative inside, shape (...), and unit vectors (..., 3).
        """
        solid = self.solid()
        table = solid.table.take() if solid.table.count else place.new_zeros(1)
        return distance_at(solid.function, place, solid.numbers.take(), table)

    @property
    def still(self) -> bool:
        """True if it never moves."""
        return self.path is None

    def fastest(self, farthest: float, start: float = -math.inf, end: float = math.inf) -> float:
        """Bound of its speed [m/s] at places up to ``farthest`` [m] from its centre, between two times [s]."""
        start, end = max(start, self.start), min(end, self.end)
        if not start < end:
            return 0.0
        turning = fastest(self.times, self.turns, start, end)
        return fastest(self.times, self.shifts, start, end) + (turning * farthest if turning else 0.0)

    def pose(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Its centre [m], shape (..., 3), and its rotation, shape (..., 3, 3), at times [s]; float64."""
        return self.center + between(self.times, self.shifts, time), rotation_of(between(self.times, self.turns, time))

    def motion(self, time: Tensor, dt: float | Tensor) -> tuple[Tensor, ...]:
        """Its pose, and the velocity of what is at an offset from the centre.

        The velocity [m/s] is a matrix (..., 3, 3) times the offset, and that of the centre (..., 3). It takes each
        place of the obstacle to where it is ``dt`` later.
        """
        (here, turn), (there, turned) = self.pose(time), self.pose(time + dt)
        identity = torch.eye(3, dtype=turn.dtype, device=turn.device)
        return here, turn, (turned @ turn.mT - identity) / dt, (there - here) / dt

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
    """The device function of a solid whose numbers begin with gap, friction and place of its centre."""

    def numbers() -> Tensor:
        shape = torch.as_tensor(own.take()).to(centre)
        return torch.cat([centre.new_tensor([gap, friction]), centre, shape.reshape(-1)])

    own = solid.numbers
    return replace(solid, numbers=Numbers(5 + own.count, numbers))


def grid_device_function(obstacle: Obstacle, grid: DistanceGrid, axes: Tensor) -> DeviceFunction:
    """The device function of an obstacle whose distances [m] are on a grid; its axes are columns."""
    table = Numbers(grid.values.numel(), lambda: grid.values)
    return DeviceFunction(
        grid_distance, numbers=Numbers(16, lambda: grid.numbers(axes)), table=table, sources=(obstacle,)
    )


class BallObstacle(Obstacle):
    """A ball that the material cannot enter.

    Args:
        center: Its centre, in scene units.
        radius: Its radius, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        center: Sequence[float],
        radius: float,
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(check_vector("center", center), friction, gap, path, start, end)
        check_positive("radius", radius)
        self.register_buffer("radius", torch.tensor(float(radius), dtype=torch.float64))
        self.radius: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The ball in metres, z up."""
        return self.in_metres(frame, radius=self.radius * frame.metres_per_unit)

    device_function = Obstacle.device_function

    def solid(self) -> DeviceFunction:
        return DeviceFunction(ball_distance, numbers=Numbers(1, lambda: self.radius), sources=(self,))


class BoxObstacle(Obstacle):
    """A box that the material cannot enter: a table, a step; an ``EnclosingBox`` is one that it cannot leave.

    Args:
        min: Smallest corner before it is turned, in scene units.
        max: Largest corner.
        turn: Rotation about its centre, as axis times angle [degrees], in scene axes.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        min: Sequence[float],
        max: Sequence[float],
        turn: Sequence[float] = (0.0, 0.0, 0.0),
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        low, high = check_vector("min", min), check_vector("max", max)
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"Expected `min` of the box to be below `max` on every axis, but got {low} and {high}.")
        middle = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
        super().__init__(middle, friction, gap, path, start, end)
        half = [0.5 * (b - a) for a, b in zip(low, high, strict=True)]
        angle = torch.deg2rad(torch.tensor(check_vector("turn", turn), dtype=torch.float64))
        self.register_buffer("half_sides", torch.tensor(half, dtype=torch.float64))
        self.register_buffer("axes", rotation_of(angle))
        self.half_sides: Tensor
        self.axes: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The box in metres, z up."""
        axes = frame.direction_to_sim(self.axes.T.contiguous()).T.contiguous()
        return self.in_metres(frame, half_sides=self.half_sides * frame.metres_per_unit, axes=axes)

    device_function = Obstacle.device_function

    def solid(self) -> DeviceFunction:
        numbers = Numbers(12, lambda: torch.cat([self.half_sides, self.axes.reshape(-1)]))
        return DeviceFunction(box_distance, numbers=numbers, sources=(self,))


class CapsuleObstacle(Obstacle):
    """A rod with round ends that the material cannot enter: a pole, an arm. It turns about its middle.

    Args:
        first: One end of its axis, in scene units.
        second: The other end.
        radius: Its radius, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        first: Sequence[float],
        second: Sequence[float],
        radius: float,
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        a, b = check_vector("first", first), check_vector("second", second)
        middle = tuple(0.5 * (p + q) for p, q in zip(a, b, strict=True))
        super().__init__(middle, friction, gap, path, start, end)
        check_positive("radius", radius)
        self.register_buffer("radius", torch.tensor(float(radius), dtype=torch.float64))
        half = [0.5 * (q - p) for p, q in zip(a, b, strict=True)]
        self.register_buffer("half_axis", torch.tensor(half, dtype=torch.float64))
        self.radius: Tensor
        self.half_axis: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The rod in metres, z up."""
        half = frame.direction_to_sim(self.half_axis) * frame.metres_per_unit
        return self.in_metres(frame, radius=self.radius * frame.metres_per_unit, half_axis=half)

    device_function = Obstacle.device_function

    def solid(self) -> DeviceFunction:
        def numbers() -> Tensor:
            squared = self.half_axis.square().sum()
            inverse = torch.where(squared > 0, 1 / squared, 0.0)
            return torch.cat([self.radius[None], self.half_axis, inverse[None]])

        return DeviceFunction(capsule_distance, numbers=Numbers(5, numbers), sources=(self,))


class HalfSpaceObstacle(Obstacle):
    """All space behind a plane: a floor, a wall. Unlike a ``Plane``, in ``total`` it is sharp, and it can move.

    Args:
        point: A point of the plane, in scene units; it turns about this point.
        normal: Normal towards the free side, in scene axes.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        point: Sequence[float],
        normal: Sequence[float],
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(check_vector("point", point), friction, gap, path, start, end)
        n = torch.tensor(check_vector("normal", normal), dtype=torch.float64)
        if float(n.norm()) == 0:
            raise ValueError("Expected `normal` of the half space not to be zero.")
        self.register_buffer("normal", n / n.norm())
        self.normal: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The half space in metres, z up."""
        return self.in_metres(frame, normal=frame.direction_to_sim(self.normal).clone())

    device_function = Obstacle.device_function

    def solid(self) -> DeviceFunction:
        return DeviceFunction(half_space_distance, numbers=Numbers(3, lambda: self.normal), sources=(self,))


class MeshObstacle(Obstacle):
    """A closed triangle mesh that the material cannot enter.

    Its signed distance is computed on a grid once, so details smaller than a cell of that grid are rounded off. It
    turns about the origin of the mesh.

    Args:
        mesh: A .ply or .obj file, in scene units and axes.
        cells: Cells of the grid along the longest side of the mesh.
        center: Position of the mesh's origin, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.

    Raises:
        ValueError: If the file is no closed mesh.
    """

    def __init__(
        self,
        mesh: str,
        cells: int = 48,
        center: Sequence[float] = (0.0, 0.0, 0.0),
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(check_vector("center", center), friction, gap, path, start, end)
        if cells < 4:
            raise ValueError(f"Expected `cells` of the mesh to be at least 4, but got {cells}.")
        self.mesh, self.cells = mesh, int(cells)
        found = mesh_distance(*read_mesh(mesh), cells)
        self.register_buffer("values", found.values)
        self.register_buffer("corner", found.origin)
        self.register_buffer("axes", torch.eye(3, dtype=torch.float64))
        self.values: Tensor
        self.corner: Tensor
        self.axes: Tensor
        self.spacing = found.spacing

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The mesh in metres, z up."""
        unit = frame.metres_per_unit
        axes = frame.direction_to_sim(torch.eye(3, dtype=torch.float64)).T.contiguous()
        moved = self.in_metres(frame, values=self.values * unit, corner=self.corner * unit, axes=axes)
        return changed(moved, spacing=self.spacing * unit)

    device_function = Obstacle.device_function

    def solid(self) -> DeviceFunction:
        return grid_device_function(self, DistanceGrid(self.values, self.corner, self.spacing), self.axes)


class StillGaussians(Obstacle):
    """Everything in the scene that does not move: a curtain falls over a captured table.

    Their surface is where the density of the Gaussians passes a level, on a grid around the object that a
    ``Simulation`` makes once. Details smaller than a cell are rounded off.

    Args:
        cells: Cells of the grid along its longest side.
        level: Density of the surface, from 0 to 1.
        margin: Distance by which the grid reaches beyond the object at rest, in lengths of its longest side.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        cells: int = 96,
        level: float = 0.5,
        margin: float = 1.0,
        friction: float = 0.3,
        gap: float = 0.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__((0.0, 0.0, 0.0), friction, gap, None, start, end)
        check_positive("margin", margin)
        if not 0 < level < 1 or cells < 8:
            raise ValueError(
                f"Expected `level` between 0 and 1 and `cells` of at least 8, but got {level:g} and {cells}."
            )
        self.cells, self.level, self.margin, self.spacing = int(cells), float(level), float(margin), 0.0
        self.register_buffer("values", torch.zeros(2, 2, 2, dtype=torch.float64), persistent=False)
        self.register_buffer("corner", torch.zeros(3, dtype=torch.float64), persistent=False)
        self.values: Tensor
        self.corner: Tensor

    def take(self, found: DistanceGrid) -> None:
        """Set the grid of distances from the Gaussians, in metres, z up."""
        assign(self, values=found.values, corner=found.origin, spacing=found.spacing)

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """Itself: it is in metres."""
        return copy.copy(self)

    def solid(self) -> DeviceFunction:
        """The interpolation of the grid; RuntimeError if none was set."""
        if self.spacing == 0:
            raise RuntimeError(
                "The StillGaussians have no Gaussians: give them to a Simulation, which knows the scene."
            )
        return grid_device_function(
            self, DistanceGrid(self.values, self.corner, self.spacing), torch.eye(3, device=self.corner.device)
        )

    def device_function(self) -> DeviceFunction | None:
        return None if self.spacing == 0 else Obstacle.device_function(self)


Solid = Plane | Obstacle


def solids_of(boundaries: Sequence[Boundary], pins: Container[int] = ()) -> list[tuple[Solid, int]] | None:
    """All solids, each with the number of its boundary; None if a boundary has no device function.

    Args:
        boundaries: The boundary conditions of a body.
        pins: Numbers of those that are no solids.
    """
    others = [(one, k) for k, one in enumerate(boundaries) if k not in pins]
    if any(boundary.device_function() is None for boundary, _ in others):
        return None
    return [(part, k) for one, k in others for part in one.modules() if isinstance(part, Solid)]
