"""Distances between point sets, by a tree or in chunks: memory does not grow with the product of their sizes."""

from __future__ import annotations

import torch
from torch import Tensor

PAIRS = {"cpu": 2**20, "cuda": 2**24}
"""Most distances in memory at a time, where all pairs are looked at; on a CPU they should fit in the cache."""


@torch.no_grad()
def nearest_distances(source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of every point to the nearest one of the other set, both ways; neither set may be empty.

    Exact on any device: a GPU looks at all pairs, a CPU searches a tree. Distances are computed from
    differences of coordinates, not from expanded squares, so they stay precise far from the origin. There is no
    gradient.

    Args:
        source: Points [m], shape (P, D).
        target: Points [m], shape (Q, D).

    Returns:
        Distances from ``source`` to ``target`` [m], shape (P,), and from ``target`` to ``source`` [m], shape (Q,).
    """
    if not source.is_cuda and bool(torch.isfinite(source).all()) and bool(torch.isfinite(target).all()):
        return _by_tree(source, target), _by_tree(target, source)
    return _by_chunks(source, target)


def _by_chunks(source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    forward = source.new_empty(len(source))
    backward = target.new_full((len(target),), torch.inf)
    rows = max(1, PAIRS[source.device.type] // len(target))
    for start in range(0, len(source), rows):
        part = slice(start, start + rows)
        distance = _distances(source[part], target)
        forward[part] = distance.amin(1)
        backward = torch.minimum(backward, distance.amin(0))
    return forward, backward


def _distances(source: Tensor, target: Tensor) -> Tensor:
    """Distances of all pairs, shape (..., P, Q)."""
    if not source.is_cuda:
        return torch.cdist(source, target, compute_mode="donot_use_mm_for_euclid_dist")
    squares = source.new_zeros(len(source), len(target))  # cdist takes a block of threads for each pair there
    for one, other in zip(source.T, target.T, strict=True):
        apart = one[:, None] - other
        squares.addcmul_(apart, apart)
    return squares.sqrt_()


def _by_tree(source: Tensor, target: Tensor) -> Tensor:
    """Distances to the target, shape (P,), by scipy's KD-tree."""
    from scipy.spatial import cKDTree

    two = range(1, min(2, len(target)) + 1)  # the tree computes in double precision, so two may be equally near here
    index = torch.from_numpy(cKDTree(target.numpy()).query(source.numpy(), two)[1])
    return _distances(source[:, None], target[index]).amin((1, 2))
