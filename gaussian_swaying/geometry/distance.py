"""Signed distances to solids, with their gradients: formulas, and values on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


def _outwards(vector: Tensor, fallback: int) -> tuple[Tensor, Tensor]:
    """Length (...) and direction (..., 3) of vectors; a zero vector points along the axis ``fallback``."""
    length = torch.linalg.vector_norm(vector, dim=-1)
    some = length > torch.finfo(vector.dtype).tiny ** 0.5
    axis = torch.zeros_like(vector)
    axis[..., fallback] = 1.0
    return length, torch.where(some[..., None], vector / torch.where(some, length, 1.0)[..., None], axis)


def ball_distance(place: Tensor, radius: float | Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance to a ball around the origin, negative inside.

    Args:
        place: Places, shape (..., 3).
        radius: Its radius.

    Returns:
        Distances, shape (...), and their gradients, unit vectors (..., 3); z at the centre.
    """
    length, direction = _outwards(place, 2)
    return length - radius, direction


def capsule_distance(place: Tensor, half: Tensor, radius: float | Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance to a capsule: all places within a radius of the segment from ``-half`` to ``half``.

    Args:
        place: Places, shape (..., 3).
        half: Half of its axis, shape (3,); zero for a ball.
        radius: Its radius.

    Returns:
        Distances, shape (...), and their gradients, unit vectors (..., 3).
    """
    squared = (half * half).sum().clamp(min=torch.finfo(half.dtype).tiny)
    along = ((place * half).sum(-1) / squared).clamp(-1.0, 1.0)
    return ball_distance(place - along[..., None] * half, radius)


def box_distance(place: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance to a box around the origin with sides along the axes.

    Args:
        place: Places, shape (..., 3).
        half: Half of its sides, shape (3,).

    Returns:
        Distances, shape (...), and their gradients, unit vectors (..., 3): of the nearest face inside the box.
    """
    beyond = place.abs() - half
    sign = torch.where(place < 0, -1.0, 1.0).to(place)
    outside, away = _outwards(beyond.clamp(min=0.0), 2)
    deepest, axis = beyond.max(-1)
    face = torch.nn.functional.one_hot(axis, 3).to(place)
    within = deepest <= 0
    return torch.where(within, deepest, outside), sign * torch.where(within[..., None], face, away)


@dataclass(frozen=True, slots=True)
class DistanceGrid:
    """Signed distances at the nodes of a regular grid, negative inside.

    Attributes:
        values: Distances [m], shape (nx, ny, nz).
        origin: The first node [m], shape (3,).
        spacing: Distance of the nodes [m].
    """

    values: Tensor
    origin: Tensor
    spacing: float

    def at(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Trilinear interpolation; beyond the grid, the value at its border plus the distance to it.

        Args:
            place: Places [m], shape (..., 3).

        Returns:
            Distances [m], shape (...), and unit gradients, shape (..., 3).
        """
        return grid_distance(place, self.values, self.origin, self.spacing)


def grid_distance(place: Tensor, values: Tensor, origin: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """:meth:`DistanceGrid.at` from its tensors."""
    values, size = values.to(place), [n - 1 for n in values.shape]
    most = torch.stack([(place[..., 0] * 0 + n) for n in size], dim=-1)
    lattice = (place - origin.to(place)) / spacing
    inside = lattice.clamp(min=0.0).minimum(most)
    first = inside.detach().floor().minimum(most - 1).clamp(min=0.0)
    f = inside - first
    x, y, z = first.long().unbind(-1)
    _, ny, nz = values.shape
    flat = values.reshape(-1)
    distance = torch.zeros_like(f[..., 0])
    slope = [torch.zeros_like(distance) for _ in range(3)]
    for i in range(2):
        for j in range(2):
            for k in range(2):
                corner = flat[((x + i) * ny + y + j) * nz + z + k]
                w = [f[..., a] if bit else 1 - f[..., a] for a, bit in enumerate((i, j, k))]
                distance = distance + w[0] * w[1] * w[2] * corner
                for a, bit in enumerate((i, j, k)):
                    other = w[(a + 1) % 3] * w[(a + 2) % 3]
                    slope[a] = slope[a] + (corner if bit else -corner) * other
    beyond = (lattice - inside) * spacing
    far, away = _outwards(beyond, 2)
    _, direction = _outwards(torch.stack(slope, dim=-1), 2)
    out = (far > 0)[..., None]
    return distance + far, torch.where(out, away, direction)
