"""The body of a run: its material, bound to its laws and to the boundaries that act on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import joined
from gaussian_swaying.mpm.boundaries.boundary import CLOCK, Boundary
from gaussian_swaying.mpm.boundaries.rigid_region import RigidRegion
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.dispatch import LawDispatch
from gaussian_swaying.mpm.state import MaterialPoints


@dataclass(frozen=True, slots=True)
class Held:
    """The particles that a boundary holds, and the nodes held through them.

    Attributes:
        mass: Mass of those particles [kg], zero elsewhere, shape (..., P).
        total: Mass of all of them [kg], shape (...).
        release: Time at which each particle is released [s], shape (..., P), or None if they are not released one by
            one.
        share: Their share of the mass of each node, shape (..., G), if it is constant, else None.
        threshold: Share above which a node is held.
        nodes: The nodes that are held in any scene, shape (K,), if their share is constant, else None.
    """

    mass: Tensor
    total: Tensor
    release: Tensor | None = None
    share: Tensor | None = None
    threshold: float = 0.0
    nodes: Tensor | None = None

    def mass_at(self, time: Tensor) -> Tensor:
        """Mass of the particles that are held at a time [kg], zero elsewhere, shape (..., P)."""
        return self.mass if self.release is None else torch.where(self.release > time + CLOCK, self.mass, 0.0)


class Body:
    """A material, its laws, and the boundaries that act on it.

    Args:
        points: The material at rest.
        boundaries: Boundary conditions in metres, in order.
        surface: Contact samples of its surface; None for the material points, which then touch obstacles only.

    Attributes:
        laws: The laws of the material, bound to its particles.
        held: The particles that each boundary holds; None for one that holds none.
        rigid: The places among the boundaries of those that make a part rigid.
    """

    def __init__(self, points: MaterialPoints, boundaries: Sequence[Boundary], surface: Surface | None = None) -> None:
        self.points, self.boundaries, self.surface = points, tuple(boundaries), surface
        self.laws = LawDispatch(points)
        self.held = tuple(_held(points, boundary) for boundary in self.boundaries)
        self.rigid = [k for k, boundary in enumerate(self.boundaries) if isinstance(boundary, RigidRegion)]

    @cached_property
    def pieces(self) -> list[Tensor | None]:
        """The points of each connected piece, int64, on the CPU; one entry of None if there is only one."""
        attached = self.points.attached
        if attached is None:
            return [None]
        attached = attached.cpu()
        label = attached if attached.dim() == 1 else joined(self.points.count, attached.T)
        _, of = torch.unique(label, return_inverse=True)
        many = of.bincount()
        return [None] if len(many) < 2 else list(of.argsort(stable=True).split(many.tolist()))

    def soften(self, particles: Tensor, factor: float) -> None:
        """Multiply the stiffness of some particles, bool (..., P), with a factor; ``points`` stay as they are."""
        E = self.points.youngs_modulus
        self.laws = LawDispatch(replace(self.points, youngs_modulus=torch.where(particles, factor * E, E)))

    def is_rigid(self) -> Tensor:
        """The particles of rigid parts, bool, shape (..., P)."""
        found = torch.zeros_like(self.points.mass, dtype=torch.bool)
        for k in self.rigid:
            held = self.held[k]
            assert held is not None
            found |= held.mass > 0
        return found

    def mapped_surface(self, function: Callable[[Tensor], Tensor]) -> Surface | None:
        """The surface with a function applied to its tensors, if there is one."""
        return None if self.surface is None else self.surface.map(function)

    def tensors(self) -> list[Tensor]:
        """Tensors that a substep depends on, besides its state and forces; any of them may require a gradient."""
        points = self.points
        own = [points.position, points.mass, points.volume, points.youngs_modulus, points.poisson_ratio]
        own += [] if points.bending is None else [points.bending]
        return own + [t for boundary in self.boundaries for t in (*boundary.parameters(), *boundary.buffers())]


def _held(points: MaterialPoints, boundary: Boundary) -> Held | None:
    position = points.position.detach()
    mask = boundary.particle_mask(position)
    if mask is None:
        return None
    mass = torch.where(mask, points.mass, 0.0)
    return Held(mass, mass.sum(-1), boundary.release_time(position))
