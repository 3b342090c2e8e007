"""Nearest neighbours in plain torch, on grids that get coarser and coarser."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape

_CROWD = 16  # points in the cell of a point, on average, on the first grid; 8 to 32 take about as long
_PAIRS = 200_000  # candidate pairs of a chunk: few enough for the cache of a processor


def nearest_neighbours(points: Tensor, count: int, queries: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Distances and indices of the nearest points, exact and deterministic, computed on the CPU.

    A query is answered on the first grid whose 27 cells around it contain enough points within one cell size. Only the
    remaining queries go on to the grid with twice the cell size. Memory is bounded by chunks of candidate pairs.

    Args:
        points: Points to find, shape (N, 3).
        count: Number of neighbours to find for each query, at most N (N - 1 without ``queries``).
        queries: Points to search from, shape (M, 3); None for the points themselves, where no point is its own
            neighbour.

    Returns:
        Distances, ascending, and indices, each of shape (M, count).
    """
    points = points.detach().cpu()
    own = queries is None
    places = points if queries is None else queries.detach().cpu().to(points.dtype)
    both = points if queries is None else torch.cat([points, places])
    distance = torch.empty(len(places), count, dtype=points.dtype)
    index = torch.empty(len(places), count, dtype=torch.long)
    if len(places) == 0:
        return distance, index
    low = both.amin(0)
    extent = max(float((both.amax(0) - low).amax()), torch.finfo(points.dtype).tiny * 1e20)
    around = torch.arange(-1, 2)
    pending = torch.arange(len(places))
    level = _first_level(points, low, extent)
    while len(pending):
        size = extent * 2.0**-level
        key, order = _cell_key(((points - low) / size).floor().long()).sort(stable=True)
        # cells along z follow each other in the order of keys, except where keys are shared
        shifts = torch.cartesian_prod(around, around, around if level >= 20 else torch.zeros(1, dtype=torch.long))
        wanted = _cell_key(((places[pending] - low) / size).floor().long()[:, None] + shifts)
        beside = 0 if level >= 20 else 1
        begin = torch.searchsorted(key, wanted - beside)
        length = torch.searchsorted(key, wanted + beside, right=True) - begin
        candidates = length.sum(-1)
        last = level <= 0
        keep = torch.nonzero(candidates >= count + own).squeeze(-1)
        keep = keep[candidates[keep].argsort(stable=True)]  # rows of one chunk need about the same width
        settled = torch.zeros(len(pending), dtype=torch.bool)
        start = 0
        while start < len(keep):
            width = max(1, _PAIRS // int(candidates[keep[min(start + 20_000, len(keep) - 1)]]))
            rows = keep[start : start + min(width, 20_000)]
            start += len(rows)
            query = pending[rows]
            itself = query if own else torch.full_like(query, -1)
            near, who = _nearest_among(points, places[query], itself, order, begin[rows], length[rows], count)
            done = torch.ones(len(rows), dtype=torch.bool) if last else near[:, -1] <= size
            distance[query[done]], index[query[done]] = near[done], who[done]
            settled[rows[done]] = True
        pending = pending[~settled]
        level -= 1
    return distance, index


def _first_level(points: Tensor, low: Tensor, extent: float) -> int:
    """The coarsest grid with few enough pairs, as a number of halvings of the extent, at most 40.

    A point shares its cell with at most :data:`_CROWD` others on average, which bounds the pairs to look at.
    """
    for level in range(1, 40):
        cells = ((points - low) / (extent * 2.0**-level)).floor().long()
        crowd = _cell_key(cells).unique(return_counts=True)[1].double()
        if float(crowd.square().sum()) <= _CROWD * len(points):
            return level
    return 40


def _cell_key(cells: Tensor) -> Tensor:
    """One number per cell (..., 3); cells 2^20 apart share one, which only adds candidates that are too far away."""
    x, y, z = (cells & (2**20 - 1)).unbind(-1)
    return (x << 40) | (y << 20) | z


def _nearest_among(
    points: Tensor, place: Tensor, itself: Tensor, order: Tensor, begin: Tensor, length: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """The nearest of the points in runs (B, R) of ``order`` for each place (B, 3), other than ``itself`` (B,)."""
    ends = length.cumsum(-1)
    column = torch.arange(int(ends[:, -1].max()))
    run = torch.searchsorted(ends, column.expand(len(place), -1).contiguous(), right=True).clamp_max(ends.shape[-1] - 1)
    at = begin.gather(-1, run) + column - (ends - length).gather(-1, run)
    who = order[at.clamp_max(len(points) - 1)]
    squared = (points[who] - place[:, None]).square().sum(-1)
    squared = squared.masked_fill((column >= ends[:, -1:]) | (who == itself[:, None]), torch.inf)
    nearest, chosen = squared.topk(count, dim=-1, largest=False, sorted=True)
    return nearest.sqrt(), who.gather(-1, chosen)


def particle_spacing(points: Tensor) -> float:
    """90th percentile of the distance to the nearest other point, from an even sample of some 4,000 points.

    Args:
        points: Shape (N, 3).
    """
    check_shape("points", points, None, 3)
    step = max(1, len(points) // 4000)
    distance = nearest_neighbours(points, 2, points[::step])[0][:, 1].double()
    return float(distance.kthvalue(1 + round(0.9 * (len(distance) - 1))).values)
