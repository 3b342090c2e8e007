"""A region of space with a prescribed velocity."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.boundary import Boundary, Nodes


class VelocityBox(Boundary):
    """Gives the nodes inside a region a prescribed velocity.

    Args:
        region: Region in which the nodes are driven, in scene units.
        velocity: Velocity [m/s], z up.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
        travels: Whether the region moves with ``velocity`` from ``start`` on; otherwise it stays where it is.
    """

    needs_position = True

    def __init__(
        self,
        region: Region,
        velocity: Sequence[float],
        start: float = 0.0,
        end: float | None = None,
        travels: bool = False,
    ) -> None:
        super().__init__(start, end)
        self.region, self.recordable, self.travels = region, region.recordable, bool(travels)
        self.register_buffer("velocity", torch.tensor(check_vector("velocity", velocity), dtype=torch.float64))
        self.velocity: Tensor

    def in_frame(self, frame: SimFrame) -> VelocityBox:
        """The box with its region evaluated in metres."""
        return self.copy_in(frame)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        where = nodes.position
        if self.travels:
            where = where - (self.velocity * (nodes.time - self.start)).to(where)
        inside = self.region.contains(where) & self.active(nodes.time)
        return torch.where(inside[..., None], self.velocity.to(velocity), velocity)
