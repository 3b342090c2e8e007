"""Material points: samples of the surface and the inside of an object, one for each Gaussian or for groups."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import number_of
from gaussian_swaying.gaussians.filling import Filling
from gaussian_swaying.gaussians.grouping import grid_groups
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.groups import equal_rows, sums
from gaussian_swaying.geometry.regions import Region, whereabouts
from gaussian_swaying.mpm.damping import decay_rate
from gaussian_swaying.mpm.laws.elastic import FixedCorotated
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.material import PLATE, Material, layer_distance, plate_stiffness
from gaussian_swaying.wind.patches import joined_directions, second_moments

_FLAT = 0.01  # standard deviation [cubes] below which a group has no extent in a direction
SHARED = 4
"""Largest number of directions in a group whose patches are shared among all its points."""

SIMPSON = (2 / 3, 1 / 6, 1 / 6)  # middle plane and faces of a sheet: exact for the square of the height
_PROPERTIES = ("E", "nu", "density", "thickness", "bending", "damping_ratio")
_KINDS = ("E", "nu", "density", "thickness", "bending", "damping")


@dataclass(frozen=True)
class Samples:
    """Samples of an object, each with a share of its material; those on the surface come first.

    Attributes:
        position: Rest positions [m], shape (N, 3), float64.
        normal: Unit normals, of either sign, zero inside a solid, shape (N, 3), float64.
        body_area: Areas that carry material [m²], shape (N,); zero inside a solid.
        area: Areas that feel the wind [m²], shape (N,).
        volume: Volumes [m³], shape (N,).
        E: Young's moduli [Pa], shape (N,).
        nu: Poisson's ratios, shape (N,).
        density: Densities [kg/m³], shape (N,).
        thickness: Thicknesses of the surface [m], shape (N,).
        bending: Bending stiffnesses of sheets [N m], zero for a membrane, shape (N,).
        damping: Rates at which the velocity decays [1/s], shape (N,).
        law_index: Which law applies to each, int64, shape (N,).
        surface: Which are on the surface, bool, shape (N,).
    """

    position: Tensor
    normal: Tensor
    body_area: Tensor
    area: Tensor
    volume: Tensor
    E: Tensor
    nu: Tensor
    density: Tensor
    thickness: Tensor
    bending: Tensor
    damping: Tensor
    law_index: Tensor
    surface: Tensor

    @property
    def mass(self) -> Tensor:
        """Masses [kg], shape (N,)."""
        return self.density * self.volume

    @property
    def span(self) -> Tensor:
        """Distances between the outer two of three layers [m], shape (N,)."""
        return layer_distance(self.bending, self.E, self.nu, self.thickness)

    def choose(self, index: Tensor) -> Samples:
        return Samples(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def points(
        self, layers: int, laws: Sequence[ConstitutiveLaw], dtype: torch.dtype, attached: Tensor | None = None
    ) -> MaterialPoints:
        """The samples as material points: one each, or three through the thickness (the other two at the end).

        Those of one layer have a bending stiffness of their own, and so have three layers by their distance.
        ``attached`` are the pairs of points that are attached, shape (E, 2); None if all are.
        """
        position, volume, index = self.position, self.volume, self.law_index
        properties = {name: getattr(self, name) for name in ("E", "nu", "density", "damping")}
        if layers == 3:
            out = 0.5 * self.span[:, None] * self.normal
            position = torch.cat([position, position + out, position - out])
            volume = torch.cat([part * volume for part in SIMPSON])
            properties = {name: value.repeat(3) for name, value in properties.items()}
            index = index.repeat(3)
        bends = layers == 1 and bool((self.bending > 0).any())
        return MaterialPoints.create(
            position.to(dtype),
            volume=volume.to(dtype),
            density=properties["density"].to(dtype),
            youngs_modulus=properties["E"].to(dtype),
            poisson_ratio=properties["nu"].to(dtype),
            law=list(laws),
            law_index=index if len(laws) > 1 else None,
            attached=attached,
            damping=properties["damping"].to(dtype) if bool((self.damping > 0).any()) else None,
            normal=self.normal.to(dtype) if bends else None,
            bending=(self.bending * self.body_area).to(dtype) if bends else None,
        )


def sample_object(
    position: Tensor,
    normal: Tensor,
    body_area: Tensor,
    area: Tensor,
    filling: Filling | None,
    material: Material,
    frame: SimFrame,
    dx: float,
    layers: int,
) -> tuple[Samples, list[ConstitutiveLaw]]:
    """The samples of an object with their material, and the laws of the material.

    Args:
        position: Samples of the surface [m], shape (S, 3), float64.
        normal: Their unit normals, shape (S, 3).
        body_area: Areas that carry material [m²], shape (S,).
        area: Areas that feel the wind [m²], shape (S,).
        filling: Samples inside a solid, if there are any.
        material: The material of the object.
        frame: Conversion from scene units to metres.
        dx: Grid spacing [m], for ``material.volume = "cell"``.
        layers: Layers of points through the thickness of a sheet.
    """
    surface = torch.ones(len(position), dtype=torch.bool)
    if filling is not None:
        inside = len(filling.position)
        position = torch.cat([position, filling.position])
        normal = torch.cat([normal, normal.new_zeros(inside, 3)])
        body_area, area = (torch.cat([part, part.new_zeros(inside)]) for part in (body_area, area))
        surface = torch.cat([surface, torch.zeros(inside, dtype=torch.bool)])
    where = frame.point_to_scene(position)
    given = {name: getattr(material, name) for name in _PROPERTIES}
    properties = {name: torch.full_like(area, _number(v)) for name, v in given.items()}
    laws, index = [material.law or FixedCorotated()], torch.zeros(len(position), dtype=torch.long)
    for entry in material.regions:
        inside_region = entry.region.contains(where)
        if not bool(inside_region.any()):
            between, hint = whereabouts(entry.region, where, frame.rotation)
            raise ValueError(
                f"The region {entry.region!r} of `material.regions` holds no simulated Gaussian: they lie {between}; "
                f"{hint or 'move or enlarge it'}."
            )
        for name in _PROPERTIES:
            if getattr(entry, name) is not None:
                properties[name][inside_region] = _number(getattr(entry, name))
        if entry.law is not None:
            index[inside_region] = len(laws)
            laws.append(entry.law)
    for k, law in enumerate(laws):
        if bool((properties["nu"][index == k] < law.least_nu).any()):
            warnings.warn(
                f"With `material.nu` below {law.least_nu:g} the energy of {type(law).__name__} has no least value: "
                "material that is deformed by some tens of percent runs away. Use `material.law: StVKHencky`, or a nu "
                f"of at least {law.least_nu:g}.",
                UserWarning,
                stacklevel=2,
            )
    if material.volume == "cell":
        volume = cell_volume(position, dx)
    else:
        volume = body_area * properties["thickness"]
        if filling is not None:
            solid = torch.cat([filling.gaussian_volume, filling.volume]).to(volume)
            volume = torch.where(solid > 0, solid, volume)
    bending = properties.pop("bending")
    of_plate = plate_stiffness(properties["E"], properties["nu"], properties["thickness"])
    bending = torch.where(bending.isinf() | (bending.isnan() & (layers == 3)), of_plate, bending.nan_to_num(0.0))
    damping = decay_rate(1.0, 1.0) * properties.pop("damping_ratio").nan_to_num(0.0)
    found = Samples(
        position, normal, body_area, area, volume, **properties, bending=bending, damping=damping, law_index=index,
        surface=surface,
    )  # fmt: skip
    return found, laws


def _number(value: Any) -> float:
    """The number of a property of a material: not a number for none, and infinity for the stiffness of a plate."""
    return math.nan if value is None else math.inf if value == PLATE else number_of(value)


def cell_volume(position: Tensor, dx: float) -> Tensor:
    """PhysGaussian's rule for solids: the volume of the grid cell divided by the number of particles in it.

    Args:
        position: Rest position [m], shape (P, 3).
        dx: Grid spacing [m].

    Returns:
        Volume [m³], shape (P,).
    """
    cell = torch.floor(position / dx).long()
    group = equal_rows(cell)
    return dx**3 / group.bincount()[group].to(position.dtype)


@torch.no_grad()
def grouped(
    samples: Samples,
    dx: float,
    per_cell: int,
    apart: Sequence[Region],
    frame: SimFrame,
    dtype: torch.dtype,
    piece: Tensor | None = None,
    home: Tensor | None = None,
) -> tuple[Samples, Tensor, Tensor]:
    """Samples for a grid: for each group one or a few that keep its mass, centre of mass and volume.

    A group never mixes materials, laws, the surface and the inside, samples that feel wind and samples that do not,
    pieces, or the two sides of the border of a region in ``apart``.

    Args:
        samples: The samples.
        dx: Grid spacing [m].
        per_cell: Points along the side of a cell. An even number makes groups of twice that size, see
            :func:`matched_points`.
        apart: Regions in scene units: those of pins and edits.
        frame: Conversion from scene units to metres.
        dtype: Precision of the solver.
        piece: A number for each sample, the same for those that are attached in their cell, shape (N,); None if all
            are.
        home: The places by which they are grouped [m], shape (N, 3), if these are not their own.

    Returns:
        The points as samples, those on the surface first; the point that each sample belongs to, shape (N,); and the
        group of each point, shape (P,).
    """
    kinds = torch.stack([getattr(samples, name) for name in _KINDS], -1)
    kind = equal_rows(kinds)
    where = frame.point_to_scene(samples.position)
    masks = [region.contains(where) for region in apart]
    pieces = [] if piece is None else [piece]
    label = torch.stack([kind, samples.law_index, samples.surface, samples.area > 0, *masks, *pieces], -1).long()
    home = samples.position if home is None else home
    matched = per_cell % 2 == 0
    cubes = per_cell // 2 if matched else per_cell
    group = grid_groups(home.to(dtype), dx, cubes, samples.mass, samples.normal, label)
    parts = torch.full((int(group.max()) + 1,), matched)  # which groups are divided into several points
    of = matched_points(samples.position, samples.mass, group, parts, dx / cubes)[2]
    group, parts = _parted(group, parts, group.bincount() <= of.bincount())  # no more points than there were
    while True:
        points, owner, of = _points_of(samples, group, parts, dx / cubes)
        astray = torch.zeros(len(points.position), dtype=torch.bool)
        centre = frame.point_to_scene(points.position)
        for region, mask in zip(apart, masks, strict=True):
            own = torch.zeros(len(parts), dtype=torch.bool).index_put((group,), mask)
            astray |= region.contains(centre) != own[of]
        if not bool(astray.any()):
            break
        wrong = torch.zeros(len(parts), dtype=torch.bool).index_put((of[astray],), torch.tensor(True))
        if not bool(parts[wrong].all()):  # even its centre lies across a border: the samples stay alone
            group, parts = _parted(group, parts, wrong & ~parts)
        else:
            parts[wrong] = False
    order = (~points.surface).long().argsort(stable=True)
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order)))
    return points.choose(order), rank[owner], of[order]


@torch.no_grad()
def shared_wind(samples: Samples, owner: Tensor, parent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The patches that feel the wind, so that the points of a group share its wind as they share its mass.

    A group of up to :data:`SHARED` directions is one patch of each direction at each of its points, with an equal part
    of the area: the wind then has the second moments of the group, too. If each patch went to the point next to it,
    some points of a cell that a sheet crosses obliquely would get much more wind than mass, and the sheet would
    wrinkle. In a group of more directions, as in noisy captures, each patch does go to that point.

    Args:
        samples: The samples of the object.
        owner: The point that each belongs to, shape (N,).
        parent: The group of each point, shape (P,).

    Returns:
        Unit normals, shape (Q, 3), areas [m²], shape (Q,), and the point of each patch, shape (Q,).
    """
    feels = samples.area > 0
    normal, area, point = samples.normal[feels], samples.area[feels], owner[feels]
    group, count = parent[point], parent.bincount()
    vector, of = joined_directions(normal, area, group, second_moments(normal, area, group, len(count)))
    few = of.bincount(minlength=len(count)) <= SHARED
    vector, of = vector[few[of]], of[few[of]]
    times = count[of]  # a copy for each point of the group
    copies = torch.repeat_interleave(torch.arange(len(of)), times)
    rank = torch.arange(len(copies)) - (times.cumsum(0) - times)[copies]
    members = parent.argsort(stable=True)
    their_point = members[(count.cumsum(0) - count)[of[copies]] + rank]
    size = vector.norm(dim=-1)
    own = ~few[group]
    return (
        torch.cat([normal[own], (vector / size[:, None])[copies]]),
        torch.cat([area[own], (size / times)[copies]]),
        torch.cat([point[own], their_point]),
    )


