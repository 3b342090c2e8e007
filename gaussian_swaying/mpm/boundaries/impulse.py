"""A push on a part of the material."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying._fixed import assign
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.boundary import Nodes, ParticleBoundary


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
