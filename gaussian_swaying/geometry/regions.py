"""Regions of space, in scene units, which choose the Gaussians that move."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape, check_vector
from gaussian_swaying._fixed import Fixed
from gaussian_swaying.geometry.distance import (
    DistanceGrid,
    ball_distance,
    box_distance,
    capsule_distance,
    distance_at,
    grid_distance,
    half_space_distance,
)
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.meshes import mesh_distance, read_mesh


class Region(Fixed, ABC):
    """A part of space. Subclasses can be named in a configuration.

    Attributes:
        recordable: Whether a CUDA graph may record :meth:`contains`. That is so if it copies nothing from or to the
            host after the first call (see :meth:`on`). A class that overrides ``contains`` must set this itself.
        axes: The axes in which the region is given, in words; empty for those of the points passed to it.
        distance: For the shape of an obstacle, the device function of its distance
            (:mod:`~gaussian_swaying.geometry.distance`).
        middle: The place about which it turns; None for a shape without a place of its own.
    """

    recordable: bool = False
    axes: str = ""
    distance: Any = None
    middle: tuple[float, ...] | None = None

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "contains" in vars(cls) and "recordable" not in vars(cls):
            cls.recordable = False

    def __getstate__(self) -> dict[str, object]:
        """The state without tensors cached on devices, which another machine may not have."""
        return {name: value for name, value in vars(self).items() if name != "_known"}

    def on(self, points: Tensor, values: Sequence[float]) -> Tensor:
        """Constants of the region as a tensor with the dtype and device of some points.

        They are cached as long as the region lives, so that later calls copy nothing to a GPU and a recorded CUDA graph
        never reads freed memory.
        """
        known: dict[tuple[object, ...], Tensor] = self.__dict__.setdefault("_known", {})
        key = (tuple(values), points.dtype, points.device)
        if key not in known:
            with torch.inference_mode(False):
                known[key] = torch.tensor(values, dtype=points.dtype, device=points.device)
        return known[key]

    @abstractmethod
    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""

    def solid(self, unit: float, axes: Tensor) -> tuple[Tensor, Tensor]:
        """Return the numbers and the table of :attr:`distance`, around :attr:`middle`.

        Args:
            unit: Length of a scene unit [m].
            axes: Axes of the region, in columns, float64, shape (3, 3).
        """
        raise ValueError(f"A {type(self).__name__} is not the shape of an obstacle: use a Box or Capsule.")

    def bounds(self, points: Tensor) -> tuple[list[float], list[float]]:
        """Smallest and largest coordinates of points (..., 3), in the region's axes and units."""
        flat = points.detach().reshape(-1, 3).double()
        low, high = ([round(v, 4) for v in corner.tolist()] for corner in (flat.amin(0), flat.amax(0)))
        return low, high


class Everything(Region):
    """All of space."""

    recordable = True

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        check_shape("points", points, 3)
        return torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)


class Box(Region):
    """A box with sides along the axes, its faces included.

    Args:
        min: Lower corner [scene units], 3 numbers; null leaves that side open.
        max: Upper corner [scene units], 3 numbers; null leaves that side open.

    Raises:
        ValueError: If a corner does not have 3 finite numbers, or ``min`` is not below ``max`` along an axis.
        TypeError: If a corner is not a list.
    """

    recordable = True
    distance = box_distance

    def __init__(self, min: Sequence[float | None], max: Sequence[float | None]) -> None:
        self.min = _corner("min", min, -float("inf"))
        self.max = _corner("max", max, float("inf"))
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if not low < high:
                raise ValueError(f"Expected `min` to be below `max` of the box along {axis}, but got {low} and {high}.")
        self.middle = tuple(0.5 * (low + high) for low, high in zip(self.min, self.max, strict=True))

    def solid(self, unit: float, axes: Tensor) -> tuple[Tensor, Tensor]:
        half = 0.5 * unit * (axes.new_tensor(self.max) - axes.new_tensor(self.min))
        if not half.isfinite().all():
            raise ValueError("Expected `min` and `max` of an obstacle without null.")
        return torch.cat([half, axes.reshape(-1)]), axes[:0]

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        check_shape("points", points, 3)
        return ((points >= self.on(points, self.min)) & (points <= self.on(points, self.max))).all(-1)


class Sphere(Region):
    """A ball, its surface included.

    Args:
        center: Centre [scene units], 3 numbers.
        radius: Radius [scene units], above zero.

    Raises:
        ValueError: If ``center`` does not have 3 finite numbers or ``radius`` is not positive.
        TypeError: If ``center`` is not a list.
    """

    recordable = True
    distance = ball_distance

    def __init__(self, center: Sequence[float], radius: float) -> None:
        self.center = self.middle = check_vector("center", center)
        check_positive("radius", radius)
        self.radius = float(radius)

    def solid(self, unit: float, axes: Tensor) -> tuple[Tensor, Tensor]:
        return axes.new_tensor([unit * self.radius]), axes[:0]

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        check_shape("points", points, 3)
        return (points - self.on(points, self.center)).square().sum(-1) <= self.radius**2


