"""A box that nothing can leave."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying._fixed import FixedList, changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.boundaries.boundary import Boundary, Nodes
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.twins import Twin


class EnclosingBox(Boundary):
    """Six planes that keep the particles inside an axis-aligned box.

    Args:
        min: Smallest corner, in scene units.
        max: Largest corner, in scene units.
        kind: ``sticky``, ``slip`` or ``separate``.
        friction: Coulomb friction coefficient of ``slip`` and ``separate``.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True

    def __init__(
        self,
        min: Sequence[float],
        max: Sequence[float],
        kind: str = "separate",
        friction: float = 0.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        low, high = check_vector("min", min), check_vector("max", max)
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"Expected `min` of the box to be below `max` on every axis, but got {low} and {high}.")
        planes = []
        for axis in range(3):
            direction = [0.0, 0.0, 0.0]
            direction[axis] = 1.0
            planes.append(Plane(low, direction, kind, friction, start, end))
            planes.append(Plane(high, [-d for d in direction], kind, friction, start, end))
        self.planes = FixedList(planes)

    def in_frame(self, frame: SimFrame) -> EnclosingBox:
        """The box in metres, z up."""
        return changed(self, planes=FixedList(p.in_frame(frame) for p in self.planes))  # type: ignore[operator]

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        for plane in self.planes:
            velocity = plane(velocity, nodes)
        return velocity

    def twin(self) -> Twin:
        """Nothing but that of each plane."""
        return Twin(None, parts=tuple(plane.twin() for plane in self.planes))  # type: ignore[operator]
