"""A part of the material that is moved and rotated."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.boundary import Nodes
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion


class Handle(PinnedRegion):
    """Moves the particles of a region as a rigid body: a pin that travels and turns.

    Each substep moves the held nodes exactly to their place in the rigid motion, so a handle that turns for minutes
    neither grows nor drifts. It releases the nodes when its time window ends.

    Args:
        region: Region of the held particles at rest, in scene units.
        velocity: Velocity [m/s], z up.
        angular_velocity: Axis of the rotation times its rate [rad/s], z up.
        pivot: Point about which it turns, in scene units at time ``start``; it travels with ``velocity``.
        held_share: Share of the nodal mass in ``total``, between 0 and 1.
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
        held_share: float = 0.07,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(region, held_share, start, end)
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

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Give the held nodes the velocity of the rigid motion."""
        assert nodes.lattice is not None
        driven = self.velocity.to(velocity).expand_as(velocity)
        if self.rate > 0:
            pivot = self.pivot + self.velocity * (nodes.time - self.start)
            axis = self.axis.to(velocity).expand_as(velocity)
            arm = nodes.lattice - pivot.to(velocity)
            across = torch.linalg.cross(axis, arm, dim=-1)
            # the chord of the arc (Rodrigues), not the tangent: the velocity whose explicit step ends on the circle
            angle = self.rate * nodes.dt
            inward = (2 * _sin(angle / 2) ** 2 / nodes.dt) * torch.linalg.cross(axis, across, dim=-1)
            driven = driven + (_sin(angle) / nodes.dt) * across + inward
        return torch.where((nodes.held & self.active(nodes.time))[..., None], driven, velocity)


def _sin(angle: float | Tensor) -> float | Tensor:
    return angle.sin() if isinstance(angle, Tensor) else math.sin(angle)
