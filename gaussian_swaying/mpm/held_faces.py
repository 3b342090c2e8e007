r"""Faces between clamped and free material, and the test whether a body is a sheet there.

A clamped solid does not move at that face; its strain across the face is free. So a clamp holds rows on the face
(:mod:`~gaussian_swaying.mpm.point_holds`): the mean displacement of patches of half a cell, and its slopes along the
face, without which a strip thinner than a cell could turn. Behind the face it holds the nodes that carry held material
alone. Nodes that carry both follow the free side: a condition on them would move the face by up to a cell, which is
why pins of ``kind: nodes`` are of first order.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.mpm.held_rows import LEAST_APART, MOST_ROWS, groups, means

PATCH = 0.5
"""Side of a patch of a face [cells]: with patches of a whole cell, a section two cells thick still turns by some per
cent."""

HELD_ALONE = 0.999
"""Share of the mass of a node above which it counts as carrying held material alone."""

SOFTENED = 0.03
"""Factor of the stiffness of material that a clamp holds all the time.

Rigid material needs no stiffness. In the cells that the face cuts, held material would share the curvature of the free
side and stiffen it, as if the face lay up to a quarter of a cell farther out: an error of first order. Without any
stiffness of the held material, nodes with only a sliver of free material would be almost unconnected. Measured on
cantilevers of 0.3 to 6 cells.
"""

SHEET = 1.25
"""A sheet is at most so thick [cells]: the grid cannot tell the two sides of it apart."""

LAYER = 0.05
"""Thickness below which a body is a single layer of points [cells]."""

_SEEN, _WIDE, _BROAD = 4.0, 2.0, 2.5  # cells around a held particle; least width in cells, and in thicknesses
_SAMPLES = 32
_TURNS = 8  # times that a normal is found again with the weights that it gives


def extents(points: Tensor, mass: Tensor, centre: Tensor, radius: float) -> Tensor:
    """Three sides of the box with the mass and second moments of the points around each of some places.

    Args:
        points: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        centre: Places, shape (N, 3).
        radius: Radius of the search [m].

    Returns:
        The sides, ascending [m], shape (N, 3).
    """
    near = torch.cdist(centre, points, compute_mode="donot_use_mm_for_euclid_dist") < radius
    sides = []
    for some in near:
        weight, place = mass[some], points[some]
        mean = (weight[:, None] * place).sum(0) / weight.sum()
        arm = place - mean
        moments = (weight[:, None] * arm).T @ arm / weight.sum()
        sides.append((12 * torch.linalg.eigvalsh(moments).clamp(min=0)).sqrt())
    return torch.stack(sides)


@torch.no_grad()
def thickness(points: Tensor, mass: Tensor, places: Tensor, dx: float) -> tuple[float, bool]:
    """The thickness of a body at some places, and whether it is a sheet there.

    A sheet is no thicker than :data:`SHEET` cells, and at least two cells and two and a half thicknesses wide. The
    median over at most 32 of the places decides. It is measured within four cells.

    Args:
        points: Positions of all particles [m], shape (P, 3).
        mass: Their masses [kg], shape (P,).
        places: The places [m], shape (N, 3).
        dx: Grid spacing [m].

    Returns:
        The thickness [m], and whether the body is a sheet; no thickness and True without a place.
    """
    if not len(places):
        return 0.0, True
    some = places[:: max(1, math.ceil(len(places) / _SAMPLES))]
    least, middle, _ = extents(points.double(), mass.double(), some.double(), _SEEN * dx).median(0).values.tolist()
    return least, least <= SHEET * dx and middle >= max(_WIDE * dx, _BROAD * least)


@torch.no_grad()
def width(held: Tensor, mass: Tensor, dx: float) -> float:
    """The width of a line or a patch of particles [m]: the middle one of its sides, within four cells.

    Args:
        held: Their positions [m], shape (N, 3), at least one.
        mass: Their masses [kg], shape (N,).
        dx: Grid spacing [m].
    """
    some = held[:: max(1, math.ceil(len(held) / _SAMPLES))]
    return float(extents(held, mass, some, _SEEN * dx)[:, 1].median())


@torch.no_grad()
def normals(points: Tensor, mass: Tensor, places: Tensor, dx: float) -> Tensor:
    """Unit normals of a sheet at some places, of either sign, shape (N, 3): that of the nearest of a few of them.

    They are the first ones in cubes of two cells, so that they do not depend on what lies elsewhere. The arguments are
    those of :func:`thickness`.
    """
    cube = equal_rows((places / (2 * dx)).floor())
    order = torch.arange(len(places), device=places.device)
    some = places[torch.full_like(order, len(places)).scatter_reduce(0, cube, order, "amin")[: int(cube.max()) + 1]]
    found = []
    for place in some:
        near = (points - place).square().sum(-1) < (_SEEN * dx) ** 2 + (SHEET * dx) ** 2
        arm, weight = points[near] - place, mass[near]
        share = weight
        for _ in range(_TURNS):  # weights that fade along the sheet, alike for all of its layers
            centred = arm - (share[:, None] * arm).sum(0) / share.sum()
            normal = torch.linalg.eigh((share[:, None] * centred).T @ centred)[1][:, 0]
            across = arm @ normal
            along = arm.square().sum(-1) - across.square()
            share = weight * (1 - along / (_SEEN * dx) ** 2).clamp(min=0).square() * (across.abs() <= SHEET * dx)
        found.append(normal)
    nearest = torch.cdist(places, some, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)
    return torch.stack(found)[nearest]


def face(points: Tensor, held: Tensor, dx: float) -> tuple[Tensor, Tensor]:
    """Places on the face between held and free particles, and directions across it.

    A place lies in the middle between a held and a free particle, each of which is the nearest of its kind to the
    other, less than two cells apart.

    Args:
        points: Positions [m], shape (P, 3).
        held: Which particles are held, bool, shape (P,).
        dx: Grid spacing [m].

    Returns:
        Places [m] and unit vectors from held to free, shape (N, 3) each.
    """
    own, free = points[held], points[~held]
    if not len(own) or not len(free):
        return points[:0], points[:0]
    distance, partner = (found[:, 0] for found in nearest_neighbours(free, 1, own))
    reach = (distance < 2 * dx).nonzero()[:, 0]
    own, partner = own[reach], partner[reach]
    beside, index = torch.unique(partner, return_inverse=True)
    back = nearest_neighbours(own, 1, free[beside])[1][:, 0] if len(own) else partner
    mutual = back[index] == torch.arange(len(own))
    start, end = own[mutual], free[partner[mutual]]
    across = end - start
    return (start + end) / 2, across / across.norm(dim=-1, keepdim=True)


def along_face(normal: Tensor) -> Tensor:
    """Directions of the slopes that a clamp holds at patches of a face.

    Args:
        normal: Mean of the directions across the face, shape (N, 3).

    Returns:
        Shape (N, 3, 3): two unit vectors along the face and zeros; the three axes where the normal is short, because
        directions differ so much that the patch has no side.
    """
    long = normal.norm(dim=-1)
    axes = torch.eye(3, dtype=normal.dtype)
    unit = normal / long.clamp(min=1e-9)[:, None]
    first = torch.linalg.cross(unit, axes[unit.abs().argmin(-1)], dim=-1)
    first = first / first.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    both = torch.stack([first, torch.linalg.cross(unit, first, dim=-1), torch.zeros_like(unit)], dim=-2)
    return torch.where((long > 0.5)[:, None, None], both, axes)


def face_patches(points: Tensor, mass: Tensor, held: Tensor, dx: float) -> tuple[Tensor, Tensor]:
    """The patches of the face of a clamped region: their centres, and the directions of the slopes that are held.

    Patches are larger than :data:`PATCH` where the face would take too many rows. A sheet of a single layer has no
    section that could turn, so the slope across its face is held, too.

    Args:
        points: Positions [m], shape (P, 3).
        mass: Masses [kg], shape (P,).
        held: Which particles are held, bool, shape (P,).
        dx: Grid spacing [m].

    Returns:
        Shapes (N, 3) and (N, 3, 3).
    """
    place, across = face(points, held, dx)
    size, equal = PATCH * dx, torch.ones(len(place), dtype=place.dtype)
    while True:
        cell = equal_rows((place.detach() / size).floor())
        if 4 * (int(cell.max()) + 1 if len(cell) else 0) <= MOST_ROWS:
            break
        size *= 2
    group = groups(place, equal, cell, LEAST_APART * size)
    normal = means(across, equal, group)
    if len(place) and thickness(points, mass, place.detach(), dx)[0] < LAYER * dx:
        normal = torch.zeros_like(normal)
    return means(place, equal, group), along_face(normal)
