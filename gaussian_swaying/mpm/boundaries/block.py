"""A box that the material cannot enter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying.geometry.distance import box_distance
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.twins import Numbers, Twin


class BoxObstacle(Obstacle):
    """A box that the material cannot enter: a table, a step; an ``EnclosingBox`` is one that it cannot leave.

    Args:
        min: Smallest corner before it is turned, in scene units.
        max: Largest corner.
        turn: Rotation about its centre, as axis times angle [degrees], in scene axes.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        min: Sequence[float],
        max: Sequence[float],
        turn: Sequence[float] = (0.0, 0.0, 0.0),
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        low, high = check_vector("min", min), check_vector("max", max)
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"Expected `min` of the box to be below `max` on every axis, but got {low} and {high}.")
        middle = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
        super().__init__(middle, friction, gap, path, start, end)
        half = [0.5 * (b - a) for a, b in zip(low, high, strict=True)]
        angle = torch.deg2rad(torch.tensor(check_vector("turn", turn), dtype=torch.float64))
        self.register_buffer("half_sides", torch.tensor(half, dtype=torch.float64))
        self.register_buffer("axes", rotation_of(angle))
        self.half_sides: Tensor
        self.axes: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The box in metres, z up."""
        axes = frame.direction_to_sim(self.axes.T.contiguous()).T.contiguous()
        return self.in_metres(frame, half_sides=self.half_sides * frame.metres_per_unit, axes=axes)

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        axes = self.axes.to(place)  # its columns are the sides of the box
        distance, normal = box_distance(place @ axes, self.half_sides.to(place))
        return distance, normal @ axes.T

    def twin(self) -> Twin:
        from gaussian_swaying.geometry.distance_triton import box_distance

        numbers = Numbers(12, lambda: torch.cat([self.half_sides, self.axes.reshape(-1)]))
        return Twin(box_distance, numbers=numbers, sources=(self,))
