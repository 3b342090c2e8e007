"""A part of the material that is moved and rotated."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion


class Handle(PinnedRegion):
    """Moves the particles of a region as a rigid body: a pin that travels and turns.

    Each substep moves what is held exactly to its place in the rigid motion, so a handle that turns for minutes neither
    grows nor drifts. It releases the material when its time window ends. As a ``hinge`` it turns its points, but not
    the slope of a sheet; as a ``clamp`` it turns both.

    Args:
        region: Region of the held particles at rest, in scene units.
        velocity: Velocity [m/s], z up.
        angular_velocity: Axis of the rotation times its rate [rad/s], z up.
        pivot: Point about which it turns, in scene units at time ``start``; it travels with ``velocity``.
        kind: ``hinge``, ``clamp``, ``nodes`` or None, as for a :class:`PinnedRegion`.
        held_share: Share of the nodal mass for ``nodes`` in ``total``, between 0 and 1.
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
        kind: str | None = None,
        held_share: float = 0.07,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(region, kind, held_share=held_share, start=start, end=end)
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

    def target(self, place: Tensor, time: Tensor, dt: float | Tensor) -> Tensor:
        """Velocity of the rigid motion, such that an explicit step ends exactly on it.

        Shape (..., 3) [m/s].
        """
        driven = self.velocity.to(place).expand_as(place)
        if self.rate > 0:
            pivot = self.pivot + self.velocity * (time - self.start)
            along, inward = self._arc(place - pivot.to(place), dt)
            driven = driven + along + inward
        return driven

    def turning(self, arm: Tensor, dt: float | Tensor) -> Tensor:
        """The part of the velocity that is due to the rotation, for arms (..., 3) from the pivot [m]."""
        along, inward = self._arc(arm, dt)
        return along + inward

    def _arc(self, arm: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor]:
        """Velocity along the circle about the axis and towards it; together the chord of the arc."""
        if self.rate == 0:
            return torch.zeros_like(arm), torch.zeros_like(arm)
        axis = self.axis.to(arm).expand_as(arm)
        across = torch.linalg.cross(axis, arm, dim=-1)
        # the chord of the arc (Rodrigues), not the tangent: the velocity whose explicit step ends on the circle
        angle = self.rate * dt
        inward = (2 * _sin(angle / 2) ** 2 / dt) * torch.linalg.cross(axis, across, dim=-1)
        return (_sin(angle) / dt) * across, inward


def _sin(angle: float | Tensor) -> float | Tensor:
    return angle.sin() if isinstance(angle, Tensor) else math.sin(angle)
