"""Fewer points for a coarse grid: groups of points that share a small part of a cell, and specks without connection.

A grid carries no more information than its nodes, and captures have many more Gaussians than a cell can tell apart.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import equal_rows, joined, sums
from gaussian_swaying.geometry.neighbours import nearest_neighbours

LOOSE = 0.01  # share of the largest part; what is smaller and connected to nothing is loose
_NEIGHBOURS = 26  # that are looked at, as many as the cubes around a cube
_ALIGNED = (
    0.8  # share of the normals' second moment along their main direction: above it, a group is a sheet or several
)
_APART = 0.12  # standard deviation across a sheet [cells], above which it is two: of two sheets 0.24 cells apart


@torch.no_grad()
def grid_groups(
    position: Tensor,
    dx: float,
    per_cell: int,
    weight: Tensor,
    normal: Tensor | None = None,
    label: Tensor | None = None,
) -> Tensor:
    """Group points for a grid: those in the same cube of side ``dx / per_cell``, with the same label, on one sheet.

    Cubes are parts of the cells whose points share their 27 nodes in a quadratic B-spline. So the centre of a group
    touches the same nodes as its points, and no point follows a node without mass.

    Sheets that lie close to each other in a cube stay apart: a group whose normals agree is split in two if the points
    spread across the sheet as those of two sheets do that are 0.24 cells apart.

    Args:
        position: Points [m], shape (N, 3), in the precision in which the solver has them.
        per_cell: Cubes along the side of a cell, at least 1.
        weight: Weights above zero, shape (N,).
        normal: Unit normals of either sign, zero inside a solid, shape (N, 3); None to keep no sheets apart.
        label: Integers, shape (N, L): points of one group agree in all of them.

    Returns:
        The group of each point, from 0 on, shape (N,).
    """
    lattice = position / dx
    base = torch.floor(lattice - 0.5)
    part = ((lattice - base - 0.5) * per_cell).floor().clamp(0, per_cell - 1)
    rows = [base.long() * per_cell + part.long()]
    if label is not None:
        rows.append(label)
    group = equal_rows(torch.cat(rows, -1))
    if normal is None or len(group) == 0:
        return group
    place, share, across = position.double(), weight.double(), normal.double()
    total = sums(share, group)
    centre = sums(share[:, None] * place, group) / total[:, None]
    moment = sums(share[:, None, None] * across[:, :, None] * across[:, None, :], group) / total[:, None, None]
    size, axis = torch.linalg.eigh(moment)
    height = ((place - centre[group]) * axis[group, :, 2]).sum(-1)
    spread = (sums(share * height.square(), group) / total).sqrt()
    two = (spread > _APART * dx) & (size[:, 2] > _ALIGNED * size.sum(-1))
    return torch.unique(2 * group + (two[group] & (height > 0)), return_inverse=True)[1]


@torch.no_grad()
def loose_points(points: Tensor, side: float) -> Tensor:
    """Return a mask of points connected to nothing, or by a thread only: on a grid, the wind would blow them away.

    One point of each cube counts, the one nearest to the centre of its cube's points, and two of them are connected if
    they are at most two sides apart, as are points in cubes side by side. Loose are

    - the parts with fewer than one in a hundred of the points of the largest part: as surfaces they are less than a
      tenth as long as it, too short for a usual grid to bend;
    - points with fewer than two neighbours: left out, they part nothing, and a thread loses no more than its end.

    Args:
        points: Points, shape (N, 3).
        side: Side of the cubes, in the unit of the points, less than half the spacing of the grid. Points farther apart
            than one spacing share only nodes with small weights, and can move apart without strain.

    Returns:
        Booleans, shape (N,); none if otherwise all would be loose.
    """
    where = points.double()
    cell = torch.floor((where - where.amin(0)) / side).long()
    group = equal_rows(cell)
    centre = sums(where, group) / sums(torch.ones_like(where[:, :1]), group)
    order = (where - centre[group]).square().sum(-1).argsort(stable=True)
    first = torch.full((len(centre),), len(points))
    first.scatter_reduce_(0, group[order], torch.arange(len(points)), "amin")
    kept = order[first]
    if len(kept) < 3:
        return torch.zeros(len(points), dtype=torch.bool)
    distance, index = nearest_neighbours(where[kept], min(_NEIGHBOURS, len(kept) - 1))
    near = distance <= 2 * side
    pairs = torch.stack([near.nonzero()[:, 0], index[near]])
    part = joined(len(kept), pairs)
    size = part.bincount()
    loose = (size[part] < LOOSE * size.max()) | (near.sum(-1) < 2)
    return (loose & ~loose.all())[group]


def connected_parts(points: Tensor, cell: float) -> Tensor:
    """The number of each point's connected part; points in the same or in touching cells are connected.

    Args:
        points: Shape (N, 3).

    Returns:
        Numbers from 0, shape (N,).
    """
    from scipy.spatial import cKDTree

    index = ((points.double() - points.amin(0).double()) / cell).floor()
    of_point = equal_rows(index)
    cells = index.new_empty(int(of_point.max()) + 1, 3).index_copy(0, of_point, index)
    touching = cKDTree(cells.numpy()).query_pairs(1.5, p=math.inf, output_type="ndarray")
    return joined(len(cells), torch.from_numpy(touching.T))[of_point]
