"""The Gaussians that a camera should show: the whole object, including parts that do not move."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.preview.shape import quantile

RADIUS = 1.9  # distance of a camera in multiples of the longest side of the shown box
SOLID = 0.1  # opacity


def nearby(points: Tensor, simulated: Tensor) -> Tensor:
    """Return a mask of the points (N, 3) at most one longest side outside the box of those that move, shape (N,)."""
    low, high = points[simulated].amin(0), points[simulated].amax(0)
    side = (high - low).amax()
    return ((points >= low - side) & (points <= high + side)).all(-1)


def whole_box(
    points: Tensor, opacity: Tensor, simulated: Tensor, outside: Tensor, cell: float
) -> tuple[list[float], list[float]]:
    """Box of the moving part and everything connected with it, at most one longest side larger on each side.

    Args:
        points: Centres [scene units], shape (N, 3).
        opacity: Opacities, shape (N,).
        simulated: The moving part, shape (N,).
        outside: Gaussians that are not part of the object, such as a floor, shape (N,).
        cell: Points in the same or in touching cells of this size are connected [scene units].

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
    """Target and distance of an orbiting camera that shows all of an object.

    Args:
        whole: Corners of the box of the whole object [scene units].
        moving: Corners of the box of the moving part [scene units].

    Returns:
        ``target_offset`` and ``radius`` of an orbiting camera, in multiples of the longest side of the moving part.
    """
    size = max(b - a for a, b in zip(*moving, strict=True))
    share = max(b - a for a, b in zip(*whole, strict=True)) / size
    shift = [0.5 * (a + b - c - d) / size for a, b, c, d in zip(*whole, *moving, strict=True)]
    if share < 1.02 and max(map(abs, shift)) < 0.02:
        return (0.0, 0.0, 0.0), RADIUS
    return tuple(round(c, 3) + 0.0 for c in shift), round(RADIUS * share, 2)
