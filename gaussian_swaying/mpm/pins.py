"""Pins and pushes: what holds, drives or moves a part of the material."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_vector
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.geometry.rigid import rigid_velocity
from gaussian_swaying.mpm.boundary import BY_BODY, Boundary, Nodes, ParticleBoundary, refuse_points

KINDS = ("hinge", "clamp", "nodes")


class PinnedRegion(ParticleBoundary):
    """Holds the material whose rest position lies in a region.

    There are three kinds:

    - ``hinge`` holds one point in each grid cell of the region: the centre of the particles there. The material can
      turn about a line of such points, like a flag on its pole. It is held exactly where the region is. It is for
      sheets and cords: a part of several cells in thickness is neither free to turn nor held by it.
    - ``clamp`` holds the face between the particles of the region and the others, halfway between them, and what lies
      behind it. The material cannot turn. It is of second order, for any thickness and depth of the region.
    - ``nodes`` holds the grid nodes of the particles: in ``updated`` all nodes that the particles touch, in ``total``
      those where they have more than ``held_share`` of the mass. It cannot turn, either. Its effective edge is accurate
      to a fraction of a cell: in ``total`` it lies between 0.4 cells too far out and 0.4 cells too far in, depending on
      how the particles lie on the grid, and is right on average with the default share; in ``updated`` it lies about
      0.7 cells too far in.

    Args:
        region: Region of the pinned particles at rest, in scene units.
        kind: ``hinge`` and ``clamp`` (only in ``total``), ``nodes``, or None. None is ``nodes`` in ``updated``. In
            ``total`` it is ``hinge`` for a sheet (up to 1.25 cells thick where it is held, and at least two cells and
            2.5 thicknesses wide) and for points that are released one by one, and ``clamp`` for anything else.
        held_share: Share of the nodal mass for ``nodes`` in ``total``, between 0 and 1.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    recordable = True

    def __init__(
        self,
        region: Region,
        kind: str | None = None,
        *,
        held_share: float = 0.07,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(region, start, end)
        if kind is not None:
            check_choice("kind", kind, KINDS)
        if not 0 <= held_share < 1:
            raise ValueError(f"Expected `held_share` to lie in [0, 1), but got {held_share}.")
        self.kind, self.held_share = kind, held_share

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """The ``kind``, or the one that suits the formulation."""
        if self.kind is None:  # a subclass with its own `forward` acts on nodes
            return BY_BODY if neighbours_fixed and type(self).forward is PinnedRegion.forward else "nodes"
        if self.kind != "nodes" and not neighbours_fixed:
            raise refuse_points(self, f"`kind: {self.kind}`", "`kind` to nodes")
        return self.kind

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Give the held nodes their target velocity."""
        target = (
            torch.zeros_like(velocity) if nodes.lattice is None else self.target(nodes.lattice, nodes.time, nodes.dt)
        )
        return torch.where((nodes.held & self.active(nodes.time))[..., None], target, velocity)


class PinnedPoints(Boundary):
    """Holds the material at given places, exactly; only in ``total``.

    The places need not be particles: a banner hangs from its two grommets, a bar is held at its wall.

    Args:
        at: The places at rest, in scene units. Each must lie in the material, or less than a cell outside it.
        kind: ``hinge`` holds the places, ``clamp`` also the deformation there.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.

    Example:
        >>> PinnedPoints([[0.0, 0.0, 1.0], [0.8, 0.0, 1.0]]).at.shape
        torch.Size([2, 3])
    """

    recordable = True

    def __init__(
        self, at: Sequence[Sequence[float]], kind: str = "hinge", *, start: float = 0.0, end: float | None = None
    ) -> None:
        super().__init__(start, end)
        check_choice("kind", kind, KINDS[:2])
        if len(at) == 0:
            raise ValueError("Expected `at` of the PinnedPoints to name at least one place, but it is empty.")
        self.kind = kind
        self.register_buffer("at", torch.tensor([check_vector("at", place) for place in at], dtype=torch.float64))
        self.at: Tensor

    def in_frame(self, frame: SimFrame) -> PinnedPoints:
        """The same places in metres."""
        return changed(self, at=frame.point_to_sim(self.at))

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """The ``kind``."""
        if not neighbours_fixed:
            raise refuse_points(self, "Pinned points", "the boundary to a PinnedRegion of `kind: nodes`")
        return self.kind

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """The unchanged velocity: no node is held as such."""
        return velocity


class Handle(PinnedRegion):
    """Moves the particles of a region as a rigid body: a pin that travels and turns.

    Each substep moves what is held exactly to its place in the rigid motion, so a handle that turns for minutes neither
    grows nor drifts. It releases the material when its time window ends. As a ``hinge`` it turns its points, but not
    the slope of a sheet; as a ``clamp`` it turns both.

    Args:
        region: Region of the held particles at rest, in scene units.
        velocity: Velocity [m/s], z up.
        angular_velocity: Axis of the rotation times its rate [rad/s], z up.
        pivot: Point about which it turns, in scene units at time ``start``; it travels with ``velocity``.
        kind: ``hinge``, ``clamp``, ``nodes`` or None, as for a :class:`PinnedRegion`.
        held_share: Share of the nodal mass for ``nodes`` in ``total``, between 0 and 1.
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
        kind: str | None = None,
        held_share: float = 0.07,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(region, kind, held_share=held_share, start=start, end=end)
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

    def in_frame(self, frame: SimFrame) -> Handle:
        """The handle with its region and pivot in metres."""
        return self.copy_in(frame, pivot=frame.point_to_sim(self.pivot))

    def target(self, place: Tensor, time: Tensor, dt: float | Tensor) -> Tensor:
        """Velocity of the rigid motion, such that an explicit step ends exactly on it.

        Shape (..., 3) [m/s].
        """
        driven = self.velocity.to(place).expand_as(place)
        if self.rate > 0:
            pivot = self.pivot + self.velocity * (time - self.start)
            along, inward = self._arc(place - pivot.to(place), dt)
            driven = driven + along + inward
        return driven

    def turning(self, arm: Tensor, dt: float | Tensor) -> Tensor:
        """The part of the velocity that is due to the rotation, for arms (..., 3) from the pivot [m]."""
        along, inward = self._arc(arm, dt)
        return along + inward

    def _arc(self, arm: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Velocity along the circle about the axis and towards it; together the chord of the arc."""
        if self.rate == 0:
            return torch.zeros_like(arm), torch.zeros_like(arm)
        axis = self.axis.to(arm).expand_as(arm)
        across = torch.linalg.cross(axis, arm, dim=-1)
        # the chord of the arc (Rodrigues), not the tangent: the velocity whose explicit step ends on the circle
        angle = self.rate * dt
        inward = (2 * _sin(angle / 2) ** 2 / dt) * torch.linalg.cross(axis, across, dim=-1)
        return (_sin(angle) / dt) * across, inward


def _sin(angle: float | Tensor) -> float | Tensor:
    return angle.sin() if isinstance(angle, Tensor) else math.sin(angle)


class SequentialRelease(PinnedRegion):
    """Holds the particles of a region and releases them one after the other, as a front passes over them.

    Args:
        region: Region of the held particles at rest, in scene units.
        direction: Direction in which the front travels, in scene axes.
        start: Time at which the front meets the first particle [s]; before that, all are held.
        end: Time at which it passes the last one [s].
        kind: ``hinge``, ``clamp``, ``nodes`` or None, as for a :class:`PinnedRegion`. Held points are released when the
            front passes them.
        held_share: Share of the nodal mass for ``nodes`` in ``total``, between 0 and 1.
        first: Point that the front meets at ``start``, in scene units, instead of the first particle.
        last: Point that it passes at ``end``, in scene units, instead of the last particle; must be given together with
            ``first`` and lie farther along ``direction``.
    """

    def __init__(
        self,
        region: Region,
        direction: Sequence[float] = (0.0, 0.0, 1.0),
        start: float = 0.0,
        end: float = 1.0,
        kind: str | None = None,
        held_share: float = 0.07,
        first: Sequence[float] | None = None,
        last: Sequence[float] | None = None,
    ) -> None:
        super().__init__(region, kind, held_share=held_share, start=start, end=end)
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
                    f"Expected `last` of the SequentialRelease to be farther along `direction` than `first`, but got "
                    f"{list(last)} and {list(first)}."
                )
        self.register_buffer("ends", ends)  # first and last, shape (2, 3)
        self.ends: Tensor | None

    def in_frame(self, frame: SimFrame) -> SequentialRelease:
        """The release with its region, direction and points in metres, z up."""
        tensors = {"direction": frame.direction_to_sim(self.direction).clone()}
        if self.ends is not None:
            tensors["ends"] = frame.point_to_sim(self.ends)
        return self.copy_in(frame, **tensors)

    @property
    def holds_from(self) -> float:
        return -math.inf

    def active(self, time: Tensor) -> Tensor:
        """Always: particles are released one by one instead."""
        return time > -math.inf

    def release_time(self, rest_position: Tensor) -> Tensor:
        """When the front passes each particle [s], shape (..., P), float64."""
        mask = self.region.contains(rest_position)
        place = in_double(rest_position)
        mask = mask.to(place.device)
        along = (place * self.direction.to(place.device)).sum(-1)
        if self.ends is None:
            low = along.where(mask, math.inf).amin(-1, keepdim=True)
            high = along.where(mask, -math.inf).amax(-1, keepdim=True)
        else:
            low, high = (self.ends.to(along) @ self.direction.to(along)).unbind()
        part = (along - low) / (high - low).clamp(min=torch.finfo(torch.float64).tiny)
        return self.start + part * (self.end - self.start)


class Impulse(ParticleBoundary):
    """Pushes the particles of a region: a short hit, or a force for some time.

    The impulse is spread evenly over the window and over the mass of the region; the total does not depend on the
    substep.

    Args:
        region: Region of the pushed particles at rest, in scene units.
        impulse: Impulse on the region as a whole [N s], z up.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s].
        per_particle: Whether ``impulse`` acts on each particle, so that the total grows with their number.
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
        # number of particles in each scene of the batch, once known
        self.register_buffer("count", torch.ones((), dtype=torch.float64), persistent=False)
        self.count: Tensor

    def particle_mask(self, rest_position: Tensor) -> Tensor:
        """Particles inside the region at rest, which are also counted; ValueError if there are none."""
        mask = super().particle_mask(rest_position)
        if self.per_particle:
            assign(self, count=mask.sum(-1).to(self.impulse))
        return mask

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Add the part of the impulse that belongs to the substep."""
        assert nodes.share is not None
        assert nodes.held_mass is not None
        overlap = (nodes.time + nodes.dt).clamp(max=self.end) - nodes.time.clamp(min=self.start)
        part = (overlap.clamp(min=0) / (self.end - self.start)).to(velocity)
        # in a scene of the batch without such particles all shares are zero
        per_mass = nodes.share / nodes.held_mass.clamp(min=torch.finfo(velocity.dtype).tiny)[..., None]
        whole = self.impulse if not self.per_particle else self.count[..., None, None] * self.impulse
        return velocity + per_mass[..., None] * (part * whole.to(velocity))


FREE = 1e-9  # weight of a free node beside that of a held one: what holds a node of a body holds the body


class RigidRegion(ParticleBoundary):
    """Moves the material whose rest position lies in a region as one rigid body, driven by all forces on it.

    In each substep the nodes of its particles get the velocities of the rigid motion that has their momentum and
    angular momentum. Soft material pulls the body where it shares nodes with it, and is moved there. In ``updated``
    these are all nodes that the particles touch, in ``total`` those where they have more than ``held_share`` of the
    mass, as for a :class:`PinnedRegion` of kind ``nodes``.

    A pin of kind ``nodes`` that shares nodes with the body holds it, and a handle of that kind leads it.

    Args:
        region: Region of the body at rest, in scene units.
        held_share: Share of the nodal mass in ``total``, between 0 and 1.
    """

    needs_lattice = True
    recordable = True

    def __init__(self, region: Region, held_share: float = 0.07) -> None:
        super().__init__(region)
        if not 0 <= held_share < 1:
            raise ValueError(f"Expected `held_share` to lie in [0, 1), but got {held_share}.")
        self.held_share = held_share

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Give the nodes of the body the velocities of a rigid motion."""
        assert nodes.mass is not None
        assert nodes.lattice is not None
        index = nodes.index

        def part(field: Tensor, dim: int) -> Tensor:
            return field if index is None else field.index_select(dim, index)

        held, own = part(nodes.held, -1), part(velocity, -2)
        mass = torch.where(held, in_double(part(nodes.mass, -1)), 0.0)
        if nodes.fixed is not None:
            fixed = part(nodes.fixed, -1) & held
            mass = mass * torch.where(fixed | ~fixed.any(-1, keepdim=True), 1.0, FREE)
        dt = nodes.dt if isinstance(nodes.dt, float) else nodes.dt.to(mass)
        moved = rigid_velocity(in_double(part(nodes.lattice, -2)), in_double(own), mass, dt)
        moved = torch.where(held[..., None], moved.to(velocity), own)
        return moved if index is None else velocity.index_copy(-2, index, moved)
