"""Boundary conditions: what holds, stops or drives grid nodes, each within a window of time.

A condition changes nodal velocities after the momentum update. Where a node "is" depends on the formulation: a lattice
point in ``updated``, the centre of the mass that it carries in ``total``.

A condition that holds particles holds the nodes that carry them: in ``updated`` all that they touch, in ``total`` those
in which they have more than a share of the mass.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying._graphs import Recordable
from gaussian_swaying.geometry.regions import Region


class FrameLike(Protocol):
    """The part of ``SimFrame`` that boundaries need."""

    def point_to_sim(self, points: Tensor) -> Tensor:
        """Scene coordinates (..., 3) to metres, z up."""
        ...

    def point_to_scene(self, points: Tensor) -> Tensor:
        """Metres, z up (..., 3) to scene coordinates."""
        ...

    def direction_to_sim(self, directions: Tensor) -> Tensor:
        """Directions (..., 3) turned into the z-up frame."""
        ...


CLOCK = 1e-9  # round-off of a time that many substeps were added to [s]


@dataclass(frozen=True, slots=True)
class Nodes:
    """What a boundary may know about the grid nodes besides their velocity.

    Attributes:
        time: Time at the start of the substep [s], scalar float64 tensor.
        dt: Substep [s], a number or a scalar float64 tensor.
        position: Where the nodes are [m], shape (..., G, 3), for a boundary with ``needs_position``.
        lattice: Where the lattice points are [m], shape (..., G, 3), for one with ``needs_lattice``: in ``total`` they
            have moved with the material, and a velocity that is affine in them moves it rigidly up to its border.
        share: Share of each node's mass that belongs to the particles of the boundary, shape (..., G), if it has any.
        threshold: Share above which such a node is held.
        held_mass: Mass of those particles [kg], shape (...).
    """

    time: Tensor
    dt: float | Tensor
    position: Tensor | None = None
    lattice: Tensor | None = None
    share: Tensor | None = None
    threshold: float = 0.0
    held_mass: Tensor | None = None

    @property
    def held(self) -> Tensor:
        """Nodes that the particles of the boundary hold, bool, shape (..., G)."""
        assert self.share is not None
        return self.share > self.threshold


class RegionInFrame(Region):
    """A region given in axes and units of its own, asked about points in others: metres with z up, or scene units."""

    axes = " in the axes of the region"

    def __init__(self, region: Region, frame: FrameLike) -> None:
        self.region, self.frame = region, frame
        self.recordable = region.recordable

    def contains(self, points: Tensor) -> Tensor:
        """Whether each point (..., 3) [m, z up] lies inside; bool, shape (...)."""
        return self.region.contains(self.frame.point_to_scene(points))

    def bounds(self, points: Tensor) -> tuple[list[float], list[float]]:
        """Least and largest coordinates of points (..., 3), in the axes and units in which the region is given."""
        return self.region.bounds(self.frame.point_to_scene(points.reshape(-1, 3)))

    def __repr__(self) -> str:
        return repr(self.region)


def plane_velocity(velocity: Tensor, normal: Tensor, kind: str, friction: float) -> Tensor:
    """Velocity of nodes in contact with a plane at rest.

    Args:
        velocity: Node velocity [m/s], shape (..., 3).
        normal: Unit normal, pointing to the free side, shape (3,).
        kind: ``sticky`` (no motion), ``slip`` (no motion along the normal), ``separate`` (only none into the plane).
        friction: Coulomb coefficient: the tangential speed falls by at most ``friction`` times the normal speed that
            the contact takes away.

    Returns:
        Shape (..., 3).
    """
    if kind == "sticky":
        return torch.zeros_like(velocity)
    along = (velocity * normal).sum(-1, keepdim=True)
    removed = along.clamp(max=0.0) if kind == "separate" else along
    tangential = velocity - along * normal
    if friction > 0:
        speed = torch.linalg.vector_norm(tangential, dim=-1, keepdim=True)
        tangential = tangential * (
            1 - friction * removed.abs() / speed.clamp(min=torch.finfo(velocity.dtype).tiny)
        ).clamp(min=0.0)
    return tangential + (along - removed) * normal


class Boundary(Recordable, nn.Module, ABC):
    """Base of all conditions.

    Args:
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.

    Attributes:
        needs_position: Whether :meth:`forward` looks at where nodes are.
        needs_lattice: Whether it looks at where lattice points are.
        held_share: Share of a node's mass above which the particles of :meth:`particle_mask` hold it in ``total``; None
            if the condition acts on particles without holding nodes.
    """

    needs_position = False
    needs_lattice = False
    held_share: float | None = None

    def __init__(self, start: float = 0.0, end: float | None = None) -> None:
        super().__init__()
        self.start = float(start)
        self.end = math.inf if end is None else float(end)
        if not self.start < self.end:
            raise ValueError(f"Expected `end` to be later than `start` ({self.start} s), but got {self.end} s.")

    def in_frame(self, frame: FrameLike) -> Boundary:
        """The same condition with its geometry brought from scene units to metres, z up."""
        return self

    def particle_mask(self, rest_position: Tensor) -> Tensor | None:
        """Particles that the condition holds, from their rest positions (..., P, 3); None if it holds none."""
        return None

    def release_time(self, rest_position: Tensor) -> Tensor | None:
        """Time at which each particle is let go [s], shape (..., P); None if only ``end`` counts."""
        return None

    def active(self, time: Tensor) -> Tensor:
        """Whether the condition acts at a time [s]; scalar bool tensor, so that no GPU has to wait."""
        now = time + CLOCK
        return (now >= self.start) & (now < self.end)

    @abstractmethod
    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Return the node velocity (..., G, 3) [m/s] with the condition applied.

        Args:
            velocity: Node velocity after the momentum update [m/s], shape (..., G, 3).
            nodes: What else is known about them.
        """


