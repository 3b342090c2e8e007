"""Boundary conditions: what holds, stops or drives grid nodes, each within a window of time.

A condition changes nodal velocities after the momentum update. Where a node "is" depends on the formulation: a lattice
point in ``updated``, the centre of the mass that it carries in ``total``.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying.gaussians.selection import Region


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


class RegionInFrame(Region):
    """A region given in scene units, asked about points in metres."""

    def __init__(self, region: Region, frame: FrameLike) -> None:
        self.region, self.frame = region, frame

    def contains(self, points: Tensor) -> Tensor:
        """Whether each point (..., 3) [m, z up] lies inside; bool, shape (...)."""
        return self.region.contains(self.frame.point_to_scene(points))

    def bounds(self, points: Tensor) -> str:
        """Where points [m, z up] lie, in the units in which the region was given."""
        return _bounds(self.frame.point_to_scene(points.reshape(-1, 3)))

    def __repr__(self) -> str:
        return repr(self.region)


def _bounds(points: Tensor) -> str:
    low, high = ([round(v, 4) for v in corner.tolist()] for corner in (points.amin(0), points.amax(0)))
    return f"{low} and {high}"


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


class Boundary(nn.Module, ABC):
    """Base of all conditions.

    Args:
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.

    Attributes:
        needs_position: Whether :meth:`forward` looks at where nodes are.
        held_share: Share of a node's mass that must belong to the particles of :meth:`particle_mask`, or None if the
            condition has no particles of its own.
    """

    needs_position = False

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

    def active(self, time: Tensor) -> Tensor:
        """Whether the condition acts at a time [s]; scalar bool tensor, so that no GPU has to wait."""
        return (time >= self.start) & (time < self.end)

    @abstractmethod
    def forward(self, velocity: Tensor, position: Tensor | None, held: Tensor | None, time: Tensor) -> Tensor:
        """Return the node velocity (..., G, 3) [m/s] with the condition applied.

        Args:
            velocity: Node velocity after the momentum update [m/s], shape (..., G, 3).
            position: Where the nodes are [m], shape (..., G, 3), if ``needs_position``.
            held: Nodes that the particles of the condition hold, bool, shape (..., G), if it has any.
            time: Time [s], scalar tensor.
        """


class PinnedRegion(Boundary):
    """Holds the grid nodes of the particles whose rest position lies in a region.

    A pin that only reset its particles would let a sheet slide off, since their neighbours keep moving the shared
    nodes. So the nodes are held: in ``updated`` all that the particles touch, in ``total`` those in which they hold
    more than ``held_share`` of the mass.

    Args:
        region: Where the pinned particles rest, in scene units.
        held_share: Share of the nodal mass in ``total``, between 0 and 1.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(self, region: Region, held_share: float = 0.3, start: float = 0.0, end: float | None = None) -> None:
        super().__init__(start, end)
        if not 0 <= held_share < 1:
            raise ValueError(f"Expected `held_share` to lie in [0, 1), but got {held_share}.")
        self.region = region
        self.held_share = held_share

    def in_frame(self, frame: FrameLike) -> PinnedRegion:
        """The pin with its region asked in metres."""
        moved = copy.copy(self)
        moved.region = RegionInFrame(self.region, frame)
        return moved

    def particle_mask(self, rest_position: Tensor) -> Tensor:
        """Particles inside the region at rest; ValueError if there are none."""
        mask = self.region.contains(rest_position)
        if not bool(mask.any()):
            inner = self.region
            where = (
                inner.bounds(rest_position)
                if isinstance(inner, RegionInFrame)
                else _bounds(rest_position.reshape(-1, 3))
            )
            raise ValueError(
                f"The pin {inner!r} holds no particle: the simulated particles lie between {where}; move or enlarge "
                "`region` of the PinnedRegion."
            )
        return mask

    def forward(self, velocity: Tensor, position: Tensor | None, held: Tensor | None, time: Tensor) -> Tensor:
        """Hold the nodes."""
        assert held is not None
        return torch.where((held & self.active(time))[..., None], torch.zeros_like(velocity), velocity)


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
        moved.point, moved.normal = frame.point_to_sim(self.point), frame.direction_to_sim(self.normal)
        return moved

    def forward(self, velocity: Tensor, position: Tensor | None, held: Tensor | None, time: Tensor) -> Tensor:
        """Stop the nodes at or behind the plane."""
        assert position is not None
        normal = self.normal.to(velocity)
        behind = ((position - self.point.to(velocity)) * normal).sum(-1) <= 0
        stopped = plane_velocity(velocity, normal, self.kind, self.friction)
        return torch.where((behind & self.active(time))[..., None], stopped, velocity)


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

    def forward(self, velocity: Tensor, position: Tensor | None, held: Tensor | None, time: Tensor) -> Tensor:
        """Stop the nodes at or beyond each face."""
        for plane in self.planes:
            velocity = plane(velocity, position, held, time)
        return velocity


class VelocityBox(Boundary):
    """Gives the nodes inside a region a prescribed velocity.

    Args:
        region: Where the nodes are driven, in scene units.
        velocity: Velocity [m/s], z up.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True

    def __init__(self, region: Region, velocity: Sequence[float], start: float = 0.0, end: float | None = None) -> None:
        super().__init__(start, end)
        self.region = region
        self.register_buffer("velocity", torch.tensor(check_vector("velocity", velocity), dtype=torch.float64))
        self.velocity: Tensor

    def in_frame(self, frame: FrameLike) -> VelocityBox:
        """The box with its region asked in metres."""
        moved = copy.copy(self)
        moved.region = RegionInFrame(self.region, frame)
        return moved

    def forward(self, velocity: Tensor, position: Tensor | None, held: Tensor | None, time: Tensor) -> Tensor:
        """Drive the nodes inside."""
        assert position is not None
        inside = self.region.contains(position) & self.active(time)
        return torch.where(inside[..., None], self.velocity.to(velocity), velocity)
