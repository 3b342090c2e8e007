"""The body of a simulation: settings of scene and material, samples, groups, points, and how Gaussians follow them."""

from __future__ import annotations

import dataclasses
import math
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from gaussian_swaying._arguments import shown
from gaussian_swaying._checks import (
    Number,
    check_plain,
    check_poisson_ratio,
    check_positive,
    check_vector,
    number_of,
    requires_grad,
)
from gaussian_swaying._fixed import Fixed, FixedList, changed, fixed
from gaussian_swaying._live import SAME, SIZE, TOGETHER, live_numbers
from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.connectivity import attached_pairs
from gaussian_swaying.gaussians.filling import Filling, InteriorFilling, density_grid
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.grouping import grid_groups, loose_points
from gaussian_swaying.gaussians.material_fields import MaterialField, MaterialFile, MaterialSource
from gaussian_swaying.gaussians.model import DeformedGaussians, GaussianSurfaceModel
from gaussian_swaying.gaussians.openness import openness
from gaussian_swaying.gaussians.parts import NUMBERS, PartRegion, Parts
from gaussian_swaying.gaussians.selection import select_simulated
from gaussian_swaying.gaussians.subdivision import Subdivision, subdivide
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.directions import hull_area
from gaussian_swaying.geometry.distance import DistanceGrid
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.groups import equal_rows, joined, once, sums
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.origin import counted_from
from gaussian_swaying.geometry.patches import deform_all
from gaussian_swaying.geometry.regions import Everything, Region, StillGaussians, whereabouts
from gaussian_swaying.geometry.surface_normals import neighbour_normals
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.contact import Contact, Surface
from gaussian_swaying.mpm.damping import decay_rate
from gaussian_swaying.mpm.embedded import EmbeddedAtPoints, EmbeddedInGrid, EmbeddedPoints, on_material
from gaussian_swaying.mpm.joints import PointJoint
from gaussian_swaying.mpm.laws.elastic import FixedCorotated
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.mpm.pins import PinnedRegion, RigidRegion
from gaussian_swaying.mpm.protocol import Solver
from gaussian_swaying.mpm.state import MaterialPoints, State, bounding_grid
from gaussian_swaying.mpm.timestep import wave_speed
from gaussian_swaying.mpm.virtual_nodes import first_nodes, virtual_nodes
from gaussian_swaying.scenes.procedural import ProceduralScene
from gaussian_swaying.wind.patches import Patches, joined_directions, second_moments

if TYPE_CHECKING:
    PartsLike = str | os.PathLike[str] | Parts
    MaterialsLike = MaterialSource | str | os.PathLike[str]  # a parser takes the first that fits
else:  # what a YAML file can contain
    PartsLike = str | os.PathLike[str]
    MaterialsLike = MaterialSource | str


class Scene(Fixed):
    """The source of the Gaussians, and the choice of those that are simulated.

    Args:
        ply: A splat in any format that can be read (3DGS or compressed .ply, .splat, .spz, SOG, glTF); takes precedence
            over ``generator``.
        generator: A scene made in code.
        region: Part that is simulated, in scene units; the rest does not move and is rendered as well.
        parts: Which part each Gaussian belongs to, and whether a part is soft, held or still (``parts.npz``, see
            :mod:`~gaussian_swaying.gaussians.parts`); in Python also :class:`~gaussian_swaying.gaussians.parts.Parts`.
            Null for one soft part.
        materials: A material for each Gaussian: an .npz file, or a
            :class:`~gaussian_swaying.gaussians.material_fields.MaterialFile` with a largest E. Parts and
            ``material.regions`` win over it. Null for the one of ``material``.
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
            :func:`~gaussian_swaying.geometry.patches.deform_all`), in pictures and exports; null for no limit.
            Nothing changes below the limit. Above it a Gaussian would look like a streak: two parts of the object that
            share cells of the grid were pulled apart, or a material flowed.
        layers: Layers of material points through the thickness: 1 is a membrane that folds without resistance, or with
            ``material.bending`` a sheet that bends; 3 resists bending like a plate (the Gaussians in the middle plane,
            two more points at the faces of the sheet, weights of Simpson's rule) and needs three times the points.
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
            moments of a group too (see :func:`~gaussian_swaying.simulation.body.matched_points`), so 2 is more
            accurate than 3.
        connected: What shares nodes of the grid: ``grid``, all that lies within a cell, or ``surface``, only what is
            connected along the surface (see :func:`~gaussian_swaying.gaussians.connectivity.attached_pairs`), so that
            leaves closer than a cell move apart. ``surface`` needs ``solver.formulation: total``.
        normals: Normals of the patches: ``smallest_axis`` of each Gaussian, as in the paper, or ``neighbours``, of
            smooth surfaces through neighbouring centres (see
            :func:`~gaussian_swaying.geometry.surface_normals.neighbour_normals`), which are better where Gaussians
            have good positions but bad orientations.
    """

    live_as = "scene"

    def __init__(
        self,
        ply: str | os.PathLike[str] | None = None,
        generator: ProceduralScene | None = None,
        *,
        region: Region | None = None,
        parts: PartsLike | None = None,
        materials: MaterialsLike | None = None,
        opacity_threshold: float = 0.1,
        faint: Literal["carry", "static", "drop"] = "carry",
        up: list[float] = [0.0, 0.0, 1.0],  # noqa: B006  (never changed; the schema of the config shows it)
        longest_side: float | None = None,
        metres_per_unit: float | None = None,
        area: Literal["coverage", "open", "paper", "equal"] | None = None,
        filling: InteriorFilling | None = None,
        wind_on: Literal["surface", "all"] = "surface",
        max_stretch: float | None = 2.0,
        layers: int = 1,
        particle_spacing: float | None = None,
        points: Literal["gaussian", "grid"] | None = None,
        points_per_cell: int = 2,
        loose: Literal["simulate", "carry"] = "simulate",
        connected: Literal["grid", "surface"] = "grid",
        normals: Literal["smallest_axis", "neighbours"] = "smallest_axis",
    ) -> None:
        if points_per_cell not in range(1, 9):
            raise ValueError(
                f"Expected `scene.points_per_cell` to be a whole number from 1 to 8, but got {points_per_cell}."
            )
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
        if connected == "surface" and filling is not None:
            raise ValueError("Expected `scene.connected` grid with `scene.filling`: what fills a solid has no surface.")
        self.connected = connected
        self.ply, self.generator, self.region = ply, generator, region or Everything()
        self.parts = Parts.load(parts) if isinstance(parts, str | os.PathLike) else parts
        if not isinstance(self.parts, Parts | None):
            raise TypeError(f"Expected `scene.parts` to be Parts or a file, but got {shown(parts)}.")
        alone = connected != "surface" and self.parts is not None and self.parts.attached_to() is not None
        if alone:
            raise ValueError(
                "A part of `scene.parts` is `attached` to one other, which has no effect with `scene.connected: grid`: "
                "set that to surface, or remove `attached`."
            )
        if isinstance(materials, str | os.PathLike):
            if not os.fspath(materials).endswith(".npz"):
                raise ValueError(
                    "Expected `scene.materials` to be an .npz file, or `class_path` and `init_args` of a "
                    f"MaterialSource that can be imported, but got {shown(materials)}."
                )
            materials = MaterialFile(materials)
        self.materials = materials
        self.opacity_threshold, self.faint, self.up = float(opacity_threshold), faint, list(up)
        self.longest_side, self.metres_per_unit, self.area = longest_side, metres_per_unit, area
        self.filling, self.wind_on = filling, wind_on
        self.max_stretch = None if max_stretch is None else float(max_stretch)
        self.layers, self.particle_spacing, self.loose = layers, particle_spacing, loose
        self.points, self.points_per_cell, self.normals = points, int(points_per_cell), normals

    @property
    def area_kind(self) -> str:
        """``area``, or the default for this scene."""
        if self.area is not None:
            return self.area
        return "open" if self.ply is not None and self.wind_on == "surface" else "coverage"

    def cloud(self) -> GaussianCloud:
        """Read the file or run the generator."""
        if self.ply is not None:
            return read_gaussians(self.ply)
        assert self.generator is not None
        return self.generator.generate()

    def select(self, cloud: GaussianCloud) -> Tensor:
        """Mask of the simulated Gaussians: in the region, opaque enough, and in no still or hidden part.

        Args:
            cloud: All Gaussians.

        Returns:
            Booleans, shape (N,).

        Raises:
            ValueError: If there are none, or ``parts`` are those of another splat.
        """
        opacity = torch.sigmoid(cloud.opacities)
        try:
            chosen = select_simulated(cloud.means, opacity, self.region, self.opacity_threshold, self.up)
        except ValueError as error:
            if any(cloud.origin):
                raise ValueError(f"{str(error)[:-1]}; {counted_from(cloud.origin)}.") from error
            raise
        if self.parts is None:
            return chosen
        self.parts.check_count(len(cloud.means))
        left = chosen & ~self.parts.mask(role="still") & ~self.parts.mask(role="hidden")
        if not bool((left & ~self.parts.mask(role="held")).any()):
            raise ValueError(
                f"Nothing is left to move: all simulated Gaussians belong to parts of `scene.parts` that are still, "
                f"held or hidden, {self.parts!r}. Make one of them soft, or change `scene.region`."
            )
        return left