class _OfParticles(Boundary):
    """Base of the conditions that act on the particles of a region, wherever they go."""

    def __init__(self, region: Region, start: float = 0.0, end: float | None = None) -> None:
        super().__init__(start, end)
        self.region = region

    def in_frame(self, frame: FrameLike) -> Boundary:
        """The condition with its region asked in metres."""
        moved = copy.copy(self)
        moved.region = RegionInFrame(self.region, frame)
        return moved

    def particle_mask(self, rest_position: Tensor) -> Tensor:
        """Particles inside the region at rest; ValueError if there are none."""
        mask = self.region.contains(rest_position)
        if not bool(mask.any()):
            low, high = self.region.bounds(rest_position)
            name = type(self).__name__
            raise ValueError(
                f"The region {self.region!r} of the {name} holds no particle: the simulated particles lie "
                f"between {low} and {high}; move or enlarge `region`."
            )
        return mask


class PinnedRegion(_OfParticles):
    """Holds the grid nodes of the particles whose rest position lies in a region.

    A pin that only reset its particles would let a sheet slide off, since their neighbours keep moving the shared
    nodes. So the nodes are held: in ``updated`` all that the particles touch, in ``total`` those in which they hold
    more than ``held_share`` of the mass. Where the material seems to be held is so known to a part of a cell: in
    ``total`` between 0.4 cells too far out and 0.4 too far in, as the particles lie to the grid, on average right with
    the default share; in ``updated`` about 0.7 too far in.

    Args:
        region: Where the pinned particles rest, in scene units.
        held_share: Share of the nodal mass in ``total``, between 0 and 1.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    recordable = True

    def __init__(self, region: Region, held_share: float = 0.07, start: float = 0.0, end: float | None = None) -> None:
        super().__init__(region, start, end)
        if not 0 <= held_share < 1:
            raise ValueError(f"Expected `held_share` to lie in [0, 1), but got {held_share}.")
        self.held_share = held_share

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Hold the nodes."""
        return torch.where((nodes.held & self.active(nodes.time))[..., None], torch.zeros_like(velocity), velocity)


class Handle(PinnedRegion):
    """Moves the particles of a region as a rigid body: a pin that travels and turns.

    Each substep takes the held nodes to exactly where the rigid motion has them at its end, so a handle that turns for
    minutes neither grows nor drifts. Once the window closes it lets go.

    Args:
        region: Where the held particles rest, in scene units.
        velocity: Velocity [m/s], z up.
        angular_velocity: Axis of the rotation times its rate [rad/s], z up.
        pivot: Point about which it turns, in scene units at time ``start``; it travels with ``velocity``.
        held_share: Share of the nodal mass in ``total``, between 0 and 1.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_lattice = True
    recordable = True

    def __init__(
        self,
        region: Region,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        pivot: Sequence[float] = (0.0, 0.0, 0.0),
        held_share: float = 0.07,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(region, held_share, start, end)
        turn = check_vector("angular_velocity", angular_velocity)
        self.rate = math.sqrt(sum(c * c for c in turn))
        for name, value in (
            ("velocity", check_vector("velocity", velocity)),
            ("axis", [c / self.rate if self.rate > 0 else 0.0 for c in turn]),
            ("pivot", check_vector("pivot", pivot)),
        ):
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))
        self.velocity: Tensor
        self.axis: Tensor
        self.pivot: Tensor

    def in_frame(self, frame: FrameLike) -> Handle:
        """The handle with its region and pivot in metres."""
        moved = copy.copy(self)
        moved.region = RegionInFrame(self.region, frame)
        moved._buffers = dict(self._buffers) | {"pivot": frame.point_to_sim(self.pivot)}
        return moved

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Take the held nodes along."""
        assert nodes.lattice is not None
        driven = self.velocity.to(velocity).expand_as(velocity)
        if self.rate > 0:
            pivot = self.pivot + self.velocity * (nodes.time - self.start)
            axis = self.axis.to(velocity).expand_as(velocity)
            arm = nodes.lattice - pivot.to(velocity)
            across = torch.linalg.cross(axis, arm, dim=-1)
            # the chord of the arc (Rodrigues), not the tangent: the velocity whose explicit step ends on the circle
            angle = self.rate * nodes.dt
            inward = (2 * _sin(angle / 2) ** 2 / nodes.dt) * torch.linalg.cross(axis, across, dim=-1)
            driven = driven + (_sin(angle) / nodes.dt) * across + inward
        return torch.where((nodes.held & self.active(nodes.time))[..., None], driven, velocity)


