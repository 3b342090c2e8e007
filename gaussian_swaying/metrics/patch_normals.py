"""Tilt of the normals of a surface over patches of a given size."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def patch_normal_error(
    points: Tensor, normals: Tensor, true_normals: Tensor, size: float, weights: Tensor | None = None
) -> float:
    r"""Root mean square angle between normals and true normals after averaging over patches.

    The error of single normals is mostly noise, which a force on the surface averages out. A tilt of a larger patch is
    not: it changes the pressure of the wind on it. Space is cut into cubes of side ``size``, eight times, each time
    shifted by half a side along some axes. In each cube the mean normal is compared with the mean true normal, and the
    squared angles are averaged with the weights of the cubes.

    Args:
        points: Points on the surface, shape (N, 3).
        normals: Unit normals there, of either sign, shape (N, 3).
        true_normals: True unit normals there, with signs that agree with each other nearby, shape (N, 3).
        size: Side of a patch, in the unit of ``points``.
        weights: Weight of each point, such as its area, shape (N,); equal weights when None.

    Returns:
        The angle [degrees].

    Raises:
        ValueError: If there are no points, shapes do not match, ``size`` is not positive, or all weights are zero.

    Example:
        >>> points = torch.rand(1000, 3) * torch.tensor([1.0, 1.0, 0.0])
        >>> up = torch.tensor([0.0, 0.0, 1.0]).expand(1000, 3)
        >>> patch_normal_error(points, -up, up, 0.4)
        0.0
    """
    if points.dim() != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"Expected `points` of shape (N, 3) with N > 0, but got {tuple(points.shape)}.")
    for name, value in (("normals", normals), ("true_normals", true_normals)):
        if value.shape != points.shape:
            raise ValueError(f"Expected `{name}` of shape {tuple(points.shape)}, but got {tuple(value.shape)}.")
    if not (size > 0 and math.isfinite(size)):
        raise ValueError(f"Expected `size` to be positive, but got {size}.")
    share = points.new_ones(len(points)) if weights is None else weights
    if share.shape != points.shape[:1]:
        raise ValueError(f"Expected `weights` of shape ({len(points)},), but got {tuple(share.shape)}.")
    points, normals, true_normals, share = (part.detach().double() for part in (points, normals, true_normals, share))
    total = float(share.sum())
    if not total > 0:
        raise ValueError("Expected some of `weights` to be positive, but all are zero.")
    normals = torch.where((normals * true_normals).sum(-1, keepdim=True) < 0, -normals, normals)
    start = points.amin(0)
    squares = 0.0
    for shift in range(8):
        offset = points.new_tensor([0.5 * (shift >> axis & 1) for axis in range(3)])
        cell = torch.floor((points - start) / size + offset).long()
        _, owner = torch.unique(cell, dim=0, return_inverse=True)
        count = int(owner.max()) + 1
        both = torch.cat([normals, true_normals], dim=-1) * share[:, None]
        sums = both.new_zeros(count, 6).index_add_(0, owner, both)
        weight = share.new_zeros(count).index_add_(0, owner, share)
        ours, true = sums[:, :3], sums[:, 3:]
        angle = torch.atan2(torch.linalg.cross(ours, true).norm(dim=-1), (ours * true).sum(-1))
        squares += float((weight * angle.square()).sum()) / total
    return math.degrees(math.sqrt(squares / 8))
