"""Contact in a scene: samples on the surface of the object, and the Gaussians that stand still as an obstacle."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gaussian_swaying.gaussians.filling import density_grid
from gaussian_swaying.gaussians.grouping import grid_groups
from gaussian_swaying.geometry.distance import DistanceGrid
from gaussian_swaying.geometry.groups import sums
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.mpm.contact import Contact, Surface
from gaussian_swaying.mpm.embedded import on_material
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.sampling import Samples

PER_CELL = 2
"""Contact samples along the side of a cell: the nodes cannot represent a finer shape."""

DISC = 0.75
"""Least radius of a disc, in spacings of the contact samples: discs on a square lattice overlap from 0.71 on."""

BAND = 4
"""Distance up to which the distance from Gaussians is computed [cells]; beyond it is constant."""

FACING = 0.8
"""Two contact samples belong to different layers if at least this share of their distance is along a normal."""


@torch.no_grad()
def surface_of(samples: Samples, owner: Tensor, points: MaterialPoints, dx: float, contact: Contact | None) -> Surface:
    """The surface of an object: one of its samples for each part of a cell, with a disc for those that it stands for.

    Args:
        samples: The samples of the object.
        owner: A material point close to each, shape (N,).
        points: The material.
        dx: Grid spacing [m].
        contact: Contact of the surface with itself; None if only obstacles count.

    Returns:
        The surface, in the precision of the points.
    """
    chosen = (samples.surface & (samples.body_area > 0)).nonzero()[:, 0]
    part = samples.choose(chosen)
    kind = points.position.dtype
    label = torch.zeros(len(chosen), 1, dtype=torch.long)
    group = grid_groups(part.position.to(kind), dx, PER_CELL, part.body_area, part.normal, label)
    area = sums(part.body_area, group)
    centre = sums(part.body_area[:, None] * part.position, group) / area[:, None]
    away = (part.position - centre[group]).square().sum(-1)
    nearest = torch.full_like(area, torch.inf).scatter_reduce_(0, group, away, "amin")
    first = torch.full((len(area),), len(group)).scatter_reduce_(
        0, group, torch.where(away <= nearest[group], torch.arange(len(group)), len(group)), "amin"
    )
    place, facing = part.position[first], part.normal[first]
    near = owner[chosen[first]]
    read, _ = on_material(place, near, points, dx)
    radius = (1.3 * (area / torch.pi).sqrt()).clamp(min=DISC * dx / PER_CELL)
    thickness = part.thickness[first]
    if contact is not None and contact.thickness is not None:
        thickness = torch.full_like(thickness, contact.thickness)
    place, facing, read = (t.to(kind) for t in (place, facing, read))
    surface = Surface(place, facing, radius.to(kind), thickness.to(kind), read, contact, near)
    if contact is not None:
        warn_close(surface)
    return surface


@torch.no_grad()
def close_at_rest(surface: Surface) -> int:
    """Count pairs of contact samples closer at rest than the thickness, one above the other: they are pushed apart."""
    from scipy.spatial import cKDTree

    tree = cKDTree(surface.place.double().cpu().numpy())
    pairs = torch.from_numpy(tree.query_pairs(float(surface.thickness.amax()), output_type="ndarray"))
    first, second = pairs.to(surface.place.device).unbind(1)
    arm = surface.place[first] - surface.place[second]
    distance = arm.norm(dim=-1)
    along = torch.stack([(arm * surface.normal[k]).sum(-1).abs() for k in (first, second)]).amax(0)
    thickness = 0.5 * (surface.thickness[first] + surface.thickness[second])
    return int(((distance < thickness) & (along > FACING * distance)).sum())


def warn_close(surface: Surface) -> None:
    """Warn if surfaces start closer than the thickness."""
    close = close_at_rest(surface)
    if close:
        warnings.warn(
            f"{close:,} pairs of places on the surface start closer than {float(surface.thickness.amax()):.3g} m, the "
            "thickness that surfaces keep: those less than two cells apart are left alone, others are pushed apart; "
            "lower `contact.thickness`, or move the parts.",
            UserWarning,
            stacklevel=2,
        )


@torch.no_grad()
def still_distance(
    means: Tensor, covariances: Tensor, opacities: Tensor, low: Tensor, high: Tensor, cells: int, level: float
) -> DistanceGrid:
    """Signed distance from the surface of Gaussians that stand still: where their density passes a level.

    Args:
        means: Centres [m], shape (N, 3).
        covariances: Covariances [m²], shape (N, 3, 3).
        opacities: From 0 to 1, shape (N,).
        low: Lower corner of the grid [m], shape (3,).
        high: Upper corner of the grid [m], shape (3,).
        cells: Cells along its longest side.
        level: The density of the surface.

    Returns:
        The distance at the centres of the cells, negative where the density is higher; at most :data:`BAND` cells.
    """
    spacing = float((high - low).amax()) / cells
    size = ((high - low) / spacing).ceil().long().clamp(min=2)
    reach = 3 * torch.linalg.eigvalsh(covariances.double())[:, -1].clamp(min=0).sqrt() + spacing
    near = ((means.double() + reach[:, None] > low) & (means.double() - reach[:, None] < high)).all(-1)
    shape = (int(size[0]), int(size[1]), int(size[2]))
    density = density_grid(means[near], covariances[near], opacities[near], low, spacing, shape)
    dense = density > level
    if not bool(dense.any()):
        raise ValueError(
            f"The Gaussians that stand still are nowhere denser than {level:g} around the object, so they cannot be an "
            "obstacle or a wall: lower `level` of the StillGaussians, or leave it or `air.still_walls` out."
        )
    axes = [torch.arange(n, dtype=torch.float64) for n in shape]
    nodes = torch.cartesian_prod(*axes).reshape(*shape, 3)
    crossings = []
    for axis in range(3):
        n = shape[axis] - 1
        a, b = density.narrow(axis, 0, n), density.narrow(axis, 1, n)
        passes = dense.narrow(axis, 0, n) != dense.narrow(axis, 1, n)
        place = nodes.narrow(axis, 0, n)[passes].clone()
        place[:, axis] += ((level - a[passes]) / (b[passes] - a[passes])).double()
        crossings.append(place)
    surface = torch.cat(crossings)
    origin = low.double() + 0.5 * spacing
    if len(surface) == 0:  # dense everywhere
        return DistanceGrid(torch.full(shape, -spacing, dtype=torch.float64), origin, spacing)
    # exact within a band, as nothing else is near enough to touch
    width = 2 * BAND + 1
    most, least = (torch.nn.functional.max_pool3d(s * dense[None].float(), width, 1, BAND)[0] for s in (1, -1))
    band = most != -least
    away = torch.full(shape, float(BAND), dtype=torch.float64)
    away[band] = nearest_neighbours(surface, 1, nodes[band])[0][:, 0].clamp(max=BAND)
    return DistanceGrid(spacing * torch.where(dense, -away, away), origin, spacing)
