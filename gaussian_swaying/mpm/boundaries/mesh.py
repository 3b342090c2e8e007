"""A triangle mesh that the material cannot enter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.distance import grid_distance
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.meshes import mesh_distance, read_mesh
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle, grid_twin
from gaussian_swaying.mpm.twins import Twin


class MeshObstacle(Obstacle):
    """A closed triangle mesh that the material cannot enter.

    Its signed distance is computed on a grid once, so details smaller than a cell of that grid are rounded off. It
    turns about the origin of the mesh.

    Args:
        mesh: A .ply or .obj file, in scene units and axes.
        cells: Cells of the grid along the longest side of the mesh.
        center: Position of the mesh's origin, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.

    Raises:
        ValueError: If the file is no closed mesh.
    """

    def __init__(
        self,
        mesh: str,
        cells: int = 48,
        center: Sequence[float] = (0.0, 0.0, 0.0),
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(check_vector("center", center), friction, gap, path, start, end)
        if cells < 4:
            raise ValueError(f"Expected `cells` of the mesh to be at least 4, but got {cells}.")
        self.mesh, self.cells = mesh, int(cells)
        found = mesh_distance(*read_mesh(mesh), cells)
        self.register_buffer("values", found.values)
        self.register_buffer("corner", found.origin)
        self.register_buffer("axes", torch.eye(3, dtype=torch.float64))
        self.values: Tensor
        self.corner: Tensor
        self.axes: Tensor
        self.spacing = found.spacing

    def in_frame(self, frame: SimFrame) -> Obstacle:
        """The mesh in metres, z up."""
        unit = frame.metres_per_unit
        axes = frame.direction_to_sim(torch.eye(3, dtype=torch.float64)).T.contiguous()
        moved = self.in_metres(frame, values=self.values * unit, corner=self.corner * unit, axes=axes)
        return changed(moved, spacing=self.spacing * unit)

    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        axes = self.axes.to(place)
        distance, normal = grid_distance(place @ axes, self.values, self.corner, self.spacing)
        return distance, normal @ axes.T

    def twin(self) -> Twin:
        return grid_twin(self, self.values, self.corner, self.axes, self.spacing)
