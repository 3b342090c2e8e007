"""Fewer points for a coarse grid: one for each small cube, what hangs on none of them, and how the rest follows."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape
from gaussian_swaying.geometry.neighbours import nearest_neighbours

LOOSE = 0.01  # share of the largest part; what is smaller and connected to nothing is loose
_NEIGHBOURS = 26  # that are looked at, as many as the cubes around a cube


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


@torch.no_grad()
def loose_points(points: Tensor, side: float) -> Tensor:
    """Which points hang on nothing, or by a thread, so that the wind would blow them off a grid.

    One point of each cube counts (:func:`group_points`), and two of them are connected if they are at most two sides
    apart, as are points in cubes side by side. Loose are

    - the parts with fewer than one in a hundred of the points of the largest part: as surfaces they are less than a
      tenth as long as it, too short for a usual grid to bend;
    - points with fewer than two neighbours: left out, they part nothing, and a thread loses no more than its end.

    Args:
        points: Points, shape (N, 3).
        side: Side of the cubes, in the unit of the points, less than half the spacing of the grid. What is farther
            apart than one spacing shares only the rims of its kernels, and moves apart without strain.

    Returns:
        Booleans, shape (N,); none if otherwise all would be loose.

    Raises:
        ValueError: If a shape is not the one above or ``side`` is not positive.
    """
    kept, group = group_points(points, torch.ones(len(points)), side)
    if len(kept) < 3:
        return torch.zeros(len(points), dtype=torch.bool)
    distance, index = nearest_neighbours(points[kept].double(), min(_NEIGHBOURS, len(kept) - 1))
    near = distance <= 2 * side
    pairs = torch.stack([near.nonzero()[:, 0], index[near]])
    part = joined(len(kept), pairs)
    size = part.bincount()
    loose = (size[part] < LOOSE * size.max()) | (near.sum(-1) < 2)
    return (loose & ~loose.all())[group]


def joined(count: int, pairs: Tensor) -> Tensor:
    """The connected part that each of ``count`` things is in, from pairs of them that are connected.

    Args:
        count: How many things.
        pairs: Their numbers, shape (2, K).

    Returns:
        Numbers from 0 on, shape (count,).
    """
    one, other = pairs
    label = torch.arange(count)
    while True:  # the smaller number spreads, by halving of paths
        smaller = torch.minimum(label[one], label[other])
        new = label.clone()
        for end in (one, other, label[one], label[other]):
            new.scatter_reduce_(0, end, smaller, "amin")
        new = new[new]
        if new.equal(label):
            break
        label = new
    return label.unique(return_inverse=True)[1]
