r"""Contact of the surface with obstacles and with itself, in the ``total`` formulation.

A contact sample (``place`` in the code) is a row :math:`w` of constant weights on the nodes, of mass :math:`m_i`: it is
at :math:`X + \sum_i w_i u_i` and moves with :math:`\sum_i w_i v_i`. An impulse :math:`j` at it changes the nodes by
:math:`w_i j / m_i`. A constraint :math:`k` has a normal :math:`n`, a gap :math:`d` and two samples, or one sample and
an obstacle. Its relative velocity along the normal after the substep must satisfy

.. math:: v_n \ge -d / \Delta t \quad (d > 0), \qquad v_n \ge \min(0.01\,|d| / \Delta t,\; 0.004\,\Delta x / \Delta t)
          \quad (d \le 0),

so that a gap closes at most to zero within a substep, and an overlap is removed in some substeps, at no more than one
per cent of the wave speed (the substep is 0.4 of the time in which a wave crosses a cell). The impulse only pushes
(:math:`\lambda \ge 0`), and Coulomb's friction is at most :math:`\mu\lambda` against the sliding velocity.

The impulses are found by Jacobi's iteration, all at once, with Nesterov's momentum (Mazhar et al. 2015, "Using
Nesterov's method to accelerate multibody dynamics with friction and contact"), so that a pile of n layers takes of
order n iterations. The step of a constraint is one over the sum of the absolute values of its row in
:math:`A = J M^{-1} J^T`, so the iteration cannot overshoot (Gershgorin): for a lone sample it is the mass that the
sample really has, and for a whole area in contact the mass of the area. With :math:`c` constraints at each sample the
sum is bounded by :math:`\sum_i |w_i| s_i / m_i`, :math:`s_i = \sum |w_i| c`, without forming A.

Two samples touch if one lies above the disc of the other. With :math:`a` the way from one to the other, the normal is
:math:`\sum (a \cdot n)\,n` over the discs above which the other lies, normalised: it needs no orientation of
the normals :math:`n`, and for an edge that meets a face it is the normal of the face. Kernels do all this
(:mod:`~gaussian_swaying.mpm.contact_kernels`).

Friction that sticks yields a little: with step :math:`\alpha` and friction :math:`j_t` it leaves the slip
:math:`v_t = -c\,j_t / \alpha`, c = ``CREEP`` (Todorov 2014, "Convex and analytically-invertible dynamics with contacts
and constraints", regularises friction so). The iterations are never finished, and with momentum they overshoot: k of
them leave the share :math:`r_k(\lambda)` of the slip of a mode that one step reduces by :math:`\lambda`. Where it is
negative, friction has pushed the material instead of holding it, in every substep again. What is left with c is
:math:`(c + \lambda\,r_k(\lambda + c)) / (c + \lambda)`. From c = 0.01 on it is nowhere negative, after any number of
iterations.

The two samples of a pair get opposite impulses, so momentum is conserved to round-off; angular momentum up to the
torque of an impulse times the shift of the two samples along the surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape
from gaussian_swaying._fixed import fixed
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints
from gaussian_swaying.mpm.transfer import bspline_stencil
from gaussian_swaying.mpm.virtual_nodes import coordinates, point_with_nodes

APART = 2.0
"""Samples closer than this at rest [cells] are neighbours: they share nodes, and a fold cannot be sharper."""


@fixed
@dataclass(frozen=True)
class Contact:
    """Contact of the material with itself: between the layers of a sheet, and between objects.

    It cannot be changed, as the surface keeps the thickness that it was made with: make another simulation.

    Args:
        thickness: Distance that two surfaces keep [m]; null for the thickness of the material at each place. Obstacles
            are kept at half of it.
        friction: Coulomb coefficient.
        iterations: Most iterations for the impulses of a substep. Two or three are made where sheets touch, more at
            an impact and in a pile; 16 are enough for eight layers.

    Raises:
        ValueError: If a number is out of range.
    """

    thickness: float | None = None
    friction: float = 0.3
    _: KW_ONLY
    iterations: int = 100

    def __post_init__(self) -> None:
        if self.thickness is not None:
            check_positive("contact.thickness", self.thickness)
        check_positive("contact.friction", self.friction, allow_zero=True)
        if isinstance(self.iterations, bool) or not isinstance(self.iterations, int) or self.iterations < 1:
            raise ValueError(
                f"Expected `contact.iterations` to be a whole number of at least 1, but got {self.iterations}."
            )


@dataclass(frozen=True, slots=True)
class Surface:
    """Contact samples of the surface, which touch obstacles and each other: discs around them cover it.

    Attributes:
        place: Rest positions [m], shape (C, 3).
        normal: Unit normals at rest, of either sign, shape (C, 3).
        radius: Radii of the discs [m], shape (C,).
        thickness: Distance that two surfaces keep [m], shape (C,).
        read: Rest position at which the motion of each is interpolated [m], shape (C, 3): the sample itself, or one
            close to it if some of its nodes have no mass.
        contact: Contact of the surface with itself; None if only obstacles count.
        near: The material point that each belongs to, shape (C,); the nearest one if None.
    """

    place: Tensor
    normal: Tensor
    radius: Tensor
    thickness: Tensor
    read: Tensor
    contact: Contact | None = None
    near: Tensor | None = None

    def __post_init__(self) -> None:
        check_shape("place", self.place, "C", 3)
        for name in ("normal", "read"):
            check_shape(name, getattr(self, name), len(self.place), 3)
        for name in ("radius", "thickness"):
            check_shape(name, getattr(self, name), len(self.place))

    @classmethod
    def of_points(
        cls,
        points: MaterialPoints,
        normal: Tensor | None = None,
        spacing: float = 0.0,
        thickness: float = 0.0,
        contact: Contact | None = None,
    ) -> Surface:
        """The material points as a surface.

        Args:
            points: The material.
            normal: Normals of the sheet at its points, shape (P, 3); needed for contact with itself.
            spacing: Distance of neighbouring points [m]; discs reach 0.75 of it.
            thickness: Distance that two surfaces keep [m], unless ``contact`` has one.
            contact: Contact of the surface with itself.
        """
        place = points.position.detach().reshape(-1, 3)
        if contact is not None and (normal is None or spacing <= 0 or points.position.dim() > 2):
            raise ValueError(
                "Contact of a surface with itself needs one scene, and `normal` and `spacing` of its points."
            )
        h = thickness if contact is None or contact.thickness is None else contact.thickness
        full = place.new_full((len(place),), 1.0)
        facing = torch.zeros_like(place) if normal is None else normal.to(place)
        own = torch.arange(points.count, device=place.device).repeat(len(place) // points.count)
        return cls(place, facing, 0.75 * spacing * full, h * full, place, contact, own)

    def map(self, function: Callable[[Tensor], Tensor]) -> Surface:
        place, normal, read = (function(field) for field in (self.place, self.normal, self.read))
        near = None if self.near is None else self.near.to(place.device)
        return Surface(place, normal, function(self.radius), function(self.thickness), read, self.contact, near)


class ContactStage:
    """The contact samples of a body on its grid.

    Args:
        surface: The contact samples.
        boundaries: The boundaries of the body; those that are obstacles act here.
        kinds: Kind of each boundary (``Boundary.hold_kind``).
        grid: The nodes.
        inverse_mass: Their inverse mass [1/kg], 0 for a node without mass, shape (..., G).
        points: With virtual nodes, the first node of the cell of each material point and its nodes, over all scenes.

    Raises:
        ValueError: If a sample has no material.
    """

    def __init__(
        self,
        surface: Surface,
        boundaries: Sequence[Boundary],
        kinds: Sequence[str],
        grid: GridSpec,
        inverse_mass: Tensor,
        points: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self.surface, self.contact, self.grid, self.dx = surface, surface.contact, grid, grid.dx
        self.obstacles = [(k, b) for k, b in enumerate(boundaries) if kinds[k] == "surface" and isinstance(b, Obstacle)]
        self.iterations = Contact.iterations if self.contact is None else self.contact.iterations
        self.inverse_mass = inverse_mass.detach().reshape(-1)
        self.scenes = len(self.inverse_mass) // grid.node_count
        each = len(surface.place) // self.scenes
        read = surface.read.reshape(self.scenes, each, 3) if self.scenes > 1 else surface.read
        stencil = bspline_stencil(read, grid, False, torch.finfo(read.dtype).eps ** 0.5)
        if not bool(stencil.inside.all()):
            raise ValueError("A contact sample lies outside the material: give samples on the simulated points.")
        basis = stencil.basis  # (C, 4, 27)
        self.node = stencil.node
        self.corner: Tensor | None = None
        if points is not None:
            self.node = self._nodes(stencil.first, *points)
            self.corner = coordinates(stencil.first % grid.node_count, grid)
        self.first, self.fraction = stencil.first, stencil.fraction
        self.weight = basis[:, 0] + ((surface.place - surface.read)[:, :, None] * basis[:, 1:4]).sum(1)
        self.reach = self.apart = 0.0
        if self.contact is not None:
            widest, thickest = float(surface.radius.amax()), float(surface.thickness.amax())
            self.reach = math.hypot(widest, thickest)
            self.apart = max(APART * self.dx, 3 * thickest)

    def _nodes(self, first: Tensor, point_first: Tensor, point_node: Tensor) -> Tensor:
        """The nodes of the samples, with virtual ones: those of the material point that each belongs to."""
        near, many = self.surface.near, len(point_first) // self.scenes
        if near is None:
            raise ValueError("Contact of a body with `attached` parts needs `near` in its Surface.")
        number = torch.arange(self.scenes).repeat_interleave(len(first) // self.scenes)
        belongs = near.cpu() + many * number
        host = point_with_nodes(first.cpu(), belongs, point_first.cpu(), point_node.cpu(), self.grid)
        if bool((host < 0).any()):
            k = int((host < 0).int().argmax())
            raise ValueError(f"The contact sample {k} lies in a cell without material of its piece: move its `read`.")
        return point_node.T[host.to(point_node.device)]
