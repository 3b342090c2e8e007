"""Distances between point sets, in chunks, so that memory does not grow with the product of their sizes."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape

_PAIRS = 2**20  # on a CPU a chunk of distances should fit in the cache
_PAIRS_CUDA = 2**24
_SLABS_FROM = 2**22  # number of pairs from which slabs are faster, on a CPU
_GROUP = 128  # points that share a slab


@torch.no_grad()
def nearest_distances(source: Tensor, target: Tensor, pairs: int | None = None) -> tuple[Tensor, Tensor]:
    """Distance of every point to the nearest one of the other set, both ways.

    Exact on any device: a GPU looks at all pairs, a CPU only at those that can be nearest. Distances are computed from
    differences of coordinates, not from expanded squares, so they stay precise far from the origin. There is no
    gradient.

    Args:
        source: Points [m], shape (P, D).
        target: Points [m], shape (Q, D).
        pairs: Largest number of distances in memory at a time, but at least Q; the default suits the device.

    Returns:
        Distances from ``source`` to ``target`` [m], shape (P,), and from ``target`` to ``source`` [m], shape (Q,).

    Raises:
        ValueError: If a set is empty, the shapes do not fit, or ``pairs`` is not positive.
    """
    if pairs is None:
        pairs = _PAIRS_CUDA if source.is_cuda else _PAIRS
    check_positive("pairs", pairs)
    check_shape("source", source, "P", "D")
    check_shape("target", target, "Q", source.shape[-1])
    for name, points in (("source", source), ("target", target)):
        if len(points) == 0:
            raise ValueError(f"Expected `{name}` to hold at least one point, but it is empty.")
    many = not source.is_cuda and len(source) * len(target) > _SLABS_FROM
    if many and bool(torch.isfinite(source).all()) and bool(torch.isfinite(target).all()):
        return _by_slabs(source, target, pairs), _by_slabs(target, source, pairs)
    return _by_chunks(source, target, pairs)


def _by_chunks(source: Tensor, target: Tensor, pairs: int) -> tuple[Tensor, Tensor]:
    """Distances from all pairs, ``pairs`` at a time."""
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
    """Distances of all pairs, shape (P, Q)."""
    if not source.is_cuda:
        return torch.cdist(source, target, compute_mode="donot_use_mm_for_euclid_dist")
    squares = source.new_zeros(len(source), len(target))  # cdist takes a block of threads for each pair there
    for one, other in zip(source.T, target.T, strict=True):
        apart = one[:, None] - other
        squares.addcmul_(apart, apart)
    return squares.sqrt_()


def _by_slabs(source: Tensor, target: Tensor, pairs: int) -> Tensor:
    """Distances to the target, shape (P,); a group of sources looks only at targets that are near along one axis.

    A few targets around the group give a bound on the nearest distances, and so the slab that contains all nearest
    targets.
    """
    axis = int((target.amax(0) - target.amin(0)).argmax())
    target = target[target[:, axis].argsort()]
    order = source[:, axis].argsort()
    heights = target[:, axis].contiguous()
    nearest = source.new_empty(len(source))
    for group in order.split(_GROUP):
        some = source[group]
        ends = some[[0, -1], axis]
        begin, end = torch.searchsorted(heights, ends).tolist()
        begin, end = max(0, begin - _GROUP), end + _GROUP
        found = _by_chunks(some, target[begin:end], pairs)[0]
        reach = 1.0001 * float(found.max())  # more than rounding
        first, last = torch.searchsorted(heights, ends + torch.tensor([-reach, reach]).to(ends)).tolist()
        if first < begin or last > end:
            found = _by_chunks(some, target[min(first, begin) : max(last, end)], pairs)[0]
        nearest[group] = found
    return nearest
