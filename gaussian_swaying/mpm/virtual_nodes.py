r"""Nodes for each connected part: material that only lies close to other material does not share its nodes.

A grid joins whatever lies within a cell. Virtual nodes (Molino, Bao & Fedkiw 2004, "A virtual node algorithm for
changing mesh topology during simulation") give it the connectivity of the material instead of that of space. Which
points are attached to each other at rest is a graph. The points that a node reaches, those of the 3 x 3 x 3 cells
around it, fall into connected components of this graph, and each component gets a copy of the node. So two cells share
a copy where the material between them is connected within the reach of the node, and only there.

Stencils of the ``total`` formulation never change, so all this is done once: the solver sees more nodes and, for each
point, 27 indices. The first component of a node keeps the node of the lattice, and the others get numbers after
all of those.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import equal_rows, joined, once
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.transfer import shifts


@dataclass(frozen=True, eq=False)
class VirtualNodes:
    """The nodes of each material point, of one or more scenes, where at least one node has copies.

    Attributes:
        node: Flat indices, over all scenes, of the 27 nodes of each point, shape (27, N).
        original: For each virtual node of a scene its node of the lattice, shape (scenes, V); node 0 for those that
            only fill up a scene.
    """

    node: Tensor
    original: Tensor


@torch.no_grad()
def virtual_nodes(first: Tensor, grid: GridSpec, attached: Tensor | None, scenes: int = 1) -> VirtualNodes | None:
    """The copies of the nodes for the connected parts of a material.

    Args:
        first: Flat index, within its scene, of the first of the 27 nodes of each point, shape (N,), scene by scene.

    Returns:
        The nodes; None if no node has a copy.
    """
    if attached is None:
        return None
    found = [_of_one_scene(own, grid, attached.cpu()) for own in first.cpu().reshape(scenes, -1)]
    most = max(len(original) for _, original in found)
    if most == 0:
        return None
    nodes = [table + s * (grid.lattice_count + most) for s, (table, _) in enumerate(found)]
    filled = [torch.nn.functional.pad(original, (0, most - len(original))) for _, original in found]
    return VirtualNodes(torch.cat(nodes, 1).to(first.device), torch.stack(filled).to(first.device))


def _of_one_scene(first: Tensor, grid: GridSpec, attached: Tensor) -> tuple[Tensor, Tensor]:
    """The 27 nodes of each point, shape (27, P), and the originals of the virtual nodes, shape (V,)."""
    if attached.dim() == 1:
        fragment = equal_rows(torch.stack([first, attached], 1))
    else:
        a, b = first[attached].unbind(1)
        fragment = joined(len(first), attached[a == b].T)  # connected within a cell: such points have the same nodes
    example = first_of(fragment)
    cell = first[example]
    node = (cell[:, None] + shifts(grid)).reshape(-1)
    if attached.dim() == 1:
        component = equal_rows(torch.stack([node, attached[example].repeat_interleave(27)], 1))
    else:
        component = joined(len(node), _common(cell, once(fragment[attached[a != b]], len(cell)), grid))
    leader = first_of(component).sort().values  # in the order of the points, whatever the graph says
    of = node[leader]
    copy = first_of(torch.unique(of, return_inverse=True)[1])
    copy = torch.ones(len(of), dtype=torch.bool).index_fill_(0, copy, False)
    number = torch.where(copy, grid.lattice_count + copy.cumsum(0) - 1, of)
    named = torch.zeros(len(leader), dtype=torch.long).index_put_((component[leader],), number)
    return named[component].reshape(-1, 27)[fragment].T.contiguous(), of[copy]


def _common(cell: Tensor, pairs: Tensor, grid: GridSpec) -> Tensor:
    """The nodes that the fragments of a pair (K, 2) share, as numbers ``27 * fragment + place``, shape (2, n)."""
    reach = torch.arange(3)
    steps = torch.cartesian_prod(reach, reach, reach)
    corner = coordinates(cell, grid)
    within = steps - (corner[pairs[:, 1]] - corner[pairs[:, 0]])[:, None]  # where it lies among those of the second
    pair, place = ((within >= 0) & (within <= 2)).all(-1).nonzero().unbind(1)
    other = (within[pair, place] * torch.tensor([9, 3, 1])).sum(-1)
    return torch.stack([27 * pairs[pair, 0] + place, 27 * pairs[pair, 1] + other])


def first_of(group: Tensor) -> Tensor:
    """The first member of each group; groups are numbered from 0."""
    many = int(group.max()) + 1 if len(group) else 0
    none = torch.full((many,), len(group))
    return none.scatter_reduce_(0, group, torch.arange(len(group)), "amin")


def coordinates(index: Tensor, grid: GridSpec) -> Tensor:
    """Place of nodes in the box of the grid, from their flat indices: int64, shape (..., 3)."""
    _, ny, nz = grid.resolution
    return torch.stack([index // (ny * nz), index // nz % ny, index % nz], dim=-1)


def first_nodes(place: Tensor, grid: GridSpec) -> Tensor:
    """Flat index of the first of the 27 nodes around places (M, 3) [m]; within the grid, whatever the place is."""
    low = torch.floor(place / grid.dx - 0.5).long() - torch.tensor(grid.offset, device=place.device)
    most = torch.tensor(grid.resolution, device=place.device) - 3
    _, ny, nz = grid.resolution
    return (low.clamp(min=0).minimum(most) * torch.tensor([ny * nz, nz, 1], device=place.device)).sum(-1)


@torch.no_grad()
def point_with_nodes(first: Tensor, near: Tensor, point_first: Tensor, point_node: Tensor, grid: GridSpec) -> Tensor:
    """For places next to material points: a point in the same cell whose nodes the place can use.

    A place takes the nodes of the point next to it if they share a cell. Otherwise it takes those of a point in its
    cell that has no other copy of any node that both reach.

    Args:
        first: First node of the cell of each place, shape (M,).
        near: The material point that each place belongs to, shape (M,).
        point_first: First node of the cell of each point, shape (P,).
        point_node: Nodes of each point, shape (27, P).

    Returns:
        The point whose nodes each place has, shape (M,); -1 where there is none.
    """
    units = equal_rows(torch.cat([point_first[:, None], point_node.T], 1))
    example = first_of(units)
    example = example[point_first[example].argsort(stable=True)]
    cells = point_first[example].contiguous()
    found = torch.where(first == point_first[near], near, -1)
    left = (found < 0).nonzero()[:, 0]
    low = torch.searchsorted(cells, first[left].contiguous())
    high = torch.searchsorted(cells, first[left].contiguous(), right=True)
    original = point_first[:, None] + shifts(grid)  # (P, 27), on the lattice
    for k in range(int((high - low).max()) if len(left) else 0):
        some = ((low + k < high) & (found[left] < 0)).nonzero()[:, 0]
        candidate, beside = example[low[some] + k], near[left[some]]
        for start in range(0, len(some), 10_000):
            part = slice(start, start + 10_000)
            p, q = candidate[part], beside[part]
            both = original[p][:, :, None] == original[q][:, None, :]
            same = point_node[:, p].T[:, :, None] == point_node[:, q].T[:, None, :]
            fits = both.flatten(1).any(1) & ~(both & ~same).flatten(1).any(1)
            found[left[some[part]]] = torch.where(fits, p, found[left[some[part]]])
    return found
