"""Constraint rows: weights on the nodes by which points of the material are held; choice of independent rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import sums
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.transfer import bspline_weights, shifts
from gaussian_swaying.mpm.virtual_nodes import coordinates

MOST_ROWS = 2000
"""Most rows of one scene: its inverse is dense."""

LEAST_OWN = 0.2
"""Least share of a row, in the norm of the inverse mass, that the rows chosen before it must leave over.

The condition of the chosen rows grows with its inverse. Rows at the centres of full cells of uniform mass keep 0.79 of
themselves in a line, 0.63 in a plane and 0.5 in a solid (one over the mean of the inverse of the spectrum (3/4 +
cos(k)/4)² of a line, to the power of one, two and three). A second row at nearly the same place, or a slope along a
held line, keeps less than a fifth. The condition is then below 50 for hinges and below 200 for clamps, for lines at any
angle and for patches (tested).
"""

LEAST_OWN_ON_A_FACE = 0.05
"""The same for the rows of a clamped face, which lie closer to each other; the condition stays below 1,000 (tested)."""

LEAST_APART = 0.6
"""Least distance between the points that a region holds [cells].

Two halves of a strip one cell wide are half a cell apart: such a strip is one line, wherever it lies on the grid.
"""

_AT_ONCE = 256  # points whose distances from all others are looked at
_NO_WEIGHT = 1e-6  # of a node that a particle on the border of its cell does not reach


@dataclass(frozen=True, slots=True)
class Rows:
    """Constraint rows of one scene, K in all, on the CPU in float64.

    Attributes:
        node: Nodes of each row, shape (K, 27).
        weight: Their weights, shape (K, 27).
        place: The point at rest [m], or for a slope the step of one cell along its direction [m], shape (K, 3).
        slope: Whether the row is a slope, shape (K,).
        least: Least share of itself that the rows chosen before it must leave over, shape (K,).
        owner: Boundary that holds it, shape (K,).
        start: Time from which it is held [s], shape (K,).
        release: Time at which it is released [s], shape (K,).
    """

    node: Tensor
    weight: Tensor
    place: Tensor
    slope: Tensor
    least: Tensor
    owner: Tensor
    start: Tensor
    release: Tensor

    def select(self, index: Tensor) -> Rows:
        return Rows(*(getattr(self, f.name)[index] for f in fields(self)))

    @staticmethod
    def join(parts: Sequence[Rows]) -> Rows:
        """Join several sets of rows, one after the other."""
        return Rows(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Rows)))


def means(values: Tensor, mass: Tensor, group: Tensor) -> Tensor:
    """The mean of values (P, n) over each group, weighted with masses (P,); groups are numbered from 0, shape (P,)."""
    weighted = torch.cat([mass[:, None] * values, mass[:, None]], dim=-1)
    total = sums(weighted, group)
    return total[:, :-1] / total[:, -1:]


@torch.no_grad()
def groups(
    position: Tensor, mass: Tensor, cell: Tensor, apart: float, normal: Tensor | None = None, thick: float = 0.0
) -> Tensor:
    """Group particles by cell, and join groups with close centres until all are some distance apart.

    A strip or a sheet that is thinner than a cell may cross the border of two. Two rows so close together would hold
    its slope; joined they are the line, or the middle plane, that is meant. With a ``normal``, the points of a sheet
    that is about as thick as a cell are joined through its thickness, too: the distance is that along the sheet.

    Args:
        position: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        cell: A number for the cell of each, shape (P,).
        apart: Least distance between centres [m].
        normal: Unit normals of the sheet, of either sign, shape (P, 3).
        thick: Largest distance along the normal at which groups are joined [m].

    Returns:
        The number of the group of each particle, shape (P,).
    """
    group = torch.unique(cell, return_inverse=True)[1]
    while len(group):
        centre = means(position, mass, group)
        distance = torch.cdist(centre, centre, compute_mode="donot_use_mm_for_euclid_dist")
        if normal is not None:
            first = torch.full_like(group[: len(centre)], len(group))
            own_normal = normal[first.scatter_reduce(0, group, torch.arange(len(group)), "amin")]
            across = ((centre[:, None] - centre) * own_normal).sum(-1).abs()  # of each from the plane of another
            across = torch.minimum(across, across.T)
            along = (distance.square() - across.square()).clamp(min=0).sqrt()
            distance = torch.where(across <= thick, along, distance)
        distance.fill_diagonal_(math.inf)
        own = torch.arange(len(centre))
        least, nearest = distance.min(-1)
        # pairs that are nearest to each other; the first of equals, so that there always is one
        pair = (nearest[nearest] == own) & (least < apart)
        if not bool(pair.any()):
            break
        group = torch.unique(torch.where(pair, own.minimum(nearest), own)[group], return_inverse=True)[1]
    return group


def from_middle_plane(position: Tensor, mass: Tensor, normal: Tensor, apart: float, thick: float) -> Tensor:
    """Distance of the points of a sheet from its middle plane, as vectors along its normal.

    The middle plane is where the mean of the points is that lie close by along the sheet. A cell may have some of the
    layers there only, and their mean beside it: such places are not on one line, and would hold the slope.

    Args:
        position: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        normal: Unit normals of the sheet, of either sign, shape (P, 3).
        apart: How far points lie close by along the sheet [m].
        thick: Largest distance along the normal of points of the sheet [m].

    Returns:
        Vectors from the middle plane [m], shape (P, 3).
    """
    found = []
    for own, up in zip(position.split(_AT_ONCE), normal.split(_AT_ONCE), strict=True):
        arm = position - own[:, None]
        across = (arm * up[:, None]).sum(-1)
        along = (arm.square().sum(-1) - across.square()).clamp(min=0).sqrt()
        weight = mass * ((along < apart) & (across.abs() <= thick))
        found.append(-((weight * across).sum(-1) / weight.sum(-1))[:, None] * up)
    return torch.cat(found)


def cells_of_places(place: Tensor, grid: GridSpec, massive: Tensor) -> Tensor:
    """The cell whose nodes all have mass, in or next to each place; the weights of another one would not add up to one.

    Args:
        place: Places at rest [m], shape (N, 3).
        grid: The nodes.
        massive: Whether each node has mass, shape (G,).

    Returns:
        Flat index of the first node of each cell, shape (N,); -1 where there is none.
    """
    lattice = place / grid.dx - torch.tensor(grid.offset, dtype=place.dtype)
    size = torch.tensor(grid.resolution)
    steps = torch.tensor(list(itertools.product((0, -1, 1), repeat=3)))
    first = torch.floor(lattice - 0.5).long()[:, None] + steps  # (N, 27, 3)
    fits = ((first >= 0) & (first <= size - 3)).all(-1)
    flat = flat_index(first.clamp(min=0).minimum(size - 3), grid)
    f = (lattice[:, None] - first).reshape(-1, 3)
    nodes = flat.reshape(-1, 1) + shifts(grid)
    needed = products(bspline_weights(f.T)[0]).abs() > _NO_WEIGHT
    fits &= (massive[nodes] | ~needed).all(-1).reshape(fits.shape)
    beyond = ((f - 1).abs() - 0.5).clamp(min=0).square().sum(-1).reshape(fits.shape)
    best = beyond.where(fits, math.inf).argmin(-1, keepdim=True)
    return flat.where(fits, -1).gather(1, best)[:, 0]


def flat_index(node: Tensor, grid: GridSpec) -> Tensor:
    """Flat index of nodes (..., 3) of a grid."""
    _, ny, nz = grid.resolution
    return (node[..., 0] * ny + node[..., 1]) * nz + node[..., 2]


def products(factors: Tensor) -> Tensor:
    """The 27 products of factors (3 axes, 3 nodes, N) along the axes, shape (N, 27)."""
    x, y, z = factors
    return (x[:, None, None] * (y[:, None] * z)).reshape(27, -1).T


def rows_at(
    place: Tensor,
    first: Tensor,
    grid: GridSpec,
    massive: Tensor,
    along: Tensor,
    least: float,
    owner: int,
    start: float,
    release: Tensor,
    node: Tensor | None = None,
) -> Rows:
    """The rows of some points: their values and, for a clamp, their slopes in units of one cell.

    Args:
        place: The points at rest [m], shape (N, 3).
        first: First node of the cell of each, shape (N,).
        grid: The nodes.
        massive: Whether each node has mass, shape (G,).
        along: Directions of the slopes that are held too, shape (N, n, 3); zero for a slope that is not held.
        least: See :class:`Rows`.
        owner: The boundary.
        start: Time from which they are held [s].
        release: Times of their release [s], shape (N,).
        node: The nodes of each, shape (N, 27); None for those of the lattice.
    """
    corner = coordinates(first, grid) + torch.tensor(grid.offset)
    value, slope = bspline_weights((place / grid.dx - corner).T)
    node = first[:, None] + shifts(grid) if node is None else node
    many = len(place)
    axes = torch.arange(3)[:, None, None]
    slopes = torch.stack([products(torch.where(axes == axis, slope, value)) for axis in range(3)], dim=-1)
    parts = [products(value), *((slopes * unit[:, None]).sum(-1) for unit in along.unbind(1))]
    places = [place, *(grid.dx * unit for unit in along.unbind(1))]
    copies = len(parts)
    return Rows(
        node.repeat(copies, 1),
        torch.cat(parts) * massive[node].repeat(copies, 1),
        torch.cat(places),
        torch.arange(copies * many) >= many,
        torch.full((copies * many,), least, dtype=torch.float64),
        torch.full((copies * many,), owner),
        torch.full((copies * many,), start, dtype=torch.float64),
        release.repeat(copies),
    )


def gram(rows: Rows, inverse_mass: Tensor) -> Tensor:
    """C M^-1 C^T of some rows, shape (K, K), from the inverse masses of the nodes (G,)."""
    nodes, place = torch.unique(rows.node, return_inverse=True)
    dense = rows.weight.new_zeros(len(place), len(nodes)).scatter(1, place, rows.weight)
    return (dense * inverse_mass[nodes]) @ dense.T


@torch.no_grad()
def independent_rows(product: Tensor, rank: Sequence[Tensor], least: float | Tensor = LEAST_OWN) -> Tensor:
    """Choose rows by a pivoted Cholesky factorisation of their normalised products.

    Args:
        product: Products of the rows, shape (K, K), float64.
        rank: Groups of rows, bool (K,) each. The rows of a group come before those of the next; within a group, the one
            comes first that depends least on those already chosen.
        least: Least remainder of a row, as a share of its own product; one number, or one for each row (K,).

    Returns:
        Indices of the chosen rows in their order, shape (k,).
    """
    own = product.diagonal()
    scale = torch.where(own > 0, own, 1.0).rsqrt()
    normal = scale[:, None] * product * scale
    rest = torch.where(own > 0, 1.0, 0.0).to(product)
    factor = torch.zeros_like(normal)
    chosen: list[int] = []
    for group in rank:
        left = torch.where(group & (rest > least), rest, -1.0)
        while len(left):
            k = int(left.argmax())
            if float(left[k]) <= 0:
                break
            n = len(chosen)
            column = (normal[:, k] - factor[:, :n] @ factor[k, :n]) * rest[k].rsqrt()
            factor[:, n] = column
            chosen.append(k)
            rest -= column.square()
            left = torch.where(group & (rest > least), rest, -1.0)
            left[chosen] = -1.0
    return torch.tensor(chosen, dtype=torch.long)


def ranks(rows: Rows) -> list[Tensor]:
    """Return the groups for :func:`independent_rows`: rows released last come first, and values before slopes."""
    times = sorted(set(rows.release.tolist()), reverse=True)
    return [(rows.release == time) & (rows.slope == slope) for time in times for slope in (False, True)]