@fixed
@dataclass
class MaterialRegion:
    """Different material in a part of the object.

    Args:
        region: Where, in scene units.
        E: Young's modulus [Pa]; unchanged if null.
        nu: Poisson's ratio; unchanged if null.
        density: Density [kg/m³]; unchanged if null.
        thickness: Thickness of the surface [m]; unchanged if null.
        bending: Bending stiffness [N m]; unchanged if null.
        damping_ratio: Damping ratio at 1 Hz; unchanged if null.
        law: Constitutive law; unchanged if null.
    """

    region: Region
    E: float | None = None
    nu: float | None = None
    density: float | None = None
    thickness: float | None = None
    bending: float | Literal["plate"] | None = None
    damping_ratio: float | None = None
    law: ConstitutiveLaw | None = None


@fixed
@dataclass
class Material:
    """The material of the object.

    Args:
        E: Young's modulus [Pa].
        nu: Poisson's ratio, below 0.5.
        density: Density [kg/m³].
        thickness: Thickness of the surface [m]; a patch has volume = area x thickness.
        volume: ``patch`` (area x thickness, and the volume of the solid where ``scene.filling`` finds one) or ``cell``
            (PhysGaussian's rule for solids: cell volume / particles in it; with ``scene.layers`` 3 the layers share it,
            and ``thickness`` only says how far apart they lie).
        bending: Bending stiffness of a sheet, to a unit of its width [N m]: D of a fabric, whatever its stiffness
            against stretch, or ``plate`` for E thickness³ / (12 (1 - nu²)). With null a sheet of one layer is a
            membrane, which folds without resistance, and one of three layers (``scene.layers`` 3) is a plate. One
            layer needs a third of the points, and may be thicker than a cell. An edit of E changes it in proportion.
        damping_ratio: Share of critical damping of a vibration of 1 Hz, in ``solver.formulation: total``; parts and
            regions may have their own. The velocity decays at a rate of 4 pi Hz times the ratio, so a vibration of
            twice the frequency has half of the ratio. None if null, beside ``solver.damping``.
        law: Constitutive law, for example ``Sand`` (see :data:`gaussian_swaying.mpm.laws.LAWS`); fixed corotated
            elasticity if null. Plastic laws need ``solver.formulation: updated``.
        regions: Parts with a different material; later entries win.

    In Python, ``E``, ``nu`` and ``density`` may be tensors of one number that require a gradient.
    """

    live_as = "material"
    live = live_numbers(
        E=SIZE | SAME, nu=SAME, density=SIZE | SAME, thickness=SIZE | TOGETHER | {"same_points": False},
    )  # fmt: skip

    E: Number = 1e5
    nu: Number = 0.3
    _: KW_ONLY
    density: Number = 200.0
    thickness: float = 0.01
    volume: Literal["patch", "cell"] = "patch"
    bending: float | Literal["plate"] | None = None
    damping_ratio: float | None = None
    law: ConstitutiveLaw | None = None
    regions: list[MaterialRegion] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in DIFFERENTIABLE:
            value = getattr(self, name)
            if requires_grad(value) and any(getattr(entry, name) is not None for entry in self.regions):
                raise ValueError(
                    f"`material.{name}` requires a gradient, but `material.regions` gives it too: remove it there."
                )
        entries: list[Material | MaterialRegion] = [self, *self.regions]
        for entry in entries:
            given = {name: getattr(entry, name) for name in ("E", "nu", "density", "thickness", "bending")}
            if entry is self:
                given |= {name: number_of(given[name]) for name in DIFFERENTIABLE}
            for name in ("E", "density", "thickness", "bending"):
                if given[name] is not None and given[name] != PLATE:
                    check_positive(f"material.{name}", given[name])
            if entry.damping_ratio is not None:
                check_positive("material.damping_ratio", entry.damping_ratio, allow_zero=True)
            if given["nu"] is not None:
                check_plain("material.nu", given["nu"])
                check_poisson_ratio("material.nu", given["nu"])
        if any(entry.bending is not None for entry in entries):
            self._check_bending()

    def _check_bending(self) -> None:
        if self.volume == "cell":
            raise ValueError(
                "Expected `material.volume` to be patch with `material.bending`, but got cell: the stiffness against "
                "stretch, on which the layers' distance depends, is then not E x thickness."
            )
        for name in ("E", "nu"):
            if requires_grad(getattr(self, name)):
                raise ValueError(
                    f"`material.{name}` requires a gradient, which `material.bending` does not pass on: leave it out."
                )

    @classmethod
    def named(cls, name: str, **own: Any) -> Material:
        """The material of a name, with some fields of its own.

        Args:
            name: One of :data:`~gaussian_swaying.mpm.materials.MATERIALS`.
            own: Fields that differ.

        Raises:
            ValueError: If there is no material of that name; the message lists the names.

        Example:
            >>> Material.named("cotton", thickness=0.001).density
            430.0
        """
        return cls(**(known_material(name).numbers | own))


