"""The scene of a run: the Gaussians that move, their material, and how they follow it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying.aero.patches import Patches
from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.compact import read_gaussians
from gaussian_swaying.gaussians.filling import Filling, InteriorFilling
from gaussian_swaying.gaussians.grouping import loose_points
from gaussian_swaying.gaussians.model import DeformedGaussians, GaussianSurfaceModel
from gaussian_swaying.gaussians.openness import openness
from gaussian_swaying.gaussians.selection import select_simulated
from gaussian_swaying.gaussians.subdivision import Subdivision, subdivide
from gaussian_swaying.geometry.directions import hull_area
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.patches import deform_all
from gaussian_swaying.geometry.regions import Everything, Region
from gaussian_swaying.geometry.surface_normals import neighbour_normals
from gaussian_swaying.mpm.boundaries.obstacle import Obstacle
from gaussian_swaying.mpm.boundaries.still_gaussians import StillGaussians
from gaussian_swaying.mpm.contact.surface import Contact, Surface
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.scenes.procedural import ProceduralScene
from gaussian_swaying.simulation.extent import check_extent
from gaussian_swaying.simulation.followers import Followers, GridFollowers, PointFollowers, on_material
from gaussian_swaying.simulation.material import Material, MaterialRegion, with_gradients
from gaussian_swaying.simulation.sampling import Samples, grouped, sample_object, shared_wind
from gaussian_swaying.simulation.touching import still_distance, surface_of

__all__ = ["Material", "MaterialRegion", "Scene", "SimulatedScene"]


class Scene:
    """The source of the Gaussians, and the choice of those that are simulated.

    Args:
        ply: A 3DGS .ply, a compressed .ply or a .splat; takes precedence over ``generator``.
        generator: A scene made in code.
        region: Part that is simulated, in scene units; the rest does not move and is rendered as well.
        opacity_threshold: Gaussians in the region below this opacity carry no mass and feel no wind.
        faint: Treatment of Gaussians below that opacity: ``carry`` (they follow their nearest simulated neighbour),
            ``static`` or ``drop``.
        loose: Treatment of specks that are not connected to the object, or only by a thin thread (see
            :func:`~gaussian_swaying.gaussians.grouping.loose_points`): ``simulate`` (like all others, so the wind blows
            them away) or ``carry`` (no mass, no wind; they follow their nearest simulated neighbour).
        up: Direction in the scene that points up, for example [0, -1, 0].
        longest_side: Longest side of the simulated part [m] (PhysGaussian normalises to 1). Cannot be combined with
            metres_per_unit.
        metres_per_unit: Length of a scene unit [m]; 1 if neither is given.
        area: Patch area, for wind and mass: ``coverage`` (independent of how many Gaussians carry the surface),
            ``open`` (the same, weighed by how open each patch is to the outside, see
            :func:`~gaussian_swaying.gaussians.openness.openness`: layers behind the skin of a capture count for almost
            nothing), ``paper`` (pi s1 s2), or ``equal`` (the same area for all, with the total of ``coverage``; for
            comparison with a wind that does not use patches). Null for ``open`` with ``ply`` and ``coverage`` with
            ``generator`` or ``wind_on: all``.
        filling: Fills the inside of a solid with points that carry mass and feel no wind; null for a shell.
        wind_on: The simulated Gaussians that feel the wind: ``surface`` (those in contact with open air) or ``all``
            (also those inside the solid that ``filling`` finds). Without ``filling``, all are on the surface.
        max_stretch: Largest size at which a Gaussian is drawn, as a multiple of its size at rest (see
            :func:`~gaussian_swaying.geometry.covariances.limit_deformed`), in pictures and exports; null for no limit.
            Nothing changes below the limit. Above it a Gaussian would look like a streak: two parts of the object that
            share cells of the grid were pulled apart, or a material flowed.
        layers: Layers of material points through the thickness: 1 is a membrane that folds without resistance; 3
            resists bending like a plate (the Gaussians in the middle plane, two more points at the faces of the sheet,
            weights of Simpson's rule) and needs three times the points.
        particle_spacing: Largest distance between neighbouring material points on the surface [m]. Larger Gaussians get
            extra points (see :func:`~gaussian_swaying.gaussians.subdivision.subdivide`). A splat trained without a
            limit on sizes needs this: use 0.45 ``solver.dx`` or less. Null for none with ``points: gaussian``; with
            ``grid``, null fills holes: extra points, ``solver.dx / points_per_cell`` apart, where no Gaussian is
            within 0.6 cells.
        points: The points that carry the material: ``gaussian`` (one for each simulated Gaussian, as in the paper and
            PhysGaussian), or ``grid`` (groups of Gaussians, as many as the grid can use, and extra points where
            Gaussians are sparse; the Gaussians follow the nodes). ``grid`` is many times faster where the splat is
            much finer than the grid, and needs ``solver.formulation: total``. Null for ``grid`` in ``total`` and
            ``gaussian`` in ``updated``.
        points_per_cell: Points along the side of a cell with ``points: grid``: a sheet then has the square of it in a
            cell, a solid the cube, a cord as many. With 1 an object falls apart. An even number keeps the second
            moments of a group too (see :func:`~gaussian_swaying.simulation.sampling.matched_points`), so 2 is more
            accurate than 3.
        normals: Normals of the patches: ``smallest_axis`` of each Gaussian, as in the paper, or ``neighbours``, of
            planes through neighbouring centres (see
            :func:`~gaussian_swaying.geometry.surface_normals.neighbour_normals`), which are better on large smooth
            surfaces whose Gaussians have good positions but bad orientations.
    """

    def __init__(
        self,
        ply: str | os.PathLike[str] | None = None,
        generator: ProceduralScene | None = None,
        region: Region | None = None,
        opacity_threshold: float = 0.1,
        faint: str = "carry",
        up: list[float] = [0.0, 0.0, 1.0],  # noqa: B006  (never changed; the schema of the config shows it)
        longest_side: float | None = None,
        metres_per_unit: float | None = None,
        area: str | None = None,
        filling: InteriorFilling | None = None,
        wind_on: str = "surface",
        max_stretch: float | None = 2.0,
        layers: int = 1,
        particle_spacing: float | None = None,
        points: str | None = None,
        points_per_cell: int = 2,
        loose: str = "simulate",
        normals: str = "smallest_axis",
    ) -> None:
        if points is not None:
            check_choice("scene.points", points, ("gaussian", "grid"))
        if points_per_cell not in range(1, 9):
            raise ValueError(
                f"Expected `scene.points_per_cell` to be a whole number from 1 to 8, but got {points_per_cell}."
            )
        check_choice("scene.faint", faint, ("carry", "static", "drop"))
        check_choice("scene.loose", loose, ("simulate", "carry"))
        check_choice("scene.wind_on", wind_on, ("surface", "all"))
        check_choice("scene.normals", normals, ("smallest_axis", "neighbours"))
        if area is not None:
            check_choice("scene.area", area, ("coverage", "open", "paper", "equal"))
        if area == "open" and wind_on == "all":
            raise ValueError(
                'Expected `scene.wind_on` surface with `scene.area` "open": areas behind the surface feel no wind.'
            )
        if not any(check_vector("scene.up", up)):
            raise ValueError("Expected `scene.up` to be a direction, for example [0, -1, 0], but got zero.")
        if not 0 <= opacity_threshold < 1:
            raise ValueError(f"Expected `scene.opacity_threshold` to lie in [0, 1), but got {opacity_threshold}.")
        if max_stretch is not None and not max_stretch > 1:
            raise ValueError(
                f"Expected `scene.max_stretch` to be above 1, or null for no limit, but got {max_stretch}."
            )
        if layers not in (1, 3):
            raise ValueError(f"Expected `scene.layers` to be 1 or 3, but got {layers}.")
        if layers > 1 and filling is not None:
            raise ValueError("Expected `scene.layers` 1 with `scene.filling`: a solid resists bending without layers.")
        if particle_spacing is not None:
            check_positive("scene.particle_spacing", particle_spacing)
            if filling is not None:
                raise ValueError("Expected `scene.particle_spacing` null with `scene.filling`, which adds points.")
        if ply is None and generator is None:
            raise ValueError("The scene is empty: give `scene.ply` (a 3DGS .ply file) or `scene.generator`.")
        self.ply, self.generator, self.region = ply, generator, region or Everything()
        self.opacity_threshold, self.faint, self.up = float(opacity_threshold), faint, list(up)
        self.longest_side, self.metres_per_unit, self.area = longest_side, metres_per_unit, area
        self.filling, self.wind_on = filling, wind_on
        self.max_stretch = None if max_stretch is None else float(max_stretch)
        self.layers, self.particle_spacing, self.loose = layers, particle_spacing, loose
        self.points, self.points_per_cell, self.normals = points, int(points_per_cell), normals

    @property
    def area_kind(self) -> str:
        """``area``, or what null stands for."""
        if self.area is not None:
            return self.area
        return "open" if self.ply is not None and self.wind_on == "surface" else "coverage"

    def cloud(self) -> GaussianCloud:
        """Read the file or run the generator."""
        if self.ply is not None:
            return read_gaussians(self.ply)
        assert self.generator is not None
        return self.generator.generate()


HOLE = 0.6
"""Distance from all Gaussians [cells] at which ``points: grid`` puts extra points on large ones by itself."""

SPECK = 1 / 2.2
"""Side of the cubes by which ``scene.loose`` finds specks [cells]."""


class SimulatedScene(nn.Module):
    """Gaussians, material points and patches of one scene, and how the Gaussians follow the material.

    There are three kinds of Gaussians: simulated ones belong to the material, carried ones (faint or loose) follow the
    nearest simulated one, and static ones do not move. With ``points: gaussian`` each simulated Gaussian is a material
    point, and the points that fill a solid, those at the faces of a sheet of three layers, and the extra points of
    large Gaussians (``particle_spacing``) come after them. With ``points: grid`` a material point is a group of
    Gaussians and of such points. Wind acts on patches: those of the simulated Gaussians and of their extra points.

    Args:
        scene: The source of the Gaussians.
        material: Their material.
        dx: Grid spacing [m].
        dtype: Precision of the simulation.
        cloud: The Gaussians of the scene, if they have been read already.
        fixed: Whether the solver keeps the neighbours of its points (``total``), as ``points: grid`` needs.
        apart: Regions whose borders no group of Gaussians crosses, in scene units: those of pins and edits.

    Attributes:
        simulated: Indices of the simulated Gaussians.
        carried: Indices of the carried Gaussians.
        loose: Number of Gaussians selected by region and opacity that are loose and therefore carried.
        points: The material, for the solver.
        filled: Number of points inside a solid.
        on_surface: Number of points on the surface, without those at the faces of a sheet.
        patches: The patches that feel the wind.
        frame: Conversion from scene units to metres.
        bounds: Smallest and largest corner of the simulated part at rest [scene units].
        size: Its longest side [scene units].
        moving: Indices of the Gaussians that move, first the simulated and then the carried ones, shape (M,).
        all_move: Whether ``moving`` is all Gaussians, in their order.
        rest_facing: Normals at rest of the Gaussians that move, in the z-up frame, shape (M, 3).
        further: Number of extra points on large Gaussians.
        tracked: Number of points that :meth:`surface` returns.
        surface_places: Contact samples, which touch obstacles and each other, or None.
        source: The .ply file; None for a scene made in code.
    """

    def __init__(
        self,
        scene: Scene,
        material: Material,
        dx: float,
        dtype: torch.dtype = torch.float32,
        cloud: GaussianCloud | None = None,
        fixed: bool = True,
        apart: Sequence[Region] = (),
    ) -> None:
        super().__init__()
        cloud = scene.cloud() if cloud is None else cloud
        self.source = scene.ply
        by_grid = scene.points == "grid" or (scene.points is None and fixed)
        if by_grid and not fixed:
            raise ValueError(
                "`scene.points: grid` needs `solver.formulation: total`, where Gaussians can follow the nodes: set "
                "`scene.points` to gaussian."
            )
        opacity = torch.sigmoid(cloud.opacities)
        chosen = select_simulated(cloud.means, opacity, scene.region, scene.opacity_threshold, scene.up)
        faint = scene.region.contains(cloud.means) & ~chosen
        if scene.faint == "drop" and bool(faint.any()):
            cloud, chosen, faint = cloud.select(~faint), chosen[~faint], faint[~faint]
        self.model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
        simulated = chosen.nonzero()[:, 0]
        self.frame = SimFrame.fit(cloud.means[simulated], scene.up, scene.longest_side, scene.metres_per_unit)
        unit = self.frame.metres_per_unit
        means = cloud.means[simulated]
        check_extent(means, unit, dx, simulated)
        self.bounds = (means.amin(0), means.amax(0))
        largest = cloud.scales[simulated].amax().exp()  # a single Gaussian has a size too
        self.size = max(float((self.bounds[1] - self.bounds[0]).amax()), float(largest))
        spacing, hole = scene.particle_spacing, 0.0
        if spacing is None and by_grid and scene.filling is None:
            spacing, hole = dx / scene.points_per_cell, HOLE * dx / unit
        spacing = None if spacing is None else spacing / unit
        pieces = _pieces(cloud, simulated, spacing, hole)
        carried = faint if scene.faint == "carry" else torch.zeros_like(faint)
        self.loose = 0
        if scene.loose == "carry":
            where = means if pieces is None else torch.cat([means, pieces.means.to(means)])
            specks = simulated[loose_points(where, SPECK * dx / unit)[: len(means)]]
            self.loose = len(specks)
            if self.loose:
                chosen[specks], carried[specks] = False, True
                simulated = chosen.nonzero()[:, 0]
                pieces = _pieces(cloud, simulated, spacing, hole)
        normals = self.model.normals()
        if scene.normals == "neighbours":
            weight = opacity[simulated] * patch_area(cloud.scales[simulated])
            parts = cloud.means[simulated], normals[simulated], weight
            normals = normals.index_put((simulated,), neighbour_normals(*parts))
        position = self.frame.point_to_sim(cloud.means[simulated].double())
        filling = None
        if scene.filling is not None:
            shape = self.frame.covariance_to_sim(self.model.covariance()[simulated].double())
            visible = self.model.opacity()[simulated]
            filling = within_region(scene.filling.fill(position, shape, visible, 0.5 * dx), scene.region, self.frame)
        if pieces is not None:
            position = torch.cat([position, self.frame.point_to_sim(pieces.means.double())])
        source = torch.arange(len(simulated))  # the simulated Gaussian of each sample of the surface
        source = source if pieces is None else torch.cat([source, pieces.parent])
        outer = torch.ones(len(source), dtype=torch.bool) if filling is None else filling.on_surface
        areas = cloud.means.new_zeros(len(source))
        kind = scene.area_kind
        # inner points take no area from the surface
        for part, mode in ((outer, kind), (~outer, "coverage" if kind == "open" else kind)):
            areas[part] = _areas(cloud.select(simulated), normals[simulated], source, pieces, part, mode)
        body_area = self.frame.area_to_sim(areas).double()
        area = body_area if scene.wind_on == "all" else torch.where(outer, body_area, 0)
        facing = self.frame.direction_to_sim(normals[simulated[source]].double())
        samples, laws = sample_object(position, facing, body_area, area, filling, material, self.frame, dx)
        owner = torch.arange(len(samples.position))
        chosen_samples = samples
        feels = samples.area > 0
        patches = samples.normal[feels], samples.area[feels], owner[feels]
        if by_grid:
            chosen_samples, owner, parent = grouped(samples, dx, scene.points_per_cell, apart, self.frame, dtype)
            patches = shared_wind(samples, owner, parent)
        self.points = with_gradients(chosen_samples.points(scene.layers, laws, dtype), material)
        self.on_surface = int(chosen_samples.surface.sum())
        self.filled = len(chosen_samples.surface) - self.on_surface
        self.patches = Patches(patches[0].to(dtype), patches[1].to(dtype), patches[2], self.points.count)
        self.max_stretch = scene.max_stretch
        self._kept: tuple[MaterialPoints, Tensor] | None = None
        self._dx, self._near = dx, owner
        self._samples: Samples | None = samples
        self.surface_places: Surface | None = None
        carried = carried.nonzero()[:, 0]
        self.register_buffer("simulated", simulated)
        self.register_buffer("carried", carried)
        self.register_buffer("rest_covariances", self.model.covariance())
        self.register_buffer("rest_normals", normals)
        # computed once here, as every picture needs it
        moving = torch.cat([simulated, carried])
        self.all_move = bool(moving.equal(torch.arange(len(cloud.means))))
        self.register_buffer("moving", moving, persistent=False)
        nearest = nearest_neighbours(cloud.means[simulated].double(), 1, cloud.means[carried].double())[1][:, 0]
        anchor = torch.cat([torch.arange(len(simulated)), nearest])  # the simulated Gaussian that is followed
        self.register_buffer("owner", owner[anchor], persistent=False)
        self.further = len(source) - len(simulated)
        self.tracked = len(source) if by_grid else self.points.count
        place = samples.position[: len(source)]
        own = self.frame.point_to_sim(cloud.means[moving].double())
        if by_grid:
            read = on_material(place, owner[: len(source)], self.points, dx)
            self.follow: Followers = GridFollowers(read[anchor].to(dtype), _arm(own - read[anchor], dtype))
            self.track: GridFollowers | None = GridFollowers(read.to(dtype), _arm(place - read, dtype))
        else:
            self.follow = PointFollowers(anchor, _arm(own - place[anchor], dtype), self.points.position)
            self.track = None
        facing = self.frame.direction_to_sim(normals[moving].double()).to(normals.dtype)
        self.register_buffer("rest_facing", facing, persistent=False)
        felt = area[anchor] > 0
        self.register_buffer("in_wind", felt, persistent=False)
        self.register_buffer("identity", torch.eye(3, dtype=cloud.means.dtype), persistent=False)
        self.simulated: Tensor
        self.carried: Tensor
        self.owner: Tensor
        self.in_wind: Tensor
        self.rest_covariances: Tensor
        self.rest_normals: Tensor
        self.moving: Tensor
        self.rest_facing: Tensor
        self.identity: Tensor

    def _apply(self, fn, recurse: bool = True) -> SimulatedScene:  # type: ignore[no-untyped-def] # noqa: ANN001
        super()._apply(fn, recurse)
        self.points = self.points.map(fn)
        if self.surface_places is not None:
            self.surface_places = self.surface_places.map(fn)
        return self

    def take_contact(self, contact: Contact | None, obstacles: Sequence[Obstacle]) -> None:
        """Make the contact samples, and give obstacles of Gaussians those that stand still.

        Args:
            contact: Contact of the surface with itself; None for none.
            obstacles: Obstacles of the solver.
        """
        samples, self._samples = self._samples, None
        if samples is None or (contact is None and not obstacles):
            return
        self.surface_places = surface_of(samples, self._near, self.points, self._dx, contact)
        for obstacle in obstacles:
            if isinstance(obstacle, StillGaussians):
                low, high = self._box(obstacle.margin)
                still = torch.ones(len(self.model.means), dtype=torch.bool)
                still[self.moving] = False
                means = self.frame.point_to_sim(self.model.means.detach()[still].double())
                shape = self.frame.covariance_to_sim(self.rest_covariances[still].double())
                opacity = self.model.opacity().detach()[still]
                obstacle.take(still_distance(means, shape, opacity, low, high, obstacle.cells, obstacle.level))

    def _box(self, margin: float) -> tuple[Tensor, Tensor]:
        """Corners [m] of a box around the points at rest, with a margin in lengths of its longest side."""
        position = self.points.position.double()
        low, high = position.amin(0), position.amax(0)
        more = margin * float((high - low).amax())
        return low - more, high + more

    @property
    def center(self) -> Tensor:
        """Centre of the simulated part at rest, scene units, shape (3,)."""
        return self.frame.origin

    def hull_area(self) -> float:
        """Area of the convex hull of the simulated Gaussians at rest [m²]; that of a flat sheet has two sides."""
        return hull_area(self.model.means[self.simulated]) * self.frame.metres_per_unit**2

    def rest(self) -> DeformedGaussians:
        """The Gaussians at rest."""
        means = self.model.means.detach()
        eye = self.identity.expand(len(means), 3, 3)
        return DeformedGaussians(means, self.rest_covariances, self.rest_normals, eye, model=self.model)

    def deformed(self, state: MPMState, rotations: bool = True) -> DeformedGaussians:
        """The Gaussians moved by the material: x, F A Fᵀ, F⁻ᵀN (paper, "Surface Formulation").

        If the scene has a ``max_stretch``, it limits the covariances.

        Args:
            state: State of one scene, fields of shape (P, ·).
            rotations: Whether to compute the rotations; otherwise they are those at rest, which is enough for colours
                that are the same from every direction.

        Returns:
            All Gaussians, the static ones at rest.
        """
        rest, index = self.rest(), self.moving
        own = rest.means, rest.covariances, rest.normals
        if not self.all_move:
            own = rest.means[index], rest.covariances[index], rest.normals[index]
        solid = None if self.max_stretch is None else self.solid()
        moved = None
        if isinstance(self.follow, GridFollowers):
            moved = self.follow.drawn(state, self.frame, *own, rotations, self.max_stretch, solid)
        if moved is None:
            kind = rest.means.dtype
            move, F = self.follow.motion(state)
            move, F = self.frame.displacement_to_scene(move.to(kind)), self.frame.gradient_to_scene(F.to(kind))
            moved = own[0] + move, *deform_all(F, *own[1:], rotations, self.max_stretch, solid)
        means, covariances, normals, turns = moved
        parts: dict[str, Any] = {"means": means, "covariances": covariances, "normals": normals}
        parts |= {} if turns is None else {"rotations": turns}
        if not self.all_move:
            parts = {name: getattr(rest, name).index_copy(0, index, part) for name, part in parts.items()}
        return replace(rest, **parts)

    def surface(self, state: MPMState) -> tuple[Tensor, Tensor]:
        """Position [m], shape (S, 3), and F, shape (S, 3, 3), of the points that a trajectory records.

        These are all particles, or with ``points: grid`` the simulated Gaussians and their extra points.
        """
        if self.track is None:
            return state.position, state.F_total
        move, F = self.track.motion(state)
        rest = self.track.place if self.track.arm is None else self.track.place + self.track.arm
        return rest + move, F

    def solid(self) -> Tensor:
        """Return a mask (M,) of the moving Gaussians that keep their shape, as their law has no return map."""
        if self._kept is None or self._kept[0] is not self.points:  # an edit replaces the points
            laws, index = self.points.laws, self.points.law_index
            with torch.inference_mode(False):  # it outlives the call
                solid = torch.tensor([not law.plastic for law in laws], device=self.simulated.device)
                own = solid[:1].expand(self.points.count) if index is None else solid[index]
                self._kept = (self.points, own[self.owner])
        return self._kept[1]

    def on_gaussians(self, values: Tensor) -> Tensor:
        """Values of the moving Gaussians (M,) for all of them (N,); the static ones get 0."""
        own = values.to(self.model.means.dtype)
        return own.new_zeros(len(self.model.means)).index_copy(0, self.moving, own)


def _arm(arm: Tensor, dtype: torch.dtype) -> Tensor | None:
    """Arms in the precision of the solver; None if all are zero."""
    return arm.to(dtype) if bool(arm.any()) else None


def _pieces(cloud: GaussianCloud, simulated: Tensor, spacing: float | None, hole: float) -> Subdivision | None:
    """Return extra points on large simulated Gaussians, no farther apart than a spacing [scene units].

    Only those farther than ``hole`` from all Gaussians [scene units]; None if there are none.
    """
    if spacing is None:
        return None
    part = cloud.select(simulated)
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
    shape = means[group], normals[source[group]], log_scales[group]
    found = coverage_area(*shape, opacity[group])
    if mode == "open":
        return found * openness(*shape, found, opacity[group])
    return found.mean().expand(len(found)) if mode == "equal" and len(found) else found


def within_region(filling: Filling, region: Region, frame: SimFrame) -> Filling:
    """A filling without the points outside a region given in scene units."""
    inside = region.contains(frame.point_to_scene(filling.position))
    return replace(filling, position=filling.position[inside], volume=filling.volume[inside])