def _sin(angle: float | Tensor) -> float | Tensor:
    return angle.sin() if isinstance(angle, Tensor) else math.sin(angle)


class SequentialRelease(PinnedRegion):
    """Holds the particles of a region and lets them go one after the other, as a front passes over them.

    Args:
        region: Where the held particles rest, in scene units.
        direction: Direction in which the front travels, in scene axes.
        start: Time at which the front meets the first particle [s]; before it all are held.
        end: Time at which it passes the last one [s].
        held_share: Share of the nodal mass in ``total``, between 0 and 1.
        first: Point that the front meets at ``start``, in scene units, in place of the first particle.
        last: Point that it passes at ``end``, likewise; given together with ``first``, and farther along ``direction``.
    """

    recordable = True

    def __init__(
        self,
        region: Region,
        direction: Sequence[float] = (0.0, 0.0, 1.0),
        start: float = 0.0,
        end: float = 1.0,
        held_share: float = 0.07,
        first: Sequence[float] | None = None,
        last: Sequence[float] | None = None,
    ) -> None:
        super().__init__(region, held_share, start, end)
        if not math.isfinite(self.end):
            raise ValueError(f"Expected `end` of the SequentialRelease to be a finite time, but got {end}.")
        if not any(check_vector("direction", direction)):
            raise ValueError("Expected `direction` of the SequentialRelease not to be zero.")
        self.register_buffer("direction", torch.tensor([float(c) for c in direction], dtype=torch.float64))
        self.direction: Tensor
        if (first is None) != (last is None):
            raise ValueError("Give both `first` and `last` of the SequentialRelease, or neither.")
        ends = None
        if first is not None and last is not None:
            ends = torch.tensor([check_vector("first", first), check_vector("last", last)], dtype=torch.float64)
            if not float((ends[1] - ends[0]) @ self.direction) > 0:
                raise ValueError(
                    f"Expected `last` of the SequentialRelease farther along `direction` than `first`, but got "
                    f"{list(last)} and {list(first)}."
                )
        self.register_buffer("ends", ends)  # first and last, shape (2, 3)
        self.ends: Tensor | None

    def in_frame(self, frame: FrameLike) -> SequentialRelease:
        """The release with its region, direction and points in metres, z up."""
        moved = copy.copy(self)
        moved.region = RegionInFrame(self.region, frame)
        moved._buffers = dict(self._buffers) | {"direction": frame.direction_to_sim(self.direction).clone()}
        if self.ends is not None:
            moved._buffers["ends"] = frame.point_to_sim(self.ends)
        return moved

    def release_time(self, rest_position: Tensor) -> Tensor:
        """When the front passes each particle [s], shape (..., P), float64."""
        mask = self.region.contains(rest_position)
        along = (rest_position.double() * self.direction.to(rest_position.device)).sum(-1)
        if self.ends is None:
            low = along.where(mask, math.inf).amin(-1, keepdim=True)
            high = along.where(mask, -math.inf).amax(-1, keepdim=True)
        else:
            low, high = (self.ends.to(along) @ self.direction.to(along)).unbind()
        part = (along - low) / (high - low).clamp(min=torch.finfo(torch.float64).tiny)
        return self.start + part * (self.end - self.start)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Hold the nodes of those not yet released."""
        return torch.where(nodes.held[..., None], torch.zeros_like(velocity), velocity)


class Impulse(_OfParticles):
    """Pushes the particles of a region: a knock, or a force for some time.

    The impulse is spread evenly over the window and over the mass of the region; it arrives whole whatever the substep.

    Args:
        region: Where the pushed particles rest, in scene units.
        impulse: Impulse on the region as a whole [N s], z up.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s].
        per_particle: Whether ``impulse`` is that on each particle, so that the whole grows with their number.
    """

    recordable = True

    def __init__(
        self,
        region: Region,
        impulse: Sequence[float],
        start: float = 0.0,
        end: float = 0.04,
        per_particle: bool = False,
    ) -> None:
        super().__init__(region, start, end)
        if not math.isfinite(self.end):
            raise ValueError(f"Expected `end` of the Impulse to be a finite time, but got {end}.")
        self.register_buffer("impulse", torch.tensor(check_vector("impulse", impulse), dtype=torch.float64))
        self.impulse: Tensor
        self.per_particle = bool(per_particle)
        # particles of each scene of the batch, once they are known
        self.register_buffer("count", torch.ones((), dtype=torch.float64), persistent=False)
        self.count: Tensor

    def in_frame(self, frame: FrameLike) -> Impulse:
        """The impulse with its region asked in metres."""
        moved = copy.copy(self)
        moved.region, moved._buffers = RegionInFrame(self.region, frame), dict(self._buffers)
        return moved

    def particle_mask(self, rest_position: Tensor) -> Tensor:
        """Particles inside the region at rest, which are counted too; ValueError if there are none."""
        mask = super().particle_mask(rest_position)
        if self.per_particle:
            self.count = mask.sum(-1).to(self.impulse)
        return mask

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Add the part of the impulse that falls into the substep."""
        assert nodes.share is not None
        assert nodes.held_mass is not None
        overlap = (nodes.time + nodes.dt).clamp(max=self.end) - nodes.time.clamp(min=self.start)
        part = (overlap.clamp(min=0) / (self.end - self.start)).to(velocity)
        # a scene of the batch without any such particle has no share to push
        per_mass = nodes.share / nodes.held_mass.clamp(min=torch.finfo(velocity.dtype).tiny)[..., None]
        whole = self.impulse if not self.per_particle else self.count[..., None, None] * self.impulse
        return velocity + per_mass[..., None] * (part * whole.to(velocity))


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
        check_choice("kind", kind, ("sticky", "slip", "separate"))
        check_positive("friction", friction, allow_zero=True)
        self.kind, self.friction = kind, float(friction)
        n = torch.tensor(check_vector("normal", normal), dtype=torch.float64)
        if float(n.norm()) == 0:
            raise ValueError("Expected `normal` of the plane not to be zero.")
        self.register_buffer("point", torch.tensor(check_vector("point", point), dtype=torch.float64))
        self.register_buffer("normal", n / n.norm())
        self.point: Tensor
        self.normal: Tensor

    def in_frame(self, frame: FrameLike) -> Plane:
        """The plane in metres, z up."""
        moved = Plane([0, 0, 0], [0, 0, 1], self.kind, self.friction, self.start, self.end)
        moved.point, moved.normal = frame.point_to_sim(self.point), frame.direction_to_sim(self.normal).clone()
        return moved

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Stop the nodes at or behind the plane."""
        assert nodes.position is not None
        normal = self.normal.to(velocity)
        behind = ((nodes.position - self.point.to(velocity)) * normal).sum(-1) <= 0
        stopped = plane_velocity(velocity, normal, self.kind, self.friction)
        return torch.where((behind & self.active(nodes.time))[..., None], stopped, velocity)


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
            raise ValueError(f"Expected `min` of the box below `max` on every axis, but got {low} and {high}.")
        planes = []
        for axis in range(3):
            direction = [0.0, 0.0, 0.0]
            direction[axis] = 1.0
            planes.append(Plane(low, direction, kind, friction, start, end))
            planes.append(Plane(high, [-d for d in direction], kind, friction, start, end))
        self.planes = nn.ModuleList(planes)

    def in_frame(self, frame: FrameLike) -> EnclosingBox:
        """The box in metres, z up."""
        moved = copy.copy(self)
        moved._modules = {"planes": nn.ModuleList([p.in_frame(frame) for p in self.planes])}  # type: ignore[operator]
        return moved

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Stop the nodes at or beyond each face."""
        for plane in self.planes:
            velocity = plane(velocity, nodes)
        return velocity


class VelocityBox(Boundary):
    """Gives the nodes inside a region a prescribed velocity.

    Args:
        region: Where the nodes are driven, in scene units.
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

    def in_frame(self, frame: FrameLike) -> VelocityBox:
        """The box with its region asked in metres."""
        moved = copy.copy(self)
        moved.region = RegionInFrame(self.region, frame)
        return moved

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Drive the nodes inside."""
        assert nodes.position is not None
        where = nodes.position
        if self.travels:
            where = where - (self.velocity * (nodes.time - self.start)).to(where)
        inside = self.region.contains(where) & self.active(nodes.time)
        return torch.where(inside[..., None], self.velocity.to(velocity), velocity)
