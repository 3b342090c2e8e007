"""The force of the wind on surface patches, for ``MPMSolver.rollout``, and the air that they carry along."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import cache, partial
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
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import Fixed, FixedList, changed
from gaussian_swaying._live import SIZE, live_numbers
from gaussian_swaying.geometry.groups import sums
from gaussian_swaying.geometry.linalg import entries, vectors
from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    chosen,
    cofactor,
    cross3,
    dot3,
    dot9,
    load3,
    matmul,
    matvec,
    read,
    scale3,
    transpose,
)
from gaussian_swaying.geometry.patches import deformed_patch
from gaussian_swaying.kernels.derive import device_function, gradient, on_tensors, primitive
from gaussian_swaying.kernels.graphs import tensors_in
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers
from gaussian_swaying.mpm.forces import Force, Given
from gaussian_swaying.mpm.state import MaterialPoints, State
from gaussian_swaying.wind.effects import Moment
from gaussian_swaying.wind.field import SpatialWind, WindField
from gaussian_swaying.wind.patches import Patches, PatchSums
from gaussian_swaying.wind.tables import Shelter, wind_axes

LAWS = ("paper", "projected", "linear", "cross_flow")


@triton.jit
def drag_speed(air, relative, LAW: tl.constexpr):
    """The speed factor of drag, besides the flow along the patch: that of the wind in the linear law."""
    found = dot3(relative, relative)
    if LAW == 2:
        found = dot3(air, air)
    return tl.sqrt(found)


@triton.jit
def yielding(air, relative, numbers, LAW: tl.constexpr):
    """Resistance per half density and area, see ``AeroForce.resistance``."""
    speed = tl.sqrt(dot3(relative, relative))
    return numbers[0] * drag_speed(air, relative, LAW) + (numbers[1] + tl.abs(numbers[2])) * speed


@triton.jit
def wind_terms(air, relative, facing, across, through, tangent, numbers, LAW: tl.constexpr):
    r"""Drag, friction and lift per half density: the law of the force, of one patch or of a sum over patches.

    Each term is :math:`v_r^2` times that of :func:`aero_force`, without ever dividing by :math:`v_r`.

    ``facing``: area vector s on the side that meets the flow; per area for one patch. ``across``: the part of the flow
    through the patch, :math:`A\, (\mathbf{v}_r \cdot \mathbf{n})\, \mathbf{n}`. ``through``: the same times the size
    of the flow through the patch. ``tangent``: the part along it. ``numbers``: C_D, C_F and C_L.
    """
    speed = tl.sqrt(dot3(relative, relative))
    pressed = across
    pressure = numbers[0]
    if LAW == 3:
        pressed = through
    elif LAW == 0:
        pressed = facing
        pressure = pressure * speed * speed
    else:
        pressure = pressure * drag_speed(air, relative, LAW)
    side = cross3(relative, facing)
    return add3(axpy3(pressure, pressed, numbers[1] * speed, tangent), numbers[2] * speed, side)


@triton.jit
def patch_force(air, velocity, normal, area, numbers, LAW: tl.constexpr):
    """:func:`aero_force`; ``numbers``: C_D, C_F, C_L, half the density of the air."""
    relative = add3(air, -1.0, velocity)
    along = dot3(relative, normal)
    sign = tl.where(along < 0, -1.0, 1.0)
    tangent = add3(relative, -along, normal)
    force = wind_terms(
        air, relative, scale3(sign, normal), scale3(along, normal), scale3(sign * along * along, normal), tangent,
        numbers, LAW,
    )  # fmt: skip
    return scale3(numbers[3] * area, force)


@triton.jit
def force_on_patch(F, velocity, patch, numbers, air, table, LAW: tl.constexpr):
    """Force on a deformed patch (normal and area at rest), and its area in the wind.

    ``numbers``: as for :func:`patch_force`, and the largest ratio of areas.
    """
    normal, area = deformed_patch(F, chosen(patch, 0, 3), patch[3], numbers[4])
    return patch_force(air, velocity, normal, area, numbers, LAW), area


@triton.jit
def _changed_wind(m: tl.constexpr, EFFECTS: tl.constexpr, v, position, now, table):
    OPTIONS: tl.constexpr = EFFECTS.options[m]
    numbers = read(table, EFFECTS.numbers[m][0], EFFECTS.numbers[m][1])
    own = chosen(now, 3 + EFFECTS.per_substep[m][0], EFFECTS.per_substep[m][1])
    return EFFECTS.functions[m](v, position, numbers, own, table + EFFECTS.tables[m], OPTIONS)


@triton.jit
def shaped_wind(position, now, table, EFFECTS: tl.constexpr):
    """``WindField.shaped``: the wind with its effects, of which ``now`` has the velocity without them first."""
    v = chosen(now, 0, 3)
    if len(EFFECTS.functions) > 0:
        zero = position[0] * 0
        v = (v[0] + zero, v[1] + zero, v[2] + zero)
    for m in tl.static_range(len(EFFECTS.functions)):
        v = _changed_wind(m, EFFECTS, v, position, now, table)
    return v


@triton.jit
def add_direction(s, q, b, w, LAW: tl.constexpr):
    """Add the area vector b of one direction to two sums.

    ``s`` gets sign(b w) b; in LAW 3, ``q`` gets sign(b w) (b w)² b / b².
    """
    along = dot3(b, w)
    sign = tl.where(along < 0, -1.0, 1.0)
    s = add3(s, sign, b)
    if LAW == 3:
        flow = sign * along * along / tl.maximum(dot3(b, b), 1.2e-38)
        q = add3(q, flow, b)
    return s, q


@triton.jit
def sums_over_patches(table, place, w, LAW: tl.constexpr):
    """The sums over the patches of each point: tensor and its trace, and the sums of :func:`add_direction`.

    ``place``: first row in the table of ``PatchSums``, and number of vectors there.
    """
    first = 4 * place[0].to(tl.int32)
    count = place[1].to(tl.int32)
    real = count > 0
    t = load3(table, 1, first, real) + load3(table, 1, first + 3, real)
    tensor = (t[0], t[1], t[2], t[1], t[3], t[4], t[2], t[4], t[5])
    rest = t[0] + t[3] + t[5]
    zero = rest * 0
    s = (zero, zero, zero)
    q = (zero, zero, zero)
    for k in range(0, tl.max(count), 4):  # four rows at once
        row = first + 8 + 4 * k
        b = ()
        for j in tl.static_range(4):
            b = b + (load3(table, 1, row + 4 * j, k + j < count),)  # type: ignore[assignment]
        for j in tl.static_range(4):
            s, q = add_direction(s, q, b[j], w, LAW)
    return tensor, rest, s, q


@triton.jit
def flow_adjoint(table, place, w, by_q):
    """Gradient by w of the last sum of :func:`sums_over_patches` times a vector."""
    first = 4 * place[0].to(tl.int32)
    count = place[1].to(tl.int32)
    zero = w[0] * 0
    by_w = (zero, zero, zero)
    for k in range(0, tl.max(count)):
        known = k < count
        b = load3(table, 1, first + 8 + 4 * k, known)
        share = 2 * tl.abs(dot3(b, w)) * dot3(b, by_q) / tl.maximum(dot3(b, b), 1.2e-38)
        by_w = add3(by_w, tl.where(known, share, 0.0), b)
    return by_w


def _sums(patches: PatchSums, place: Any, w: tuple[Tensor, ...], LAW: int) -> Any:
    point, count, zero = patches.point, len(patches.tensor), (0.0, 0.0, 0.0)
    own = tuple(part.expand(count)[point] for part in w)
    terms = on_tensors(add_direction)(zero, zero, patches.vector.unbind(-1), own, LAW)
    found = [sums(torch.stack(term, -1), point, count).unbind(-1) for term in (terms if LAW == 3 else terms[:1])]
    return entries(patches.tensor), patches.area, found[0], found[-1]


def _sums_adjoint(given: Any, result: Any, bars: Any) -> Any:
    table, place, w, law = given
    by_w = on_tensors(flow_adjoint)(table, place, w, bars[3]) if law == 3 else (0.0, 0.0, 0.0)
    return 0.0, (0.0, 0.0), by_w, 0.0


primitive(flow_adjoint, outputs=3)
primitive(sums_over_patches, outputs=(9, 0, 3, 3), on_tensors=_sums, vjp=_sums_adjoint)


@triton.jit
def force_on_group(F, velocity, place, numbers, air, table, LAW: tl.constexpr):
    """Force on a group of patches, see :mod:`~gaussian_swaying.wind.patches`, and their area in the wind.

    ``place``: as for :func:`sums_over_patches`. The rest is as for :func:`force_on_patch`.
    """
    relative = add3(air, -1.0, velocity)
    c = cofactor(F)
    w = matvec(transpose(c), relative)
    tensor, rest, s, q = sums_over_patches(table, place, w, LAW)
    turned = matmul(c, tensor)
    growth = tl.sqrt(tl.maximum(dot9(turned, c) / tl.maximum(rest, 1.2e-38), 1.2e-38))
    across = scale3(1.0 / growth, matvec(turned, w))
    area = growth * rest
    through = across
    if LAW == 3:
        through = scale3(1.0 / (growth * growth), matvec(c, q))
    tangent = axpy3(area, relative, -1.0, across)
    force = wind_terms(air, relative, matvec(c, s), across, through, tangent, numbers, LAW)
    cap = tl.where(rest > 0, tl.minimum(numbers[4], growth) / growth, 0.0)
    return scale3(numbers[3] * cap, force), cap * area


@triton.jit
def wind_force(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):
    """``WindForce`` on patches, or on groups of them, whose table follows that of the effects.

    ``now``: velocity without effects, and the numbers of each effect. ``OPTIONS``: place of the law in :data:`LAWS`,
    semi-implicit drag, groups, effects.
    """
    EFFECTS: tl.constexpr = OPTIONS[3]  # Triton passes an object only by a name
    air = shaped_wind(position, now, table, EFFECTS)
    if OPTIONS[2]:
        force, area = force_on_group(F, velocity, point, numbers, air, table + EFFECTS.size, OPTIONS[0])
    else:
        force, area = force_on_patch(F, velocity, point, numbers, air, table, OPTIONS[0])
    resistance = area * 0
    if OPTIONS[1]:
        resistance = numbers[3] * area * yielding(air, add3(air, -1.0, velocity), numbers, OPTIONS[0])
    return force, resistance


@cache
def force_adjoint(groups: bool, law: int) -> Any:
    """The gradients of a . f of a force by F, velocity, wind and coefficients, as ``DeviceFunction.adjoint``.

    Args:
        groups: Whether it is that of :func:`force_on_group`, or else of :func:`force_on_patch`.
    """
    function = force_on_group if groups else force_on_patch

    def formula(F: Any, velocity: Any, point: Any, numbers: Any, air: Any, table: Any, a: Any) -> Any:
        force, _ = on_tensors(function)(F, velocity, point, numbers, air, table, law)
        return gradient(force, (F, velocity, air, numbers[:3]), a)

    shapes = {"F": 9, "velocity": 3, "point": 2 if groups else 4, "numbers": 5, "now": 3, "table": 0, "a": 3}
    return device_function(f"{function.__name__}_adjoint", shapes, formula)


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
    numbers = tuple(part.to(velocity) if isinstance(part, Tensor) else part for part in (drag, friction, lift))
    given = wind.to(velocity).unbind(-1), velocity.unbind(-1), normal.unbind(-1), area, (*numbers, 0.5 * air_density)
    return vectors(on_tensors(patch_force)(*given, LAWS.index(law)))


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
        max_area_ratio: Largest ratio of a patch's area in the wind to its area at rest; null for no cap, which suits
            elastic materials. Plastic materials need one, for example 1: their total deformation gradient grows without
            bound, and so does the area from Nanson's formula, but grains catch no more wind than they do at rest.
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
    live = live_numbers(**{name: SIZE | {"differentiable": True} for name in ("C_D", "C_F", "C_L")}, added_mass=SIZE)
    C_D: Tensor
    C_F: Tensor
    C_L: Tensor

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
        """True if reversing the normal changes the force by less than 5 %."""
        drag, friction, lift = (float(c.detach()) for c in (self.C_D, self.C_F, self.C_L.abs()))
        sided = lift / max(drag + friction + lift, 1e-30)
        return self.law in ("projected", "linear") and sided < 0.05

    def rate(self, speed: Tensor, area: Tensor, mass: Tensor) -> Tensor:
        r"""Rate :math:`\rho A C v_r / m` [1/s] at which drag changes velocities; explicit steps need dt < 2 / rate.

        The drag of the ``linear`` law changes half as fast as a quadratic one: its slope is rho A C_D U / 2. For a
        bound, ``speed`` must then be no less than the speed U of the wind.

        Args:
            speed: Relative speed [m/s], shape (..., P).
            area: Patch area [m²], shape (..., P).
            mass: Mass [kg], shape (..., P).

        Returns:
            Shape (..., P).
        """
        drag = 0.5 * self.C_D if self.law == "linear" else self.C_D
        coefficient = (drag + self.C_F + self.C_L.abs()).to(speed.dtype)
        return self.air_density * coefficient * area * speed / mass

    def resistance(self, wind: Tensor, velocity: Tensor, area: Tensor) -> Tensor | None:
        r"""Decrease of the force per unit of velocity that the patch gains [kg/s], for ``MPMSolver.step(drag=...)``.

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
        wind, numbers = wind.to(velocity), self.numbers().to(velocity).unbind()
        rate = on_tensors(yielding)(wind.unbind(-1), (wind - velocity).unbind(-1), numbers, LAWS.index(self.law))
        return numbers[3] * area * rate

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
        return aero_force(
            wind, velocity, normal, area, drag=self.C_D, friction=self.C_F, lift=self.C_L,
            air_density=self.air_density, law=self.law,
        )  # fmt: skip

    def numbers(self) -> Tensor:
        """The coefficients, half the density of the air, and the largest ratio of areas, shape (5,), float64."""
        half, widest = (torch.full_like(self.C_D, value) for value in (0.5 * self.air_density, self.max_area_ratio))
        return torch.stack([self.C_D, self.C_F, self.C_L, half, widest])

    def on_patches(
        self, wind: Tensor, velocity: Tensor, deformation_gradient: Tensor, patches: PatchSums | tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Force on the patches of each point [N], shape (..., P, 3), and their area in the wind [m²], shape (..., P).

        Args:
            wind: Air velocity [m/s], broadcastable to (..., P, 3).
            velocity: Velocity of the points [m/s], shape (..., P, 3).
            deformation_gradient: Total deformation gradient of the points, shape (..., P, 3, 3).
            patches: The sums over the patches, or one unit normal and area at rest of each point.
        """
        groups = isinstance(patches, PatchSums)
        point = (0.0, 0.0) if isinstance(patches, PatchSums) else (*patches[0].unbind(-1), patches[1])
        force, area = on_tensors(force_on_group if groups else force_on_patch)(
            entries(deformation_gradient), velocity.unbind(-1), point, self.numbers().to(velocity).unbind(),
            wind.to(velocity).unbind(-1), patches if groups else None, LAWS.index(self.law),
        )  # fmt: skip
        return vectors(force), area


@triton.jit
def air_push(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):
    """Device function: a force at rest minus a rate times the velocity; ``point``: force (3) and rate."""
    return add3(point, -point[3], velocity), point[3] * 0.0


def carried_mass(patches: Patches, aero: AeroForce) -> Tensor:
    """Mass of the air that the patches of each point carry at rest [kg], shape (P,)."""
    return aero.carried * patches.areas()


def with_added_mass(points: MaterialPoints, patches: Patches, aero: AeroForce) -> MaterialPoints:
    """The material with the air that it carries; the same object if it carries none.

    Args:
        aero: The force of the wind, for ``added_mass`` and ``air_density``.
    """
    if aero.carried == 0:
        return points
    return replace(points, mass=points.mass + carried_mass(patches, aero).to(points.mass))


class AirLift(Force):
    """The weight of carried air, upward, so that gravity pulls at the material alone.

    Args:
        mass: Mass of the air that each point carries [kg], shape (..., P).
        gravity: Acceleration [m/s²].

    Attributes:
        force: Force on each point [N], shape (..., P, 3).

    Example:
        >>> AirLift(torch.tensor([0.5]), [0.0, 0.0, -10.0]).force
        tensor([[-0., -0., 5.]])
    """

    recordable = True
    force: Tensor

    def __init__(self, mass: Tensor, gravity: Sequence[float]) -> None:
        super().__init__()
        down = torch.tensor(list(gravity), dtype=torch.float64).to(mass)
        self.register_buffer("force", mass.detach()[..., None] * -down)

    def potential(self, state: State) -> Tensor:
        """Potential energy of the force [J], shape (...) over the batch, float64."""
        return -(in_double(self.force) * in_double(state.position)).sum((-2, -1))

    def device_function(self) -> DeviceFunction | None:
        numbers = Numbers(4, lambda: torch.nn.functional.pad(self.force, (0, 1)))
        return DeviceFunction(air_push, per_point=numbers, sources=(self.force,))


Wind = WindField | SpatialWind


class WindForce(Force):
    """Wind on surface patches that deform with their particles.

    Pass it to ``MPMSolver.rollout`` as one of its ``forces``. A uniform wind has a device function, so kernels of the
    substep compute the force.

    Args:
        aero: Coefficients and law of the force.
        wind: The wind; or one for each scene of a batch, as a list or by ``WindField.together``, which is faster for
            many.
        normal: Unit normals of the patches at rest, one for each particle, shape (..., P, 3); or any number of
            :class:`~gaussian_swaying.wind.patches.Patches`, those of the scenes of a batch one after the other.
        area: Their areas at rest [m²], shape (..., P); zero for particles that feel no wind. None with ``Patches``.
        places: Positions of copies, which are simulated at the place of the original: a module with ``turn``, rotations
            to the axes of the wind, shape (B, 3, 3), ``shift`` [m], shape (B, 3), and ``delay`` [s], shape (B,).

    Attributes:
        normal: Unit normals at rest, shape (..., P, 3).
        area: Area of the patches of each particle at rest [m²], shape (..., P).
        sums: The sums over patches, if a particle has patches of several directions; else None, and ``normal`` is the
            direction of each particle.

    Raises:
        ValueError: If the shapes do not agree, or the numbers of winds and scenes differ.

    Example:
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> force = WindForce(AeroForce(C_F=0.0, C_L=0.0), WindField([0.0, 0.0, 2.0]), up, torch.ones(1))
        >>> force.winds(torch.zeros((), dtype=torch.float64), dt=1e-3, steps=4).shape
        torch.Size([4, 3])
    """

    normal: Tensor
    area: Tensor

    def __init__(
        self,
        aero: AeroForce,
        wind: Wind | Sequence[Wind],
        normal: Tensor | Patches,
        area: Tensor | None = None,
        places: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.sums: PatchSums | None = None
        patches = normal if isinstance(normal, Patches) else None
        if isinstance(normal, Patches):
            found = PatchSums(normal, coarse=aero.mostly_linear)
            self.sums = None if found.single else found
            normal, area = found.normals(), found.area
        if area is None:
            raise ValueError("Expected `area` of the patches, one for each `normal`.")
        check_shape("normal", normal, "P", 3)
        check_shape("area", area, normal.shape[-2])
        self._fields = nn.ModuleList([wind] if isinstance(wind, nn.Module) else wind)
        self.places: Any
        self.places = places
        several = None if places is None else len(self.places.delay)
        scenes = several or (wind.scenes if isinstance(wind, WindField) else None)
        scenes = scenes if isinstance(wind, nn.Module) else len(wind)
        if patches is not None and scenes and len(area) % scenes == 0:
            normal, area = normal.reshape(scenes, -1, 3), area.reshape(scenes, -1)
        self.aero = aero
        self.register_buffer("normal", normal, persistent=False)
        self.register_buffer("area", area, persistent=False)
        self._shared = scenes is None
        given = tuple(normal.shape[:-2])
        if scenes is not None and given not in ((scenes,), ()):  # () for all scenes alike
            raise ValueError(f"Expected one `wind` for each of the {given} scenes, but got {scenes}.")

    @property
    def wind(self) -> nn.Module | tuple[nn.Module, ...]:
        """The wind, or a list with one wind for each scene of a batch."""
        return self._fields[0] if len(self._fields) == 1 else tuple(self._fields)

    @property
    def uniform(self) -> bool:
        """True if the wind is the same everywhere in a scene."""
        return all(bool(wind.uniform) for wind in self._fields)

    @property
    def recordable(self) -> bool:  # type: ignore[override]
        """True if a CUDA graph can record all winds, that is, spatial winds and modulations are ``recordable``."""
        return all(
            wind.recordable and (isinstance(wind, SpatialWind) or type(wind) is WindField) for wind in self._fields
        )

    def winds(self, time: Tensor, dt: float | Tensor, steps: int) -> Tensor:
        """Velocity of a uniform wind [m/s] at the start of ``steps`` substeps of ``dt`` [s] from ``time`` [s] on.

        Args:
            time: Scalar float64 tensor.
            dt: Number, or scalar float64 tensor on the same device.
            steps: Number of substeps.

        Returns:
            Shape (steps, 3), or (steps, B, 1, 3) with one wind for each scene; float64, on the device of ``time``.
        """
        times = _times(time, dt, steps)
        at = times if self.places is None else times[:, None] - self.places.delay
        if len(self._fields) == 1:
            found = _blow(self._fields[0], at)
        else:
            each = [times] * len(self._fields) if self.places is None else at.unbind(1)
            found = torch.stack(list(map(_blow, self._fields, each)), dim=1)
        if self._shared:
            return found
        return found[:, :, None] if self.places is None else found[:, :, None] @ self.places.turn

    def air(self, time: Tensor, position: Tensor) -> Tensor:
        """Air velocity at given positions [m/s].

        Args:
            time: Time [s], scalar float64 tensor.
            position: Positions [m], shape (..., P, 3).

        Returns:
            Broadcastable to (..., P, 3).
        """
        if self.uniform:
            return self.winds(time, 0.0, 1)[0]
        if self._shared:
            return _air(self._fields[0], time, position)
        when, place = time.expand(len(position)), position
        if self.places is not None:
            when = time - self.places.delay
            place = position @ self.places.turn.to(position).mT + self.places.shift.to(position)[:, None]
        parts = map(_air, self._fields, when, place)
        found = torch.stack([part.to(position).expand_as(position[0]) for part in parts])
        return found if self.places is None else found @ self.places.turn.to(position)

    def samples(self, state: State, dt: float, steps: int) -> Tensor:
        """Air velocity [m/s] at a state's particles, at ``steps`` times, ``dt`` [s] apart, starting now.

        Returns:
            Shape (steps, ...), broadcastable to (steps, ..., P, 3) from its second axis on.
        """
        if self.uniform:
            return self.winds(state.time, dt, steps)
        return torch.stack([self.air(state.time + k * dt, state.position) for k in range(steps)])

    def force(self, state: State, wind: Tensor) -> tuple[Tensor, Tensor | None]:
        """Force on every particle [N] (..., P, 3), and the resistance of a semi-implicit drag [kg/s] (..., P) or None.

        Args:
            state: The state at the start of the substep.
            wind: Air velocity [m/s], broadcastable to (..., P, 3).
        """
        velocity, F, shape = state.velocity, state.F_total, state.velocity.shape
        if self.sums is None:
            force, area = self.aero.on_patches(wind, velocity, F, (self.normal, self.area))
        else:
            given = wind.expand(shape).reshape(-1, 3), velocity.reshape(-1, 3), F.reshape(-1, 3, 3)
            force, area = self.aero.on_patches(*given, self.sums)
            force, area = force.reshape(shape), area.reshape(shape[:-1])
        return force, self.aero.resistance(wind, velocity, area)

    def forward(self, state: State) -> tuple[Tensor, Tensor | None]:
        """:meth:`force` in the wind of ``state.time``."""
        return self.force(state, self.air(state.time, state.position))

    def _shelters(self) -> list[Shelter]:
        wind = self._fields[0]
        if not (self._shared and isinstance(wind, WindField)):
            return []
        return [effect for effect in wind.effects if isinstance(effect, Shelter)]

    def foreseen(self, state: State) -> WindForce:
        """Return a copy of the force for the frame that starts with a state; this one does not change.

        Shelters of the result have tables of their own, as this one may be in use on another stream.
        """
        if not self._shelters():
            return self
        wind = self._fields[0]
        assert isinstance(wind, WindField)
        effects = [
            changed(effect, **{name: held.clone() for name, held in effect.named_buffers()})
            if isinstance(effect, Shelter)
            else copy(effect)
            for effect in wind.effects
        ]
        other = changed(self, _fields=nn.ModuleList([changed(wind, effects=FixedList(effects))]))
        other.refresh(state)
        return other

    def refreshed(self) -> list[Tensor]:
        """The tensors that :meth:`refresh` writes."""
        return tensors_in(self._shelters())

    def refresh(self, state: State) -> None:
        """Update each :class:`~gaussian_swaying.wind.tables.Shelter` from the body's present shape; once in a frame.

        Args:
            state: The state at the start of the frame.
        """
        wind, shelters = self._fields[0], self._shelters()
        if not shelters or state.position.ndim > 2:
            return
        assert isinstance(wind, WindField)
        with torch.no_grad():
            flow = wind.mean_flow(state.time)
            axes = wind_axes(flow)
            still = state.replace(velocity=torch.zeros_like(state.velocity))
            force, _ = self.force(still, axes[0].to(still.velocity))  # in a wind of 1 m/s
            area = (force * axes[0].to(force)).sum(-1).clamp(min=0) / max(0.5 * self.aero.air_density, 1e-30)
            area = area * (flow.square().sum() > 0)
            for shelter in shelters:
                shelter.refresh(state.position, area, axes)

    def during(self, time: Tensor, dt: float, steps: int) -> Callable[[State, int], Given]:
        """See ``Force.during``: a uniform wind is computed for all substeps at once."""
        if self.uniform:
            winds = self.winds(time, dt, steps)
            return lambda state, k: self.force(state, winds[k])
        wind = self._fields[0]
        if not (self._shared and isinstance(wind, WindField)):
            return super().during(time, dt, steps)
        times = _times(time, dt, steps)
        moments = list(map(Moment, *vars(wind.moment(times)).values()))
        blown = _blow(wind, times)
        return lambda state, k: self.force(state, wind.shaped(blown[k], state.position, moments[k]))

    def on_sites(self, site: Tensor, count: int) -> WindForce:
        """The wind on the patches of groups of points, with a drag that is semi-implicit; see ``Force.on_sites``."""
        scenes = max(1, site.shape[:-1].numel())
        shift = count * torch.arange(scenes, device=site.device)[:, None]
        group = (site.reshape(scenes, -1) + shift).reshape(-1)
        aero = changed(self.aero, drag_step="semi_implicit")
        if self.sums is not None:
            sums = self.sums.grouped(group, scenes * count, aero.mostly_linear)
        else:
            normal, area = self.normal.expand(*site.shape, 3).reshape(-1, 3), self.area.expand(site.shape).reshape(-1)
            sums = PatchSums(Patches(normal, area, group, scenes * count), coarse=aero.mostly_linear)
        area = sums.area.reshape(*site.shape[:-1], count)
        return changed(self, aero=aero, sums=sums, area=area, normal=area.new_zeros(*area.shape, 3))

    def device_function(self) -> DeviceFunction | None:
        """None if an effect has none, or the lists of patches are too long."""
        wind, aero, sums = self._fields[0], self.aero, self.sums
        if sums is not None and sums.rows >= 2**24:  # rows are counted in float32
            return None
        parts: tuple[DeviceFunction, ...] = ()
        if not self.uniform:
            if not (self._shared and type(wind) is WindField):
                return None
            found = [effect.device_function() for effect in wind.effects]  # type: ignore[operator]
            parts = tuple(part for part in found if part is not None)
            if len(parts) < len(found):
                return None
        implicit, groups, law = aero.drag_step == "semi_implicit", sums is not None, LAWS.index(aero.law)
        width = 3 + sum(part.per_substep.count for part in parts)
        if sums is None:
            patch = Numbers(4, lambda: torch.cat([self.normal.expand(*self.area.shape, 3), self.area[..., None]], -1))
            patches: dict[str, Any] = {"per_point": patch, "sources": (self.normal, self.area)}
        else:
            point, table = (
                Numbers(2, lambda: sums.lists().reshape(*self.area.shape, 2)),
                Numbers(4 * sums.rows, sums.table),
            )
            patches = {"per_point": point, "table": table, "sources": (sums.tensor, sums.vector)}
        return DeviceFunction(
            wind_force,
            options=(law, implicit, groups),
            numbers=Numbers(5, aero.numbers),
            per_substep=Numbers(width, partial(self._with_effects, parts) if parts else self.winds),
            implicit=implicit,
            parts=parts,
            adjoint=partial(force_adjoint, groups, law) if self.uniform and not implicit else None,
            **patches,
        )

    def _with_effects(self, parts: Sequence[DeviceFunction], time: Tensor, dt: float | Tensor, steps: int) -> Tensor:
        """As :meth:`winds`, and the numbers of the device functions of the effects at these times, shape (steps, n)."""
        wind = self._fields[0]
        assert isinstance(wind, WindField)
        times = _times(time, dt, steps)
        moment = wind.moment(times)
        own = [part.per_substep.take(moment) for part in parts if part.per_substep.count]
        return torch.cat([_blow(wind, times), *map(torch.as_tensor, own)], dim=-1)


def _times(time: Tensor, dt: float | Tensor, steps: int) -> Tensor:
    """Times [s] at the start of ``steps`` substeps of ``dt`` [s]."""
    return time + torch.arange(steps, dtype=torch.float64, device=time.device) * dt


def _air(wind: nn.Module, time: Tensor, position: Tensor) -> Tensor:
    found: Tensor = wind.at(time, position) if isinstance(wind, WindField) else wind(time, position)
    return found


def _blow(wind: nn.Module, times: Tensor) -> Tensor:
    """Velocity of a uniform wind at times [s], on their device."""
    velocity: Tensor = wind(times)
    return velocity.to(times.device)
