"""Base class of the rigid obstacles that the material cannot enter."""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath, between, fastest
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.mpm.boundaries.boundary import Boundary, Nodes
from gaussian_swaying.mpm.boundaries.plane import plane_velocity
from gaussian_swaying.mpm.twins import Numbers, Twin


class Obstacle(Boundary):
    """A rigid body, fixed or moving, that the material cannot enter, with Coulomb friction.

    In ``total`` it stops contact samples of the body's surface, at the obstacle's own surface
    (:mod:`~gaussian_swaying.mpm.contact`). In ``updated`` it stops grid nodes, as a ``Plane`` does, so the gap is up to
    a cell wide.

    Args:
        center: Origin of its own axes at rest, in scene units.
        friction: Coulomb coefficient.
        gap: Distance that the material keeps from it [m].
        path: Motion of the obstacle; None for one at rest.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True

    def __init__(
        self,
        center: tuple[float, ...],
        friction: float = 0.3,
        gap: float = 0.0,
        path: KeyedPath | None = None,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        check_positive("friction", friction, allow_zero=True)
        check_positive("gap", gap, allow_zero=True)
        self.friction, self.gap, self.path = float(friction), float(gap), path
        self.register_buffer("center", torch.tensor(center, dtype=torch.float64))
        times, moves, turns = KeyedPath([0.0]).keys() if path is None else path.keys()
        for name, value in (("times", times), ("shifts", moves), ("turns", turns)):
            self.register_buffer(name, value)
        self.center: Tensor
        self.times: Tensor
        self.shifts: Tensor
        self.turns: Tensor

    def in_metres(self, frame: SimFrame, **tensors: Tensor) -> Obstacle:
        """A copy with its centre and path in metres, and with some tensors replaced."""
        if self.path is not None:
            _, moves, turns = self.path.keys(frame)
            tensors |= {"shifts": moves, "turns": turns}
        return self.copy_in(frame, center=frame.point_to_sim(self.center), **tensors)

    def hold_kind(self, neighbours_fixed: bool) -> str:
        """``surface``: it acts on the surface where particles keep their neighbours, otherwise on ``nodes``."""
        return "surface" if neighbours_fixed else "nodes"

    @abstractmethod
    def distance(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance from its surface and the gradient of it, at rest.

        Args:
            place: Places relative to its centre [m], shape (..., 3).

        Returns:
            Distances [m], negative inside, shape (...), and unit vectors (..., 3).
        """

    @property
    def still(self) -> bool:
        """True if it never moves."""
        return self.path is None

    def fastest(self, farthest: float, start: float = -math.inf, end: float = math.inf) -> float:
        """Bound of its speed [m/s] at places up to ``farthest`` [m] from its centre, between two times [s]."""
        start, end = max(start, self.start), min(end, self.end)
        if not start < end:
            return 0.0
        turning = fastest(self.times, self.turns, start, end)
        return fastest(self.times, self.shifts, start, end) + (turning * farthest if turning else 0.0)

    def pose(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Its centre [m], shape (3,), and its rotation, shape (3, 3), at a time [s]; float64."""
        return self.center + between(self.times, self.shifts, time), rotation_of(between(self.times, self.turns, time))

    def touch(self, place: Tensor, time: Tensor, dt: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distance from the obstacle, its normal, and its velocity at places.

        Args:
            place: Places [m], shape (..., 3).
            time: Time now [s], scalar float64 tensor.
            dt: Substep [s]; the velocity takes each place of the obstacle to where it is ``dt`` later.

        Returns:
            Distance less the ``gap`` [m], shape (...), normal out of the obstacle and velocity [m/s], shape (..., 3).
        """
        if self.still:
            distance, normal = self.distance(place - self.center.to(place))
            return distance - self.gap, normal, torch.zeros_like(place)
        (here, turn), (there, turned) = self.pose(time), self.pose(time + dt)
        own = (place - here.to(place)) @ turn.to(place)
        distance, normal = self.distance(own)
        later = own @ turned.T.to(place) + (there - here).to(place)
        return distance - self.gap, normal @ turn.T.to(place), (later - (place - here.to(place))) / dt

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        distance, normal, own = self.touch(nodes.position, nodes.time, nodes.dt)
        stopped = own + plane_velocity(velocity - own, normal, "separate", self.friction)
        return torch.where(((distance <= 0) & self.active(nodes.time))[..., None], stopped, velocity)


def grid_twin(obstacle: Obstacle, values: Tensor, corner: Tensor, axes: Tensor, spacing: float) -> Twin:
    """The twin of an obstacle whose distances [m] are on a grid, shape (X, Y, Z); its axes are columns."""
    from gaussian_swaying.geometry.distance_triton import grid_distance

    def numbers() -> Tensor:
        return torch.cat([corner, axes.to(corner).reshape(-1), corner.new_tensor([spacing, *values.shape])])

    table = Numbers(values.numel(), lambda: values)
    return Twin(grid_distance, numbers=Numbers(16, numbers), table=table, sources=(obstacle,))