def _parted(group: Tensor, parts: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
    """Split some groups (M,) into single samples; return the groups (N,), and which of them are divided (M',)."""
    new = torch.where(which[group], len(parts) + torch.arange(len(group)), group)
    kept, group = torch.unique(new, return_inverse=True)
    return group, torch.cat([parts, torch.zeros(len(new), dtype=torch.bool)])[kept]


def _points_of(samples: Samples, group: Tensor, parts: Tensor, side: float) -> tuple[Samples, Tensor, Tensor]:
    """The points of all groups, the point of each sample, (N,), and the group of each point."""
    mass = samples.mass
    position, owner, of = matched_points(samples.position, mass, group, parts, side)
    count = len(position)
    first = torch.full((len(parts),), len(group)).scatter_reduce_(0, group, torch.arange(len(group)), "amin")
    found = samples.choose(first[of])
    share = of.bincount()[of].double()
    alone = group.bincount()[of] == 1
    position = torch.where(alone[:, None], found.position, position)
    of_group = second_moments(samples.normal, samples.body_area, group, len(parts))[of]
    own = second_moments(samples.normal, samples.body_area, owner, count)
    empty = own.diagonal(dim1=1, dim2=2).sum(-1) == 0
    axis = torch.linalg.eigh(torch.where(empty[:, None, None], of_group, own))[1][..., 2]
    solid = of_group.diagonal(dim1=1, dim2=2).sum(-1) == 0
    normal = torch.where(solid[:, None], 0.0, torch.where(alone[:, None], found.normal, axis))
    areas = {name: sums(getattr(samples, name), owner, count) for name in ("body_area", "area")}
    volume = sums(samples.volume, group)[of] / share
    return replace(found, position=position, normal=normal, volume=volume, **areas), owner, of


def matched_points(
    position: Tensor, mass: Tensor, group: Tensor, parts: Tensor, side: float
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Points of equal mass that have the centre of mass and the second moments of their group.

    They are the corners of a box around the centre, :math:`\pm \sqrt{\lambda_k}` from it along the principal axes, with
    the eigenvalues of the covariance: eight, four for a flat group, two for a line. For a group that fills a cell, or a
    flat sheet across it, they are the points of Gauss' rule with two points along each direction, so that the strain
    energy of a linear strain is exact. A point at the centre alone makes a thin cord or a curved leaf too soft, whose
    stiffness in bending is a second moment. Four corners of the eight, no two side by side, have the same second
    moments, but some motions of a thin stalk strain none of them.

    Args:
        position: Samples [m], shape (N, 3), float64.
        mass: Their masses [kg], shape (N,).
        group: The group of each, shape (N,).
        parts: Which groups are divided; the others get one point at their centre, bool, shape (M,).
        side: Side of the cubes [m].

    Returns:
        Positions of the points [m], shape (P, 3), the point that each sample is closest to, by the signs of its
        principal coordinates, shape (N,), and the group of each point, shape (P,).
    """
    total = sums(mass, group)
    centre = sums(mass[:, None] * position, group) / total[:, None]
    arm = position - centre[group]
    covariance = sums(mass[:, None, None] * arm[:, :, None] * arm[:, None, :], group) / total[:, None, None]
    values, axes = torch.linalg.eigh(covariance)
    size, axes = values.clamp(min=0).sqrt().flip(-1), axes.flip(-1)
    divided = (size > _FLAT * side) & parts[:, None]
    count = 2 ** divided.sum(-1)
    start = count.cumsum(0) - count
    of = torch.repeat_interleave(torch.arange(len(count)), count)
    rank = torch.arange(len(of)) - start[of]
    bit = 2 ** (divided.long().cumsum(-1) - divided.long())  # of each divided axis
    sign = 2.0 * ((rank[:, None] // bit[of]) % 2) - 1
    offset = torch.where(divided[of], sign * size[of], 0.0)
    points = centre[of] + (axes[of] * offset[:, None, :]).sum(-1)
    side = (axes[group] * arm[:, :, None]).sum(1) > 0
    owner = start[group] + torch.where(divided[group] & side, bit[group], 0).sum(-1)
    return points, owner, of
