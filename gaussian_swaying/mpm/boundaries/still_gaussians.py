"""The Gaussians of a capture that stand still, as an obstacle."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._fixed import assign
from gaussian_swaying.geometry.distance import DistanceGrid, grid_distance
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle, grid_twin
from gaussian_swaying.mpm.twins import Twin


class StillGaussians(Obstacle):
    """Everything in the scene that does not move: a curtain falls over a captured table.

    Their surface is where the density of the Gaussians passes a level, on a grid around the object that a
    ``Simulation`` makes once. Details smaller than a cell are rounded off.

    Args:
        cells: Cells of the grid along its longest side.
        level: Density of the surface, from 0 to 1.
        margin: Distance by which the grid reaches beyond the object at rest, in lengths of its longest side.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    def __init__(
        self,
        cells: int = 96,
        level: float = 0.5,
        margin: float = 1.0,
        friction: float = 0.3,
        gap: float = 0.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__((0.0, 0.0, 0.0), friction, gap, None, start, end)
        check_positive("margin", margin)
        if not 0 < level < 1 or cells < 8:
            raise ValueError(
                f"Expected `level` between 0 and 1 and `cells` of at least 8, but got {level:g} and {cells}."
            )
        self.cells, self.level, self.margin, self.spacing = int(cells), float(level), float(margin), 0.0
        self.register_buffer("values", torch.zeros(2, 2, 2, dtype=torch.float64), persistent=False)
        self.register_buffer("corner", torch.zeros(3, dtype=torch.float64), persistent=False)
        self.values: Tensor
        self.corner: Tensor

    def take(self, found: DistanceGrid) -> None:
        """Set the grid of distances from the Gaussians, in metres, z up."""
        assign(self, values=found.values, corner=found.origin, spacing=found.spacing)

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """Itself: it is in metres."""
        return copy.copy(self)

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolate the grid; RuntimeError if none was set."""
        if self.spacing == 0:
            raise RuntimeError(
                "The StillGaussians have no Gaussians: give them to a Simulation, which knows the scene."
            )
        return grid_distance(place, self.values, self.corner, self.spacing)

    def twin(self) -> Twin | None:
        if self.spacing == 0:
            return None
        return grid_twin(self, self.values, self.corner, torch.eye(3), self.spacing)
