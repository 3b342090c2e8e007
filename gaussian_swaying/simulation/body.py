"""The body of a scene: what a solver takes, made from the Gaussians that move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.filling import Filling
from gaussian_swaying.gaussians.grouping import loose_points
from gaussian_swaying.gaussians.openness import openness
from gaussian_swaying.gaussians.subdivision import Subdivision, subdivide
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.attached import attached_points, attached_samples, homes, lies_apart, pieces_in_cells
from gaussian_swaying.simulation.material import Material, with_gradients
from gaussian_swaying.simulation.sampling import Samples, grouped, sample_object, shared_wind
from gaussian_swaying.simulation.scene import Scene
from gaussian_swaying.wind.patches import Patches

HOLE = 0.6
"""Distance from all Gaussians [cells] at which ``points: grid`` puts extra points on large ones by itself."""

SPECK = 1 / 2.2
"""Side of the cubes by which ``scene.loose`` finds specks [cells]."""


@dataclass(frozen=True, eq=False)
class Body:
    """Material points and patches, and the samples of the object that they stand for.

    Attributes:
        points: The material.
        patches: What feels the wind.
        on_surface: Number of points on the surface, without those at the faces of a sheet.
        samples: Samples of the object: first one for each Gaussian, then extra ones, then those inside a solid.
        surface_samples: Number of those that are not inside.
        owner: The material point of each sample, shape (N,).
        pairs: The pairs of samples that are attached, shape (E, 2), with ``scene.connected: surface``; else None.
    """

    points: MaterialPoints
    patches: Patches
    on_surface: int
    samples: Samples
    surface_samples: int
    owner: Tensor
    pairs: Tensor | None = None


def body_of(
    part: GaussianCloud,
    normals: Tensor,
    scene: Scene,
    material: Material,
    frame: SimFrame,
    dx: float,
    dtype: torch.dtype,
    by_grid: bool,
    apart: Sequence[Region],
    labels: Tensor | None = None,
) -> Body:
    """Turn Gaussians into what a solver takes: samples, their areas and material, groups, patches.

    Args:
        part: The simulated Gaussians.
        normals: Their unit normals, shape (N, 3).
        scene: How they are sampled.
        material: Their material.
        frame: Conversion from scene units to metres.
        dx: Length that the solver resolves [m].
        dtype: Precision of the simulation.
        by_grid: Whether samples are grouped.
        apart: Regions whose borders no group crosses, in scene units.
        labels: The part of each Gaussian, shape (N,), if the scene has parts.

    Returns:
        The body.
    """
    position = frame.point_to_sim(part.means.double())
    source = torch.arange(len(position))  # the Gaussian of each sample of the surface
    filling = None
    if scene.filling is not None:
        shape = frame.covariance_to_sim(covariance(part.quats, part.scales).double())
        filling = scene.filling.fill(position, shape, torch.sigmoid(part.opacities), 0.5 * dx)
        filling = within_region(filling, scene.region, frame)
    pieces = _pieces(part, scene, frame.metres_per_unit, dx, by_grid)
    if pieces is not None:
        position = torch.cat([position, frame.point_to_sim(pieces.means.double())])
        source = torch.cat([source, pieces.parent])
    outer = torch.ones(len(source), dtype=torch.bool) if filling is None else filling.on_surface
    areas, kind = part.means.new_zeros(len(source)), scene.area_kind
    # inner points take no area from the surface
    for group, mode in ((outer, kind), (~outer, "coverage" if kind == "open" else kind)):
        areas[group] = _areas(part, normals, source, pieces, group, mode)
    body_area = frame.area_to_sim(areas).double()
    area = body_area if scene.wind_on == "all" else torch.where(outer, body_area, 0)
    facing = frame.direction_to_sim(normals[source].double())
    samples, laws = sample_object(position, facing, body_area, area, filling, material, frame, dx, scene.layers)
    chosen, owner, feels = samples, torch.arange(len(samples.position)), samples.area > 0
    patches = samples.normal[feels], samples.area[feels], owner[feels]
    pairs = piece = home = parent = None
    if scene.connected == "surface":
        rest = samples.position.to(dtype)
        pairs = attached_samples(samples.position, samples.normal, len(part.means), scene.parts, labels)
        if lies_apart(rest, dx, pairs):
            home, piece = homes(samples.position, dx, pairs, pieces_in_cells(rest, dx, pairs))
    if by_grid:
        chosen, owner, parent = grouped(samples, dx, scene.points_per_cell, apart, frame, dtype, piece, home)
        patches = shared_wind(samples, owner, parent)
    if scene.layers == 3:
        _require_cells_as_large_as(chosen.span, chosen.thickness, dx)
    elif filling is not None and bool((samples.bending > 0).any()):
        raise ValueError(
            "Expected no `material.bending` with `scene.filling`: a solid bends as its shape and `material.E` allow."
        )
    attached = None
    if pairs is not None and piece is not None:
        attached = attached_points(pairs, owner, parent, scene.layers)
    points = with_gradients(chosen.points(scene.layers, laws, dtype, attached), material)
    felt = Patches(patches[0].to(dtype), patches[1].to(dtype), patches[2], points.count)
    return Body(points, felt, int(chosen.surface.sum()), samples, len(source), owner, pairs)


def _require_cells_as_large_as(span: Tensor, thickness: Tensor, dx: float) -> None:
    """Refuse three layers across more than a cell: the middle one then moves apart from the faces without any strain.

    The nodes have five planes across them, and the three slopes leave one motion besides a shift.
    """
    most = int(span.argmax())
    if float(span[most]) > dx * (1 + 1e-6):
        own = math.isclose(float(span[most]), float(thickness[most]), rel_tol=1e-6)
        what = f"is {span[most]:g} m thick" if own else f"has its outer layers {span[most]:g} m apart"
        lower = "`material.thickness`" if own else "`material.bending`, raise `material.E`"
        raise ValueError(
            f"A sheet of three layers (`scene.layers: 3`) that {what} needs cells at least as large, but `solver.dx` "
            f"is {dx:g} m, and its layers would come apart: raise `solver.dx`, lower {lower}, or set `scene.layers` "
            "to 1, which bends by `material.bending` at any thickness."
        )


def specks_of(
    cloud: GaussianCloud, simulated: Tensor, scene: Scene, frame: SimFrame, dx: float, by_grid: bool
) -> Tensor:
    """The simulated Gaussians that are not connected to the object, if ``scene.loose`` carries them.

    Args:
        cloud: All Gaussians.
        simulated: Indices of those that are simulated, shape (N,).
        scene: How they are sampled.
        frame: Conversion from scene units to metres.
        dx: Length that the solver resolves [m].
        by_grid: Whether samples are grouped.

    Returns:
        Their indices, shape (M,).
    """
    if scene.loose != "carry":
        return simulated[:0]
    part = cloud.select(simulated)
    pieces = _pieces(part, scene, frame.metres_per_unit, dx, by_grid)
    where = part.means if pieces is None else torch.cat([part.means, pieces.means.to(part.means)])
    return simulated[loose_points(where, SPECK * dx / frame.metres_per_unit)[: len(part.means)]]


def _pieces(part: GaussianCloud, scene: Scene, unit: float, dx: float, by_grid: bool) -> Subdivision | None:
    """Return extra points on large Gaussians, no farther apart than ``scene.particle_spacing``; None if there are none.

    Groups by themselves get those that fill holes, far from all Gaussians.
    """
    spacing, hole = scene.particle_spacing, 0.0
    if spacing is None and by_grid and scene.filling is None:
        spacing, hole = dx / scene.points_per_cell, HOLE * dx / unit
    if spacing is None:
        return None
    spacing = spacing / unit
    found = subdivide(part.means, part.quats, part.scales, torch.sigmoid(part.opacities), spacing)
    if hole > 0 and len(found.means):
        far = nearest_neighbours(part.means.double(), 1, found.means.double())[0][:, 0] > hole
        own = torch.arange(len(far))[far]
        of_all = torch.cat([torch.arange(len(part.means)), len(part.means) + own])
        found = Subdivision(found.parent[far], found.means[far], found.log_scales[of_all], found.opacity[of_all])
    return found if len(found.means) else None


def _areas(
    cloud: GaussianCloud, normals: Tensor, source: Tensor, pieces: Subdivision | None, group: Tensor, mode: str
) -> Tensor:
    """Areas [scene units^2] of a group of points, shared within it; each point belongs to a Gaussian of the cloud."""
    if mode == "paper":
        shares = torch.bincount(source, minlength=len(cloud.means)).to(cloud.means)
        return (patch_area(cloud.scales) / shares.clamp_min(1))[source[group]]
    means, log_scales, opacity = cloud.means, cloud.scales, torch.sigmoid(cloud.opacities)
    if pieces is not None:
        means, log_scales, opacity = torch.cat([means, pieces.means]), pieces.log_scales, pieces.opacity
    shape = means[group], normals[source[group]], log_scales[group], opacity[group]
    found = _shared_areas(*shape, open_only=mode == "open")
    return found.mean().expand(len(found)) if mode == "equal" and len(found) else found


_last: list[Tensor] = []
"""Arguments and result of the last areas."""


def _shared_areas(*shape: Tensor, open_only: bool) -> Tensor:
    """Areas of overlapping patches (N,), computed on the CPU; if only the material or the grid has changed, the last.

    The simulations of a preview, a sweep or a fit have the same Gaussians.

    Args:
        shape: Means, normals, logarithms of scales, and opacities.
        open_only: Whether they are weighted with :func:`openness`.
    """
    means, normals, log_scales, opacity = shape
    if len(means) == 0:
        return means.new_zeros(0)
    key = [torch.tensor(open_only), *(part.detach().cpu() for part in shape)]
    if not (_last and all(a.dtype == b.dtype and torch.equal(a, b) for a, b in zip(_last, key, strict=False))):
        found = coverage_area(means, normals, log_scales, opacity)
        if open_only:
            found = found * openness(means, normals, log_scales, found, opacity)
        _last[:] = [*(part.clone() for part in key), found.cpu()]
    return _last[-1].to(means, copy=True)


def within_region(filling: Filling, region: Region, frame: SimFrame) -> Filling:
    """A filling without the points outside a region given in scene units."""
    inside = region.contains(frame.point_to_scene(filling.position))
    return replace(filling, position=filling.position[inside], volume=filling.volume[inside])
