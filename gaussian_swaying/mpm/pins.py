r"""Pins and pushes: what holds, drives or moves a part of the material.

Pins act on nodes, or in the ``total`` formulation on points of the material. A pinned point is a constraint row of
constant weights :math:`C` on the nodes: the quadratic B-splines at its rest place, or their slopes for a clamp. The
velocity :math:`v` of the nodes, of mass :math:`M`, is changed as little as possible (Gauss's principle of least
constraint) so that the rows move with their target velocity :math:`g'`:

.. math:: v \leftarrow v - M^{-1} C^T \lambda, \qquad (C M^{-1} C^T)\, \lambda = C v - g'.

:math:`\lambda` is the reaction impulse: the momentum that each row takes from the body. The projection removes motions
and adds no stiffness, so the stable substep does not shrink. All rows of a body form one system, so pins that share
nodes agree.

Rows that nearly depend on others are left out (``independent_rows``). They are sorted by decreasing release time.
With :math:`C M^{-1} C^T = L L^T` and :math:`W = L^{-1}`, both lower triangular, the inverse for the first k rows is
:math:`W^T D W`, where :math:`D` keeps the first k: nothing is factorised during a run. For each time at which a
boundary starts there is a phase with its own rows.

A clamped solid does not move at the face between pinned and free material; its strain across the face is free. So a
clamped region has its rows on the face: the mean displacement of patches of half a cell, and its slopes along the
face, without which a strip thinner than a cell could turn. Behind the face the boundary stops the nodes that carry
pinned material alone. Nodes that carry both follow the free side: a condition on them would move the face by up to a
cell, which is why pins of ``kind: nodes`` are of first order.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_vector
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.groups import equal_rows, sums
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.geometry.rigid import rigid_velocity
from gaussian_swaying.mpm.boundary import BY_BODY, CLOCK, FACE, Boundary, Nodes, ParticleBoundary
from gaussian_swaying.mpm.formulation import Formulation
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.transfer import Stencil, bspline_weights, shifts
from gaussian_swaying.mpm.virtual_nodes import coordinates, first_nodes, first_of, point_with_nodes

KINDS = ("hinge", "clamp", "nodes")

NODE_SHARE = 0.07
"""Share of the mass of a node in ``total`` above which pinned particles hold it: the edge is right on average."""

MOST_ROWS = 2000
"""Most rows of one scene: its inverse is dense."""

LEAST_OWN = 0.2
"""Least share of a row, in the norm of the inverse mass, that the rows chosen before it must leave over.

The condition of the chosen rows grows with its inverse. Rows at the centres of full cells of uniform mass keep 0.79 of
themselves in a line, 0.63 in a plane and 0.5 in a solid (one over the mean of the inverse of the spectrum (3/4 +
cos(k)/4)² of a line, to the power of one, two and three). A second row at nearly the same place, or a slope along a
pinned line, keeps less than a fifth. The condition is then below 50 for hinges and below 200 for clamps, for lines at
any angle and for patches (tested).
"""

LEAST_OWN_ON_A_FACE = 0.05
"""The same for the rows of a clamped face, which lie closer to each other; the condition stays below 1,000 (tested)."""

LEAST_APART = 0.6
"""Least distance between the points of a region that are pinned [cells].

Two halves of a strip one cell wide are half a cell apart: such a strip is one line, wherever it lies on the grid.
"""

PATCH = 0.5
"""Side of a patch of a face [cells]: with patches of a whole cell, a section two cells thick still turns by some per
cent."""

PINNED_ALONE = 0.999
"""Share of the mass of a node above which it counts as carrying pinned material alone."""

SOFTENED = 0.03
"""Factor of the stiffness of material that a clamp holds all the time.