class Cylinder(Region):
    """A straight round cylinder, its surface included.

    Args:
        center: Middle of its axis [scene units], 3 numbers.
        axis: Direction of its axis, 3 numbers of any length above zero.
        radius: Radius [scene units], above zero.
        height: Length along the axis [scene units], above zero; half of it is on each side of ``center``.

    Raises:
        ValueError: If a vector does not have 3 finite numbers, ``axis`` is zero, or a size is not positive.
        TypeError: If a vector is not a list.
    """

    recordable = True

    def __init__(self, center: Sequence[float], axis: Sequence[float], radius: float, height: float) -> None:
        self.center = check_vector("center", center)
        direction = check_vector("axis", axis)
        length = sum(component**2 for component in direction) ** 0.5
        if length == 0:
            raise ValueError(f"Expected `axis` to have a length above zero, but got {list(direction)}.")
        self.axis = tuple(component / length for component in direction)
        check_positive("radius", radius)
        check_positive("height", height)
        self.radius, self.height = float(radius), float(height)

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        check_shape("points", points, 3)
        axis = self.on(points, self.axis)
        offset = points - self.on(points, self.center)
        along = (offset * axis).sum(-1)
        across = (offset - along[..., None] * axis).square().sum(-1)
        return (along.abs() <= 0.5 * self.height) & (across <= self.radius**2)


class Capsule(Region):
    """A rod with round ends: a pole, an arm.

    Args:
        first: One end of its axis [scene units], 3 numbers.
        second: The other end.
        radius: Radius [scene units], above zero.
    """

    distance = capsule_distance

    def __init__(self, first: Sequence[float], second: Sequence[float], radius: float) -> None:
        self.first, self.second = check_vector("first", first), check_vector("second", second)
        check_positive("radius", radius)
        self.radius = float(radius)
        self.middle = tuple(0.5 * (p + q) for p, q in zip(self.first, self.second, strict=True))

    def solid(self, unit: float, axes: Tensor) -> tuple[Tensor, Tensor]:
        half = 0.5 * unit * axes @ (axes.new_tensor(self.second) - axes.new_tensor(self.first))
        squared = half.square().sum()
        inverse = torch.where(squared > 0, 1 / squared, 0.0)
        return torch.cat([axes.new_tensor([unit * self.radius]), half, inverse[None]]), axes[:0]

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        return _within(self, points)


class HalfSpace(Region):
    """All space behind a plane: a floor, a wall.

    Args:
        point: A point of the plane [scene units], 3 numbers.
        normal: Direction out of it, 3 numbers of any length above zero.
    """

    distance = half_space_distance

    def __init__(self, point: Sequence[float], normal: Sequence[float]) -> None:
        self.point = self.middle = check_vector("point", point)
        self.normal = check_vector("normal", normal)
        if not any(self.normal):
            raise ValueError("Expected `normal` of the half space not to be zero.")

    def solid(self, unit: float, axes: Tensor) -> tuple[Tensor, Tensor]:
        return torch.nn.functional.normalize(axes @ axes.new_tensor(self.normal), dim=0), axes[:0]

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        return _within(self, points)


