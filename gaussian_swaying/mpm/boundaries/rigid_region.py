"""A part of the material that moves as one rigid body."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.geometry.rigid import rigid_velocity
from gaussian_swaying.mpm.boundaries.boundary import Nodes, ParticleBoundary

FREE = 1e-9  # weight of a free node beside that of a held one: what holds a node of a body holds the body


class RigidRegion(ParticleBoundary):
    """Moves the material whose rest position lies in a region as one rigid body, driven by all forces on it.

    In each substep the nodes of its particles get the velocities of the rigid motion that has their momentum and
    angular momentum. Soft material pulls the body where it shares nodes with it, and is moved there. In ``updated``
    these are all nodes that the particles touch, in ``total`` those where they have more than ``held_share`` of the
    mass, as for a :class:`PinnedRegion` of kind ``nodes``.

    A pin of kind ``nodes`` that shares nodes with the body holds it, and a handle of that kind leads it.

    Args:
        region: Region of the body at rest, in scene units.
        held_share: Share of the nodal mass in ``total``, between 0 and 1.
    """

    needs_lattice = True
    recordable = True

    def __init__(self, region: Region, held_share: float = 0.07) -> None:
        super().__init__(region)
        if not 0 <= held_share < 1:
            raise ValueError(f"Expected `held_share` to lie in [0, 1), but got {held_share}.")
        self.held_share = held_share

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Give the nodes of the body the velocities of a rigid motion."""
        assert nodes.mass is not None
        assert nodes.lattice is not None
        index = nodes.index

        def part(field: Tensor, dim: int) -> Tensor:
            return field if index is None else field.index_select(dim, index)

        held, own = part(nodes.held, -1), part(velocity, -2)
        mass = torch.where(held, in_double(part(nodes.mass, -1)), 0.0)
        if nodes.fixed is not None:
            fixed = part(nodes.fixed, -1) & held
            mass = mass * torch.where(fixed | ~fixed.any(-1, keepdim=True), 1.0, FREE)
        dt = nodes.dt if isinstance(nodes.dt, float) else nodes.dt.to(mass)
        moved = rigid_velocity(in_double(part(nodes.lattice, -2)), in_double(own), mass, dt)
        moved = torch.where(held[..., None], moved.to(velocity), own)
        return moved if index is None else velocity.index_copy(-2, index, moved)
