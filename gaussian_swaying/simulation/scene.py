"""The scene of a run: which Gaussians move, what they are made of, and how they follow the material."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_poisson_ratio, check_positive, check_vector
from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.compact import read_gaussians
from gaussian_swaying.gaussians.filling import Filling, InteriorFilling
from gaussian_swaying.gaussians.grouping import blend_weights, group_points, loose_points
from gaussian_swaying.gaussians.model import DeformedGaussians, GaussianSurfaceModel
from gaussian_swaying.gaussians.selection import select_simulated
from gaussian_swaying.gaussians.subdivision import Subdivision, subdivide
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.patches import deform_all
from gaussian_swaying.geometry.regions import Everything, Region
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.scenes.procedural import ProceduralScene
from gaussian_swaying.simulation.extent import check_extent


@dataclass
class MaterialRegion:
    """Different material in a part of the object.

    Args:
        region: Where, in scene units.
        E: Young's modulus [Pa]; unchanged if null.
        nu: Poisson's ratio; unchanged if null.
        density: Density [kg/m³]; unchanged if null.
        thickness: Thickness of the surface [m]; unchanged if null.
        law: Constitutive law; unchanged if null.
    """

    region: Region
    E: float | None = None
    nu: float | None = None
    density: float | None = None
    thickness: float | None = None
    law: ConstitutiveLaw | None = None


@dataclass
class Material:
    """What the object is made of.

    Args:
        E: Young's modulus [Pa].
        nu: Poisson's ratio, below 0.5.
        density: Density [kg/m³].
        thickness: Thickness of the surface [m]; a patch has volume = area x thickness.
        volume: ``patch`` (area x thickness, and the volume of the solid where ``scene.filling`` finds one) or ``cell``
            (PhysGaussian's rule for solids: cell volume / particles in it).
        law: Constitutive law, for example ``Sand`` (see :data:`gaussian_swaying.mpm.laws.LAWS`); fixed corotated
            elasticity if null. Plastic laws need ``solver.formulation: updated``.
        regions: Parts with a different material; later entries win.
    """

    E: float = 1e5
    nu: float = 0.3
    density: float = 200.0
    thickness: float = 0.01
    volume: str = "patch"
    law: ConstitutiveLaw | None = None
    regions: list[MaterialRegion] = field(default_factory=list)

    def __post_init__(self) -> None:
        check_choice("material.volume", self.volume, ("patch", "cell"))
        entries: list[Material | MaterialRegion] = [self, *self.regions]
        for entry in entries:
            for name in ("E", "density", "thickness"):
                if getattr(entry, name) is not None:
                    check_positive(f"material.{name}", getattr(entry, name))
            if entry.nu is not None:
                check_poisson_ratio("material.nu", entry.nu)


class Scene:
    """Where the Gaussians come from and which of them are simulated.

    Args:
        ply: A 3DGS .ply, a compressed .ply or a .splat; takes precedence over ``generator``.
        generator: A scene made in code.
        region: Part that is simulated, in scene units; the rest does not move and is rendered as well.
        opacity_threshold: Gaussians in the region below this opacity carry no mass and feel no wind.
        faint: What happens to Gaussians below that opacity: ``carry`` (they follow their nearest simulated neighbour),
            ``static`` or ``drop``.
        loose: What happens to specks that are not connected to the object, or only by a thin thread (see
            :func:`~gaussian_swaying.gaussians.grouping.loose_points`): ``simulate`` (like all others, so the wind blows
            them away) or ``carry`` (no mass, no wind; they follow their nearest simulated neighbour).
        up: Direction in the scene that points up, for example [0, -1, 0].
        longest_side: Longest side of the simulated part [m] (PhysGaussian normalises to 1). Cannot be combined with
            metres_per_unit.
        metres_per_unit: Length of a scene unit [m]; 1 if neither is given.
        area: Patch area: ``coverage`` (independent of how many Gaussians carry the surface), ``paper`` (pi s1 s2), or
            ``equal`` (the same area for all, with the total of ``coverage``; for comparison with a wind that does not
            use patches).
        filling: Fills the inside of a solid with points that carry mass and feel no wind; null for a shell.
        wind_on: Which simulated Gaussians feel the wind: ``surface`` (those in contact with open air) or ``all`` (also
            those inside the solid that ``filling`` finds). Without ``filling``, all are on the surface.
        max_stretch: Largest size at which a Gaussian is drawn, as a multiple of its size at rest (see
            :func:`~gaussian_swaying.geometry.covariances.limit_deformed`), in pictures and exports; null for no limit.
            Nothing changes below the limit. Above it a Gaussian would look like a streak: two parts of the object that
            share cells of the grid were pulled apart, or a material flowed.
        layers: Layers of material points through the thickness: 1 is a membrane that folds without resistance; 3
            resists bending like a plate (the Gaussians in the middle plane, two more points at the faces of the sheet,
            weights of Simpson's rule) and needs three times the points.
        particle_spacing: Largest distance between neighbouring material points on the surface [m]. Larger Gaussians get
            extra points (see :func:`~gaussian_swaying.gaussians.subdivision.subdivide`). A splat trained without a
            limit on sizes needs this: use 0.45 ``solver.dx`` or less. Null for one point per Gaussian.
        sampling: Which points carry the material: ``gaussian`` (every simulated Gaussian), or ``grid`` (one point for
            each cube of side ``solver.dx`` / 2.2, with the total mass and area of the Gaussians in it; the other
            Gaussians follow the points around them). ``grid`` is many times faster where the splat is much finer than
            the grid.
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
        area: str = "coverage",
        filling: InteriorFilling | None = None,
        wind_on: str = "surface",
        max_stretch: float | None = 2.0,
        layers: int = 1,
        particle_spacing: float | None = None,
        sampling: str = "gaussian",
        loose: str = "simulate",
    ) -> None:
        check_choice("scene.sampling", sampling, ("gaussian", "grid"))
        check_choice("scene.faint", faint, ("carry", "static", "drop"))
        check_choice("scene.loose", loose, ("simulate", "carry"))
        check_choice("scene.wind_on", wind_on, ("surface", "all"))
        check_choice("scene.area", area, ("coverage", "paper", "equal"))
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
        if sampling == "grid" and filling is not None:
            raise ValueError('Expected `scene.sampling` "gaussian" with `scene.filling`, which chooses points itself.')
        if ply is None and generator is None:
            raise ValueError("The scene is empty: give `scene.ply` (a 3DGS .ply file) or `scene.generator`.")
        self.ply, self.generator, self.region = ply, generator, region or Everything()
        self.opacity_threshold, self.faint, self.up = float(opacity_threshold), faint, list(up)
        self.longest_side, self.metres_per_unit, self.area = longest_side, metres_per_unit, area
        self.filling, self.wind_on = filling, wind_on
        self.max_stretch = None if max_stretch is None else float(max_stretch)
        self.layers, self.particle_spacing, self.sampling, self.loose = layers, particle_spacing, sampling, loose

    def cloud(self) -> GaussianCloud:
        """Read the file or run the generator."""
        if self.ply is not None:
            return read_gaussians(self.ply)
        assert self.generator is not None
        return self.generator.generate()


POINTS_PER_CELL = 2.2  # per direction, for ``sampling: grid``; more is finer than the grid can resolve
FOLLOWED = 6  # number of points that a Gaussian without its own point follows
_SIMPSON = (2 / 3, 1 / 6, 1 / 6)  # middle plane and faces of a sheet: exact for the square of the height


class SimulatedScene(nn.Module):
    """Gaussians, material points and patches of one scene, and how the Gaussians follow the points.

    There are three kinds of Gaussians: simulated ones are material points themselves, carried ones follow the nearest
    simulated one (with ``sampling: grid`` the nearest few), and static ones do not move. The points that fill a solid,
    and those at the faces of a sheet of three layers, are material only: no Gaussian belongs to them, and their patch
    area is zero. The extra points of large Gaussians (``particle_spacing``) are separate patches, but no Gaussian is
    drawn at them.

    Args:
        scene: Where the Gaussians come from.
        material: What they are made of.
        dx: Grid spacing [m], for ``material.volume = "cell"``, as twice the spacing of ``scene.filling``, and for
            ``scene.sampling`` and ``scene.loose``.
        dtype: Precision of the simulation.
        cloud: The Gaussians of the scene, if they have been read already.

    Attributes:
        chosen: Indices of the Gaussians selected by region and opacity, without loose ones. With ``sampling: gaussian``
            all of them are simulated; with ``grid`` some are simulated and the others are carried.
        loose: Number of Gaussians selected by region and opacity that are loose and therefore carried.
        points: The material, for the solver: the simulated Gaussians in their order, then the points without a
            Gaussian.
        filled: Number of points inside a solid.
        on_surface: Number of points on the surface. They come first: the simulated Gaussians, then the extra points of
            large ones.
        patch_normal: Unit normals of the points at rest in the z-up frame, shape (P, 3).
        patch_area: Areas of the points that feel the wind [m²], shape (P,).
        frame: Conversion from scene units to metres.
        bounds: Smallest and largest corner of the simulated part at rest [scene units].
        size: Its longest side [scene units].
        moving: Indices of the Gaussians that move, first the simulated and then the carried ones, shape (M,).
        all_move: Whether ``moving`` is all Gaussians, in their order.
        rest_facing: Normals at rest of the Gaussians that move, in the z-up frame, shape (M, 3).
        source: The .ply file; None for a scene made in code.
    """

    def __init__(
        self,
        scene: Scene,
        material: Material,
        dx: float,
        dtype: torch.dtype = torch.float32,
        cloud: GaussianCloud | None = None,
    ) -> None:
        super().__init__()
        cloud = scene.cloud() if cloud is None else cloud
        self.source = scene.ply
        opacity = torch.sigmoid(cloud.opacities)
        chosen = select_simulated(cloud.means, opacity, scene.region, scene.opacity_threshold)
        faint = scene.region.contains(cloud.means) & ~chosen
        if scene.faint == "drop" and bool(faint.any()):
            cloud, chosen, faint = cloud.select(~faint), chosen[~faint], faint[~faint]
        self.model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
        simulated = chosen.nonzero()[:, 0]
        self.frame = SimFrame.fit(cloud.means[simulated], scene.up, scene.longest_side, scene.metres_per_unit)
        means = cloud.means[simulated]
        check_extent(means, self.frame.metres_per_unit, dx, simulated)
        self.bounds = (means.amin(0), means.amax(0))
        largest = cloud.scales[simulated].amax().exp()  # a single Gaussian has a size too
        self.size = max(float((self.bounds[1] - self.bounds[0]).amax()), float(largest))
        piece_spacing = None if scene.particle_spacing is None else scene.particle_spacing / self.frame.metres_per_unit
        pieces = _pieces(cloud, simulated, piece_spacing)
        carried = faint if scene.faint == "carry" else torch.zeros_like(faint)
        self.loose = 0
        if scene.loose == "carry":
            where = means if pieces is None else torch.cat([means, pieces.means.to(means)])
            side = dx / POINTS_PER_CELL / self.frame.metres_per_unit
            specks = simulated[loose_points(where, side)[: len(means)]]
            self.loose = len(specks)
            if self.loose:
                chosen[specks], carried[specks] = False, True
                simulated = chosen.nonzero()[:, 0]
                pieces = _pieces(cloud, simulated, piece_spacing)
        normals = self.model.normals()
        position = self.frame.point_to_sim(cloud.means[simulated].double())
        filling = None
        if scene.filling is not None:
            shape = self.frame.covariance_to_sim(self.model.covariance()[simulated].double())
            visible = self.model.opacity()[simulated]
            filling = within_region(scene.filling.fill(position, shape, visible, 0.5 * dx), scene.region, self.frame)
        self.filled = 0 if filling is None else len(filling.position)
        if pieces is not None:
            position = torch.cat([position, self.frame.point_to_sim(pieces.means.double())])
        source = torch.arange(len(simulated))  # the simulated Gaussian of each point on the surface
        source = source if pieces is None else torch.cat([source, pieces.parent])
        self.on_surface = len(source)
        outer = torch.ones(len(source), dtype=torch.bool) if filling is None else filling.on_surface
        areas = cloud.means.new_zeros(len(source))
        for group in (outer, ~outer):  # inner points take no area from the surface
            areas[group] = _areas(cloud.select(simulated), normals[simulated], source, pieces, group, scene.area)
        self.max_stretch = scene.max_stretch
        followed = 1
        if scene.sampling == "grid":
            kept, group = group_points(position, areas, dx / POINTS_PER_CELL, preferred=len(simulated))
            areas = areas.new_zeros(len(kept)).index_add_(0, group, areas)
            position, normal_of = position[kept], simulated[source[kept]]
            followed, carried = FOLLOWED, carried | chosen
            simulated = simulated[kept[kept < len(simulated)]]
            carried[simulated] = False
            self.on_surface, outer = len(kept), outer[kept]
        else:
            normal_of = simulated[source]
        carried = carried.nonzero()[:, 0]
        self.register_buffer("chosen", chosen.nonzero()[:, 0], persistent=False)
        self._kept: tuple[MaterialPoints, Tensor] | None = None
        self.register_buffer("simulated", simulated)
        self.register_buffer("carried", carried)
        anchor, share = blend_weights(cloud.means[simulated], cloud.means[carried], followed)
        self.register_buffer("anchor", anchor)
        self.register_buffer("share", share.to(cloud.means.dtype), persistent=False)
        self.register_buffer("rest_covariances", self.model.covariance())
        self.register_buffer("rest_normals", normals)
        facing = self.frame.direction_to_sim(normals[normal_of].double())
        area = self.frame.area_to_sim(areas)
        body_area, area = area, area if scene.wind_on == "all" else torch.where(outer, area, 0)
        if filling is not None:  # a filled point is a patch of zero area
            position = torch.cat([position, filling.position])
            facing = torch.cat([facing, torch.tensor([[0.0, 0.0, 1.0]]).to(facing).expand(self.filled, 3)])
            body_area, area = (torch.cat([part, part.new_zeros(self.filled)]) for part in (body_area, area))
        self.register_buffer("patch_normal", facing.to(dtype))
        self.register_buffer("patch_area", area.to(dtype))
        # computed once here, as every picture needs it
        moving = torch.cat([simulated, carried])
        self.all_move = bool(moving.equal(torch.arange(len(cloud.means))))
        self.register_buffer("moving", moving, persistent=False)
        arm = cloud.means[carried][:, None] - cloud.means[simulated[self.anchor]]
        self.register_buffer("arm", arm, persistent=False)
        facing = self.frame.direction_to_sim(normals[moving].double()).to(normals.dtype)
        self.register_buffer("rest_facing", facing, persistent=False)
        self.register_buffer("identity", torch.eye(3, dtype=cloud.means.dtype), persistent=False)
        self.chosen: Tensor
        self.simulated: Tensor
        self.carried: Tensor
        self.anchor: Tensor
        self.share: Tensor
        self.rest_covariances: Tensor
        self.rest_normals: Tensor
        self.patch_normal: Tensor
        self.patch_area: Tensor
        self.moving: Tensor
        self.arm: Tensor
        self.rest_facing: Tensor
        self.identity: Tensor
        count = len(position)
        where = cloud.means[simulated]
        if filling is not None or pieces is not None:
            further = self.frame.point_to_scene(position[len(simulated) :])
            where = torch.cat([where, further.to(where.dtype)])
        fields = {name: torch.full((count,), getattr(material, name), dtype=dtype) for name in _MATERIAL_FIELDS}
        laws, law_index = [material.law or FixedCorotated()], torch.zeros(count, dtype=torch.long)
        for entry in material.regions:
            inside = entry.region.contains(where)
            if not bool(inside.any()):
                low, high = entry.region.bounds(where)
                raise ValueError(
                    f"The region {entry.region!r} of `material.regions` holds no simulated Gaussian: they lie between "
                    f"{low} and {high}{entry.region.axes}; move or enlarge it."
                )
            for name in _MATERIAL_FIELDS:
                if getattr(entry, name) is not None:
                    fields[name][inside] = getattr(entry, name)
            if entry.law is not None:
                law_index[inside] = len(laws)
                laws.append(entry.law)
        if material.volume == "patch":
            volume = body_area.to(dtype) * fields["thickness"]
            if filling is not None:
                solid = torch.cat([filling.gaussian_volume, filling.volume]).to(dtype)
                volume = torch.where(solid > 0, solid, volume)
        else:
            volume = cell_volume(position, dx).to(dtype)
        if scene.layers == 3:
            if material.volume != "patch":
                raise ValueError('Expected `material.volume` "patch" with `scene.layers` 3: layers share a thickness.')
            out = 0.5 * (fields["thickness"][:, None] * self.patch_normal).to(position)
            position = torch.cat([position, position + out, position - out])
            volume = torch.cat([part * volume for part in _SIMPSON])
            fields = {name: value.repeat(3) for name, value in fields.items()}
            law_index = law_index.repeat(3)
            self.patch_normal = torch.cat([self.patch_normal] * 3)
            self.patch_area = torch.cat([self.patch_area, self.patch_area.new_zeros(2 * count)])
        self.points = MaterialPoints.create(
            position.to(dtype),
            volume=volume,
            density=fields["density"],
            youngs_modulus=fields["E"],
            poisson_ratio=fields["nu"],
            law=laws,
            law_index=law_index if len(laws) > 1 else None,
        )

    def _apply(self, fn, recurse: bool = True) -> SimulatedScene:  # type: ignore[no-untyped-def] # noqa: ANN001
        super()._apply(fn, recurse)
        self.points = self.points.map(fn)
        return self

    @property
    def center(self) -> Tensor:
        """Centre of the simulated part at rest, scene units, shape (3,)."""
        return self.frame.origin

    def rest(self) -> DeformedGaussians:
        """The Gaussians at rest."""
        means = self.model.means.detach()
        eye = self.identity.expand(len(means), 3, 3)
        return DeformedGaussians(means, self.rest_covariances, self.rest_normals, eye)

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
        rest = self.rest()
        kind = rest.means.dtype
        count = len(self.simulated)  # the points after them are not drawn
        move = self.frame.displacement_to_scene((state.position - self.points.position)[:count].to(kind))
        F = self.frame.gradient_to_scene(state.F_total[:count].to(kind))
        if len(self.carried):
            near = F[self.anchor]
            turned = (near * self.arm[..., None, :]).sum(-1) - self.arm  # a difference, so that nothing moves at rest
            along = self._blend(move[self.anchor] + turned)
            move, F = torch.cat([move, along]), torch.cat([F, self._blend(near)])
        if self.all_move:
            covariances, normals, turns = self._deform(F, rest.covariances, rest.normals, rotations)
            return DeformedGaussians(
                rest.means + move, covariances, normals, rest.rotations if turns is None else turns
            )
        index = self.moving
        covariances, normals, turns = self._deform(F, rest.covariances[index], rest.normals[index], rotations)
        return DeformedGaussians(
            rest.means.index_add(0, index, move),
            rest.covariances.index_copy(0, index, covariances),
            rest.normals.index_copy(0, index, normals),
            rest.rotations if turns is None else rest.rotations.index_copy(0, index, turns),
        )

    def _deform(
        self, F: Tensor, covariances: Tensor, normals: Tensor, rotations: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """``deform_all`` with the limit of the scene."""
        solid = None if self.max_stretch is None else self._solid()
        return deform_all(F, covariances, normals, rotations, self.max_stretch, solid)

    def _solid(self) -> Tensor:
        """Which moving Gaussians keep their shape because their law has no return map; bool, shape (M,)."""
        if self._kept is None or self._kept[0] is not self.points:  # an edit replaces the points
            laws, index = self.points.laws, self.points.law_index
            with torch.inference_mode(False):  # it outlives the call
                solid = torch.tensor([not law.plastic for law in laws], device=self.simulated.device)
                count = len(self.simulated)
                own = solid[:1].expand(count) if index is None else solid[index[:count]]
                self._kept = (self.points, torch.cat([own, own[self.anchor[:, 0]]]))
        return self._kept[1]

    def _blend(self, values: Tensor) -> Tensor:
        """Blend the values (C, K, ...) of the points that each carried Gaussian follows into one, shape (C, ...)."""
        if values.shape[1] == 1:
            return values[:, 0]
        return (values * self.share.reshape(self.share.shape + (1,) * (values.ndim - 2))).sum(1)

    def on_gaussians(self, values: Tensor) -> Tensor:
        """Particle values for all Gaussians: carried ones take the values of their neighbours, static ones get 0.

        Args:
            values: One number per particle, shape (P,).

        Returns:
            Shape (N,), in the precision of the Gaussians.
        """
        own = values[: len(self.simulated)].to(self.model.means.dtype)
        found = own.new_zeros(len(self.model.means))
        return found.index_copy(0, self.moving, torch.cat([own, self._blend(own[self.anchor])]))


def _pieces(cloud: GaussianCloud, simulated: Tensor, spacing: float | None) -> Subdivision | None:
    """Extra points on large simulated Gaussians, no farther apart than a spacing [scene units]."""
    if spacing is None:
        return None
    part = cloud.select(simulated)
    return subdivide(part.means, part.quats, part.scales, torch.sigmoid(part.opacities), spacing)


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
    found = coverage_area(means[group], normals[source[group]], log_scales[group], opacity[group])
    return found.mean().expand(len(found)) if mode == "equal" and len(found) else found


_MATERIAL_FIELDS = ("E", "nu", "density", "thickness")


def within_region(filling: Filling, region: Region, frame: SimFrame) -> Filling:
    """A filling without the points outside a region given in scene units."""
    inside = region.contains(frame.point_to_scene(filling.position))
    return replace(filling, position=filling.position[inside], volume=filling.volume[inside])


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