class Mesh(Region):
    """A closed triangle mesh.

    Its signed distance is computed on a grid once, so details smaller than a cell of that grid are rounded off.

    Args:
        file: A .ply or .obj file, in scene units and axes.
        cells: Cells of the grid along the longest side of the mesh.
        center: Position of the mesh's origin, about which it turns [scene units].

    Raises:
        ValueError: If the file is no closed mesh.
    """

    distance = grid_distance

    def __init__(self, file: str, cells: int = 48, center: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        self.center = self.middle = check_vector("center", center)
        if cells < 4:
            raise ValueError(f"Expected `cells` of the mesh to be at least 4, but got {cells}.")
        self.file, self.cells = file, int(cells)
        self.grid = mesh_distance(*read_mesh(file), cells)

    def solid(self, unit: float, axes: Tensor) -> tuple[Tensor, Tensor]:
        grid = DistanceGrid(self.grid.values * unit, self.grid.origin * unit, self.grid.spacing * unit)
        return grid.numbers(axes), grid.values

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        return _within(self, points)


class StillGaussians(Region):
    """Everything in the scene that does not move, as the shape of an obstacle: a curtain falls over a captured table.

    Its surface is where the density of the Gaussians passes a level, on a grid around the object that a
    ``Simulation`` makes once. Details smaller than a cell are rounded off.

    Args:
        cells: Cells of the grid along its longest side.
        level: Density of the surface, from 0 to 1.
        margin: Distance by which the grid reaches beyond the object at rest, in lengths of its longest side.
    """

    distance = grid_distance

    def __init__(self, cells: int = 96, level: float = 0.5, margin: float = 1.0) -> None:
        check_positive("margin", margin)
        if not 0 < level < 1 or cells < 8:
            raise ValueError(
                f"Expected `level` between 0 and 1 and `cells` of at least 8, but got {level:g} and {cells}."
            )
        self.cells, self.level, self.margin = int(cells), float(level), float(margin)

    def solid(self, unit: float, axes: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing, as only a simulation knows the Gaussians."""
        return axes[0, :0], axes[:0]

    def contains(self, points: Tensor) -> Tensor:
        raise ValueError("StillGaussians are the shape of an obstacle, not a region.")


def _within(region: Region, points: Tensor) -> Tensor:
    check_shape("points", points, 3)
    numbers, table = region.solid(1.0, torch.eye(3, dtype=torch.float64))
    place = points - region.on(points, region.middle or ())
    return distance_at(type(region).distance, place, numbers, table)[0] <= 0


class Union(Region):
    """All points in at least one of several regions.

    Args:
        regions: Regions to join, at least one.

    Raises:
        ValueError: If the list is empty.
        TypeError: If an entry is not a region.
    """

    def __init__(self, regions: list[Region]) -> None:
        if not regions:
            raise ValueError("Expected `regions` to hold at least one region, but got an empty list.")
        self.regions = list(regions)
        self.recordable = all(region.recordable for region in self.regions)

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        inside = self.regions[0].contains(points)
        for region in self.regions[1:]:
            inside = inside | region.contains(points)
        return inside


class Not(Region):
    """All of space outside a region.

    Args:
        region: Region to leave out.

    Raises:
        TypeError: If ``region`` is not a region.
    """

    def __init__(self, region: Region) -> None:
        self.region, self.recordable = region, region.recordable

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [scene units] that are inside."""
        return ~self.region.contains(points)


def _corner(name: str, values: Sequence[float | None], unbounded: float) -> tuple[float, ...]:
    """A corner as 3 floats, with ``unbounded`` in place of None."""
    if isinstance(values, Tensor):
        values = values.tolist()
    if isinstance(values, (str, bytes)) or not hasattr(values, "__len__"):
        raise TypeError(f"Expected `{name}` to be a list of 3 numbers or nulls, but got {values!r}.")
    finite = check_vector(name, [0.0 if value is None else value for value in values])
    return tuple(unbounded if value is None else item for value, item in zip(values, finite, strict=True))


def whereabouts(region: Region, points: Tensor, rotation: Tensor) -> tuple[str, str]:
    """Describe where points lie, for an error about a region without points, and name a remedy if its axes are wrong.

    Winds and other velocities have z up, but regions are in the axes of the scene, in which up may be another axis.

    Args:
        points: Points as :meth:`Region.contains` takes them, shape (..., 3).
        rotation: Scene axes to axes with z up, shape (3, 3).

    Returns:
        The corners of their box, also with z up where that differs; and what to change if the region would contain some
        of them with z up, otherwise nothing.
    """
    between = "between {} and {}".format(*region.bounds(points)) + region.axes
    rotation = rotation.to(points.device, torch.float64)
    if region.axes or torch.equal(rotation, torch.eye(3).to(rotation)):
        return between, ""
    turned = (points.double() @ rotation.T).to(points.dtype)
    between += " (with z up, as for `wind.flow`: between {} and {})".format(*region.bounds(turned))
    inside = int(region.contains(turned).sum())
    up = [round(v, 3) + 0.0 for v in rotation[2].tolist()]
    hint = (
        f"with z up it would hold {inside:,} of them, but regions are in scene axes, where up is {up}: turn the region"
    )
    return between, hint if inside else ""


class RegionInFrame(Region):
    """A region given in axes and units of its own, asked about points in others: metres with z up, or scene units."""

    axes = " in the axes of the region"

    def __init__(self, region: Region, frame: SimFrame) -> None:
        self.region, self.frame = region, frame
        self.recordable = region.recordable

    def contains(self, points: Tensor) -> Tensor:
        """Return a mask (...) of the points (..., 3) [m, z up] that are inside."""
        return self.region.contains(self.frame.point_to_scene(points))

    def bounds(self, points: Tensor) -> tuple[list[float], list[float]]:
        """Least and largest coordinates of points (..., 3), in the axes and units in which the region is given."""
        return self.region.bounds(self.frame.point_to_scene(points.reshape(-1, 3)))

    def __repr__(self) -> str:
        return repr(self.region)
