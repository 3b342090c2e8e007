"""Values of a regular grid at any place, by linear interpolation along each axis."""

from __future__ import annotations

import torch
from torch import Tensor


def picked(values: Tensor, index: Tensor) -> Tensor:
    """Rows of a tensor (N, ...) by integers of any shape, also of none, without making the host wait.

    ``values[index]`` with a scalar on a GPU would read it on the host, which a CUDA graph cannot record.
    """
    return values.index_select(0, index.reshape(-1)).reshape((*index.shape, *values.shape[1:]))


def trilinear(
    table: Tensor,
    place: Tensor,
    wraps: tuple[bool, bool, bool] = (False, False, False),
    number: Tensor | None = None,
) -> Tensor:
    """Interpolate between the eight corners of the cell around each place.

    Args:
        table: Values at the corners, shape (X, Y, Z, C); with a ``number``, shape (T, X, Y, Z, C).
        place: Places in cells from the first corner, shape (..., 3).
        wraps: Whether the table repeats along each axis; if not, its outermost values go on outside.

        number: Which of the T tables, a scalar integer tensor.

    Returns:
        Shape (..., C), in the dtype of ``place``.

    Example:
        >>> table = torch.arange(8.0).reshape(2, 2, 2, 1)
        >>> trilinear(table, torch.tensor([[0.5, 0.0, 1.0]]))
        tensor([[3.]])
    """
    shape, width = table.shape[-4:-1], table.shape[-1]
    flat = place.reshape(-1, 3)
    below, weights = [], []
    for axis in range(3):
        n, x = shape[axis], flat[:, axis]
        if not wraps[axis]:
            x = x.clamp(0, n - 1)
        first = x.detach().floor()
        share = x - first
        low = first.long()
        high = low + 1
        if wraps[axis]:
            low, high = low.remainder(n), high.remainder(n)
        else:  # NaN, as where a simulation diverges, must not lead out of the table
            low, high = low.clamp(0, n - 1), high.clamp(0, n - 1)
        below.append((low, high))
        weights.append((1 - share, share))
    (x0, x1), (y0, y1), (z0, z1) = below
    rows = [(x * shape[1] + y) * shape[2] + z for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]
    if number is not None:
        rows = [row + number * (shape[0] * shape[1] * shape[2]) for row in rows]
    parts = [a * b * c for a in weights[0] for b in weights[1] for c in weights[2]]
    corners = table.reshape(-1, width).index_select(0, torch.stack(rows).reshape(-1)).to(place.dtype)
    found = (corners.view(8, -1, width) * torch.stack(parts)[..., None]).sum(0)
    return found.reshape(*place.shape[:-1], width)
