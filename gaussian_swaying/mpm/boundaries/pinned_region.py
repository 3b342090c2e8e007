"""A part of the material that is held in place."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.boundary import Nodes
from gaussian_swaying.mpm.boundaries.particle_boundary import ParticleBoundary


class PinnedRegion(ParticleBoundary):
    """Holds the grid nodes of the particles whose rest position lies in a region.

    A pin that only reset its particles would let a sheet slide off, since their neighbours keep moving the shared
    nodes. So the nodes are held: in ``updated`` all nodes that the particles touch, in ``total`` those where they have
    more than ``held_share`` of the mass. The effective edge of the pin is therefore accurate to a fraction of a cell:
    in ``total`` it lies between 0.4 cells too far out and 0.4 cells too far in, depending on how the particles lie on
    the grid, and is right on average with the default share; in ``updated`` it lies about 0.7 cells too far in.

    Args:
        region: Region of the pinned particles at rest, in scene units.
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
