"""Bodies that do not move and that the wind flows round, as effects."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.twins import Numbers, Twin
from gaussian_swaying.wind.effects import Moment, WindEffect, placed
from gaussian_swaying.wind.obstacle_flow import (
    cylinder_flow,
    ellipsoid_flow,
    ellipsoid_strength,
    plane_wake,
    round_wake,
    wake_start,
)

AnyObstacle = TypeVar("AnyObstacle", bound="Obstacle")


class Obstacle(WindEffect):
    """Base of bodies in the wind: potential flow round them, and a wake behind them.

    The flow is that of the wind at each place, gusts included: right for gusts much longer than the body. The wake lies
    in the direction of the mean flow.
    """

    recordable = True

    def __init__(self, center: Sequence[float], drag: float) -> None:
        super().__init__()
        check_positive("drag", drag, allow_zero=True)
        self.center, self.drag = list(check_vector("center", center)), float(drag)
        self.register_buffer("middle", torch.tensor(self.center, dtype=torch.float64), persistent=False)
        self.middle: Tensor

    @abstractmethod
    def around(self, velocity: Tensor, place: Tensor) -> Tensor:
        """Potential flow at places from the centre [m], shape (..., P, 3)."""

    @abstractmethod
    def wake(self, place: Tensor, moment: Moment) -> Tensor:
        """Velocity deficit as a share of the speed, shape (..., P)."""

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        place = position - self.middle.to(position)
        found = self.around(velocity.to(position).expand_as(position), place)
        if self.drag == 0:
            return found
        return found * (1 - self.wake(place, moment)[..., None])

    def moved(self: AnyObstacle, frame: SimFrame, **values: Any) -> AnyObstacle:
        """A copy with its centre in metres, z up, and other values."""
        return changed(self, middle=torch.tensor(placed(frame, self.center), dtype=torch.float64), **values)


def _direction(flow: Tensor) -> Tensor:
    """Unit vector of a flow, zero in still air."""
    return flow / torch.linalg.vector_norm(flow).clamp(min=1e-12)


class CylinderObstacle(Obstacle):
    """A long pole in the wind.

    Args:
        center: A point on its axis, in scene units.
        radius: In scene units.
        axis: Direction of its axis.
        drag: Drag coefficient of its wake; 1.2 for a pole in wind, 0 for no wake.
    """

    def __init__(
        self,
        center: Sequence[float],
        radius: float,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        drag: float = 1.2,
    ) -> None:
        super().__init__(center, drag)
        check_positive("radius", radius)
        self.radius = float(radius)
        given = torch.tensor(check_vector("axis", axis), dtype=torch.float64)
        if not float(given.norm()) > 0:
            raise ValueError("Expected `axis` to have a direction, but it is zero.")
        self.register_buffer("axis", given / given.norm(), persistent=False)
        self.axis: Tensor

    def around(self, velocity: Tensor, place: Tensor) -> Tensor:
        return cylinder_flow(velocity, place, self.axis.to(place), self.radius)

    def twin(self) -> Twin:
        from gaussian_swaying.wind.obstacles_triton import past_cylinder

        return Twin(
            past_cylinder,
            options=(self.drag > 0,),
            numbers=Numbers(
                8, lambda: torch.cat([self.middle, self.axis, self.middle.new_tensor([self.radius, self.drag])])
            ),
            per_substep=Numbers(3, lambda moment: moment.flow),
            sources=(self,),
        )

    def wake(self, place: Tensor, moment: Moment) -> Tensor:
        axis = self.axis.to(place)
        flow = moment.flow.to(place)
        across = flow - (flow * axis).sum() * axis  # what flows along it meets nothing
        direction = _direction(across)
        left = torch.linalg.cross(axis, direction)
        return plane_wake((place * direction).sum(-1), (place * left).sum(-1), 2 * self.radius, self.drag)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """In metres, z up."""
        return self.moved(frame, radius=self.radius * frame.metres_per_unit, axis=frame.direction_to_sim(self.axis))


class EllipsoidObstacle(Obstacle):
    """An ellipsoid in the wind, such as a hill, a hedge or, if it is flat, a wall.

    Args:
        center: Its centre, in scene units.
        radii: Its half axes along the axes of the scene, in scene units.
        turn: Angle by which it is turned about the vertical [degrees].
        drag: Drag coefficient of its wake, below 1; 0 for no wake.
    """

    def __init__(self, center: Sequence[float], radii: Sequence[float], turn: float = 0.0, drag: float = 0.9) -> None:
        super().__init__(center, drag)
        self.radii = list(check_vector("radii", radii))
        for radius in self.radii:
            check_positive("radii", radius)
        if not drag < 1:
            raise ValueError(f"Expected `drag` of an ellipsoid to be below 1, but got {drag}: a wall has 0.9.")
        angle = torch.tensor(float(turn), dtype=torch.float64).deg2rad()
        cos, sin, zero = angle.cos(), angle.sin(), torch.zeros((), dtype=torch.float64)
        rows = [torch.stack([cos, sin, zero]), torch.stack([-sin, cos, zero]), torch.stack([zero, zero, zero + 1])]
        self.register_buffer("axes", torch.stack(rows), persistent=False)
        self.axes: Tensor

    def around(self, velocity: Tensor, place: Tensor) -> Tensor:
        axes = self.axes.to(place)
        return ellipsoid_flow(velocity @ axes.T, place @ axes.T, self.radii) @ axes

    def twin(self) -> Twin:
        from gaussian_swaying.wind.obstacles_triton import past_ellipsoid

        def numbers() -> Tensor:
            radii = tuple(map(float, self.radii))
            size = max(radii)
            shape = [*(radius / size for radius in radii), *ellipsoid_strength(radii)]
            rest = self.middle.new_tensor([size, self.drag, wake_start(self.drag), *shape])
            return torch.cat([self.middle, self.axes.reshape(-1), rest])

        return Twin(
            past_ellipsoid,
            options=(self.drag > 0,),
            numbers=Numbers(21, numbers),
            per_substep=Numbers(3, lambda moment: moment.flow),
            sources=(self,),
        )

    def wake(self, place: Tensor, moment: Moment) -> Tensor:
        """See :class:`Obstacle`: the Gaussian is as wide, and as high, as the body is across the flow."""
        direction = _direction(moment.flow).to(place)
        side = torch.stack([-direction[1], direction[0], torch.zeros_like(direction[0])])
        side = _direction(side)
        up = torch.linalg.cross(direction, side)
        scaled = torch.stack([axis * size for axis, size in zip(self.axes.to(place), self.radii, strict=True)])
        wide, high = (2 * torch.linalg.vector_norm(scaled @ part) for part in (side, up))
        mean = (wide * high).clamp(min=1e-12).sqrt()
        behind, left, above = ((place * part).sum(-1) for part in (direction, side, up))
        narrow = [mean / size.clamp(min=1e-12) for size in (wide, high)]
        aside = ((left * narrow[0]).square() + (above * narrow[1]).square()).sqrt()
        return round_wake(behind / mean, aside / mean, 1.0, self.drag)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """In metres, z up."""
        radii = [radius * frame.metres_per_unit for radius in self.radii]
        return self.moved(frame, radii=radii, axes=frame.direction_to_sim(self.axes))
