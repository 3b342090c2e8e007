"""Base class of the conditions that act on the particles of a region."""

from __future__ import annotations

from torch import Tensor

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
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
            low, high = self.region.bounds(rest_position)
            name = type(self).__name__
            raise ValueError(
                f"The region {self.region!r} of the {name} holds no particle: the simulated particles lie "
                f"between {low} and {high}; move or enlarge `region`."
            )
        return mask