Rigid material needs no stiffness. In the cells that the face cuts, pinned material would share the curvature of the
free side and stiffen it, as if the face lay up to a quarter of a cell farther out: an error of first order. Without any
stiffness of the pinned material, nodes with only a sliver of free material would be almost unconnected. Measured on
cantilevers of 0.3 to 6 cells.
"""

SHEET = 1.25
"""A sheet is at most so thick [cells]: the grid cannot tell the two sides of it apart."""

LAYER = 0.05
"""Thickness below which a body is a single layer of points [cells]."""

_SEEN, _WIDE, _BROAD = 4.0, 2.0, 2.5  # cells around a pinned particle; least width in cells, and in thicknesses
_SAMPLES = 32
_TURNS = 8  # times that a normal is found again with the weights that it gives
_AT_ONCE = 256  # points whose distances from all others are looked at
_NO_WEIGHT = 1e-6  # of a node that a particle on the border of its cell does not reach

POINTS = ("hinge", "clamp", FACE)
"""Kinds of boundaries that hold points."""


class PinnedRegion(ParticleBoundary):
    """Holds the material whose rest position lies in a region.

    There are three kinds:

    - ``hinge`` holds one point in each grid cell of the region: the centre of the particles there. The material can
      turn about a line of such points, like a flag on its pole. It is held exactly where the region is. It is for
      sheets and cords: a part of several cells in thickness is neither free to turn nor held by it.
    - ``clamp`` holds the face between the particles of the region and the others, halfway between them, and what lies
      behind it. The material cannot turn. It is of second order, for any thickness and depth of the region.
    - ``nodes`` holds the grid nodes of the particles: in ``updated`` all nodes that the particles touch, in ``total``
      those where they have more than 7 % of the mass. It cannot turn, either. Its effective edge is accurate to a
      fraction of a cell: in ``total`` it lies between 0.4 cells too far out and 0.4 cells too far in, depending on how
      the particles lie on the grid, and is right on average; in ``updated`` it lies about 0.7 cells too far in.

    It may travel and turn as a rigid body: each substep moves what is held exactly to its place in the rigid motion, so
    a pin that turns for minutes neither grows nor drifts. As a ``hinge`` it turns its points, but not the slope of a
    sheet; as a ``clamp`` it turns both. With a ``front`` it releases its particles one after the other.

    Args:
        region: Region of the pinned particles at rest, in scene units.
        kind: ``hinge`` and ``clamp`` (only in ``total``), ``nodes``, or None. None is ``nodes`` in ``updated``. In
            ``total`` it is ``hinge`` for a sheet (up to 1.25 cells thick where it is held, and at least two cells and
            2.5 thicknesses wide) and for points that are released one by one, and ``clamp`` for anything else.
        velocity: Velocity [m/s], z up.
        angular_velocity: Axis of the rotation times its rate [rad/s], z up.
        pivot: Point about which it turns, in scene units at time ``start``; it travels with ``velocity``.
        front: Direction of a front that releases what it passes, in scene axes: ``[direction]``. It meets the first
            particle at ``start``, and passes the last one at ``end``; or two places in scene units instead of these
            particles, ``[first, last]``, in planes across their line. Before ``start``, all are held.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    recordable = True
    pinned_share = NODE_SHARE
    velocity: Tensor
    axis: Tensor
    pivot: Tensor

    def __init__(
        self,
        region: Region,
        kind: str | None = None,
        *,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        angular_velocity: Sequence[float] = (0.0, 0.0, 0.0),
        pivot: Sequence[float] = (0.0, 0.0, 0.0),
        front: list[list[float]] | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(region, start, end)
        if kind is not None:
            check_choice("kind", kind, KINDS)
        self.kind = kind
        turn = check_vector("angular_velocity", angular_velocity)
        self.rate = math.sqrt(sum(c * c for c in turn))
        for name, value in (
            ("velocity", check_vector("velocity", velocity)),
            ("axis", [c / self.rate if self.rate > 0 else 0.0 for c in turn]),
            ("pivot", check_vector("pivot", pivot)),
        ):
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))
        self.driven = self.rate > 0 or any(velocity)
        ends = None
        if front is not None:
            ends = torch.tensor([check_vector("front", place) for place in front], dtype=torch.float64)
            if len(front) not in (1, 2) or not bool((ends[-1] - ends[:-1].sum(0)).any()):
                raise ValueError(f"Expected `front` to be a direction, or two places apart, but got {ends.tolist()}.")
            if not math.isfinite(self.end):
                raise ValueError(f"Expected `end` of a PinnedRegion with a `front` to be a finite time, but got {end}.")
        self.register_buffer("front", ends)
        self.front: Tensor | None

    @property
    def moves(self) -> bool:
        """True if it travels or turns."""
        return self.driven or type(self).target is not PinnedRegion.target

    @property
    def needs_lattice(self) -> bool:  # type: ignore[override]
        """True if it moves."""
        return self.moves

    @property
    def holds_from(self) -> float:
        return self.start if self.front is None else -math.inf

    def active(self, time: Tensor) -> Tensor:
        """With a front always: particles are released one by one instead."""
        return super().active(time) if self.front is None else time > -math.inf

    def in_frame(self, frame: SimFrame) -> PinnedRegion:
        """The pin with its places in metres, z up."""
        tensors = {"pivot": frame.point_to_sim(self.pivot)}
        if self.front is not None:
            alone = len(self.front) == 1
            tensors["front"] = frame.direction_to_sim(self.front) if alone else frame.point_to_sim(self.front)
        return self.copy_in(frame, **tensors)

    def target(self, place: Tensor, time: Tensor, dt: float | Tensor) -> Tensor:
        """Velocity of the rigid motion, such that an explicit step ends exactly on it.

        Shape (..., 3) [m/s].
        """
        driven = self.velocity.to(place).expand_as(place)
        if self.rate > 0:
            pivot = (self.pivot + self.velocity * (time - self.start)).to(place)
            axis = self.axis.to(place).expand_as(place)
            across = torch.linalg.cross(axis, place - pivot, dim=-1)
            # the chord of the arc (Rodrigues), not the tangent: the velocity whose explicit step ends on the circle
            angle = self.rate * dt
            inward = (2 * _sin(angle / 2) ** 2 / dt) * torch.linalg.cross(axis, across, dim=-1)
            driven = driven + (_sin(angle) / dt) * across + inward
        return driven

    def release_time(self, rest_position: Tensor) -> Tensor | None:
        """When the front passes each particle [s], shape (..., P), float64."""
        if self.front is None:
            return None
        mask = self.region.contains(rest_position)
        place = in_double(rest_position)
        mask = mask.to(place.device)
        front = self.front.to(place.device)
        direction = front[0] if len(front) == 1 else front[1] - front[0]
        along = (place * direction).sum(-1)
        if len(front) == 1:
            low = along.where(mask, math.inf).amin(-1, keepdim=True)
            high = along.where(mask, -math.inf).amax(-1, keepdim=True)
        else:
            low, high = (front @ direction).unbind()
        part = (along - low) / (high - low).clamp(min=torch.finfo(torch.float64).tiny)
        return self.start + part * (self.end - self.start)

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """The ``kind``, or the one that suits the formulation."""
        if self.kind is None:  # a subclass with its own `forward` acts on nodes
            return BY_BODY if neighbours_fixed and type(self).forward is PinnedRegion.forward else "nodes"
        if self.kind != "nodes" and not neighbours_fixed:
            raise _refused(self, f"`kind: {self.kind}`", "`kind` to nodes")
        return self.kind

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Give the held nodes their target velocity."""
        target = torch.zeros_like(velocity)
        if self.moves and nodes.lattice is not None:
            target = self.target(nodes.lattice, nodes.time, nodes.dt)
        return torch.where((nodes.pinned & self.active(nodes.time))[..., None], target, velocity)


def _refused(boundary: Boundary, what: str, instead: str) -> ValueError:
    return ValueError(
        f"{what} of the {type(boundary).__name__} needs particles that keep their neighbours, which the updated "
        f"formulation does not have: set {instead}, or `solver.formulation` to total."
    )


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
    at: Tensor

    def __init__(
        self, at: Sequence[Sequence[float]], kind: str = "hinge", *, start: float = 0.0, end: float | None = None
    ) -> None:
        super().__init__(start, end)
        check_choice("kind", kind, KINDS[:2])
        if len(at) == 0:
            raise ValueError("Expected `at` of the PinnedPoints to name at least one place, but it is empty.")
        self.kind = kind
        self.register_buffer("at", torch.tensor([check_vector("at", place) for place in at], dtype=torch.float64))

    def in_frame(self, frame: SimFrame) -> PinnedPoints:
        """The same places in metres."""
        return changed(self, at=frame.point_to_sim(self.at))

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """The ``kind``."""
        if not neighbours_fixed:
            raise _refused(self, "Pinned points", "the boundary to a PinnedRegion of `kind: nodes`")
        return self.kind

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """The unchanged velocity: no node is held as such."""
        return velocity


def _sin(angle: float | Tensor) -> float | Tensor:
    return angle.sin() if isinstance(angle, Tensor) else math.sin(angle)


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
    turn = 0
    impulse: Tensor
    count: Tensor

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
        self.per_particle = bool(per_particle)
        # number of particles in each scene of the batch, once known
        self.register_buffer("count", torch.ones((), dtype=torch.float64), persistent=False)

    def particle_mask(self, rest_position: Tensor) -> Tensor:
        """Particles inside the region at rest, which are also counted; ValueError if there are none."""
        mask = super().particle_mask(rest_position)
        if self.per_particle:
            assign(self, count=mask.sum(-1).to(self.impulse))
        return mask

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Add the part of the impulse that belongs to the substep."""
        assert nodes.share is not None
        assert nodes.pinned_mass is not None
        overlap = (nodes.time + nodes.dt).clamp(max=self.end) - nodes.time.clamp(min=self.start)
        part = (overlap.clamp(min=0) / (self.end - self.start)).to(velocity)
        # in a scene of the batch without such particles all shares are zero
        per_mass = nodes.share / nodes.pinned_mass.clamp(min=torch.finfo(velocity.dtype).tiny)[..., None]
        whole = self.impulse if not self.per_particle else self.count[..., None, None] * self.impulse
        return velocity + per_mass[..., None] * (part * whole.to(velocity))


