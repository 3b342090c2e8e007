"""The force of the wind on a surface patch."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import (
    Number,
    check_choice,
    check_plain,
    check_positive,
    check_shape,
    check_vector,
    number_of,
)
from gaussian_swaying._fixed import Fixed
from gaussian_swaying.geometry.groups import sums
from gaussian_swaying.geometry.linalg import cofactor
from gaussian_swaying.wind.patches import PatchSums

LAWS = ("paper", "projected", "linear", "cross_flow")


Product = tuple[Tensor | float, Tensor | float]
"""A vector as a product of two factors, which multiply a coefficient one after the other."""


def drag_speed(wind: Tensor, speed: Tensor, law: str) -> Tensor:
    """Speed that the drag is proportional to, besides that of the flow along a patch: that of the wind if ``linear``.

    Args:
        wind: Air velocity [m/s], broadcastable to (..., P, 3).
        speed: Relative speed [m/s], shape (..., P).
        law: One of :data:`LAWS`; with ``cross_flow`` it is a bound.
    """
    return torch.linalg.vector_norm(wind, dim=-1).expand_as(speed) if law == "linear" else speed


def wind_terms(
    wind: Tensor,
    relative: Tensor,
    facing: Product,
    across: Product,
    pressed: Tensor,
    tangent: Tensor,
    *,
    drag: Tensor | float,
    friction: Tensor | float,
    lift: Tensor | float,
    law: str,
) -> Tensor:
    r"""Drag, friction and lift per half density: the law of the force, of one patch or of a sum over patches.

    Each term is :math:`v_r^2` times that of :func:`aero_force`, without ever dividing by :math:`v_r`.

    Args:
        wind: Air velocity u [m/s], broadcastable to (..., P, 3).
        relative: Relative wind [m/s], shape (..., P, 3).
        facing: Area vector s on the side that meets the flow; per area for one patch, (..., P, 3).
        across: The part of the flow through the patch, :math:`A\, (\mathbf{v}_r \cdot \mathbf{n})\, \mathbf{n}`.
        pressed: The same times the size of the flow through the patch,
            :math:`A\, |\mathbf{v}_r \cdot \mathbf{n}| (\mathbf{v}_r \cdot \mathbf{n})\, \mathbf{n}`.
        tangent: The part along it.
        drag: C_D.
        friction: C_F.
        lift: C_L.
        law: See :func:`aero_force`.

    Returns:
        Shape (..., P, 3).
    """
    speed = torch.linalg.vector_norm(relative, dim=-1, keepdim=True)
    if law == "paper":
        pressure = drag * (speed * speed * facing[0]) * facing[1]
    elif law == "cross_flow":
        pressure = drag * pressed
    else:
        pressure = drag * (drag_speed(wind, speed[..., 0], law)[..., None] * across[0]) * across[1]
    side = torch.linalg.cross(relative, facing[0] * facing[1], dim=-1)
    return pressure + friction * speed * tangent + lift * (speed * side)


def aero_force(
    wind: Tensor,
    velocity: Tensor,
    normal: Tensor,
    area: Tensor,
    *,
    drag: Tensor | float,
    friction: Tensor | float,
    lift: Tensor | float,
    air_density: float = 1.225,
    law: str = "paper",
) -> Tensor:
    r"""Drag, friction and lift on patches in relative wind (paper, "Aerodynamics").

    .. math::
        \mathbf{f} = \tfrac12 \rho\, v_r^2 A \bigl( C_D\, \mathbf{n} + C_F\, \mathbf{d}^t
        + C_L\, \mathbf{d} \times \mathbf{n} \bigr), \qquad
        \mathbf{v}_r = \mathbf{u} - \mathbf{v} = v_r \mathbf{d}, \quad
        \mathbf{d}^t = \mathbf{d} - (\mathbf{d} \cdot \mathbf{n}) \mathbf{n}

    A patch has no inside or outside, so its normal is flipped to point along the flow (n·d >= 0). Otherwise drag could
    push upwind. With the ``paper`` law, a patch that is exactly edge-on keeps the given sign.

    Args:
        wind: Air velocity u [m/s], broadcastable to (..., P, 3).
        velocity: Patch velocity v [m/s], shape (..., P, 3).
        normal: Unit normal of either sign, shape (..., P, 3).
        area: Patch area [m²], shape (..., P); a patch of zero area feels no force.
        drag: C_D.
        friction: C_F.
        lift: C_L.
        air_density: Density of the air [kg/m³].
        law: ``paper`` follows the paper literally: the full drag acts along n at every angle of incidence.
            ``projected`` multiplies the drag by n·d, as for a plate, so that it vanishes edge-on. ``linear`` is the
            drag of Blender's cloth, :math:`\tfrac12 \rho A C_D |\mathbf{u}| (\mathbf{v}_r \cdot \mathbf{n})\,
            \mathbf{n}`: that of ``projected`` on a patch at rest, but linear in the velocity of the patch. In still
            air this drag is zero, however the patch moves. ``cross_flow`` is the drag of the flow along the normal
            alone, :math:`\tfrac12 \rho A C_D |\mathbf{v}_r \cdot \mathbf{n}| (\mathbf{v}_r \cdot \mathbf{n})\,
            \mathbf{n}` (the independence principle: Taylor 1952; Gosselin, de Langre & Machado-Almeida 2010, JFM 650,
            319, for plates that bend). Friction and lift are those of the other laws.

    Returns:
        Force [N], shape (..., P, 3).

    Raises:
        ValueError: If a shape does not fit or an option is unknown.
    """
    check_choice("law", law, LAWS)
    patches = velocity.shape[-2]
    check_shape("velocity", velocity, "P", 3)
    check_shape("normal", normal, patches, 3)
    check_shape("area", area, patches)
    check_shape("wind", wind, 3)
    wind = wind.to(velocity)
    relative = wind - velocity
    along = (relative * normal).sum(-1, keepdim=True)
    sign = torch.where(along < 0, -1.0, 1.0)
    oriented = sign * normal
    tangent = relative - along * normal
    terms = wind_terms(
        wind, relative, (1.0, oriented), (sign * along, oriented), along * along * oriented, tangent, drag=drag,
        friction=friction, lift=lift, law=law,
    )  # fmt: skip
    return (0.5 * air_density) * area[..., None] * terms


def grouped_force(
    wind: Tensor,
    velocity: Tensor,
    deformation_gradient: Tensor,
    patches: PatchSums,
    *,
    drag: Tensor | float,
    friction: Tensor | float,
    lift: Tensor | float,
    air_density: float = 1.225,
    law: str = "paper",
    max_area_ratio: float = math.inf,
) -> tuple[Tensor, Tensor]:
    r"""Force on the patches of each point, see :mod:`~gaussian_swaying.wind.patches`, and their area now.

    Args:
        wind: Air velocity [m/s], broadcastable to (P, 3).
        velocity: Velocity of the points [m/s], shape (P, 3).
        deformation_gradient: Total deformation gradient of the points, shape (P, 3, 3).
        patches: The sums over the patches.
        drag: C_D.
        friction: C_F.
        lift: C_L.
        air_density: Density of the air [kg/m³].
        law: As in :func:`aero_force`.
        max_area_ratio: Largest ratio of the area to that at rest (see
            :func:`capped_area`).

    Returns:
        Force [N], shape (P, 3), and area [m²], shape (P,).
    """
    wind = wind.to(velocity)
    relative = wind - velocity
    cof = cofactor(deformation_gradient)
    pulled = (cof * relative[..., None]).sum(-2)  # w
    turned = (cof[..., :, :, None] * patches.tensor[..., None, :, :]).sum(-2)  # cof(F) A N N^T
    rest = patches.area
    grown = ((turned * cof).sum((-2, -1)) / rest.clamp(min=torch.finfo(rest.dtype).tiny)).clamp(min=0)
    growth = grown.clamp(min=torch.finfo(rest.dtype).tiny).sqrt()
    across = (turned * pulled[..., None, :]).sum(-1) / growth[..., None]  # T v_r
    facing = torch.zeros_like(across)
    if law in ("paper", "cross_flow") or not _is_zero(lift):
        dots = (patches.vector * pulled[patches.point]).sum(-1, keepdim=True)
        sign = torch.where(dots < 0, -1.0, 1.0)
        signed = sums(sign * patches.vector, patches.point, len(relative))
        facing = (cof * signed[..., None, :]).sum(-1)  # s
    area = growth * rest
    pressed = torch.zeros_like(across)
    if law == "cross_flow":
        flow = dots * dots.abs() / patches.vector.square().sum(-1, keepdim=True)
        pressed = (cof * sums(flow * patches.vector, patches.point, len(relative))[..., None, :]).sum(-1)
        pressed = pressed / growth.square()[..., None]
    tangent = area[..., None] * relative - across
    terms = wind_terms(
        wind, relative, (facing, 1.0), (across, 1.0), pressed, tangent, drag=drag, friction=friction, lift=lift,
        law=law,
    )  # fmt: skip
    scale = 0.5 * air_density * (rest > 0).to(rest)
    if max_area_ratio < math.inf:
        cap = (max_area_ratio / growth).clamp(max=1.0)
        scale, area = scale * cap, area * cap
    return scale[..., None] * terms, area


def _is_zero(coefficient: Tensor | float) -> bool:
    """True for a coefficient that is known to be zero without waiting for a GPU."""
    if isinstance(coefficient, Tensor):
        return not (coefficient.is_cuda or coefficient.requires_grad) and float(coefficient) == 0
    return coefficient == 0


def drag_rate(speed: Tensor, area: Tensor, mass: Tensor, coefficient: Tensor | float, air_density: float) -> Tensor:
    r"""Rate :math:`\rho A C v_r / m` [1/s] at which drag changes a patch's velocity; explicit steps need dt < 2 / rate.

    Args:
        speed: Relative speed [m/s], shape (..., P).
        area: Patch area [m²], shape (..., P).
        mass: Mass [kg], shape (..., P).
        coefficient: Sum of the coefficients.
        air_density: Density of the air [kg/m³].

    Returns:
        Shape (..., P).
    """
    return air_density * coefficient * area * speed / mass


def capped_area(area: Tensor, rest_area: Tensor, max_ratio: float) -> Tensor:
    r"""Area that the wind acts on, :math:`\min(A, r_{max} A_0)`.

    The total deformation gradient of a plastic material grows without bound, and so does the area from Nanson's
    formula. But a patch of grains catches no more wind than its grains do. Without a cap, wind and area would amplify
    each other.

    Args:
        area: Current patch area [m²], shape (..., P).
        rest_area: Patch area at rest [m²], shape (..., P).
        max_ratio: Largest allowed ratio of the two; infinite for no cap.

    Returns:
        Shape (..., P). The gradient with respect to ``area`` is zero where the cap applies.
    """
    return area if max_ratio == math.inf else torch.minimum(area, max_ratio * rest_area)


def added_mass_per_area(breadth: float, air_density: float) -> float:
    r"""Mass of the air that a plate carries when it is accelerated along its normal, :math:`\rho \pi b / 4`, per area.

    That of the potential flow about a plate of the breadth b and of infinite length (Lamb, Hydrodynamics): a length of
    it carries the air of a cylinder of the diameter b. Spread evenly over the breadth, it slows a sheet of
    :math:`\sigma` kg/m² in still air to :math:`\sqrt{\sigma / (\sigma + \rho \pi b / 4)}` of its frequency.

    Args:
        breadth: The smaller side b of the plate [m].
        air_density: Density of the air [kg/m³].

    Returns:
        Mass per area of the plate, seen from one side [kg/m²].

    Example:
        >>> round(added_mass_per_area(1.0, 1.225), 3)
        0.962
    """
    return 0.25 * math.pi * air_density * breadth


class AeroForce(Fixed, nn.Module):
    """Wind on surface patches: stores the coefficients and calls :func:`aero_force`.

    The paper's coefficients are visual parameters. For comparison, a flat plate across the flow has a C_D of about 1.2,
    and skin friction is about 0.005. In Python the three coefficients may be tensors, which keep their gradient.

    Args:
        C_D: Drag coefficient.
        C_F: Friction coefficient.
        C_L: Lift coefficient.
        air_density: Density of the air [kg/m³].
        law: ``paper``, ``projected``, ``linear`` or ``cross_flow``.
        drag_step: ``explicit``, or ``semi_implicit``: the solver evaluates the drag at the velocity at the end of the
            substep (see :meth:`resistance`), so that very light objects in strong wind need no shorter substeps.
        max_area_ratio: Largest ratio of a patch's area in the wind to its area at rest (see :func:`capped_area`); null
            for no cap, which suits elastic materials. Plastic materials need a cap, for example 1.
        added_mass: Breadth b [m] of a thin, wide thing (laundry, a curtain, a leaf), for the air that it carries along:
            :func:`added_mass_per_area` more inertia per area of its patches at rest, and no more weight. It acts in all
            directions: that along the sheet is overestimated, which hardly moves for a sheet. In a simulation it is
            part of what the solver is bound to; a force of wind alone is the same with and without. Computed air has
            inertia of its own. 0 for none.

    Example:
        >>> aero = AeroForce(C_D=1.0, C_F=0.0, C_L=0.0, air_density=2.0)
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> aero(torch.tensor([0.0, 0.0, -3.0]), torch.zeros(1, 3), up, torch.ones(1))[0, 2]
        tensor(-9.)
    """

    live_as = "aero"

    def __init__(
        self,
        C_D: Number = 0.5,
        C_F: Number = 0.4,
        *,
        C_L: Number = 0.01,
        air_density: float = 1.225,
        law: Literal["paper", "projected", "linear", "cross_flow"] = "paper",
        drag_step: Literal["explicit", "semi_implicit"] = "explicit",
        max_area_ratio: float | None = None,
        added_mass: float = 0.0,
    ) -> None:
        super().__init__()
        numbers = {"C_D": number_of(C_D), "C_F": number_of(C_F), "air_density": air_density, "added_mass": added_mass}
        for name, value in numbers.items():
            check_positive(name, value, allow_zero=True)
        check_vector("C_L", [number_of(C_L)], 1)
        check_plain("max_area_ratio", max_area_ratio)
        if max_area_ratio is not None and not max_area_ratio > 0:
            raise ValueError(
                f"Expected `max_area_ratio` to be positive, or null for no cap on the area, but got {max_area_ratio}."
            )
        # float64 scalars: they neither lower the precision of a float64 run nor raise that of a float32 run
        for name, value in (("C_D", C_D), ("C_F", C_F), ("C_L", C_L)):
            given = value.reshape(()).double() if isinstance(value, Tensor) and value.requires_grad else float(value)
            self.register_buffer(name, torch.as_tensor(given, dtype=torch.float64))
        self.C_D: Tensor
        self.C_F: Tensor
        self.C_L: Tensor
        self.air_density, self.law, self.drag_step = float(air_density), law, drag_step
        self.max_area_ratio = math.inf if max_area_ratio is None else float(max_area_ratio)
        self.added_mass = float(added_mass)

    @property
    def carried(self) -> float:
        """Mass of the air that patches carry per area [kg/m²], see :func:`added_mass_per_area`."""
        return added_mass_per_area(self.added_mass, self.air_density)

    @property
    def idle(self) -> bool:
        """True if the force is zero in any wind, so that it need not be computed."""
        coefficients = (self.C_D, self.C_F, self.C_L)
        needed = any(float(c.detach()) or c.requires_grad for c in coefficients)
        return self.air_density == 0 or not needed

    @property
    def mostly_linear(self) -> bool:
        """True if less than 5 % of the force depends on the side of the patch that the flow meets."""
        drag, friction, lift = (float(c.detach()) for c in (self.C_D, self.C_F, self.C_L.abs()))
        sided = lift / max(drag + friction + lift, 1e-30)
        return self.law in ("projected", "linear") and sided < 0.05

    def rate(self, speed: Tensor, area: Tensor, mass: Tensor) -> Tensor:
        """:func:`drag_rate` [1/s], shape (..., P), with the coefficients of this component.

        The drag of the ``linear`` law changes half as fast as a quadratic one: its slope is rho A C_D U / 2. For a
        bound, ``speed`` must then be no less than the speed U of the wind.
        """
        drag = 0.5 * self.C_D if self.law == "linear" else self.C_D
        coefficient = (drag + self.C_F + self.C_L.abs()).to(speed.dtype)
        return drag_rate(speed, area, mass, coefficient, self.air_density)

    def resistance(self, wind: Tensor, velocity: Tensor, area: Tensor) -> Tensor | None:
        r"""Decrease of the force per velocity that the patch gains [kg/s], for ``MPMSolver.step(drag=...)``.

        :math:`D = \tfrac12 \rho A C v_r`, so that the force at the end of the step is about :math:`f - D (v^+ - v)`. If
        the velocity does not change, this is the explicit force. A free patch never overtakes the wind. With the
        ``linear`` law, the speed of the wind stands for v_r in the part of C_D.

        Args:
            wind: Air velocity [m/s], broadcastable to (..., P, 3).
            velocity: Patch velocity [m/s], shape (..., P, 3).
            area: Patch area [m²], shape (..., P).

        Returns:
            Shape (..., P), or None with ``drag_step="explicit"``.
        """
        if self.drag_step == "explicit":
            return None
        wind = wind.to(velocity)
        speed = torch.linalg.vector_norm(wind - velocity, dim=-1)
        blow = drag_speed(wind, speed, self.law)
        drag, rest = (c.to(speed.dtype) for c in (self.C_D, self.C_F + self.C_L.abs()))
        return 0.5 * self.air_density * area * (drag * blow + rest * speed)

    def forward(self, wind: Tensor, velocity: Tensor, normal: Tensor, area: Tensor) -> Tensor:
        """Force on each patch [N].

        Args:
            wind: Air velocity [m/s], broadcastable to (..., P, 3).
            velocity: Patch velocity [m/s], shape (..., P, 3).
            normal: Unit normal of either sign, shape (..., P, 3).
            area: Patch area [m²], shape (..., P).

        Returns:
            Shape (..., P, 3).
        """
        return aero_force(wind, velocity, normal, area, **self._numbers)

    def on_groups(
        self, wind: Tensor, velocity: Tensor, deformation_gradient: Tensor, patches: PatchSums
    ) -> tuple[Tensor, Tensor]:
        """The result of :func:`grouped_force` with the numbers of this component."""
        return grouped_force(
            wind, velocity, deformation_gradient, patches, **self._numbers, max_area_ratio=self.max_area_ratio
        )

    @property
    def _numbers(self) -> dict[str, Any]:
        return {
            "drag": self.C_D,
            "friction": self.C_F,
            "lift": self.C_L,
            "air_density": self.air_density,
            "law": self.law,
        }

    def extra_repr(self) -> str:
        """The settings, for printing."""
        return f"C_D={float(self.C_D):g}, C_F={float(self.C_F):g}, C_L={float(self.C_L):g}, law={self.law}"
