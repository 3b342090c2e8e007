"""A ball that the material cannot enter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.geometry.distance import ball_distance
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.twins import Numbers, Twin


class BallObstacle(Obstacle):
    """A ball that the material cannot enter.

    Args:
        center: Its centre, in scene units.
        radius: Its radius, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        center: Sequence[float],
        radius: float,
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(check_vector("center", center), friction, gap, path, start, end)
        check_positive("radius", radius)
        self.register_buffer("radius", torch.tensor(float(radius), dtype=torch.float64))
        self.radius: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The ball in metres, z up."""
        return self.in_metres(frame, radius=self.radius * frame.metres_per_unit)

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        return ball_distance(place, self.radius.to(place))

    def twin(self) -> Twin:
        from gaussian_swaying.geometry.distance_triton import ball_distance

        return Twin(ball_distance, numbers=Numbers(1, lambda: self.radius), sources=(self,))