FREE = 1e-9  # weight of a free node beside that of a held one: what holds a node of a body holds the body


class RigidRegion(ParticleBoundary):
    """Moves the material whose rest position lies in a region as one rigid body, driven by all forces on it.

    In each substep the nodes of its particles get the velocities of the rigid motion that has their momentum and
    angular momentum. Soft material pulls the body where it shares nodes with it, and is moved there. In ``updated``
    these are all nodes that the particles touch, in ``total`` those where they have more than 7 % of the
    mass, as for a :class:`PinnedRegion` of kind ``nodes``.

    A pin of kind ``nodes`` that shares nodes with the body holds it, and a handle of that kind leads it.

    Args:
        region: Region of the body at rest, in scene units.
    """

    needs_lattice = True
    recordable = True
    turn = 2
    pinned_share = NODE_SHARE

    def __init__(self, region: Region) -> None:
        super().__init__(region)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Give the nodes of the body the velocities of a rigid motion."""
        assert nodes.mass is not None
        assert nodes.lattice is not None
        index = nodes.index

        def part(field: Tensor, dim: int) -> Tensor:
            return field if index is None else field.index_select(dim, index)

        held, own = part(nodes.pinned, -1), part(velocity, -2)
        mass = torch.where(held, in_double(part(nodes.mass, -1)), 0.0)
        if nodes.fixed is not None:
            fixed = part(nodes.fixed, -1) & held
            mass = mass * torch.where(fixed | ~fixed.any(-1, keepdim=True), 1.0, FREE)
        dt = nodes.dt if isinstance(nodes.dt, float) else nodes.dt.to(mass)
        moved = rigid_velocity(in_double(part(nodes.lattice, -2)), in_double(own), mass, dt)
        moved = torch.where(held[..., None], moved.to(velocity), own)
        return moved if index is None else velocity.index_copy(-2, index, moved)


# ---- how a body is pinned


class _Part(NamedTuple):
    """The part of a connected piece of one scene that a boundary pins; on the CPU, in float64.

    Attributes:
        scene: The scene.
        piece: The particles of the piece, shape (P,).
        points: Their positions at rest [m], shape (P, 3).
        mass: Their masses [kg], shape (P,).
        pinned: Which of them are pinned, bool, shape (P,).
        place: Positions of those, or for given places the nearest to this piece, shape (N, 3).
        number: The number of each place among those that are given, shape (N,).
    """

    scene: int
    piece: Tensor
    points: Tensor
    mass: Tensor
    pinned: Tensor
    place: Tensor
    number: Tensor


def _parts(body: Formulation, k: int) -> Iterator[_Part]:
    boundary, own, count = body.boundaries[k], body.pinned[k], body.points.count
    position, mass = body.points.position.reshape(-1, count, 3).cpu().double(), body.points.mass.reshape(-1, count)
    given = boundary.at.detach().cpu().double() if isinstance(boundary, PinnedPoints) else position[0, :0]
    for scene, every in enumerate(position):
        near = nearest_neighbours(every, 1, given)[1][:, 0]
        for some in body.pieces:
            piece = torch.arange(count) if some is None else some
            points, number = every[piece], torch.isin(near, piece).nonzero()[:, 0]
            if own is None:
                pinned, place = torch.zeros(len(piece), dtype=torch.bool), given[number]
            else:
                pinned = own.mass.reshape(-1, count)[scene].cpu()[piece] > 0
                place = points[pinned]
            if len(place):
                yield _Part(scene, piece, points, mass[scene].cpu().double()[piece], pinned, place, number)


def kind_in_total(body: Formulation, k: int) -> str:
    """What a boundary acts on in ``total``: ``nodes``, ``surface``, or points as ``hinge``, ``clamp`` or ``face``.

    A pin without a kind holds a sheet by a hinge, and anything else by a clamp, but next to a rigid part nodes, as
    points cannot share nodes with one. A clamp of a region that is not released one by one is a face. Warns if a hinge
    or a clamped place is to hold a part of several cells in thickness, which it cannot, and if a hinge is wider than a
    line of points.
    """
    boundary, own, dx = body.boundaries[k], body.pinned[k], body.settings.dx
    kind, given = boundary.hold_kind(True), isinstance(boundary, PinnedPoints)
    if kind == BY_BODY and _next_to_rigid(body, k):
        return "nodes"
    released = own is not None and own.release is not None
    if kind == BY_BODY or kind == ("clamp" if given else "hinge"):
        parts = list(_parts(body, k))
        found = [thickness(part.points, part.mass, part.place, dx) for part in parts]
        thick = max(least for least, _ in found)
        if kind == BY_BODY:
            kind = "hinge" if released or all(sheet for _, sheet in found) else "clamp"
        elif thick > SHEET * dx:
            remedy = "use a PinnedRegion" if given else "set `kind` to clamp, or to null"
            warnings.warn(
                f"`kind: {kind}` of the {type(boundary).__name__} is to hold a part that is {thick / dx:.2g} cells "
                f"thick, which still turns: {remedy}.",
                UserWarning,
                stacklevel=2,
            )
        elif kind == "hinge":
            wide = max(sides(part.place, part.mass[part.pinned], part.place, dx)[1] for part in parts)
            if wide > 2 * LEAST_APART * dx:
                warnings.warn(
                    f"The region of the {type(boundary).__name__} with `kind: hinge` is {wide / dx:.2g} cells wide, so "
                    "it holds several lines and with them the slope: make it narrower than a cell (`solver.dx`), or "
                    "set `kind` to clamp to hold the slope.",
                    UserWarning,
                    stacklevel=2,
                )
    return FACE if kind == "clamp" and own is not None and not released else kind


def _next_to_rigid(body: Formulation, k: int) -> bool:
    """True if a boundary pins particles that may share nodes with a rigid part."""
    if body.pinned[k] is None or not body.rigid:
        return False
    from scipy.spatial import cKDTree

    reach, count = 3 * body.settings.dx, body.points.count
    rigid, place = body.is_rigid().reshape(-1, count).cpu(), body.points.position.detach().reshape(-1, count, 3).cpu()
    trees = [cKDTree(own[part].double().numpy()) for own, part in zip(place, rigid, strict=True)]
    return any(
        bool((trees[part.scene].query(part.place.detach(), p=math.inf, distance_upper_bound=reach)[0] < reach).any())
        for part in _parts(body, k)
    )


@torch.no_grad()
def sides(points: Tensor, mass: Tensor, places: Tensor, dx: float) -> list[float]:
    """Three sides of the box with the mass and second moments of the points within four cells of some places.

    Args:
        points: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        places: The places [m], shape (N, 3), at least one; the median over at most 32 of them counts.
        dx: Grid spacing [m].

    Returns:
        The sides, ascending [m].
    """
    near = [(points - place).norm(dim=-1) < _SEEN * dx for place in places[:: math.ceil(len(places) / _SAMPLES)]]
    moments = [torch.cov(points[some].T, correction=0, aweights=mass[some]) for some in near]
    found: list[float] = (
        (12 * torch.linalg.eigvalsh(torch.stack(moments)).clamp(min=0)).sqrt().median(0).values.tolist()
    )
    return found


def thickness(points: Tensor, mass: Tensor, places: Tensor, dx: float) -> tuple[float, bool]:
    """The thickness of a body at some places [m], and whether it is a sheet there.

    A sheet is no thicker than :data:`SHEET` cells, and at least two cells and two and a half thicknesses wide. The
    arguments are those of :func:`sides`.
    """
    least, middle, _ = sides(points, mass, places, dx)
    return least, least <= SHEET * dx and middle >= max(_WIDE * dx, _BROAD * least)


# ---- the face of a clamp


def face(points: Tensor, pinned: Tensor, dx: float) -> tuple[Tensor, Tensor]:
    """Places on the face between pinned and free particles, and directions across it.

    A place lies in the middle between a pinned and a free particle, each of which is the nearest of its kind to the
    other, less than two cells apart.

    Args:
        points: Positions [m], shape (P, 3).
        pinned: Which particles are pinned, bool, shape (P,).
        dx: Grid spacing [m].

    Returns:
        Places [m] and unit vectors from pinned to free, shape (N, 3) each.
    """
    own, free = points[pinned], points[~pinned]
    if not len(own) or not len(free):
        return points[:0], points[:0]
    distance, partner = (found[:, 0] for found in nearest_neighbours(free, 1, own))
    reach = distance < 2 * dx
    own, free = own[reach], free[partner[reach]]
    if len(own):
        mutual = nearest_neighbours(own, 1, free)[1][:, 0] == torch.arange(len(own))
        own, free = own[mutual], free[mutual]
    across = free - own
    return (own + free) / 2, across / across.norm(dim=-1, keepdim=True)


def along_face(normal: Tensor) -> Tensor:
    """Directions of the slopes that a clamp holds at patches of a face.

    Args:
        normal: Mean of the directions across the face, shape (N, 3).

    Returns:
        Shape (N, 3, 3): two unit vectors along the face and zeros; the three axes where the normal is short, because
        directions differ so much that the patch has no side.
    """
    long, axes = normal.norm(dim=-1), torch.eye(3, dtype=normal.dtype)
    unit = normal / long.clamp(min=1e-9)[:, None]
    first = torch.linalg.cross(unit, axes[unit.abs().argmin(-1)], dim=-1)
    first = first / first.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    both = torch.stack([first, torch.linalg.cross(unit, first, dim=-1), torch.zeros_like(unit)], dim=-2)
    return torch.where((long > 0.5)[:, None, None], both, axes)


def face_patches(points: Tensor, mass: Tensor, pinned: Tensor, dx: float) -> tuple[Tensor, Tensor]:
    """The patches of the face of a clamped region: their centres, and the directions of the slopes that are pinned.

    Patches are larger than :data:`PATCH` where the face would take too many rows. A sheet of a single layer has no
    section that could turn, so the slope across its face is pinned, too.

    Args:
        points: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        pinned: Which particles are pinned, bool, shape (P,).
        dx: Grid spacing [m].

    Returns:
        Shapes (N, 3) and (N, 3, 3).
    """
    place, across = face(points, pinned, dx)
    if not len(place):
        return place, across[:, None]
    size, equal = PATCH * dx, torch.ones_like(place[:, 0])
    while 4 * (int((cell := equal_rows((place.detach() / size).floor())).max()) + 1) > MOST_ROWS:
        size *= 2
    group = groups(place, equal, cell, LEAST_APART * size)
    normal = means(across, equal, group)
    if thickness(points, mass, place, dx)[0] < LAYER * dx:
        normal = torch.zeros_like(normal)
    return means(place, equal, group), along_face(normal)


# ---- the points of a hinge


def means(values: Tensor, mass: Tensor, group: Tensor) -> Tensor:
    """The mean of values (P, n) over each group, weighted with masses (P,); groups are numbered from 0, shape (P,)."""
    total = sums(torch.cat([mass[:, None] * values, mass[:, None]], dim=-1), group)
    return total[:, :-1] / total[:, -1:]


@torch.no_grad()
def groups(
    position: Tensor, mass: Tensor, cell: Tensor, apart: float, normal: Tensor | None = None, thick: float = 0.0
) -> Tensor:
    """Group particles by cell, and join groups with close centres until all are some distance apart.

    A strip or a sheet that is thinner than a cell may cross the border of two. Two rows so close together would hold
    its slope; joined they are the line, or the middle plane, that is meant. With a ``normal`` the distance is that
    along the sheet, through whose thickness groups are joined, too.

    Args:
        position: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        cell: A number for the cell of each, shape (P,).
        apart: Least distance between centres [m].
        normal: Unit normals of the sheet, of either sign, shape (P, 3).
        thick: Largest distance along the normal at which groups are joined [m].

    Returns:
        The number of the group of each particle, shape (P,).
    """
    group = torch.unique(cell, return_inverse=True)[1]
    while len(group):
        centre = means(position, mass, group)
        distance = torch.cdist(centre, centre, compute_mode="donot_use_mm_for_euclid_dist")
        if normal is not None:
            across = ((centre[:, None] - centre) * normal[first_of(group)]).sum(-1).abs()  # from the plane of another
            across = torch.minimum(across, across.T)
            along = (distance.square() - across.square()).clamp(min=0).sqrt()
            distance = torch.where(across <= thick, along, distance)
        own, (least, nearest) = torch.arange(len(centre)), distance.fill_diagonal_(math.inf).min(-1)
        # pairs that are nearest to each other; the first of equals, so that there always is one
        pair = (nearest[nearest] == own) & (least < apart)
        if not bool(pair.any()):
            break
        group = torch.unique(torch.where(pair, own.minimum(nearest), own)[group], return_inverse=True)[1]
    return group


@torch.no_grad()
def middle_plane(part: _Part, dx: float) -> tuple[Tensor, Tensor]:
    """Vectors from the pinned points of a sheet to its middle plane [m], and unit normals, shape (N, 3) each.

    The middle plane is where the mean of the points is that lie close by along the sheet. A cell may have some of the
    layers there only, and their mean beside it: such places are not on one line, and would hold the slope. The normal
    is that of the nearest of a few points, the first ones in cubes of two cells, so that it does not depend on what
    lies elsewhere.
    """
    place, mass = part.place, part.mass[part.pinned]
    some, normals = place[first_of(equal_rows((place / (2 * dx)).floor()))], []
    for middle in some:
        near = (part.points - middle).square().sum(-1) < (_SEEN * dx) ** 2 + (SHEET * dx) ** 2
        arm, share = part.points[near] - middle, part.mass[near]
        for _ in range(_TURNS):  # weights that fade along the sheet, alike for all of its layers
            normal = torch.linalg.eigh(torch.cov(arm.T, correction=0, aweights=share))[1][:, 0]
            across = arm @ normal
            fading = (1 - (arm.square().sum(-1) - across.square()) / (_SEEN * dx) ** 2).clamp(min=0).square()
            share = part.mass[near] * fading * (across.abs() <= SHEET * dx)
        normals.append(normal)
    nearest = torch.cdist(place, some, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)
    every, found = torch.stack(normals)[nearest], []
    for own, up in zip(place.split(_AT_ONCE), every.split(_AT_ONCE), strict=True):
        arm = place - own[:, None]
        across = (arm * up[:, None]).sum(-1)
        along = (arm.square().sum(-1) - across.square()).clamp(min=0).sqrt()
        weight = mass * ((along < LEAST_APART * dx) & (across.abs() <= SHEET * dx))
        found.append(((weight * across).sum(-1) / weight.sum(-1))[:, None] * up)
    return torch.cat(found), every


# ---- rows


def cells_of_places(place: Tensor, grid: GridSpec, massive: Tensor) -> Tensor:
    """A cell in or next to each place whose 27 nodes all have mass, so that its weights add up to one.

    Args:
        place: Places at rest [m], shape (N, 3).
        massive: Whether each node has mass, shape (G,).

    Returns:
        Flat index of the first node of each cell, shape (N,); -1 where there is none.
    """
    (_, ny, nz), most = grid.resolution, torch.tensor(grid.resolution) - 3
    lattice = place / grid.dx - torch.tensor(grid.offset, dtype=place.dtype)
    first = torch.floor(lattice - 0.5).long()[:, None] + torch.tensor(list(itertools.product((0, -1, 1), repeat=3)))
    flat = (first.clamp(min=0).minimum(most) * torch.tensor([ny * nz, nz, 1])).sum(-1)  # (N, 27)
    f = lattice[:, None] - first
    needed = _products(bspline_weights(f.reshape(-1, 3).T)[0]).abs() > _NO_WEIGHT
    fits = (massive[flat.reshape(-1, 1) + shifts(grid)] | ~needed).all(-1).reshape(flat.shape)
    fits &= ((first >= 0) & (first <= most)).all(-1)
    beyond = ((f - 1).abs() - 0.5).clamp(min=0).square().sum(-1)
    return flat.where(fits, -1).gather(1, beyond.where(fits, math.inf).argmin(-1, keepdim=True))[:, 0]


def _products(factors: Tensor) -> Tensor:
    """The 27 products of factors (3 axes, 3 nodes, N) along the axes, shape (N, 27)."""
    x, y, z = factors
    return (x[:, None, None] * (y[:, None] * z)).reshape(27, -1).T


@torch.no_grad()
def independent_rows(product: Tensor, rank: Tensor, least: float | Tensor = LEAST_OWN) -> Tensor:
    """Choose rows by a pivoted Cholesky factorisation of their normalised products.

    Args:
        product: Products of the rows, shape (K, K), float64.
        rank: Rows of a lower rank come first, shape (K,); among equals the one that depends least on those already
            chosen.
        least: Least remainder of a row, as a share of its own product; one number, or one for each row (K,).

    Returns:
        Indices of the chosen rows in their order, shape (k,).
    """
    own = product.diagonal()
    scale = torch.where(own > 0, own, 1.0).rsqrt()
    normal, rest = scale[:, None] * product * scale, (own > 0).to(product)
    factor, chosen = torch.zeros_like(normal), list[int]()
    while bool((left := rest > least).any()):
        k, n = int(rest.where(left & (rank == rank[left].min()), -1.0).argmax()), len(chosen)
        factor[:, n] = (normal[:, k] - factor[:, :n] @ factor[k, :n]) * rest[k].rsqrt()
        rest -= factor[:, n].square()
        rest[k] = 0.0
        chosen.append(k)
    return torch.tensor(chosen, dtype=torch.long)


class Rows(NamedTuple):
    """Constraint rows, shape (..., K).

    Attributes:
        node: Nodes of each row, shape (..., K, 27).
        weight: Their weights, float64, same shape.
        place: The point at rest [m], or for a slope the step of one cell along its direction [m], shape (..., K, 3).
        slope: Whether the row is a slope.
        owner: Boundary that holds it.
        release: Time at which it is released [s].
    """

    node: Tensor
    weight: Tensor
    place: Tensor
    slope: Tensor
    owner: Tensor
    release: Tensor


class InKernels(NamedTuple):
    """Points pinned all the time, as the kernels need them: R rows of all scenes, K in each scene.

    Attributes:
        node: Nodes of the rows over all scenes, int32, shape (27, R).
        weight: Their weights, shape (27, R).
        affected: Nodes that a row moves, over all scenes, int32, shape (A,).
        scene: The scene of each of them, int32, shape (A,).
        push: M^-1 C^T (C M^-1 C^T)^-1 of each of them, shape (A, K).
        share: Momentum that each boundary takes for the velocity of a row, float64, shape (scenes, B, K).
    """

    node: Tensor
    weight: Tensor
    affected: Tensor
    scene: Tensor
    push: Tensor
    share: Tensor


@contextmanager
def _one_thread() -> Iterator[None]:
    """One thread of torch: products of matrices round differently for each number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _stack(values: Sequence[Tensor], filling: float = 0) -> Tensor:
    most = [max(sizes) for sizes in zip(*(value.shape for value in values), strict=True)]
    pads = [[(0, m - n) for n, m in zip(value.shape[::-1], most[::-1], strict=True)] for value in values]
    return torch.stack(
        [
            torch.nn.functional.pad(v, [n for pair in pad for n in pair], value=filling)
            for v, pad in zip(values, pads, strict=True)
        ]
    )


