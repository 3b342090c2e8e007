"""Base classes of the boundary conditions: they hold, stop or drive grid nodes within a time window.

A condition changes nodal velocities after the momentum update. The position of a node depends on the formulation: the
lattice point in ``updated``, the centre of the mass that it carries in ``total``.

A condition that holds particles either holds the nodes that carry them (in ``updated`` all nodes that they touch, in
``total`` those where they have more than a given share of the mass), or, in ``total``, points of the material alone
(:mod:`~gaussian_swaying.mpm.pins`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn

from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region, RegionInFrame, whereabouts
from gaussian_swaying.kernels.graphs import Component

BY_BODY = "by body"
"""The kind of a pin that becomes a hinge for a sheet, and a clamp for anything else."""

FACE = "face"
"""The kind of a clamp of a region: it holds points on its face, and the nodes behind."""

CLOCK = 1e-9  # round-off of a time after many additions of a substep [s]
_Kind = TypeVar("_Kind", bound="Boundary")


@dataclass(frozen=True, slots=True)
class Nodes:
    """Data about the grid nodes that a boundary gets besides their velocity.

    Attributes:
        time: Time at the start of the substep [s], scalar float64 tensor.
        dt: Substep [s], a number or a scalar float64 tensor.
        position: Positions of the nodes [m], shape (..., G, 3), for a boundary with ``needs_position``.
        lattice: Positions of the lattice points [m], shape (..., G, 3), for one with ``needs_lattice``: in ``total``
            they move with the material, and a velocity that is affine in them moves it rigidly up to its border.
        share: Share of each node's mass that belongs to the particles of the boundary, shape (..., G), if it has any.
        threshold: Share above which such a node is held.
        pinned_mass: Mass of those particles [kg], shape (...).
        mass: Mass of the nodes [kg], shape (..., G).
        fixed: Nodes that pins hold now, bool, shape (..., G); None if none does.
        index: Nodes among which those that are held are, shape (K,); None for all.
    """

    time: Tensor
    dt: float | Tensor
    position: Tensor | None = None
    lattice: Tensor | None = None
    share: Tensor | None = None
    threshold: float = 0.0
    pinned_mass: Tensor | None = None
    mass: Tensor | None = None
    fixed: Tensor | None = None
    index: Tensor | None = None

    @property
    def pinned(self) -> Tensor:
        """Nodes that the particles of the boundary hold, bool, shape (..., G)."""
        assert self.share is not None
        return self.share > self.threshold


class Boundary(Component, nn.Module, ABC):
    """Base class of all boundary conditions.

    Args:
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.

    Attributes:
        needs_position: Whether :meth:`forward` uses the positions of nodes.
        needs_lattice: Whether it uses the positions of lattice points.
        turn: Impulses (0) come before conditions that hold nodes, and rigid parts (2) after them, in whatever order
            they are given.
        pinned_share: Share of a node's mass above which the particles of :meth:`particle_mask` hold it in ``total``;
            None if the condition acts on particles without holding nodes.
    """

    needs_position = False
    needs_lattice = False
    turn = 1
    pinned_share: float | None = None

    def __init__(self, start: float = 0.0, end: float | None = None) -> None:
        super().__init__()
        self.start = float(start)
        self.end = math.inf if end is None else float(end)
        if not self.start < self.end:
            raise ValueError(f"Expected `end` to be later than `start` ({self.start} s), but got {self.end} s.")

    @property
    def window(self) -> list[float]:
        """Start and end of its action [s]."""
        return [self.start, self.end]

    def in_frame(self, frame: SimFrame) -> Boundary:
        """The same condition with its geometry converted from scene units to metres, z up."""
        return self

    def copy_in(self: _Kind, frame: SimFrame, **tensors: Tensor) -> _Kind:
        """A copy with its ``region`` evaluated in metres and with some tensors replaced."""
        held = vars(self).get("region")
        return changed(self, **tensors, **({} if held is None else {"region": RegionInFrame(held, frame)}))

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """What it acts on: ``nodes`` (:meth:`forward`), points as a ``hinge`` or ``clamp``, or the ``surface``.

        It may also be :data:`BY_BODY`, which leaves the choice of hinge or clamp to the formulation.

        Args:
            neighbours_fixed: Whether the particles keep their neighbours, so that points can be held.

        Raises:
            ValueError: If it can only hold points, but they cannot be held.
        """
        return "nodes"

    @property
    def holds_from(self) -> float:
        """Time from which it holds points [s]."""
        return self.start

    @property
    def always(self) -> bool:
        """True if it never begins and never ends."""
        return self.holds_from <= 0 and self.end == math.inf

    @property
    def moves(self) -> bool:
        """True if the held part moves, that is, if it has a :meth:`target` of its own."""
        return type(self).target is not Boundary.target

    def target(self, place: Tensor, time: Tensor, dt: float | Tensor) -> Tensor:
        """Target velocity of held material at places (..., 3) [m/s], for a substep of ``dt`` [s]."""
        return torch.zeros_like(place)

    def particle_mask(self, rest_position: Tensor) -> Tensor | None:
        """Particles that the condition holds, from their rest positions (..., P, 3); None if it holds none."""
        return None

    def release_time(self, rest_position: Tensor) -> Tensor | None:
        """Time at which each particle is released [s], shape (..., P); None if only ``end`` counts."""
        return None

    def active(self, time: Tensor) -> Tensor:
        """True if the condition acts at a time [s]; scalar bool tensor, so that no GPU synchronisation is needed."""
        now = time + CLOCK
        return (now >= self.start) & (now < self.end)

    @abstractmethod
    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Return the node velocity (..., G, 3) [m/s] with the condition applied.

        Args:
            velocity: Node velocity after the momentum update [m/s], shape (..., G, 3).
            nodes: Other data about them.
        """


class ParticleBoundary(Boundary):
    """Base class of conditions on the particles that lie in a region at rest."""

    def __init__(self, region: Region, start: float = 0.0, end: float | None = None) -> None:
        super().__init__(start, end)
        self.region = region

    def in_frame(self, frame: SimFrame) -> Boundary:
        return self.copy_in(frame)

    def particle_mask(self, rest_position: Tensor) -> Tensor:
        """Particles inside the region at rest; ValueError if there are none."""
        mask = self.region.contains(rest_position)
        if not bool(mask.any()):
            region, points, rotation = self.region, rest_position, torch.eye(3)
            if isinstance(region, RegionInFrame):
                points, rotation = region.frame.point_to_scene(points), region.frame.rotation
                region = region.region
            between, hint = whereabouts(region, points, rotation)
            raise ValueError(
                f"The region {region!r} of the {type(self).__name__} holds no particle: the simulated particles lie "
                f"{between}; {hint or 'move or enlarge `region`'}."
            )
        return mask
