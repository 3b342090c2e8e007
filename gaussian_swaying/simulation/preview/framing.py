"""What a camera should show: the object with those of its parts that do not move."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.simulation.preview.shape import connected_parts, quantile

RADIUS = 1.9  # distance of a camera in multiples of the longest side of what it shows
SOLID = 0.1  # opacity


def nearby(points: Tensor, simulated: Tensor) -> Tensor:
    """Which points (N, 3) lie at most one longest side beyond the box of those that move, shape (N,)."""
    low, high = points[simulated].amin(0), points[simulated].amax(0)
    side = (high - low).amax()
    return ((points >= low - side) & (points <= high + side)).all(-1)


def whole_box(
    points: Tensor, opacity: Tensor, simulated: Tensor, outside: Tensor, cell: float
) -> tuple[list[float], list[float]]:
    """Box of what moves and of what is connected with it, at most one longest side beyond it on each side.

    Args:
        points: Centres [scene units], shape (N, 3).
        opacity: Opacities, shape (N,).
        simulated: What moves, shape (N,).
        outside: What is no part of the object, such as a floor, shape (N,).
        cell: What is in the same or in touching cells of this size is connected [scene units].

    Returns:
        Lower and upper corner [scene units].
    """
    moving = points[simulated]
    low, high = moving.amin(0), moving.amax(0)
    index = (simulated | (nearby(points, simulated) & ~outside & (opacity >= SOLID))).nonzero()[:, 0]
    own = simulated[index]
    part = connected_parts(points[index], cell)
    numbers, count = part[own].unique(return_counts=True)
    joined = points[index[torch.isin(part, numbers[count >= 0.01 * int(own.sum())])]]
    if len(joined) > len(moving):  # specks do not count
        for k in range(3):
            low[k] = min(float(low[k]), quantile(joined[:, k], 0.002))
            high[k] = max(float(high[k]), quantile(joined[:, k], 0.998))
    return [float(v) for v in low], [float(v) for v in high]


def orbit_frame(
    whole: tuple[Sequence[float], Sequence[float]], moving: tuple[Sequence[float], Sequence[float]]
) -> tuple[tuple[float, ...], float]:
    """Where a camera that circles what moves has to look, and from how far, to show all of an object.

    Args:
        whole: Corners of the box of all of it [scene units].
        moving: Corners of the box of what moves [scene units].

    Returns:
        ``target_offset`` and ``radius`` of an orbiting camera, in multiples of the longest side of what moves.
    """
    size = max(b - a for a, b in zip(*moving, strict=True))
    share = max(b - a for a, b in zip(*whole, strict=True)) / size
    shift = [0.5 * (a + b - c - d) / size for a, b, c, d in zip(*whole, *moving, strict=True)]
    if share < 1.02 and max(map(abs, shift)) < 0.02:
        return (0.0, 0.0, 0.0), RADIUS
    return tuple(round(c, 3) + 0.0 for c in shift), round(RADIUS * share, 2)