class PinnedRows:
    """All points of a body that its boundaries pin, bound to its grid.

    Args:
        body: The material and its boundaries.
        still: Nodes that the boundaries of faces stop themselves, bool, shape (..., G).
        rigid: Nodes of rigid parts, bool, shape (..., G).
        stencil: The nodes of the particles.
        grid: The nodes.
        inverse_mass: Their inverse mass [1/kg], 0 for a node without mass, shape (..., G).

    Attributes:
        starts: Times at which a later phase begins [s], shape (phases - 1,).
        rows: The rows, shape (phases, scenes, K); those that only fill up the shape are never held.
        affected: Nodes that a row moves, over all scenes, shape (scenes, A), filled up with any node.
        inverse: Their inverse mass, 0 for those that stand still, float64, same shape.
        C: The weights on these nodes, float64, shape (phases, scenes, K, A).
        W: Shape (phases, scenes, K, K), float64.
        momentum: Momentum that each boundary takes for a multiplier of one, float64, shape (phases, scenes, B, K).

    Raises:
        ValueError: If there are too many rows, a place has no material around it, or a row reaches a rigid part.
    """

    @_one_thread()
    def __init__(
        self, body: Formulation, still: Tensor, rigid: Tensor, stencil: Stencil, grid: GridSpec, inverse_mass: Tensor
    ) -> None:
        self.boundaries, self.nodes, nodes = body.boundaries, grid.node_count, grid.node_count
        self.moving = [k for k, b in enumerate(body.boundaries) if body.kinds[k] in POINTS and b.moves]
        count, device = body.points.count, inverse_mass.device
        inverse = inverse_mass.reshape(-1, nodes).cpu().double()
        scenes = torch.arange(len(inverse))[:, None]
        cell = stencil.first.reshape(-1, count).cpu() - nodes * scenes
        virtual = stencil.nodes
        own = None if virtual is None else virtual.reshape(27, -1, count).cpu() - nodes * scenes
        sets: list[list[Rows]] = [[] for _ in inverse]
        for k in reversed(range(len(body.kinds))):  # of two boundaries at the same place the last one counts
            for part in _parts(body, k) if body.kinds[k] in POINTS else ():
                s = part.scene
                site = grid, inverse[s].detach() > 0, cell[s], None if own is None else own[:, s]
                sets[s].append(_rows(body, k, part, *site))
        inverse = inverse.where(~still.reshape(-1, nodes).cpu(), 0.0)
        begin = torch.tensor([b.holds_from for b in body.boundaries], dtype=torch.float64)
        least = torch.tensor([LEAST_OWN_ON_A_FACE if kind == FACE else LEAST_OWN for kind in body.kinds])
        every = [Rows(*map(torch.cat, zip(_EMPTY, *rows, strict=True))) for rows in sets]
        later = begin[torch.cat([rows.owner for rows in every])]
        times = [0.0, *sorted(set(later[later > 0].tolist()))]
        kept, weights, factors, affected = [], [], [], []
        for s, rows in enumerate(every):
            phases = [((begin[rows.owner] <= t) & (rows.release > t)).nonzero()[:, 0] for t in times]
            for index in phases:
                self._require_few(rows.owner[index])
            node, place = torch.unique(rows.node, return_inverse=True)
            C = rows.weight.new_zeros(len(place), len(node)).scatter(1, place, rows.weight)
            rank = 2 * torch.unique(-rows.release, return_inverse=True)[1] + rows.slope  # values come before slopes
            chosen = []
            for index in phases:
                product = (C[index] * inverse[s][node]) @ C[index].T
                some = independent_rows(product.detach(), rank[index], least[rows.owner[index]])
                factors.append(torch.linalg.cholesky(product[some][:, some]))
                chosen.append(index[some])
            used = (C[torch.cat(chosen)] != 0).any(0)
            if bool(rigid.reshape(-1, nodes)[s].cpu()[node[used]].any()):
                raise ValueError(
                    "A pin holds points of a rigid part or next to it, which it cannot: set its `kind` to nodes, which "
                    "holds the whole part, or leave three cells of soft material between."
                )
            affected.append(node[used])
            weights += [C[some][:, used] for some in chosen]
            kept += [Rows(*(field[some] for field in rows)) for some in chosen]

        def stacked(values: Sequence[Tensor], filling: float = 0) -> Tensor:
            return _stack(values, filling).unflatten(0, (len(inverse), len(times))).transpose(0, 1).to(device)

        filling = (0, 0, 0, True, 0, -math.inf)
        rows = Rows(*(stacked(field, nothing) for field, nothing in zip(zip(*kept, strict=True), filling, strict=True)))
        self.rows = Rows(rows.node + nodes * scenes[..., None].to(device), *rows[1:])
        self.affected = (_stack(affected) + nodes * scenes).to(device)
        self.C = stacked(weights)
        self.inverse = inverse.reshape(-1)[self.affected.cpu()].to(device)
        whitening = [torch.linalg.solve_triangular(f, torch.eye(len(f), dtype=f.dtype), upper=False) for f in factors]
        self.W = stacked(whitening)
        self.starts = torch.tensor(times[1:], dtype=torch.float64, device=device)
        taken = (self.C.detach() * (self.inverse.detach() > 0)[:, None]).sum(-1)
        owner = torch.arange(len(body.boundaries), device=device)[:, None]
        self.momentum = (rows.owner[..., None, :] == owner) * taken[..., None, :]

    def _require_few(self, owner: Tensor) -> None:
        if len(owner) > MOST_ROWS:
            raise ValueError(
                f"The boundaries hold {len(owner):,} points and slopes, more than the {MOST_ROWS:,} that can be held "
                f"exactly: set `kind` of the {type(self.boundaries[int(owner.mode().values)]).__name__} to nodes."
            )

    @_one_thread()
    def in_kernels(self, dtype: torch.dtype) -> InKernels:
        """The rows as the kernels need them; None unless the same points are pinned at rest throughout."""
        node, weight, C, W = (field[0] for field in (self.rows.node, self.rows.weight, self.C, self.W))
        inverse = W.mT @ W
        real = self.real
        return InKernels(
            node=node.reshape(-1, 27).T.int().contiguous(),
            weight=weight.reshape(-1, 27).T.to(dtype).contiguous(),
            affected=self.affected[real].int(),
            scene=real.nonzero()[:, 0].int(),
            push=((self.inverse[..., None] * C.mT) @ inverse)[real].to(dtype).contiguous(),
            share=self.momentum[0] @ inverse,
        )

    @property
    def real(self) -> Tensor:
        """Which of the affected nodes a row moves, bool, shape (scenes, A); the others fill up the shape."""
        return (self.C != 0).any(-2).any(0)

    def _at(self, field: Tensor, phase: Tensor) -> Tensor:
        """A field of the current phase; the host does not wait."""
        return field[0] if len(self.starts) == 0 else field.index_select(0, phase)[0]

    def hold(self, velocity: Tensor, displacement: Tensor, time: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Give the pinned points their target velocity.

        Args:
            velocity: Node velocity [m/s], shape (..., G, 3).
            displacement: Node displacement at the start of the substep [m], shape (..., G, 3).
            time: Time at the start of the substep [s], scalar float64 tensor.
            dt: Substep [s], a number or a scalar float64 tensor.

        Returns:
            The velocity, and the momentum that each boundary took from the body [N s], shape (scenes, boundaries, 3),
            float64.
        """
        now = time + CLOCK
        phase = (now >= self.starts).sum().reshape(1)
        C, W, momentum = (self._at(field, phase) for field in (self.C, self.W, self.momentum))
        rows = Rows(*(self._at(field, phase) for field in self.rows))
        rate = C @ velocity.reshape(-1, 3)[self.affected].double()
        if self.moving:
            place = rows.place + C @ displacement.reshape(-1, 3)[self.affected].double()
            for k in self.moving:
                target, origin = (self.boundaries[k].target(p, time, dt) for p in (place, torch.zeros_like(place)))
                wanted = target - torch.where(rows.slope[..., None], origin, 0.0)
                rate = rate - torch.where(rows.owner[..., None] == k, wanted, 0.0)
        taken = W.mT @ torch.where((rows.release > now)[..., None], W @ rate, 0.0)
        pushed = self.inverse[..., None] * (C.mT @ taken)
        moved = velocity.reshape(-1, 3).index_add(0, self.affected.reshape(-1), -pushed.reshape(-1, 3).to(velocity))
        return moved.reshape(velocity.shape), momentum @ taken.detach()


_EMPTY = Rows(
    torch.zeros(0, 27, dtype=torch.long),
    torch.zeros(0, 27, dtype=torch.float64),
    torch.zeros(0, 3, dtype=torch.float64),
    torch.zeros(0, dtype=torch.bool),
    torch.zeros(0, dtype=torch.long),
    torch.zeros(0, dtype=torch.float64),
)


def _rows(
    body: Formulation, k: int, part: _Part, grid: GridSpec, massive: Tensor, cell: Tensor, virtual: Tensor | None
) -> Rows:
    """The rows of a part: the values of its points and, for a clamp, their slopes in units of one cell.

    Args:
        massive: Which of them have mass, shape (G,).
        cell: First node of the cell of each particle of the scene, shape (P,).
        virtual: The nodes of each, shape (27, P); None for those of the lattice.
    """
    boundary, own, kind, dx = body.boundaries[k], body.pinned[k], body.kinds[k], grid.dx
    place, release = part.place, None
    along = torch.eye(3, dtype=torch.float64)[: 0 if kind == "hinge" else 3]
    if kind == FACE:
        place, along = face_patches(part.points, part.mass, part.pinned, dx)
    elif own is not None:
        mass, normal = part.mass[part.pinned], None
        if kind == "hinge" and thickness(part.points, part.mass, place, dx)[1]:
            off, normal = middle_plane(part, dx)
            place = place + off
        mine = part.piece[part.pinned]
        group = groups(place.detach(), mass, cell[mine], LEAST_APART * dx, normal, SHEET * dx)
        place = means(place, mass, group)
        if own.release is not None:
            times = own.release.reshape(-1, len(cell))[part.scene].cpu()[mine]
            release = means(times[:, None], mass, group)[:, 0]
    if release is None:
        release = torch.full((len(place),), boundary.end, dtype=torch.float64)
    along = along.expand(len(place), -1, 3)
    if virtual is None:
        first = cells_of_places(place.detach(), grid, massive)
        node = first[:, None] + shifts(grid)
    else:  # those of the material point that is nearest, in the same cell if it can be
        distance, index = (found[:, 0] for found in nearest_neighbours(part.points, 1, place))
        near = part.piece[index]
        host = point_with_nodes(first_nodes(place.detach(), grid), near, cell, virtual, grid)
        host = torch.where(host < 0, near, host)
        first, node = cell[host].where(distance < 2 * dx, -1), virtual[:, host].T
    there = first >= 0
    if kind == FACE:
        place, along, first, node, release = (field[there] for field in (place, along, first, node, release))
    elif own is None and not bool(there.all()):
        raise ValueError(
            f"The place {int(part.number[~there][0])} of `at` of the {type(boundary).__name__} has no material around "
            "it: move it to within less than a cell of the simulated particles."
        )
    corner = coordinates(first, grid) + torch.tensor(grid.offset)
    value, slope = bspline_weights((place / dx - corner).T)
    axes = torch.eye(3, dtype=torch.bool)[..., None, None]
    slopes = torch.stack([_products(torch.where(axis, slope, value)) for axis in axes], dim=1)  # (N, 3, 27)
    weight = torch.cat([_products(value)[:, None], along @ slopes], 1).transpose(0, 1)
    copies = len(weight)
    return Rows(
        node.repeat(copies, 1),
        (weight * massive[node]).flatten(0, 1),
        torch.cat([place[:, None], dx * along], 1).transpose(0, 1).flatten(0, 1),
        torch.arange(copies * len(place)) >= len(place),
        torch.full((copies * len(place),), k),
        release.detach().repeat(copies),
    )
