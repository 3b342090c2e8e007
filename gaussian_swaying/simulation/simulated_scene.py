"""The scene of a run: all its Gaussians, and how those that move follow the body."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.model import DeformedGaussians, GaussianSurfaceModel
from gaussian_swaying.geometry.directions import hull_area
from gaussian_swaying.geometry.distance import DistanceGrid
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.patches import deform_all
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.geometry.surface_normals import neighbour_normals
from gaussian_swaying.mpm.colliders import Obstacle, StillGaussians
from gaussian_swaying.mpm.contact import Contact, Surface
from gaussian_swaying.mpm.embedded import EmbeddedAtPoints, EmbeddedInGrid, EmbeddedPoints, on_material
from gaussian_swaying.mpm.joints import PointJoint
from gaussian_swaying.mpm.state import MaterialPoints, State
from gaussian_swaying.simulation.body import Body, body_of, specks_of
from gaussian_swaying.simulation.extent import check_density, check_extent
from gaussian_swaying.simulation.joints import joints_of
from gaussian_swaying.simulation.material import Material
from gaussian_swaying.simulation.scene import Scene
from gaussian_swaying.simulation.touching import still_distance, surface_of


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
        embedded: Callable[..., EmbeddedPoints | None] = EmbeddedInGrid,
    ) -> None:
        super().__init__()
        cloud = scene.cloud() if cloud is None else cloud
        self.source, self.parts = scene.ply, scene.parts
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
        body = body_of(part, normals[simulated], scene, material, self.frame, dx, dtype, by_grid, apart, labels)
        self.points, self.patches = body.points, body.patches
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
        self.simulated: Tensor
        self.carried: Tensor
        self.owner: Tensor
        self.in_wind: Tensor
        self.rest_covariances: Tensor
        self.rest_normals: Tensor
        self.moving: Tensor
        self.rest_facing: Tensor
        self.identity: Tensor

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
            obstacles: Obstacles of the solver.
        """
        body, self._body = self._body, None
        if body is None or (contact is None and not obstacles):
            return
        self.surface_places = surface_of(body.samples, body.owner, self.points, self._dx, contact)
        for obstacle in obstacles:
            if isinstance(obstacle, StillGaussians):
                obstacle.take(self.still_distance(*self._box(obstacle.margin), obstacle.cells, obstacle.level))

    @torch.no_grad()
    def still_distance(self, low: Tensor, high: Tensor, cells: int, level: float = 0.5) -> DistanceGrid:
        """Signed distance from the surface of the Gaussians that stand still, in a box.

        Args:
            low: Lower corner of the box [m], shape (3,).
            high: Upper corner of the box [m], shape (3,).
            cells: Cells along its longest side.
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

        Returns:
            All Gaussians, the static ones at rest.
        """
        rest, index = self.rest(), self.moving
        parts: dict[str, Any] = self.moved(state, rotations)
        if not self.all_move:
            parts = {name: getattr(rest, name).index_copy(0, index, part) for name, part in parts.items()}
        return replace(rest, **parts)

    def moved(self, state: State, rotations: bool = True) -> dict[str, Any]:
        """The Gaussians that move, in the order of ``moving``: the fields that :meth:`deformed` changes, by name."""
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
        """Values of the moving Gaussians (M,) for all of them (N,); the static ones get 0."""
        own = values.to(self.model.means.dtype)
        return own.new_zeros(len(self.model.means)).index_copy(0, self.moving, own)


def _arm(arm: Tensor, dtype: torch.dtype) -> Tensor | None:
    """Arms in the precision of the solver; None if all are zero."""
    return arm.to(dtype) if bool(arm.any()) else None
