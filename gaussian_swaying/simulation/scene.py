"""The settings of a scene: the source of the Gaussians, those that move, and how they are sampled."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from gaussian_swaying._arguments import shown
from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import Fixed
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.filling import InteriorFilling
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.parts import Parts
from gaussian_swaying.gaussians.selection import select_simulated
from gaussian_swaying.geometry.origin import counted_from
from gaussian_swaying.geometry.regions import Everything, Region
from gaussian_swaying.scenes.procedural import ProceduralScene

if TYPE_CHECKING:
    PartsLike = str | os.PathLike[str] | Parts
else:  # what a YAML file can contain
    PartsLike = str | os.PathLike[str]


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
            moments of a group too (see :func:`~gaussian_swaying.simulation.sampling.matched_points`), so 2 is more
            accurate than 3.
        connected: What shares nodes of the grid: ``grid``, all that lies within a cell, or ``surface``, only what is
            connected along the surface (see :func:`~gaussian_swaying.gaussians.connectivity.attached_pairs`), so that
            leaves closer than a cell move apart. ``surface`` needs ``solver.formulation: total``.
        normals: Normals of the patches: ``smallest_axis`` of each Gaussian, as in the paper, or ``neighbours``, of
            planes through neighbouring centres (see
            :func:`~gaussian_swaying.geometry.surface_normals.neighbour_normals`), which are better on large smooth
            surfaces whose Gaussians have good positions but bad orientations.
    """

    live_as = "scene"

    def __init__(
        self,
        ply: str | os.PathLike[str] | None = None,
        generator: ProceduralScene | None = None,
        *,
        region: Region | None = None,
        parts: PartsLike | None = None,
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

    def select(self, cloud: GaussianCloud) -> Tensor:
        """The Gaussians that are simulated: in the region, opaque enough, and in no part that is still or hidden.

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
