"""Base class of the conditions that act on the particles of a region."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region, RegionInFrame, whereabouts
from gaussian_swaying.mpm.boundaries.boundary import Boundary


class ParticleBoundary(Boundary):
    """Base class of the conditions that act on the particles of a region, wherever they go."""

    def __init__(self, region: Region, start: float = 0.0, end: float | None = None) -> None:
        super().__init__(start, end)
        self.region = region

    def in_frame(self, frame: SimFrame) -> Boundary:
        """The condition with its region evaluated in metres."""
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
