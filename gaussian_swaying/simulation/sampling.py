"""Which points carry the material: samples of the surface and the inside of an object, one by one or in groups."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from gaussian_swaying.gaussians.filling import Filling
from gaussian_swaying.gaussians.grouping import grid_groups, sums
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.material import Material

SIMPSON = (2 / 3, 1 / 6, 1 / 6)  # middle plane and faces of a sheet: exact for the square of the height
_PROPERTIES = ("E", "nu", "density", "thickness")


@dataclass(frozen=True)
class Samples:
    """Places of an object with their share of its material; those on the surface come first.

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
    law_index: Tensor
    surface: Tensor

    @property
    def mass(self) -> Tensor:
        """Masses [kg], shape (N,)."""
        return self.density * self.volume

    def choose(self, index: Tensor) -> Samples:
        """Some of the samples."""
        return Samples(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def points(self, layers: int, laws: Sequence[ConstitutiveLaw], dtype: torch.dtype) -> MaterialPoints:
        """The samples as material points: one each, or three through the thickness (the other two at the end)."""
        position, volume, index = self.position, self.volume, self.law_index
        properties = {name: getattr(self, name) for name in ("E", "nu", "density")}
        if layers == 3:
            out = 0.5 * self.thickness[:, None] * self.normal
            position = torch.cat([position, position + out, position - out])
            volume = torch.cat([part * volume for part in SIMPSON])
            properties = {name: value.repeat(3) for name, value in properties.items()}
            index = index.repeat(3)
        return MaterialPoints.create(
            position.to(dtype),
            volume=volume.to(dtype),
            density=properties["density"].to(dtype),
            youngs_modulus=properties["E"].to(dtype),
            poisson_ratio=properties["nu"].to(dtype),
            law=list(laws),
            law_index=index if len(laws) > 1 else None,
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
) -> tuple[Samples, list[ConstitutiveLaw]]:
    """The samples of an object with their material, and the laws of the material.

    Args:
        position: Samples of the surface [m], shape (S, 3), float64.
        normal: Their unit normals, shape (S, 3).
        body_area: Areas that carry material [m²], shape (S,).
        area: Areas that feel the wind [m²], shape (S,).
        filling: Samples inside a solid, if there are any.
        material: What the object is made of.
        frame: Conversion from scene units to metres.
        dx: Grid spacing [m], for ``material.volume = "cell"``.

    Raises:
        ValueError: If a region of the material holds nothing.
    """
    surface = torch.ones(len(position), dtype=torch.bool)
    if filling is not None:
        inside = len(filling.position)
        position = torch.cat([position, filling.position])
        normal = torch.cat([normal, normal.new_zeros(inside, 3)])
        body_area, area = (torch.cat([part, part.new_zeros(inside)]) for part in (body_area, area))
        surface = torch.cat([surface, torch.zeros(inside, dtype=torch.bool)])
    where = frame.point_to_scene(position)
    properties = {name: torch.full_like(area, getattr(material, name)) for name in _PROPERTIES}
    laws, index = [material.law or FixedCorotated()], torch.zeros(len(position), dtype=torch.long)
    for entry in material.regions:
        inside_region = entry.region.contains(where)
        if not bool(inside_region.any()):
            low, high = entry.region.bounds(where)
            raise ValueError(
                f"The region {entry.region!r} of `material.regions` holds no simulated Gaussian: they lie between "
                f"{low} and {high}{entry.region.axes}; move or enlarge it."
            )
        for name in _PROPERTIES:
            if getattr(entry, name) is not None:
                properties[name][inside_region] = getattr(entry, name)
        if entry.law is not None:
            index[inside_region] = len(laws)
            laws.append(entry.law)
    if material.volume == "cell":
        volume = cell_volume(position, dx)
    else:
        volume = body_area * properties["thickness"]
        if filling is not None:
            solid = torch.cat([filling.gaussian_volume, filling.volume]).to(volume)
            volume = torch.where(solid > 0, solid, volume)
    return Samples(position, normal, body_area, area, volume, **properties, law_index=index, surface=surface), laws


def cell_volume(position: Tensor, dx: float) -> Tensor:
    """PhysGaussian's rule for solids: the volume of the grid cell divided by the number of particles in it.

    Args:
        position: Rest position [m], shape (P, 3).
        dx: Grid spacing [m].

    Returns:
        Volume [m³], shape (P,).
    """
    cell = torch.floor(position / dx).long()
    _, inverse, counts = torch.unique(cell, dim=0, return_inverse=True, return_counts=True)
    return dx**3 / counts[inverse].to(position.dtype)


@torch.no_grad()
def grouped(
    samples: Samples, dx: float, per_cell: int, apart: Sequence[Region], frame: SimFrame, dtype: torch.dtype
) -> tuple[Samples, Tensor]:
    """Samples for a grid: one for each group, at its centre of mass, with the sums of masses, volumes and areas.

    A group never mixes materials, laws, the surface and the inside, samples that feel wind and samples that do not, or
    the two sides of the border of a region in ``apart``.

    Args:
        samples: The samples.
        dx: Grid spacing [m].
        per_cell: As in :func:`~gaussian_swaying.gaussians.grouping.grid_groups`.
        apart: Regions in scene units: those of pins and edits.
        frame: Conversion from scene units to metres.
        dtype: Precision of the solver.

    Returns:
        The groups as samples, those on the surface first, and the group of each sample, shape (N,).
    """
    kinds = torch.stack([getattr(samples, name) for name in _PROPERTIES], -1)
    kind = torch.unique(kinds, dim=0, return_inverse=True)[1]
    where = frame.point_to_scene(samples.position)
    masks = [region.contains(where) for region in apart]
    label = torch.stack([kind, samples.law_index, samples.surface, samples.area > 0, *masks], -1).long()
    place = samples.position.to(dtype)
    group = grid_groups(place, dx, per_cell, samples.mass, samples.normal, label)
    found = _joined(samples, group, dx, dtype)
    centre = frame.point_to_scene(found.position)
    astray = torch.zeros(len(centre), dtype=torch.bool)
    for region, mask in zip(apart, masks, strict=True):
        astray |= region.contains(centre) != torch.zeros_like(astray).index_put((group,), mask)
    if bool(astray.any()):  # a centre across a border: these samples stay alone
        alone = astray[group]
        group = torch.where(alone, len(centre) + torch.arange(len(group)), group)
    group = torch.unique(group + (~samples.surface) * 2 * len(group), return_inverse=True)[1]
    return _joined(samples, group, dx, dtype), group


def _joined(samples: Samples, group: Tensor, dx: float, dtype: torch.dtype) -> Samples:
    """One sample for each group, whose normal is the main direction of its normals."""
    mass = samples.mass
    centre = sums(mass[:, None] * samples.position, group) / sums(mass, group)[:, None]
    first = torch.full((len(centre),), len(group)).scatter_reduce_(0, group, torch.arange(len(group)), "amin")
    alone = group.bincount() == 1
    centre = torch.where(
        alone[:, None], samples.position[first], _within_cell(centre, samples.position[first], dx, dtype)
    )
    weight = samples.area.clamp_min(1e-9 * samples.body_area).clamp_min(torch.finfo(torch.float64).tiny)
    normal = samples.normal
    axis = torch.linalg.eigh(sums(weight[:, None, None] * normal[:, :, None] * normal[:, None, :], group))[1][..., 2]
    solid = sums(normal.square().sum(-1), group) == 0
    axis = torch.where(solid[:, None], 0.0, torch.where(alone[:, None], normal[first], axis))
    added = {name: sums(getattr(samples, name), group) for name in ("body_area", "area", "volume")}
    return replace(samples.choose(first), position=centre, normal=axis, **added)


def _within_cell(centre: Tensor, member: Tensor, dx: float, dtype: torch.dtype) -> Tensor:
    """Centres moved by round-off, if need be, so that the solver sees them in the same cell as a member."""
    base = torch.floor(member.to(dtype) / dx - 0.5).double()
    margin = 4 * torch.finfo(dtype).eps * (base.abs() + 2)
    return (centre / dx).clamp(base + 0.5 + margin, base + 1.5 - margin) * dx
