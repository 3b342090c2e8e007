"""Attachments of material points to each other, from those of the Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.gaussians.connectivity import attached_pairs
from gaussian_swaying.gaussians.parts import Parts
from gaussian_swaying.geometry.groups import joined, once
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.mpm.state import bounding_grid
from gaussian_swaying.mpm.virtual_nodes import first_nodes, virtual_nodes

FEW, BEYOND = 12, 0.25
"""Samples of a piece in a cell that are grouped with those of the next cell, from how far [cells]."""
_BRIDGES = 8  # neighbours to which an extra point on a large Gaussian is attached, as it fills a hole


@torch.no_grad()
def attached_samples(
    position: Tensor, normal: Tensor, count: int, parts: Parts | None, labels: Tensor | None
) -> Tensor:
    """The pairs of samples of a surface that are attached.

    Args:
        position: Rest positions [m], those of the Gaussians first, then extra points, shape (N, 3).
        normal: Unit normals, shape (N, 3).
        count: Number of Gaussians.
        parts: The parts of the splat.
        labels: The part of each Gaussian, shape (count,).

    Returns:
        Pairs, int64, shape (E, 2).
    """
    to = None if parts is None else parts.attached_to()
    pairs = [attached_pairs(position[:count], normal[:count], labels, to)]
    further = position[count:].double()
    if len(further):
        index = nearest_neighbours(position.double(), min(_BRIDGES + 1, len(position)), further)[1]
        own = torch.arange(count, len(position))[:, None].expand_as(index)
        pairs.append(torch.stack([own, index], -1)[own != index])
    return torch.cat(pairs)


def pieces_in_cells(position: Tensor, dx: float, pairs: Tensor) -> Tensor:
    """A number for each sample, the same for those in one cell that are attached within it.

    Args:
        position: Rest positions [m] in the precision of the solver, shape (N, 3).
        dx: Grid spacing [m].
        pairs: Pairs of samples that are attached, shape (E, 2).
    """
    a, b = torch.floor(position / dx - 0.5)[pairs].unbind(1)
    return joined(len(position), pairs[(a == b).all(-1)].T)


@torch.no_grad()
def lies_apart(position: Tensor, dx: float, pairs: Tensor) -> bool:
    """True if some node of the grid reaches samples that are not attached to each other there.

    Args:
        position: Rest positions [m] in the precision of the solver, shape (N, 3).
        dx: Grid spacing [m].
        pairs: Pairs of samples that are attached, shape (E, 2).
    """
    grid = bounding_grid(position.amin(0), position.amax(0), dx, margin=0)
    return virtual_nodes(first_nodes(position, grid), grid, pairs) is not None


@torch.no_grad()
def homes(position: Tensor, dx: float, pairs: Tensor, piece: Tensor) -> tuple[Tensor, Tensor]:
    """The places at which samples are grouped: a few of a piece beyond the border of a cell, at the next across it.

    They would have copies of nodes of their own, with hardly any mass.

    Args:
        position: Rest positions [m], shape (N, 3).
        dx: Grid spacing [m].
        pairs: Pairs of samples that are attached, shape (E, 2).
        piece: From :func:`pieces_in_cells`, shape (N,).

    Returns:
        The places of the samples for the grid, shape (N, 3), and their pieces, shape (N,).
    """
    few = piece.bincount()[piece] < FEW
    ends = torch.cat([pairs, pairs.flip(1)])
    apart = (position[ends[:, 0]] - position[ends[:, 1]]).norm(dim=-1)
    across = few[ends[:, 0]] & ~few[ends[:, 1]] & (apart < BEYOND * dx)
    ends, apart = ends[across], apart[across]
    ends = ends[apart.argsort(stable=True)]
    ends = ends[ends[:, 0].argsort(stable=True)]  # those of a sample one after the other, the nearest first
    nearest = torch.ones(len(ends), dtype=torch.bool)
    nearest[1:] = ends[1:, 0] != ends[:-1, 0]
    other = torch.arange(len(position)).index_copy(0, *ends[nearest].unbind(1))
    return position[other], piece[other]


def attached_points(pairs: Tensor, owner: Tensor, parent: Tensor | None, layers: int) -> Tensor:
    """The pairs of material points that are attached.

    Args:
        pairs: Pairs of samples, shape (E, 2).
        owner: The point of each sample, shape (N,).
        parent: The group of each point, shape (P,), all of whose points are attached; None for points that are samples.
        layers: Layers of points through the thickness; those of a sheet of three come one after the other.

    Returns:
        Pairs, int64, shape (E', 2).
    """
    found = owner[pairs]
    many = int(owner.max()) + 1
    if parent is not None:
        order = parent.argsort(stable=True)
        size = parent.bincount()
        start = size.cumsum(0) - size
        rank = torch.arange(len(order)) - start[parent[order]]
        for k in range(1, int(size.max())):  # with the one k places before it
            late = (rank >= k).nonzero()[:, 0]
            found = torch.cat([found, torch.stack([order[late - k], order[late]], -1)])
        many = len(parent)
    found = once(found, many)
    if layers == 1:
        return found
    own = torch.arange(many)
    across = [torch.stack([own + a * many, own + b * many], 1) for a, b in ((0, 1), (0, 2), (1, 2))]
    return torch.cat([*(found + k * many for k in range(layers)), *across])
