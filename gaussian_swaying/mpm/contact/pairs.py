"""Pairs of contact samples that are close now but were not at rest, from a sorted grid."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_CHUNK = 4_000_000
"""Candidate pairs that are looked at together."""

MOST_PAIRS = 50_000_000
"""Most pairs that are kept."""

_AHEAD = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Half of the columns around one: the others see it from their side."""


@torch.no_grad()
def close_pairs(
    place: Tensor,
    reach: float,
    rest: Tensor,
    apart: float,
    unconnected: Callable[[Tensor, Tensor], Tensor] | None = None,
    least: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """All pairs of samples closer than ``reach`` that were at least ``apart`` from each other at rest.

    Samples are sorted by the cells of a grid as wide as ``reach``. Each looks at the samples after it in its own column
    of cells, and at four columns beside it, so that every pair is found once. The cost grows with the pairs.

    Args:
        place: Positions of the samples now [m], shape (C, 3).
        reach: Distance [m].
        rest: Positions of the same samples at rest [m], shape (C, 3).
        apart: Least distance at rest [m].
        unconnected: A mask of pairs, from the indices of their samples, whose parts are not connected there.
        least: Least distance of such a pair at rest [m].

    Returns:
        Indices of the two samples of each pair, the smaller first, in rising order, shape (M,) each.
    """
    count, device = len(place), place.device
    if count < 2:
        none = torch.zeros(0, dtype=torch.long, device=device)
        return none, none
    low = place.amin(0)
    extent = float((place.amax(0) - low).amax())
    if not extent < float("inf"):
        raise FloatingPointError("The position of a contact sample is NaN or infinite.")
    size = max(reach, extent / 2.0**19)  # so that float32 rounds a position by a small part of a cell, and keys fit
    cell = ((place - low) / size).long() + 1
    _, ny, nz = (cell.amax(0) + 2).tolist()
    key, order = ((cell[:, 0] * ny + cell[:, 1]) * nz + cell[:, 2]).sort(stable=True)
    place, rest = place[order], rest[order]
    own = torch.arange(count, device=device)
    found: list[Tensor] = []
    for x, y in ((0, 0), *_AHEAD):
        wanted = key + (x * ny + y) * nz
        begin = own + 1 if (x, y) == (0, 0) else torch.searchsorted(key, wanted - 1)
        length = torch.searchsorted(key, wanted + 1, right=True) - begin
        ends = length.cumsum(0)
        total, first = int(ends[-1]), 0
        while first < count:
            before = int(ends[first - 1]) if first else 0
            last = count
            if total - before > _CHUNK:
                last = max(int(torch.searchsorted(ends, before + _CHUNK)), first + 1)
            part = length[first:last]
            a = torch.repeat_interleave(own[first:last], part)
            b = begin[a] + torch.arange(len(a), device=device) + before - (ends - length)[a]
            near = (place[a] - place[b]).square().sum(-1) < reach * reach
            a, b = a[near], b[near]
            distance = (rest[a] - rest[b]).square().sum(-1)
            far = distance >= apart * apart
            if unconnected is not None:
                far |= (distance >= least * least) & unconnected(order[a], order[b])
            found.append(torch.stack([order[a[far]], order[b[far]]]))
            if sum(part.shape[1] for part in found) > MOST_PAIRS:
                raise ValueError(
                    f"More than {MOST_PAIRS:,} pairs of contact samples are closer than {reach:.3g} m: the "
                    "material has collapsed; lower `contact.thickness`, or coarsen `solver.dx`."
                )
            first = last
    pairs = torch.cat(found, dim=1)
    low_index, high_index = pairs.amin(0), pairs.amax(0)
    ranked = (low_index * count + high_index).sort()[1]
    return low_index[ranked], high_index[ranked]