def plate_stiffness(E: Tensor, nu: Tensor, thickness: Tensor) -> Tensor:
    r"""Kirchhoff's stiffness :math:`D = E h^3 / (12 (1 - \nu^2))` of a plate [N m], shape (N,).

    Args:
        thickness: Thicknesses h [m], shape (N,).
    """
    return E * thickness**3 / (12 * (1 - nu.square()))


def layer_distance(bending: Tensor, E: Tensor, nu: Tensor, thickness: Tensor) -> Tensor:
    r"""Distance of the outer two of three layers with Simpson's weights that have a bending stiffness.

    Their second moment of area is :math:`h d^2 / 12`, so that Kirchhoff's plate has
    :math:`D = E h d^2 / (12 (1 - \nu^2))`, and d is h for a plate of one material.

    Args:
        bending: D [N m], shape (N,).
        thickness: Thicknesses h [m], shape (N,).

    Returns:
        Distances d [m], shape (N,).
    """
    return (12 * bending * (1 - nu.square()) / (E * thickness)).sqrt()


PLATE = "plate"
"""The bending stiffness of a plate of the material's own E, nu and thickness."""

DIFFERENTIABLE = ("E", "nu", "density")
"""Numbers of a :class:`Material` that may require a gradient."""


def with_gradients(points: MaterialPoints, material: Material) -> MaterialPoints:
    """Material points that depend on the tensors of their material that require a gradient, with the same values."""
    for name, field_name in (("E", "youngs_modulus"), ("nu", "poisson_ratio"), ("density", "mass")):
        value = getattr(material, name)
        if requires_grad(value):
            change = (value - value.detach()).reshape(()).to(points.mass)  # zero, with a slope of one
            change = change * points.volume if name == "density" else change
            points = replace(points, **{field_name: getattr(points, field_name) + change})
    return points


_SAMPLE = 100_000  # Gaussians that are sorted, at most
_FEW = 16  # fewer Gaussians are not checked
FAR, TOO_FAR = 20, 1000  # multiples of the side of the box around 98 % of the Gaussians
COARSE, SHORT, TOO_SHORT = 10.0, 3.0, 0.5  # cells along the longest side
NARROW, ROUND, BENT = (0.25, 4.0), 0.5, 0.2  # cells across a tube; least side over middle side; motion over length
SPARSE = 0.75  # cells between neighbouring Gaussians
_SPACED = 4096  # Gaussians whose nearest neighbour is searched


