"""A half space that nothing can enter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.boundaries.boundary import Boundary, Nodes
from gaussian_swaying.mpm.twins import Numbers, Twin

KINDS = ("sticky", "slip", "separate")


def plane_velocity(velocity: Tensor, normal: Tensor, kind: str, friction: float) -> Tensor:
    """Velocity of nodes in contact with a plane at rest.

    Args:
        velocity: Node velocity [m/s], shape (..., 3).
        normal: Unit normal, pointing to the free side, shape (3,).
        kind: ``sticky`` (no motion), ``slip`` (no motion along the normal), ``separate`` (no motion into the plane).
        friction: Coulomb coefficient: the tangential speed falls by at most ``friction`` times the normal speed that
            the contact removes.

    Returns:
        Shape (..., 3).
    """
    if kind == "sticky":
        return torch.zeros_like(velocity)
    along = (velocity * normal).sum(-1, keepdim=True)
    removed = along.clamp(max=0.0) if kind == "separate" else along
    tangential = velocity - along * normal
    if friction > 0:
        speed = torch.linalg.vector_norm(tangential, dim=-1, keepdim=True)
        tangential = tangential * (
            1 - friction * removed.abs() / speed.clamp(min=torch.finfo(velocity.dtype).tiny)
        ).clamp(min=0.0)
    return tangential + (along - removed) * normal


class Plane(Boundary):
    """A half space that particles cannot enter.

    Args:
        point: A point of the plane, in scene units.
        normal: Normal towards the free side, in scene axes.
        kind: ``sticky``, ``slip`` or ``separate`` (see :func:`plane_velocity`).
        friction: Coulomb friction coefficient of ``slip`` and ``separate``.
        start: Time from which it acts [s].
        end: Time from which it no longer acts [s]; None for never.
    """

    needs_position = True
    recordable = True

    def __init__(
        self,
        point: Sequence[float],
        normal: Sequence[float],
        kind: str = "separate",
        friction: float = 0.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        super().__init__(start, end)
        check_choice("kind", kind, KINDS)
        check_positive("friction", friction, allow_zero=True)
        self.kind, self.friction = kind, float(friction)
        n = torch.tensor(check_vector("normal", normal), dtype=torch.float64)
        if float(n.norm()) == 0:
            raise ValueError("Expected `normal` of the plane not to be zero.")
        self.register_buffer("point", torch.tensor(check_vector("point", point), dtype=torch.float64))
        self.register_buffer("normal", n / n.norm())
        self.point: Tensor
        self.normal: Tensor

    def in_frame(self, frame: SimFrame) -> Plane:
        """The plane in metres, z up."""
        normal = frame.direction_to_sim(self.normal).clone()
        return self.copy_in(frame, point=frame.point_to_sim(self.point), normal=normal)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        normal = self.normal.to(velocity)
        behind = ((nodes.position - self.point.to(velocity)) * normal).sum(-1) <= 0
        stopped = plane_velocity(velocity, normal, self.kind, self.friction)
        return torch.where((behind & self.active(nodes.time))[..., None], stopped, velocity)

    def twin(self) -> Twin:
        from gaussian_swaying.geometry.distance_triton import half_space_distance

        return Twin(half_space_distance, numbers=Numbers(3, lambda: self.normal), sources=(self,))
