"""The graph of what is attached in a splat at rest: along its surfaces, cut where two only pass near each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import equal_rows, joined, once, sums
from gaussian_swaying.geometry.neighbours import nearest_neighbours

NEIGHBOURS = 16  # to which a Gaussian may be attached
LOCAL = 6  # the distance to the neighbour of this number is the local spacing
REACH = 2.0  # largest distance of two that are attached [local spacings]
SMOOTH = 0.45  # share of the neighbours near the plane through them, above which a surface is smooth there
NEAR = 0.35  # what is near it [local spacings]
ROUNDS = 5  # of fitting a plane to the neighbours that are near the last one
LEVEL = 1.2  # how far apart two smooth surfaces may lie along their normals [local spacings]
ALIGNED = 0.5  # least cosine between their normals
STRAY, SMALL = 12, 0.01  # a piece of fewer Gaussians, or of a smaller share of the largest, is attached to the nearest
JOINTS = 8  # pairs that attach a part to another one where nothing else does


@torch.no_grad()
def attached_pairs(
    means: Tensor, normals: Tensor, labels: Tensor | None = None, to: Sequence[int | None] | None = None
) -> Tensor:
    """The pairs of Gaussians that are attached to each other.

    Two Gaussians are attached if each is among the nearest of one of them, at most :data:`REACH` local spacings away.
    Where the surface is smooth around both, as on two leaves that touch, they must also lie on one surface: neither
    far above the plane of the other, nor with another normal. A stem, an edge or a fold is not smooth, and nothing is
    cut there. No cut ever takes a part off: pieces that hung together before it stay attached to each other where most
    pairs were cut. A piece of few Gaussians is haze, and each of them is attached to the nearest of the others.

    Colours are not looked at: a leaf differs from its own stem more than from the leaf beside it.

    Args:
        means: Centres, shape (N, 3).
        normals: Unit normals, of either sign, with which the planes of smooth surfaces are looked for, shape (N, 3).
        labels: The part of each, shape (N,).
        to: For each part the only other part to which it is attached, as its number, or None for any; its own number
            for a part that is attached to no other.

    Returns:
        Pairs of different Gaussians, each once, int64, shape (E, 2), on the CPU.
    """
    where = means.detach().cpu().double()
    count = len(where)
    if count < 2:
        return torch.zeros(0, 2, dtype=torch.long)
    distance, index = nearest_neighbours(where, min(NEIGHBOURS, count - 1))
    spacing = distance[:, min(LOCAL, distance.shape[1]) - 1].clamp(min=1e-30)
    spacing = spacing[index].median(1).values  # at an edge, others are farther away
    first = torch.arange(count)[:, None].expand_as(index)
    scale = (spacing[first] * spacing[index]).sqrt()
    close = distance <= REACH * scale
    pairs = once(torch.stack([first[close], index[close]], 1), count)
    if labels is not None and to is not None:
        pairs = pairs[_allowed(pairs, labels.cpu(), to)]
    normal, flat = _planes(where, normals.detach().cpu().double(), index, spacing)
    a, b = pairs.unbind(1)
    arm, size = where[b] - where[a], (spacing[a] * spacing[b]).sqrt()
    above = torch.maximum((arm * normal[a]).sum(-1).abs(), (arm * normal[b]).sum(-1).abs())
    turned = (normal[a] * normal[b]).sum(-1).abs() < ALIGNED
    cut = flat[a] & flat[b] & ((above > LEVEL * size) | turned)
    pairs = torch.cat([pairs[~cut], _put_back(count, pairs[~cut], pairs[cut])])
    if labels is not None and to is not None:
        pairs = torch.cat([pairs, _missing(where, pairs, labels.cpu(), to)])
    own = None if labels is None or to is None else torch.tensor([k == part for part, k in enumerate(to)])[labels.cpu()]
    return torch.cat([pairs, _strays(where, pairs, own)])


def _planes(where: Tensor, normals: Tensor, index: Tensor, spacing: Tensor) -> tuple[Tensor, Tensor]:
    """Normals of planes through each Gaussian and those of its neighbours (N, K) that lie on one surface with it.

    Also whether most of them do. Planes start from the normals and are fitted again to what is near them, so that one
    stays on its surface where two cross.
    """
    arm = where[index] - where[:, None]
    normal, many = torch.nn.functional.normalize(normals, dim=-1), index.shape[1]
    for _ in range(ROUNDS):
        above = (arm * normal[:, None]).sum(-1) / (NEAR * spacing[:, None])
        weight = (1 + above.square()).reciprocal().square()
        normal = torch.linalg.eigh((weight[..., None] * arm).mT @ arm)[1][..., 0]
    above = (arm * normal[:, None]).sum(-1).abs() / spacing[:, None]
    return normal, (above < NEAR).sum(1) >= SMOOTH * many


def _put_back(count: int, kept: Tensor, cut: Tensor) -> Tensor:
    """The cut pairs that are needed, so that what hung together still does: those between pieces with most of them."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree

    piece = joined(count, kept.T)
    ends = piece[cut]
    between = ends[:, 0] != ends[:, 1]
    cut, ends = cut[between], ends[between].sort(1).values
    if not len(cut):
        return cut
    contact = equal_rows(ends)
    many = contact.bincount()
    low, high = torch.zeros_like(many)[:, None].expand(-1, 2).index_copy(0, contact, ends).T
    pieces = int(piece.max()) + 1
    graph = coo_matrix((1 / many.double(), (low, high)), (pieces, pieces))
    tree = minimum_spanning_tree(graph).tocoo()
    needed = torch.isin(low * pieces + high, torch.from_numpy(tree.row * np.int64(pieces) + tree.col))
    return cut[needed[contact]]


