"""Fewer points for a coarse grid: one for each small cube, and how everything else follows them smoothly."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape
from gaussian_swaying.geometry.neighbours import nearest_neighbours


@torch.no_grad()
def group_points(points: Tensor, weight: Tensor, side: float, preferred: int | None = None) -> tuple[Tensor, Tensor]:
    """Divide space into cubes and choose one point of each: the one closest to the weighted centre of its cube.

    Args:
        points: Points, shape (N, 3).
        weight: Their weights, zero or more, shape (N,).
        side: Side of the cubes, in the unit of the points.
        preferred: If a cube contains some of the first ``preferred`` points, one of these is chosen; None for no
            preference.

    Returns:
        Indices of the chosen points, ascending, shape (M,); and for each point which of these represents it, (N,).

    Raises:
        ValueError: If a tensor does not have the shape above, or ``side`` is not positive.
    """
    check_shape("points", points, None, 3)
    check_shape("weight", weight, len(points))
    check_positive("side", side)
    where = points.double()
    share = weight.double().clamp_min(1e-12 * float(weight.sum()) + 1e-300)
    cell = torch.floor((where - where.amin(0)) / side).long()
    cube = torch.unique(cell, dim=0, return_inverse=True)[1]
    count = int(cube.max()) + 1
    total = share.new_zeros(count).index_add_(0, cube, share)
    centre = where.new_zeros(count, 3).index_add_(0, cube, share[:, None] * where) / total[:, None]
    distance = (where - centre[cube]).square().sum(-1)
    if preferred is not None:
        distance[preferred:] += 3 * side**2  # more than a cube's diagonal
    order = distance.argsort(stable=True)
    first = torch.full((count,), len(points)).scatter_reduce_(0, cube[order], torch.arange(len(points)), "amin")
    chosen = order[first]
    kept, rank = chosen.sort()
    place = torch.empty_like(rank).scatter_(0, rank, torch.arange(count))
    return kept, place[cube]


@torch.no_grad()
def blend_weights(points: Tensor, queries: Tensor, count: int = 6) -> tuple[Tensor, Tensor]:
    """The points that a query follows, and their weights, which are continuous in space.

    The weight of a point at distance d is (1/d - 1/R)², where R is the distance of the nearest point that is not used
    (Franke and Little's form of Shepard's method). So a query at a point follows that point alone.

    Args:
        points: Points, shape (M, 3).
        queries: Points that follow, shape (C, 3).
        count: How many points a query follows; fewer if there are fewer points.

    Returns:
        Indices of the points, and weights that add up to 1, each of shape (C, K).
    """
    near = min(count + 1, len(points))
    distance, index = nearest_neighbours(points.double(), near, queries.double())
    if near == 1:
        return index, torch.ones_like(distance)
    reach = distance[:, -1:].clamp_min(1e-300)
    inverse = 1 / distance[:, :-1].clamp_min(1e-9 * reach)
    weight = (inverse - 1 / reach).clamp_min(1e-12 / reach).square()
    return index[:, :-1], weight / weight.sum(-1, keepdim=True)
