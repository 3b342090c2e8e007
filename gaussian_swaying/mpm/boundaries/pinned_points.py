"""Given places of the material that are held."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.boundaries.boundary import Boundary, Nodes, refuse_points

KINDS = ("hinge", "clamp")


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
        check_choice("kind", kind, KINDS)
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