def _strays(where: Tensor, pairs: Tensor, alone: Tensor | None) -> Tensor:
    piece = joined(len(where), pairs.T)
    size = piece.bincount()
    largest = int(size.max())
    stray = size[piece] < min(max(STRAY, SMALL * largest), largest)
    if alone is not None:
        stray &= ~(alone & (size[piece] >= STRAY))
    own, others = stray.nonzero()[:, 0], (~stray).nonzero()[:, 0]
    if not len(own):
        return pairs[:0]
    return torch.stack([own, others[nearest_neighbours(where[others], 1, where[own])[1][:, 0]]], 1)


def _allowed(pairs: Tensor, labels: Tensor, to: Sequence[int | None]) -> Tensor:
    only = torch.tensor([-1 if k is None else k for k in to])
    a, b = labels[pairs].unbind(1)
    fits = [(only[p] < 0) | (only[p] == q) for p, q in ((a, b), (b, a))]
    return (a == b) | (fits[0] & fits[1])


def _missing(where: Tensor, pairs: Tensor, labels: Tensor, to: Sequence[int | None]) -> Tensor:
    found = [pairs[:0]]
    for part, other in enumerate(to):
        if other is None or other == part:
            continue
        own, theirs = (labels == part).nonzero()[:, 0], (labels == other).nonzero()[:, 0]
        ends = labels[pairs].sort(1).values
        linked = (ends == torch.tensor(sorted((part, other)))).all(1)
        if bool(linked.any()) or not len(own) or not len(theirs):
            continue
        distance, index = (t[:, 0] for t in nearest_neighbours(where[theirs], 1, where[own]))
        best = distance.argsort(stable=True)[:JOINTS]
        found.append(torch.stack([own[best], theirs[index[best]]], 1))
    return torch.cat(found)


def pieces(cell: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
    """Connected pieces of Gaussians within each cell.

    Args:
        cell: A number for the cell of each Gaussian, from 0 on, shape (N,).

    Returns:
        The piece of each, shape (N,), and whether its cell has several of at least :data:`STRAY` Gaussians, (N,).
    """
    piece = joined(len(cell), pairs[cell[pairs[:, 0]] == cell[pairs[:, 1]]].T)
    size = piece.bincount()
    large = sums((size >= STRAY).long(), torch.zeros_like(size).index_copy(0, piece, cell))
    return piece, (large >= 2)[cell]
