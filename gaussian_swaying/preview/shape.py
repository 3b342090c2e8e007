"""Measures of a cloud of points: bounds, quantiles, widths, the normal of a sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape

SHEET = 0.1  # smallest over middle standard deviation of the centres of a sheet
FAR = 1.5  # extents of the fine detail from its middle, beyond which a Gaussian is background
FEWEST = 16  # smallest number of Gaussians in an object
DIRECTIONS = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}


def bounds(points: Tensor, share: float = 0.005) -> dict[str, list[float]]:
    """Extremes and robust bounds of points.

    Args:
        points: Shape (N, 3).
        share: Share of the points beyond the robust bounds on each side.

    Returns:
        ``min``, ``max``, ``robust_min`` and ``robust_max``, 3 numbers each.
    """
    check_shape("points", points, None, 3)
    low, high = ([quantile(c, q) for c in points.unbind(-1)] for q in (share, 1 - share))
    return {
        "min": [float(v) for v in points.amin(0)],
        "max": [float(v) for v in points.amax(0)],
        "robust_min": low,
        "robust_max": high,
    }


def sheet_normal(points: Tensor) -> tuple[float, ...] | None:
    """Unit normal of points that are close to a plane (see ``SHEET``), set to an axis within 10 degrees."""
    where = points.double()
    values, axes = torch.linalg.eigh(torch.cov((where - where.mean(0)).T))
    spread = values.clamp(min=0).sqrt()
    if float(spread[1]) <= 0 or float(spread[0] / spread[1]) > SHEET:
        return None
    return snapped(axes[:, 0])


def quantile(values: Tensor, share: float) -> float:
    """Quantile without torch.quantile's limit of 2^24 values."""
    return float(values.double().kthvalue(1 + round(share * (len(values) - 1))).values)


def dense_part(points: Tensor, log_scales: Tensor) -> tuple[Tensor, float]:
    """The middle and the extent of the fine half of Gaussians, which tell where the cameras were near.

    Args:
        points: Centres [scene units], shape (N, 3).
        log_scales: Logarithms of the standard deviations, shape (N, 3).

    Returns:
        The middle, float64, shape (3,), and the longest side without a tenth at each end [scene units].
    """
    size = log_scales.amax(-1)
    fine = points[size <= size.median()].double()
    middle = torch.stack([column.median() for column in fine.unbind(-1)])
    return middle, max(extent(column, 0.1) for column in fine.unbind(-1))


def extent(values: Tensor, share: float) -> float:
    """The range of values (N,) without a share of them at each end."""
    return quantile(values, 1 - share) - quantile(values, share)


def breadth(points: Tensor, axes: Sequence[Tensor], share: float) -> float:
    """The larger of the extents of points (N, 3) along some axes, see :func:`extent`; 0 for none."""
    return max(extent(points @ axis, share) for axis in axes) if len(points) else 0.0


def largest_plane(
    points: Tensor, weight: Tensor, half: float, axis: Tensor | None = None
) -> tuple[Tensor, float] | None:
    """The plane with the most weight within a distance of it, the best of 400 through three points.

    Args:
        points: Shape (N, 3), float64.
        weight: Shape (N,), float64.
        half: The distance.
        axis: Direction from which the normal is at most 45 degrees away; None for any.

    Returns:
        Unit normal, on the side of ``axis``, and offset; None for too few points, or no such plane.
    """
    if len(points) < FEWEST:
        return None
    step = max(1, len(points) // 4000)
    where, own = points[::step], weight[::step]
    draw = torch.Generator().manual_seed(0)
    corners = where[torch.multinomial(own + 1e-12 * own.sum() + 1e-300, 3 * 400, True, generator=draw)].reshape(
        -1, 3, 3
    )
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = normals.norm(dim=-1, keepdim=True)
    normals = normals / length.clamp(min=1e-30)
    offsets = (normals * corners[:, 0]).sum(-1)
    inside = (where @ normals.T - offsets).abs() <= half
    fit = length[:, 0] > 1e-12
    if axis is not None:
        fit &= (normals @ axis).abs() > math.sqrt(0.5)
    if not bool(fit.any()):
        return None
    score = torch.where(fit, (inside * own[:, None]).sum(0), -1.0)
    normal, offset = normals[int(score.argmax())], float(offsets[int(score.argmax())])
    for _ in range(3):
        near = (where @ normal - offset).abs() <= half
        share = own[near] / own[near].sum()
        middle = (where[near] * share[:, None]).sum(0)
        away = where[near] - middle
        normal = torch.linalg.eigh((away * share[:, None]).T @ away)[1][:, 0]
        offset = float(middle @ normal)
    if axis is not None and float(normal @ axis) < 0:
        normal, offset = -normal, -offset
    return normal, offset


def plane_axes(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors perpendicular to another."""
    helper = torch.eye(3, dtype=torch.float64)[int(axis.abs().argmin())]
    first = torch.linalg.cross(axis, helper)
    first = first / first.norm()
    return first, torch.linalg.cross(axis, first)


def width(points: Tensor, axis: Tensor) -> float:
    """Geometric mean of the widths of points perpendicular to an axis, robust."""
    sides = [points.double() @ across for across in plane_axes(axis)]
    return math.sqrt(math.prod(max(extent(s, 0.03), 1e-9) for s in sides))


def snapped(direction: Tensor) -> tuple[float, ...]:
    """A unit vector, set to an axis within 10 degrees; its largest component is positive."""
    unit = direction.double() / direction.double().norm()
    main = int(unit.abs().argmax())
    if float(unit[main]) < 0:
        unit = -unit
    if float(unit[main]) > math.cos(math.radians(10)):
        unit = torch.eye(3, dtype=torch.float64)[main]
    return tuple(float(c) + 0.0 for c in unit)


def rounded(value: float, cell: float) -> float:
    """A coordinate rounded to about a hundredth of a cell."""
    return round(value, max(0, 2 - math.floor(math.log10(cell))))
