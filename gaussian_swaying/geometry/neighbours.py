"""Nearest neighbours of points, by scipy's KD-tree."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def nearest_neighbours(points: Tensor, count: int, queries: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Distances and indices of the nearest points, exact and deterministic, computed on the CPU.

    Args:
        points: Points to find, shape (N, 3).
        count: Number of neighbours to find for each query, at most N (N - 1 without ``queries``).
        queries: Points to search from, shape (M, 3); None for the points themselves, where no point is its own
            neighbour.

    Returns:
        Distances, ascending, and indices, each of shape (M, count).
    """
    points = points.detach().cpu()
    places = points if queries is None else queries.detach().cpu().to(points.dtype)
    if len(places) == 0:
        return places.new_empty(0, count), torch.empty(0, count, dtype=torch.long)
    from scipy.spatial import cKDTree

    candidates = np.arange(1, count + 1 + (queries is None))
    found = cKDTree(points.numpy()).query(places.numpy(), candidates, workers=torch.get_num_threads())
    index = torch.from_numpy(found[1])
    if queries is None:
        itself = index == torch.arange(len(points))[:, None]
        itself[:, -1] |= ~itself.any(-1)  # more points than `count` are at the same place
        index = index[~itself].reshape(len(points), count)
    distance = (points[index] - places[:, None]).square().sum(-1).sqrt()  # in the precision of the points
    distance, order = distance.sort(stable=True)
    return distance, index.gather(-1, order)


def particle_spacing(points: Tensor) -> float:
    """90th percentile of the distance to the nearest other point, from an even sample of some 4,000 points.

    Args:
        points: Shape (N, 3).
    """
    step = max(1, len(points) // 4000)
    distance = nearest_neighbours(points, 2, points[::step])[0][:, 1].double()
    return float(distance.kthvalue(1 + round(0.9 * (len(distance) - 1))).values)