def check_extent(means: Tensor, metres_per_unit: float, dx: float, index: Tensor | None = None) -> None:
    """Refuse an object whose size comes from a stray Gaussian, or that is far too small for the grid.

    Args:
        means: Centres of the simulated Gaussians [scene units], shape (N, 3).
        index: Indices of the Gaussians in the splat, for the message, shape (N,).
    """
    if len(means) < _FEW:
        return
    some = means[:: -(-len(means) // _SAMPLE)].double().sort(dim=0).values
    low, high = some[int(0.01 * len(some))], some[-1 - int(0.01 * len(some))]
    most = float((high - low).amax())
    whole = float((means.amax(0) - means.amin(0)).amax())
    if most > 0 and whole > FAR * most:
        away = (means.double() - 0.5 * (low + high)).abs().amax(-1)
        first = int(away.argmax())
        number = first if index is None else int(index[first])
        text = (
            f"Gaussian {number} lies at {[float(f'{v:.4g}') for v in means[first].tolist()]}, but 98 % of those "
            f"simulated lie within {most:.3g} scene units, so size and mass would come from empty space: leave "
            "it out with `scene.region` or `scene.opacity_threshold`."
        )
        if whole > TOO_FAR * most:
            raise ValueError(text)
        warnings.warn(text, UserWarning, stacklevel=2)
    side = whole * metres_per_unit
    if side < SHORT * dx:
        text = f"The object is {_cells(side, dx)}, so it can hardly bend: {_finer(side)}."
        if side < TOO_SHORT * dx:
            raise ValueError(text)
        warnings.warn(text, UserWarning, stacklevel=2)


def coarse(side: float, dx: float) -> list[str]:
    """A warning, as a list, if the object has so few cells that a finer grid would change its motion; else empty.

    Args:
        side: Longest side of the object [m].
    """
    if not SHORT * dx <= side < COARSE * dx:  # shorter ones are warned of at the start
        return []
    return [f"The object is {_cells(side, dx)}: on a finer grid it may move a quarter more, or less; {_finer(side)}."]


def narrow(points: Tensor, dx: float, moved: float) -> list[str]:
    """A warning, as a list, if a bent tube has so few cells across that the grid decides whether it flattens.

    Args:
        points: Rest positions of the points of a body that is not filled [m], shape (P, 3).
    """
    if len(points) < _FEW or not moved > BENT:
        return []
    centred = (points[:: -(-len(points) // _SAMPLE)]).double()
    centred = centred - centred.mean(0)
    turned = centred @ torch.linalg.eigh(centred.T @ centred).eigenvectors
    least, middle, _ = (turned.amax(0) - turned.amin(0)).sort().values.tolist()
    if least < ROUND * middle or not NARROW[0] * dx <= middle < NARROW[1] * dx:
        return []
    return [
        f"The object is hollow and {_cells(middle, dx, 'across')}: on a finer grid its section may flatten, and it "
        f"bends more; lower `solver.dx` to about {middle / 6:.2g} m, and set `scene.filling` if it is solid."
    ]


def _cells(side: float, dx: float, way: str = "long") -> str:
    return f"{side:.3g} m {way}, {side / dx:.2g} cells of `solver.dx` = {dx:g} m"


def _finer(side: float) -> str:
    return f"lower `solver.dx` to about {side / 24:.2g} m, or check `scene.longest_side` or `scene.metres_per_unit`"


def check_density(means: Tensor, metres_per_unit: float, dx: float) -> None:
    """Warn of a grid that is too fine for the Gaussians, whose material is then too soft.

    Args:
        means: Centres of the simulated Gaussians [scene units], shape (N, 3).

    Warns:
        UserWarning: If half of them are farther than three quarters of a cell from the nearest other one.
    """
    if len(means) < _FEW:
        return
    some = means[:: -(-len(means) // _SPACED)]
    spacing = float(nearest_neighbours(means, 2, some)[0][:, 1].median()) * metres_per_unit  # the first is itself
    if spacing > SPARSE * dx:
        warnings.warn(
            f"The Gaussians are {spacing:.3g} m apart, {spacing / dx:.2g} cells of `solver.dx` = {dx:g} m, so the "
            f"material has gaps and its stiffness is wrong: raise `solver.dx` to about {2 * spacing:.2g} m, or set "
            "`scene.particle_spacing` for points between them.",
            UserWarning,
            stacklevel=2,
        )


SLOWER = 3.0
"""Substeps that the stiffest material takes, over those of the median, from which on it is told."""


def tell_cost(points: MaterialPoints) -> None:
    """Warn if the stiffest of a field of materials takes many more substeps than most of it needs."""
    speed = wave_speed(points).detach().cpu()
    ratio = float(speed.amax() / speed.median())
    if ratio > SLOWER:
        E, few = float(points.youngs_modulus.amax()), float((speed > 0.5 * speed.amax()).double().mean())
        warnings.warn(
            f"`scene.materials` has E up to {E:.3g} Pa: {few:.1%} of the material make a frame take {ratio:.3g} times "
            "the substeps that the median would. `scene.materials.max_E` makes it softer, `rigid_E` rigid, and in "
            "`solver.formulation: modes` it costs nothing.",
            UserWarning,
            stacklevel=2,
        )


def suggest_spacing(longest_side: float, spacing: float, cells: int) -> float:
    """Grid spacing: the longest side over ``cells``, at least twice the particle spacing, rounded to 2 digits.

    Args:
        longest_side: Longest side of the object [m].
        spacing: From :func:`~gaussian_swaying.geometry.neighbours.particle_spacing` [m].

    Returns:
        Grid spacing [m].
    """
    check_positive("longest_side", longest_side)
    return float(f"{max(longest_side / cells, 2 * spacing):.2g}")


FEW, BEYOND = 12, 0.25
"""Samples of a piece in a cell that are grouped with those of the next cell, from how far [cells]."""

_BRIDGES = 8  # neighbours to which an extra point on a large Gaussian is attached, as it fills a hole


@torch.no_grad()
def attached_samples(
    position: Tensor, normal: Tensor, count: int, parts: Parts | None, labels: Tensor | None
) -> Tensor:
    """Pairs of attached samples of a surface.

    Args:
        position: Rest positions [m], those of the Gaussians first, then extra points, shape (N, 3).
        normal: Unit normals, shape (N, 3).
        labels: The part of each Gaussian, shape (count,).

    Returns:
        Pairs, int64, shape (E, 2).
    """
    to = None if parts is None else parts.attached_to()
    pairs = [attached_pairs(position[:count], normal[:count], labels, to)]
    further = position[count:].double()
    if len(further):
        index = nearest_neighbours(position.double(), min(_BRIDGES + 1, len(position)), further)[1]
        own = torch.arange(count, len(position))[:, None].expand_as(index)
        pairs.append(torch.stack([own, index], -1)[own != index])
    return torch.cat(pairs)


def pieces_in_cells(position: Tensor, dx: float, pairs: Tensor) -> Tensor:
    """Labels of samples: equal for those attached to each other within one cell.

    Args:
        position: Rest positions [m] in the precision of the solver, shape (N, 3).
        pairs: Pairs of samples that are attached, shape (E, 2).
    """
    a, b = torch.floor(position / dx - 0.5)[pairs].unbind(1)
    return joined(len(position), pairs[(a == b).all(-1)].T)


@torch.no_grad()
def lies_apart(position: Tensor, dx: float, pairs: Tensor) -> bool:
    """True if a grid node reaches samples that are not attached to each other.

    Args:
        position: Rest positions [m] in the precision of the solver, shape (N, 3).
        pairs: Pairs of samples that are attached, shape (E, 2).
    """
    grid = bounding_grid(position.amin(0), position.amax(0), dx, margin=0)
    return virtual_nodes(first_nodes(position, grid), grid, pairs) is not None


@torch.no_grad()
def homes(position: Tensor, dx: float, pairs: Tensor, piece: Tensor) -> tuple[Tensor, Tensor]:
    """Places by which samples are grouped; a few that stick out of a cell move to the next across its border.

    Left in their own cell, they would get separate copies of nodes with hardly any mass.

    Args:
        position: Rest positions [m], shape (N, 3).
        pairs: Pairs of samples that are attached, shape (E, 2).
        piece: From :func:`pieces_in_cells`, shape (N,).

    Returns:
        The places of the samples for the grid, shape (N, 3), and their pieces, shape (N,).
    """
    few = piece.bincount()[piece] < FEW
    ends = torch.cat([pairs, pairs.flip(1)])
    apart = (position[ends[:, 0]] - position[ends[:, 1]]).norm(dim=-1)
    across = few[ends[:, 0]] & ~few[ends[:, 1]] & (apart < BEYOND * dx)
    ends, apart = ends[across], apart[across]
    ends = ends[apart.argsort(stable=True)]
    ends = ends[ends[:, 0].argsort(stable=True)]  # those of a sample one after the other, the nearest first
    nearest = torch.ones(len(ends), dtype=torch.bool)
    nearest[1:] = ends[1:, 0] != ends[:-1, 0]
    other = torch.arange(len(position)).index_copy(0, *ends[nearest].unbind(1))
    return position[other], piece[other]


def attached_points(pairs: Tensor, owner: Tensor, parent: Tensor | None, layers: int) -> Tensor:
    """Pairs of attached material points.

    Args:
        pairs: Pairs of samples, shape (E, 2).
        owner: The point of each sample, shape (N,).
        parent: The group of each point, shape (P,), all of whose points are attached; None for points that are samples.
        layers: Layers of points through the thickness; those of a sheet of three come one after the other.

    Returns:
        Pairs, int64, shape (E', 2).
    """
    found = owner[pairs]
    many = int(owner.max()) + 1
    if parent is not None:
        order = parent.argsort(stable=True)
        size = parent.bincount()
        start = size.cumsum(0) - size
        rank = torch.arange(len(order)) - start[parent[order]]
        for k in range(1, int(size.max())):  # with the one k places before it
            late = (rank >= k).nonzero()[:, 0]
            found = torch.cat([found, torch.stack([order[late - k], order[late]], -1)])
        many = len(parent)
    found = once(found, many)
    if layers == 1:
        return found
    own = torch.arange(many)
    across = [torch.stack([own + a * many, own + b * many], 1) for a, b in ((0, 1), (0, 2), (1, 2))]
    return torch.cat([*(found + k * many for k in range(layers)), *across])


REACH, LEAST = 1.0, 3  # points so near to a joint hold it [cells], and at least so many of each part
NEXT = 1.5  # a joint is in the middle between pairs of Gaussians at most so many times as far apart as the nearest


@torch.no_grad()
def joints_of(
    parts: Parts, labels: Tensor, place: Tensor, owner: Tensor, position: Tensor, dx: float
) -> tuple[PointJoint, ...]:
    """The joints of parts.

    Args:
        labels: The part of each simulated Gaussian, shape (N,).
        place: Their rest positions [m], shape (N, 3).
        owner: The material point that each belongs to, shape (N,).
        position: Rest positions of the material points [m]; of a sheet of three layers those of the layers one after
            the other, shape (P, 3).
    """
    names, found = [part.name for part in parts.parts], []
    first_layer = int(owner.max()) + 1
    of = torch.full((first_layer,), -1).index_copy(0, owner, labels).repeat(len(position) // first_layer)
    for k, part in enumerate(parts.parts):
        if not part.has_joint:
            continue
        assert part.attached is not None
        sets = []
        for other in (k, names.index(part.attached)):
            if not bool((of == other).any()):
                raise ValueError(
                    f"The part {names[other]!r} has no Gaussian that is simulated, so there is no joint of the part "
                    f"{part.name!r}: name one that is, or remove the joint."
                )
            sets.append(other)
        mine, theirs = (place[labels == other].double() for other in sets)
        distance, index = (t[:, 0] for t in nearest_neighbours(theirs, 1, mine))
        best = distance <= NEXT * distance.amin()
        at = 0.5 * (mine[best] + theirs[index[best]]).mean(0)
        members = []
        for other in sets:
            own = (of == other).nonzero()[:, 0]
            far = (position[own].double() - at).norm(dim=-1)
            near = far.argsort(stable=True)[: max(LEAST, int((far < REACH * dx).sum()))]
            members.append(own[near])
        stiffness = math.inf if part.joint_stiffness is None else part.joint_stiffness
        found.append(PointJoint(members[0], members[1], at.tolist(), stiffness, part.joint_turning or 0.0))
    return tuple(found)


def with_parts(
    scene: Scene, cloud: GaussianCloud, material: Material, solver: Solver, field: MaterialField | None = None
) -> tuple[Material, Solver]:
    """Material and solver, extended by the parts of a scene, if it has any.

    Args:
        material: Its ``regions`` come after those of the parts, and win.
        solver: Gets a body for each part that is rigid and for each rigid body of the ``field``, and a pin for all that
            are held, which holds nodes of the grid.
    """
    parts = scene.parts
    if parts is None and field is None:
        return material, solver
    chosen = scene.select(cloud)
    means = cloud.means[chosen]
    if field is not None:
        bodies = [PartRegion(f"rigid {k + 1}", means, body) for k, body in enumerate(field.rigid_bodies(means))]
        if bodies:
            boundaries = FixedList([*solver.boundaries, *map(RigidRegion, bodies)])
            solver = changed(solver, boundaries=boundaries)
    if parts is None:
        return material, solver
    labels = parts.labels[chosen]
    regions = [
        MaterialRegion(PartRegion(part.name, means, labels == k), **{name: getattr(part, name) for name in NUMBERS})
        for k, part in enumerate(parts.parts)
        if part.has_material and bool((labels == k).any())
    ]
    acting: list[Boundary] = [
        RigidRegion(PartRegion(part.name, means, labels == k))
        for k, part in enumerate(parts.parts)
        if part.role == "rigid" and bool((labels == k).any())
    ]
    held = parts.mask(role="held")[chosen]
    if regions:
        material = dataclasses.replace(material, regions=[*regions, *material.regions])
    if bool(held.any()):
        names = [part.name for k, part in enumerate(parts.parts) if part.role == "held" and bool((labels == k).any())]
        acting.append(PinnedRegion(PartRegion(", ".join(names), means, held), "nodes"))
    if acting:
        solver = changed(solver, boundaries=FixedList([*solver.boundaries, *acting]))
    return material, solver


_FLAT = 0.01  # standard deviation [cubes] below which a group has no extent in a direction
SHARED = 4
"""Largest number of directions in a group whose patches are shared among all its points."""

SIMPSON = (2 / 3, 1 / 6, 1 / 6)  # middle plane and faces of a sheet: exact for the square of the height
_PROPERTIES = ("E", "nu", "density", "thickness", "bending", "damping_ratio")
_NUMBERS = ("E", "nu", "density", "thickness", "bending", "damping")


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
        kind: With a field of materials, of which a group takes the mean: the samples that may share a group have the
            same number, shape (N,). None for those of the same material.
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
    kind: Tensor | None = None

    @property
    def mass(self) -> Tensor:
        """Masses [kg], shape (N,)."""
        return self.density * self.volume

    @property
    def span(self) -> Tensor:
        """Distances between the outer two of three layers [m], shape (N,)."""
        return layer_distance(self.bending, self.E, self.nu, self.thickness)

    def choose(self, index: Tensor) -> Samples:
        known = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: value[index] for name, value in known.items() if value is not None})

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
    field: MaterialField | None,
) -> tuple[Samples, list[ConstitutiveLaw]]:
    """The samples of an object with their material, and the laws of the material.

    Args:
        position: Samples of the surface [m], shape (S, 3), float64.
        normal: Their unit normals, shape (S, 3).
        body_area: Areas that carry material [m²], shape (S,).
        area: Areas that feel the wind [m²], shape (S,).
        dx: Grid spacing [m], for ``material.volume = "cell"``.
        field: Numbers that win over those of the whole material, but not over its regions.
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
    for name, values in ({} if field is None else field.at(where)).items():
        properties[name] = torch.where(values.isnan(), properties[name], values)
    masks: list[Tensor] = []
    for entry in material.regions:
        inside_region = entry.region.contains(where)
        if not bool(inside_region.any()):
            between, hint = whereabouts(entry.region, where, frame.rotation)
            raise ValueError(
                f"The region {entry.region!r} of `material.regions` holds no simulated Gaussian: they lie {between}; "
                f"{hint or 'move or enlarge it'}."
            )
        masks.append(inside_region)
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
    kind = None if field is None else equal_rows(torch.stack(masks or [index], -1))
    found = Samples(
        position, normal, body_area, area, volume, **properties, bending=bending, damping=damping, law_index=index,
        kind=kind, surface=surface,
    )  # fmt: skip
    return found, laws


def _number(value: Any) -> float:
    """The number of a property of a material: not a number for none, and infinity for the stiffness of a plate."""
    return math.nan if value is None else math.inf if value == PLATE else number_of(value)


def cell_volume(position: Tensor, dx: float) -> Tensor:
    """PhysGaussian's rule for solids: the volume of the grid cell divided by the number of particles in it.

    Args:
        position: Rest position [m], shape (P, 3).

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
    """Group samples for a grid: a few points per group, with its mass, centre of mass and volume.

    A group never mixes kinds of material, laws, the surface and the inside, samples that feel wind and samples that do
    not, pieces, or the two sides of the border of a region in ``apart``.

    Args:
        piece: A number for each sample, the same for those that are attached in their cell, shape (N,); None if all
            are.
        home: The places by which they are grouped [m], shape (N, 3), if these are not their own.

    Returns:
        The points as samples, those on the surface first; the point that each sample belongs to, shape (N,); and the
        group of each point, shape (P,).
    """
    where = frame.point_to_scene(samples.position)
    masks = [region.contains(where) for region in apart]
    pieces = [] if piece is None else [piece]
    kind = equal_rows(torch.stack([getattr(samples, name) for name in _NUMBERS], -1))
    kinds = kind if samples.kind is None else samples.kind, samples.law_index, samples.surface, samples.area > 0
    label = torch.stack([*kinds, *masks, *pieces], -1).long()
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
    """Distribute the patches of each group over its points, so that wind is shared as mass is.

    A group of up to :data:`SHARED` directions is one patch of each direction at each of its points, with an equal part
    of the area: the wind then has the second moments of the group, too. If each patch went to the point next to it,
    some points of a cell that a sheet crosses obliquely would get much more wind than mass, and the sheet would
    wrinkle. In a group of more directions, as in noisy captures, each patch does go to that point.

    Args:
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
    new = torch.where(which[group], len(parts) + torch.arange(len(group)), group)
    kept, group = torch.unique(new, return_inverse=True)
    return group, torch.cat([parts, torch.zeros(len(new), dtype=torch.bool)])[kept]


def _points_of(samples: Samples, group: Tensor, parts: Tensor, side: float) -> tuple[Samples, Tensor, Tensor]:
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
    for name in () if samples.kind is None else _NUMBERS:  # a field of materials, of which the points take the mean
        values = getattr(samples, name)
        areas[name] = (sums(samples.volume * values, group) / sums(samples.volume, group))[of]
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
    """Contact surface of an object: one sample per part of a cell, with a disc that covers those it stands for.

    Args:
        owner: A material point close to each, shape (N,).
        contact: Contact of the surface with itself; None if only obstacles count.
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
    """Number of contact pairs closer at rest than the thickness; these are pushed apart."""
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
    """Signed distance to the surface of static Gaussians, where their density passes a level.

    Args:
        means: Centres [m], shape (N, 3).
        covariances: Covariances [m²], shape (N, 3, 3).
        opacities: From 0 to 1, shape (N,).
        low: Lower corner of the grid [m], shape (3,).
        high: Upper corner of the grid [m], shape (3,).

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


HOLE = 0.6
"""Distance from all Gaussians [cells] at which ``points: grid`` puts extra points on large ones by itself."""

SPECK = 1 / 2.2
"""Side of the cubes by which ``scene.loose`` finds specks [cells]."""


@dataclass(frozen=True, eq=False)
class Body:
    """Material points and patches, and the samples of the object that they stand for.

    Attributes:
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
    field: MaterialField | None = None,
) -> Body:
    """Turn Gaussians into what a solver takes: samples, their areas and material, groups, patches.

    Args:
        normals: Their unit normals, shape (N, 3).
        dx: Length that the solver resolves [m].
        labels: The part of each Gaussian, shape (N,), if the scene has parts.
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
    samples, laws = sample_object(position, facing, body_area, area, filling, material, frame, dx, scene.layers, field)
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
    """Indices of simulated Gaussians not connected to the object, if ``scene.loose`` carries them.

    Args:
        simulated: Indices of those that are simulated, shape (N,).
        dx: Length that the solver resolves [m].

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


class SimulatedScene(nn.Module):
    """Gaussians, material points and patches of one scene, and how the Gaussians follow the material.

    There are three kinds of Gaussians: simulated ones belong to the material, carried ones (faint or loose) follow the
    nearest simulated one, and static ones do not move. Of the simulated ones, those of a part that is held stay in
    place as well. With ``points: gaussian`` each simulated Gaussian is a material
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
        embedded: Returns how places are read from a state (``Solver.embedded``); where it returns None, the Gaussians
            follow the points.
        field: Materials that differ from Gaussian to Gaussian.

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
        moving: Indices of the Gaussians that move, first the simulated and then the carried ones, without parts that
            are held, shape (M,).
        all_move: Whether ``moving`` is all Gaussians, in their order.
        rest_facing: Normals at rest of the Gaussians that move, in the z-up frame, shape (M, 3).
        further: Number of extra points on large Gaussians.
        tracked: Number of points that :meth:`surface` returns.
        surface_places: Contact samples, which touch obstacles and each other, or None.
        drawn: Which Gaussians of the source are here, bool: all but hidden parts and what ``faint: drop`` leaves out.
        joints: The joints of parts.
        pairs: Simulated Gaussians that are attached, as places in ``simulated``, shape (E, 2), with
            ``scene.connected: surface``; else None.
        source: The .ply file; None for a scene made in code.
        parts: The labels of its Gaussians, with roles and materials, or None.
        field: The materials of its Gaussians, or None.
    """

    simulated: Tensor
    carried: Tensor
    owner: Tensor
    in_wind: Tensor
    rest_covariances: Tensor
    rest_normals: Tensor
    moving: Tensor
    rest_facing: Tensor
    identity: Tensor

    def __init__(
        self,
        scene: Scene,
        material: Material,
        dx: float,
        dtype: torch.dtype = torch.float32,
        cloud: GaussianCloud | None = None,
        fixed: bool = True,
        apart: Sequence[Region] = (),
        embedded: Callable[..., EmbeddedPoints | None] = EmbeddedInGrid,
        field: MaterialField | None = None,
    ) -> None:
        super().__init__()
        cloud = scene.cloud() if cloud is None else cloud
        self.source, self.parts, self.field = scene.ply, scene.parts, field
        by_grid = scene.points == "grid" or (scene.points is None and fixed)
        if by_grid and not fixed:
            raise ValueError(
                "`scene.points: grid` needs `solver.formulation: total`, where Gaussians can follow the nodes: set "
                "`scene.points` to gaussian."
            )
        if scene.connected == "surface" and not fixed:
            raise ValueError(
                "`scene.connected: surface` needs `solver.formulation: total`, where nodes keep their points: set "
                "`scene.connected` to grid."
            )
        chosen = scene.select(cloud)
        still, held, hidden = (
            torch.zeros_like(chosen) if scene.parts is None else scene.parts.mask(role=role)
            for role in ("still", "held", "hidden")
        )
        faint = scene.region.contains(cloud.means) & ~chosen & ~still & ~hidden
        self.drawn = ~(hidden | faint) if scene.faint == "drop" else ~hidden
        if not bool(self.drawn.all()):
            cloud = cloud.select(self.drawn)
            chosen, held, faint = (mask[self.drawn] for mask in (chosen, held, faint))
        self.model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False, copy=scene.ply is None)
        simulated = chosen.nonzero()[:, 0]
        self.frame = SimFrame.fit(cloud.means[simulated], scene.up, scene.longest_side, scene.metres_per_unit)
        means = cloud.means[simulated]
        check_extent(means, self.frame.metres_per_unit, dx, simulated)
        if scene.particle_spacing is None and scene.filling is None:
            check_density(means, self.frame.metres_per_unit, dx)
        self.bounds = (means.amin(0), means.amax(0))
        largest = cloud.scales[simulated].amax().exp()  # a single Gaussian has a size too
        self.size = max(float((self.bounds[1] - self.bounds[0]).amax()), float(largest))
        carried = faint if scene.faint == "carry" else torch.zeros_like(faint)
        specks = specks_of(cloud, simulated, scene, self.frame, dx, by_grid)
        self.loose = len(specks)
        if self.loose:
            chosen[specks], carried[specks] = False, True
            simulated = chosen.nonzero()[:, 0]
        normals = self.model.normals()
        if scene.normals == "neighbours":
            weight = torch.sigmoid(cloud.opacities)[simulated] * patch_area(cloud.scales[simulated])
            parts = cloud.means[simulated], normals[simulated], weight
            normals = normals.index_put((simulated,), neighbour_normals(*parts))
        part = cloud.select(simulated)
        labels = None if scene.parts is None else scene.parts.labels[self.drawn][simulated]
        body = body_of(part, normals[simulated], scene, material, self.frame, dx, dtype, by_grid, apart, labels, field)
        self.points, self.patches = body.points, body.patches
        if field is not None:
            tell_cost(body.points)
        self.joints = self._joints(scene, labels, body, dx)
        self.pairs = None if body.pairs is None else body.pairs[(body.pairs < len(simulated)).all(1)]
        self.on_surface, self.filled = body.on_surface, body.points.count // scene.layers - body.on_surface
        self.max_stretch = scene.max_stretch
        self._kept: tuple[MaterialPoints, Tensor] | None = None
        self._dx = dx
        self._body: Body | None = body
        self.surface_places: Surface | None = None
        carried = carried.nonzero()[:, 0]
        self.register_buffer("simulated", simulated)
        self.register_buffer("carried", carried)
        self.register_buffer("rest_covariances", self.model.covariance())
        self.register_buffer("rest_normals", normals)
        # computed once here, as every picture needs it
        nearest = nearest_neighbours(part.means.double(), 1, cloud.means[carried].double())[1][:, 0]
        anchor = torch.cat([torch.arange(len(simulated)), nearest])  # the simulated Gaussian that is followed
        moving = torch.cat([simulated, carried])
        free = ~(held[simulated][anchor] | held[moving])  # what is held is drawn where it is, exactly
        anchor, moving = anchor[free], moving[free]
        self.all_move = bool(moving.equal(torch.arange(len(cloud.means))))
        self.register_buffer("moving", moving, persistent=False)
        self.register_buffer("owner", body.owner[anchor], persistent=False)
        samples = body.surface_samples
        self.further = samples - len(simulated)
        self.tracked = samples if by_grid else self.points.count
        place, near = body.samples.position[:samples], body.owner[:samples]
        own = self.frame.point_to_sim(cloud.means[moving].double())
        self.track: EmbeddedPoints | None = None
        if not by_grid:
            arm, points = _arm(own - place[anchor], dtype), self.points
            self.follow: EmbeddedPoints = EmbeddedAtPoints(anchor, arm, points.position, points.attached)
        else:
            read, nodes = on_material(place, near, self.points, dx)
            given = () if nodes is None else (nodes,)
            nodal = embedded(read.to(dtype), _arm(place - read, dtype), *given)
            if nodal is not None:
                given = () if nodes is None else (nodes[:, anchor],)
                follow = embedded(read[anchor].to(dtype), _arm(own - read[anchor], dtype), *given)
                assert follow is not None
                self.follow, self.track = follow, nodal
            else:  # a solver without nodes
                rest = self.points.position
                self.track = EmbeddedAtPoints(near, _arm(place - rest[near].double(), dtype), rest)
                near = near[anchor]
                self.follow = EmbeddedAtPoints(near, _arm(own - rest[near].double(), dtype), rest)
        facing = self.frame.direction_to_sim(normals[moving].double()).to(normals.dtype)
        self.register_buffer("rest_facing", facing, persistent=False)
        felt = body.samples.area[anchor] > 0
        self.register_buffer("in_wind", felt, persistent=False)
        self.register_buffer("identity", torch.eye(3, dtype=cloud.means.dtype), persistent=False)

    def __repr__(self) -> str:
        return f"{len(self.model.means):,} Gaussians of which {len(self.moving):,} move by {self.points.count:,} points"

    @staticmethod
    def _joints(scene: Scene, labels: Tensor | None, body: Body, dx: float) -> tuple[PointJoint, ...]:
        if scene.parts is None or labels is None or not any(part.has_joint for part in scene.parts.parts):
            return ()
        place, owner = body.samples.position[: len(labels)], body.owner[: len(labels)]
        return joints_of(scene.parts, labels, place, owner, body.points.position.detach(), dx)

    def _apply(self, fn, recurse: bool = True) -> SimulatedScene:  # type: ignore[no-untyped-def] # noqa: ANN001
        super()._apply(fn, recurse)
        self.points = self.points.map(fn)
        if self.surface_places is not None:
            self.surface_places = self.surface_places.map(fn)
        return self

    def take_contact(self, contact: Contact | None, obstacles: Sequence[Obstacle]) -> None:
        """Make the contact samples, and pass the static Gaussians to obstacles made of them.

        Args:
            contact: Contact of the surface with itself; None for none.
        """
        body, self._body = self._body, None
        if body is None or (contact is None and not obstacles):
            return
        self.surface_places = surface_of(body.samples, body.owner, self.points, self._dx, contact)
        for obstacle in obstacles:
            if isinstance(shape := obstacle.shape, StillGaussians):
                obstacle.take(self.still_distance(*self._box(shape.margin), shape.cells, shape.level))

    @torch.no_grad()
    def still_distance(self, low: Tensor, high: Tensor, cells: int, level: float = 0.5) -> DistanceGrid:
        """Signed distance to the surface of the static Gaussians in a box.

        Args:
            low: Lower corner of the box [m], shape (3,).
            high: Upper corner of the box [m], shape (3,).
            level: Density of the surface, from 0 to 1.
        """
        still = torch.ones(len(self.model.means), dtype=torch.bool)
        still[self.moving.cpu()] = False
        still[self.simulated.cpu()] = False  # a part that is held belongs to the body
        means = self.frame.point_to_sim(self.model.means.cpu()[still].double())
        shape = self.frame.covariance_to_sim(self.rest_covariances.cpu()[still].double())
        return still_distance(means, shape, self.model.opacity().cpu()[still], low, high, cells, level)

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
        means = self.model.means.detach()
        eye = self.identity.expand(len(means), 3, 3)
        moving = None if self.all_move else self.moving
        return DeformedGaussians(means, self.rest_covariances, self.rest_normals, eye, model=self.model, moving=moving)

    def deformed(self, state: State, rotations: bool = True) -> DeformedGaussians:
        """The Gaussians moved by the material: x, F A Fᵀ, F⁻ᵀN (paper, "Surface Formulation").

        If the scene has a ``max_stretch``, it limits the covariances.

        Args:
            state: State of one scene, fields of shape (P, ·).
            rotations: Whether to compute the rotations; otherwise they are those at rest, which is enough for colours
                that are the same from every direction.
        """
        rest, index = self.rest(), self.moving
        parts: dict[str, Any] = self.moved(state, rotations)
        if not self.all_move:
            parts = {name: getattr(rest, name).index_copy(0, index, part) for name, part in parts.items()}
        return replace(rest, **parts)

    def moved(self, state: State, rotations: bool = True) -> dict[str, Any]:
        """Fields of the moving Gaussians that :meth:`deformed` changes, by name, in the order of ``moving``."""
        rest, index = self.rest(), self.moving
        own = rest.means, rest.covariances, rest.normals
        if not self.all_move:
            own = rest.means[index], rest.covariances[index], rest.normals[index]
        solid = None if self.max_stretch is None else self.solid()
        moved = self.follow.drawn(state, self.frame, *own, rotations, self.max_stretch, solid)
        if moved is None:
            kind = rest.means.dtype
            move, F = self.follow.motion(state)
            move, F = self.frame.displacement_to_scene(move.to(kind)), self.frame.gradient_to_scene(F.to(kind))
            moved = own[0] + move, *deform_all(F, *own[1:], rotations, self.max_stretch, solid)
        means, covariances, normals, turns = moved
        parts = {"means": means, "covariances": covariances, "normals": normals}
        return parts if turns is None else parts | {"rotations": turns}

    def surface(self, state: State) -> tuple[Tensor, Tensor]:
        """Position [m], shape (S, 3), and F, shape (S, 3, 3), of the points that a trajectory records.

        These are all particles, or with ``points: grid`` the simulated Gaussians and their extra points.
        """
        if self.track is None:
            return state.position, state.F_total
        move, F = self.track.motion(state)
        rest = self.track.places if self.track.arm is None else self.track.places + self.track.arm
        return rest + move, F

    def solid(self) -> Tensor:
        """Return a mask (M,) of the moving Gaussians that keep their shape, as their law has no return map."""
        if self._kept is None or self._kept[0] is not self.points:  # an edit replaces the points
            with torch.inference_mode(False):  # it outlives the call
                elastic = self.points.elastic
                known = torch.ones_like(self.owner, dtype=torch.bool) if elastic is None else elastic[self.owner]
                self._kept = (self.points, known)
        return self._kept[1]

    def on_gaussians(self, values: Tensor) -> Tensor:
        """Spread values of the moving Gaussians (M,) to all (N,); static ones get 0."""
        own = values.to(self.model.means.dtype)
        return own.new_zeros(len(self.model.means)).index_copy(0, self.moving, own)


def _arm(arm: Tensor, dtype: torch.dtype) -> Tensor | None:
    return arm.to(dtype) if bool(arm.any()) else None
