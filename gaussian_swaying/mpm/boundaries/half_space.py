"""A ground that the material cannot enter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.twins import Numbers, Twin


class HalfSpaceObstacle(Obstacle):
    """All space behind a plane: a floor, a wall. Unlike a ``Plane``, in ``total`` it is sharp, and it can move.

    Args:
        point: A point of the plane, in scene units; it turns about this point.
        normal: Normal towards the free side, in scene axes.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        point: Sequence[float],
        normal: Sequence[float],
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(check_vector("point", point), friction, gap, path, start, end)
        n = torch.tensor(check_vector("normal", normal), dtype=torch.float64)
        if float(n.norm()) == 0:
            raise ValueError("Expected `normal` of the half space not to be zero.")
        self.register_buffer("normal", n / n.norm())
        self.normal: Tensor

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The half space in metres, z up."""
        return self.in_metres(frame, normal=frame.direction_to_sim(self.normal).clone())

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        normal = self.normal.to(place)
        return (place * normal).sum(-1), normal.expand_as(place)

    def twin(self) -> Twin:
        from gaussian_swaying.geometry.distance_triton import half_space_distance

        return Twin(half_space_distance, numbers=Numbers(3, lambda: self.normal), sources=(self,))
