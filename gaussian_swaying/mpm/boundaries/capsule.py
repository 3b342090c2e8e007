"""A rod with round ends that the material cannot enter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.geometry.distance import capsule_distance
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.twins import Numbers, Twin


class CapsuleObstacle(Obstacle):
    """A rod with round ends that the material cannot enter: a pole, an arm. It turns about its middle.

    Args:
        first: One end of its axis, in scene units.
        second: The other end.
        radius: Its radius, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        first: Sequence[float],
        second: Sequence[float],
        radius: float,
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        a, b = check_vector("first", first), check_vector("second", second)
        middle = tuple(0.5 * (p + q) for p, q in zip(a, b, strict=True))
        super().__init__(middle, friction, gap, path, start, end)
        check_positive("radius", radius)
        self.register_buffer("radius", torch.tensor(float(radius), dtype=torch.float64))
        half = [0.5 * (q - p) for p, q in zip(a, b, strict=True)]
        self.register_buffer("half_axis", torch.tensor(half, dtype=torch.float64))
        self.radius: Tensor
        self.half_axis: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The rod in metres, z up."""
        half = frame.direction_to_sim(self.half_axis) * frame.metres_per_unit
        return self.in_metres(frame, radius=self.radius * frame.metres_per_unit, half_axis=half)

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        return capsule_distance(place, self.half_axis.to(place), self.radius.to(place))

    def twin(self) -> Twin:
        from gaussian_swaying.geometry.distance_triton import capsule_distance

        def numbers() -> Tensor:
            squared = self.half_axis.square().sum()
            inverse = torch.where(squared > 0, 1 / squared, 0.0)
            return torch.cat([self.radius[None], self.half_axis, inverse[None]])

        return Twin(capsule_distance, numbers=Numbers(5, numbers), sources=(self,))
