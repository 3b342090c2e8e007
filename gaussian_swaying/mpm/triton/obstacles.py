"""Data of planes and obstacles for the kernels: :mod:`~gaussian_swaying.mpm.triton.obstacle_kernels`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gaussian_swaying._graphs import tensors_in
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.block import BoxObstacle
from gaussian_swaying.mpm.boundaries.capsule import CapsuleObstacle
from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
from gaussian_swaying.mpm.boundaries.half_space import HalfSpaceObstacle
from gaussian_swaying.mpm.boundaries.mesh import MeshObstacle
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.boundaries.plane import KINDS, Plane
from gaussian_swaying.mpm.boundaries.still_gaussians import StillGaussians
from gaussian_swaying.mpm.forces import MOST_STEPS
from gaussian_swaying.mpm.triton import obstacle_kernels as kernels

Solid = Plane | Obstacle
TYPES: dict[type[nn.Module], int] = {
    Plane: kernels.PLANE.value,
    BallObstacle: kernels.BALL.value,
    CapsuleObstacle: kernels.CAPSULE.value,
    BoxObstacle: kernels.BOX.value,
    HalfSpaceObstacle: kernels.HALF_SPACE.value,
    MeshObstacle: kernels.GRID.value,
    StillGaussians: kernels.GRID.value,
}
"""Solids that the kernels know; a subclass may compute something else."""


def known(boundary: nn.Module) -> bool:
    """True if the kernels can apply a boundary."""
    return type(boundary) is EnclosingBox or (
        type(boundary) in TYPES and not (isinstance(boundary, StillGaussians) and boundary.spacing == 0)
    )


def solids_of(boundaries: Sequence[nn.Module]) -> list[tuple[Solid, int]]:
    """All solids, each with the number of its boundary; none if there are other boundaries.

    Args:
        boundaries: The boundary conditions of a body.
    """
    if not all(map(known, boundaries)):
        return []
    return [(part, k) for k, one in enumerate(boundaries) for part in one.modules() if isinstance(part, Solid)]


class Solids:
    """Tables of solids at fixed addresses, which recorded graphs contain.

    Args:
        parts: The solids, each with the number of its boundary.
        device: Device of the tables.
        steps: Number of substeps for which there are poses.
    """

    def __init__(self, parts: Sequence[tuple[Solid, int]], device: torch.device, steps: int = MOST_STEPS) -> None:
        self.parts, self.device = list(parts), device
        count = len(self.parts)
        self.kinds = tuple(TYPES[type(part)] for part, _ in self.parts)
        self.moves = tuple(isinstance(part, Obstacle) and not part.still for part, _ in self.parts)
        sizes = [
            part.values.numel() if isinstance(part, MeshObstacle | StillGaussians) else 0 for part, _ in self.parts
        ]
        self.rows = torch.zeros(count, kernels.NUMBERS.value, device=device)
        self.grids = torch.zeros(sum(sizes), device=device)
        self.windows = torch.zeros(count, 2, dtype=torch.float64, device=device)
        self.poses = torch.zeros(steps if any(self.moves) else min(count, 1), count, kernels.POSE.value, device=device)
        whole, start, keys = [], 0, 0
        for (part, _), size, moves in zip(self.parts, sizes, self.moves, strict=True):
            shape = part.values.shape if isinstance(part, MeshObstacle | StillGaussians) else (0, 0, 0)
            many = len(part.times) if isinstance(part, Obstacle) and moves else 0
            whole.append([start, *shape, keys, many, 0, 0])
            start, keys = start + size, keys + many
        self.whole = torch.tensor(whole or [[0] * 8], dtype=torch.int32, device=device)
        self.keys = torch.zeros(max(keys, 1), kernels.KEY.value, dtype=torch.float64, device=device)
        self._made_of: list[int] | None = None  # versions of the tensors that the tables were made from

    @property
    def moving(self) -> bool:
        """True if any of them moves."""
        return any(self.moves)

    @property
    def options(self) -> tuple[int, ...]:
        """Return constants for compiling the nodes' kernels: for each solid, twice its kind, plus 1 if it moves."""
        return tuple(2 * kind + int(moves) for kind, moves in zip(self.kinds, self.moves, strict=True))

    def take(self) -> None:
        """Fill the tables; again only if one of the tensors was written to."""
        tensors = tensors_in([part for part, _ in self.parts])
        versions = None if any(tensor.is_inference() for tensor in tensors) else [t._version for t in tensors]
        if not self.parts or (versions is not None and versions == self._made_of):
            return
        self._made_of = versions
        rows = torch.zeros(self.rows.shape, dtype=torch.float64, device=self.device)
        for row, (part, k) in zip(rows, self.parts, strict=True):
            found = _row(part, k).to(self.device)
            row[: len(found)] = found
        self.rows.copy_(rows)
        self.windows.copy_(torch.tensor([[part.start, part.end] for part, _ in self.parts], dtype=torch.float64))
        grids = [part.values.reshape(-1) for part, _ in self.parts if isinstance(part, MeshObstacle | StillGaussians)]
        if grids:
            self.grids.copy_(torch.cat([values.to(self.grids) for values in grids]))
        keys = [
            torch.cat([part.times[:, None], part.center + part.shifts, part.turns], dim=1)
            for (part, _), moves in zip(self.parts, self.moves, strict=True)
            if moves and isinstance(part, Obstacle)
        ]
        if keys:
            self.keys.copy_(torch.cat([key.to(self.keys) for key in keys]))
        for m, (part, _) in enumerate(self.parts):
            if isinstance(part, Obstacle) and part.still:
                self.poses[:, m, :3] = part.center.to(self.poses)

    def prepare(self, time: Tensor, dt: Tensor, steps: int) -> None:
        """Compute the poses of some substeps; can be recorded.

        Args:
            time: Time of the first [s], scalar float64 tensor on the device.
            dt: Substep [s], as ``time``.
            steps: Number of substeps.
        """
        if self.moving:
            count = len(self.parts)
            kernels.obstacle_poses[(steps, count)](self.keys, self.whole, time, dt, self.poses, count, num_warps=1)

    def of(self, part: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the data of a solid in the first substep: real and whole numbers, time window, pose; and grids."""
        return self.rows[part], self.whole[part], self.windows[part], self.poses[0, part], self.grids


def _row(part: Solid, boundary: int) -> Tensor:
    """The numbers of a solid, at most NUMBERS, float64."""

    def row(*values: float | Tensor) -> Tensor:
        parts = [value if isinstance(value, Tensor) else torch.tensor(float(value)) for value in values]
        return torch.cat([value.detach().double().cpu().reshape(-1) for value in parts])

    if isinstance(part, Plane):
        return row(part.point, part.normal, KINDS.index(part.kind), part.friction, boundary)
    head = (torch.zeros(6), part.gap, part.friction, boundary)
    if isinstance(part, BallObstacle):
        return row(*head, part.radius)
    if isinstance(part, CapsuleObstacle):
        squared = float(part.half_axis.square().sum())
        return row(*head, part.radius, part.half_axis, 1 / squared if squared > 0 else 0.0)
    if isinstance(part, BoxObstacle):
        return row(*head, part.half_sides, part.axes)
    if isinstance(part, HalfSpaceObstacle):
        return row(*head, part.normal)
    assert isinstance(part, MeshObstacle | StillGaussians)
    axes = part.axes if isinstance(part, MeshObstacle) else torch.eye(3)
    return row(*head, part.corner, axes, part.spacing)
