"""Distances between point sets, by a tree or in chunks: memory does not grow with the product of their sizes."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape

_PAIRS = 2**20  # on a CPU a chunk of distances should fit in the cache
_PAIRS_CUDA = 2**24


@torch.no_grad()
def nearest_distances(source: Tensor, target: Tensor, pairs: int | None = None) -> tuple[Tensor, Tensor]:
    """Distance of every point to the nearest one of the other set, both ways.

    Exact on any device: a GPU looks at all pairs, a CPU searches a tree. Distances are computed from
    differences of coordinates, not from expanded squares, so they stay precise far from the origin. There is no
    gradient.

    Args:
        source: Points [m], shape (P, D).
        target: Points [m], shape (Q, D).
        pairs: Largest number of distances in memory at a time, where all pairs are looked at, but at least Q; the
            default suits the device.

    Returns:
        Distances from ``source`` to ``target`` [m], shape (P,), and from ``target`` to ``source`` [m], shape (Q,).
    """
    if pairs is None:
        pairs = _PAIRS_CUDA if source.is_cuda else _PAIRS
    check_positive("pairs", pairs)
    check_shape("source", source, "P", "D")
    check_shape("target", target, "Q", source.shape[-1])
    for name, points in (("source", source), ("target", target)):
        if len(points) == 0:
            raise ValueError(f"Expected `{name}` to hold at least one point, but it is empty.")
    if not source.is_cuda and bool(torch.isfinite(source).all()) and bool(torch.isfinite(target).all()):
        return _by_tree(source, target), _by_tree(target, source)
    return _by_chunks(source, target, pairs)


def _by_chunks(source: Tensor, target: Tensor, pairs: int) -> tuple[Tensor, Tensor]:
    forward = source.new_empty(len(source))
    backward = target.new_full((len(target),), torch.inf)
    rows = max(1, int(pairs) // len(target))
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
