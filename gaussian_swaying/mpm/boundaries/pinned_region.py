"""A part of the material that is held in place."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.boundary import BY_BODY, Nodes, ParticleBoundary, refuse_points

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
