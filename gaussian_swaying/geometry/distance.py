"""Signed distances to solids and their unit gradients, as device functions: formulas, and values on a grid.

Each gets a place, the numbers of the solid and its table, negative inside. They are those of obstacles, see
``mpm.device_functions``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import vectors
from gaussian_swaying.geometry.linalg_triton import add3, chosen, dot3, matvec, scale3, transpose, where3
from gaussian_swaying.kernels.derive import Memory, on_tensors
from gaussian_swaying.kernels.language import tl, triton

LEAST = tl.constexpr(1.0842022e-19)
"""Length of a vector without a direction: the square root of the smallest normal number."""


@triton.jit
def _outwards(x):
    length = tl.sqrt(dot3(x, x))
    some = length > LEAST
    return length, where3(some, scale3(1 / tl.where(some, length, 1.0), x), (0.0, 0.0, 1.0))


@triton.jit
def ball_distance(x, numbers, table, mask, OPTIONS: tl.constexpr):
    """Distance from a ball around the origin; ``numbers``: radius."""
    length, direction = _outwards(x)
    return length - numbers[0], direction


@triton.jit
def capsule_distance(x, numbers, table, mask, OPTIONS: tl.constexpr):
    """Distance from a capsule around the origin.

    ``numbers``: radius, half of the axis (3), one over the square of that.
    """
    half = chosen(numbers, 1, 3)
    along = dot3(x, half) * numbers[4]
    along = tl.minimum(tl.maximum(along, -1.0), 1.0)
    return ball_distance(add3(x, -along, half), numbers, table, mask, OPTIONS)


@triton.jit
def box_distance(x, numbers, table, mask, OPTIONS: tl.constexpr):
    """Distance from a box around the origin; ``numbers``: half of the sides (3), axes in columns (9)."""
    axes = chosen(numbers, 3, 9)
    x = matvec(transpose(axes), x)
    b = (tl.abs(x[0]) - numbers[0], tl.abs(x[1]) - numbers[1], tl.abs(x[2]) - numbers[2])
    outside, away = _outwards((tl.maximum(b[0], 0.0), tl.maximum(b[1], 0.0), tl.maximum(b[2], 0.0)))
    deepest = tl.maximum(tl.maximum(b[0], b[1]), b[2])
    within = deepest <= 0
    first = b[0] == deepest
    second = (b[1] == deepest) & (b[0] != deepest)
    n0 = tl.where(within, first.to(tl.float32), away[0])
    n1 = tl.where(within, second.to(tl.float32), away[1])
    n2 = tl.where(within, 1 - (first | second).to(tl.float32), away[2])
    n = (tl.where(x[0] < 0, -n0, n0), tl.where(x[1] < 0, -n1, n1), tl.where(x[2] < 0, -n2, n2))
    return tl.where(within, deepest, outside), matvec(axes, n)


@triton.jit
def half_space_distance(x, numbers, table, mask, OPTIONS: tl.constexpr):
    """Distance from a plane through the origin; ``numbers``: its normal."""
    return dot3(x, numbers), add3(numbers, 0.0, x)


@triton.jit
def _low(x, n):
    inside = tl.minimum(tl.maximum(x, 0.0), (n - 1).to(tl.float32))
    first = tl.maximum(tl.minimum(tl.floor(inside), (n - 2).to(tl.float32)), 0.0)
    return first.to(tl.int32), inside - first, x - inside


@triton.jit
def grid_distance(x, numbers, table, mask, OPTIONS: tl.constexpr):
    """Distance interpolated in a grid; beyond the grid, the value at its border plus the distance to it.

    ``numbers``: first node (3), axes in columns (9), spacing, nodes along each axis (3). ``table``: the distances.
    """
    axes = chosen(numbers, 3, 9)
    spacing = numbers[12]
    ny = numbers[14].to(tl.int32)
    nz = numbers[15].to(tl.int32)
    x = matvec(transpose(axes), x)
    x0, f0, o0 = _low((x[0] - numbers[0]) / spacing, numbers[13].to(tl.int32))
    x1, f1, o1 = _low((x[1] - numbers[1]) / spacing, ny)
    x2, f2, o2 = _low((x[2] - numbers[2]) / spacing, nz)
    zero = f0 * 0
    distance, s0, s1, s2 = zero, zero, zero, zero
    w0, w1 = (1 - f0, f0), (1 - f1, f1)
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            line = ((x0 + i) * ny + x1 + j) * nz + x2
            low = tl.load(table + line, mask, 0.0)
            high = tl.load(table + line + 1, mask, 0.0)
            between = low + f2 * (high - low)
            distance += w0[i] * w1[j] * between
            s0 += (2 * i - 1) * w1[j] * between
            s1 += (2 * j - 1) * w0[i] * between
            s2 += w0[i] * w1[j] * (high - low)
    far, away = _outwards((o0 * spacing, o1 * spacing, o2 * spacing))
    _length, n = _outwards((s0, s1, s2))
    out = far > 0
    return distance + far, matvec(axes, where3(out, away, n))


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

    def numbers(self, axes: Tensor) -> Tensor:
        """The ``numbers`` of :func:`grid_distance`, shape (16,), with the axes in columns."""
        sizes = [self.origin.new_full((1,), size) for size in (self.spacing, *self.values.shape)]
        return torch.cat([self.origin, axes.to(self.origin).reshape(-1), *sizes])

    def at(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Distances [m], shape (...), and unit gradients at places [m], shape (..., 3)."""
        return distance_at(grid_distance, place, self.numbers(torch.eye(3)), self.values)


def distance_at(function: Any, place: Tensor, numbers: Tensor, table: Tensor) -> tuple[Tensor, Tensor]:
    """Evaluate a distance function on tensors: distances (...) and unit gradients (..., 3) at places (..., 3)."""
    known = tuple(numbers.to(place).reshape(-1).unbind())
    distance, normal = on_tensors(function)(place.unbind(-1), known, Memory(table.to(place)), None, ())
    return distance, vectors(normal)
