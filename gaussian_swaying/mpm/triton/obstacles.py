"""Data of planes and obstacles for the kernels: :mod:`~gaussian_swaying.mpm.triton.obstacle_kernels`."""

from __future__ import annotations

from collections.abc import Container, Sequence

import torch
from torch import Tensor

from gaussian_swaying.kernels.launch import launch
from gaussian_swaying.mpm.boundaries.boundary import Boundary
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.boundaries.plane import KINDS, Plane
from gaussian_swaying.mpm.forces import MOST_STEPS
from gaussian_swaying.mpm.triton import obstacle_kernels as kernels
from gaussian_swaying.mpm.twins import Composed, Tables

Solid = Plane | Obstacle


def solids_of(boundaries: Sequence[Boundary], pins: Container[int] = ()) -> list[tuple[Solid, int]] | None:
    """All solids, each with the number of its boundary; None if a boundary has no twin.

    Args:
        boundaries: The boundary conditions of a body.
        pins: Numbers of those that are no solids.
    """
    others = [(one, k) for k, one in enumerate(boundaries) if k not in pins]
    if any(boundary.twin() is None for boundary, _ in others):
        return None
    return [(part, k) for one, k in others for part in one.modules() if isinstance(part, Solid)]


class Solids:
    """Tables of solids at fixed addresses, which recorded graphs contain.

    Args:
        parts: The solids, each with the number of its boundary.
        device: Device of the tables.
        steps: Number of substeps for which there are poses.

    Attributes:
        twins: Their device functions.
        kinds: For each, its kind of contact in ``plane.KINDS``.
        moves: For each, whether it moves.
    """

    def __init__(self, parts: Sequence[tuple[Solid, int]], like: Tensor, steps: int = MOST_STEPS) -> None:
        self.parts, device = list(parts), like.device
        count, found = len(self.parts), [part.twin() for part, _ in self.parts]
        self._twins = [twin for twin in found if twin is not None]
        self.twins, self.tables = Composed(self._twins), Tables(device, like.dtype)
        self.kinds = tuple(KINDS.index(part.kind if isinstance(part, Plane) else "separate") for part, _ in self.parts)
        self.moves = tuple(isinstance(part, Obstacle) and not part.still for part, _ in self.parts)
        self.rows = like.new_zeros(count, kernels.ROW.value)
        self.windows = torch.zeros(count, 2, dtype=torch.float64, device=device)
        self.poses = like.new_zeros(steps if any(self.moves) else min(count, 1), count, kernels.POSE.value)
        spans, keys = [], 0
        for (part, _), moves in zip(self.parts, self.moves, strict=True):
            many = len(part.times) if isinstance(part, Obstacle) and moves else 0
            spans.append([keys, many])
            keys += many
        self.spans = torch.tensor(spans or [[0, 0]], dtype=torch.int32, device=device)
        self.keys = torch.zeros(max(keys, 1), kernels.KEY.value, dtype=torch.float64, device=device)

    def take(self) -> None:
        """Fill the tables; again only if one of the solids was changed."""
        if not self.tables.take(self._twins, self.twins, numbers=True):
            return
        keys = []
        for m, ((part, boundary), moves) in enumerate(zip(self.parts, self.moves, strict=True)):
            gap, center = (0.0, part.point) if isinstance(part, Plane) else (part.gap, part.center)
            self.rows[m, :3].copy_(torch.tensor([gap, part.friction, float(boundary)]))
            self.windows[m].copy_(torch.tensor([part.start, part.end], dtype=torch.float64))
            if moves and isinstance(part, Obstacle):
                keys.append(torch.cat([part.times[:, None], part.center + part.shifts, part.turns], dim=1))
            else:
                self.poses[:, m, :3] = center.to(self.poses)
        if keys:
            self.keys.copy_(torch.cat([key.to(self.keys) for key in keys]))

    def prepare(self, time: Tensor, dt: Tensor, steps: int) -> None:
        """Compute the poses of some substeps; can be recorded.

        Args:
            time: Time of the first [s], scalar float64 tensor on the device.
            dt: Substep [s], as ``time``.
            steps: Number of substeps.
        """
        if any(self.moves):
            count = len(self.parts)
            launch(kernels.obstacle_poses, (steps, count))(
                self.keys, self.spans, time, dt, self.poses, count, num_warps=1
            )
