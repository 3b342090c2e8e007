"""Bodies that do not move and that the wind flows round, as effects: potential flow and wakes in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeVar

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.linalg_triton import add3, chosen, cross3, dot3, matvec, scale3, transpose
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.twins import Numbers, Twin
from gaussian_swaying.wind.effects import Moment, WindEffect, blown, placed

PLANE_GROWTH = tl.constexpr(0.29 / math.sqrt(2 * math.log(2)))
"""Standard deviation of a plane wake per root of thickness times distance (Wygnanski and others 1986)."""

ROUND_GROWTH = tl.constexpr(0.05)
"""Growth of the width of a round wake per distance: 0.03 in smooth wind, 0.05 in gusty wind (Bastankhah & Porté-Agel
2014).
"""


@triton.jit
def _direction(flow):
    """Unit vector of a flow, zero in still air, and its speed."""
    speed = tl.sqrt(dot3(flow, flow))
    scale = 1 / tl.maximum(speed, 1e-12)
    return (flow[0] * scale, flow[1] * scale, flow[2] * scale), speed


@triton.jit
def _only(where, v):
    return tl.where(where, v[0], 0.0), tl.where(where, v[1], 0.0), tl.where(where, v[2], 0.0)


@triton.jit
def round_wake(behind, aside, width, drag, start):
    r"""Velocity deficit in the wake of a body, as a share of the speed: a Gaussian that conserves the momentum.

    .. math::
        \Bigl(1 - \sqrt{1 - \tfrac{C_D}{8 (\sigma / d)^2}}\Bigr) e^{-r^2 / 2 \sigma^2}, \qquad
        \sigma / d = k x / d + \tfrac14 \sqrt{\beta}, \quad
        \beta = \tfrac12 \frac{1 + \sqrt{1 - C_D}}{\sqrt{1 - C_D}}

    at the distance x downwind of the centre and r from the line behind it, for a body of the width d across the wind
    (Bastankhah & Porté-Agel 2014, Renewable Energy 70). Made for turbines and their thrust; a bluff body takes momentum
    in the same way, but its near wake, up to some three widths, is only an estimate. ``start`` is :func:`wake_start`.
    """
    sigma = ROUND_GROWTH * tl.maximum(behind, 0.0) / width + start
    depth = 1 - tl.sqrt(tl.maximum(1 - drag / (8 * sigma * sigma), 0.0))
    far = aside / (width * sigma)
    return tl.where(behind > 0, depth * tl.exp(-0.5 * far * far), 0.0)


@triton.jit
def plane_wake(behind, aside, width, drag):
    r"""As :func:`round_wake`, behind a long body across the wind: a plane wake.

    Its half width at half of its depth is :math:`0.29 \sqrt{\theta x}` with the momentum thickness
    :math:`\theta = C_D d / 2` (Wygnanski, Champagne & Marasli 1986, J. Fluid Mech. 168, table 2, cylinder); the depth C
    follows from the momentum, :math:`\int u (U - u)\, dy = \theta U^2`. Nearer than the least width, no wake of this
    shape takes it.

    .. math:: C = \tfrac1{\sqrt2} \Bigl(1 - \sqrt{1 - \tfrac{2 \theta}{\sqrt\pi \sigma}}\Bigr)
    """
    thickness = 0.5 * drag * width
    least = 2 * thickness / 1.7724538509055159  # the square root of pi
    sigma = tl.maximum(tl.sqrt(thickness * tl.maximum(behind, 0.0)) * PLANE_GROWTH, least)
    depth = (1 - tl.sqrt(tl.maximum(1 - least / sigma, 0.0))) * 0.7071067811865476
    far = aside / sigma
    return tl.where(behind > 0, depth * tl.exp(-0.5 * far * far), 0.0)


@triton.jit
def past_cylinder(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    r"""``CylinderObstacle``: zero inside, and the part along the axis stays (Lamb 1932, 68).

    .. math::
        \mathbf{u} = \mathbf{v} + \frac{R^2}{r^2} \bigl(\mathbf{v}_\perp - 2 (\mathbf{v} \cdot \hat r) \hat r\bigr)

    ``numbers``: middle (3), axis (3), radius, drag; ``now``: the mean flow. ``OPTIONS``: whether it has a wake.
    """
    radius = numbers[6]
    axis = (numbers[3], numbers[4], numbers[5])
    p = add3(x, -1.0, numbers)
    height = dot3(p, axis)
    away = add3(p, -height, axis)
    rising = dot3(v, axis)
    across = add3(v, -rising, axis)
    square = dot3(away, away)
    outside = square >= radius * radius
    square = tl.maximum(square, radius * radius)
    along = 2 * dot3(across, away) / square
    share = radius * radius / square
    v = add3(v, share, add3(across, -along, away))
    v = _only(outside, v)
    if OPTIONS[0]:
        rising = dot3(now, axis)
        direction, _ = _direction(add3(now, -rising, axis))
        left = cross3(axis, direction)
        behind = dot3(p, direction)
        aside = dot3(p, left)
        v = scale3(1 - plane_wake(behind, aside, 2 * radius, numbers[7]), v)
    return v


@triton.jit
def carlson_rd(x, y, z, STEPS: tl.constexpr):
    r"""Carlson's elliptic integral :math:`R_D = \tfrac32 \int_0^\infty [(t+x)(t+y)]^{-1/2} (t+z)^{-3/2} dt`.

    By duplication (Carlson 1995, Numer. Algorithms 10, 13): each step quarters the spread of the arguments, and a
    series takes what remains. After nine, its next terms are below 1e-17 if the arguments are within 1e12 of each
    other, as they are for half axes within 1e6; five are enough for float32.
    """
    total = x * 0
    factor = 1.0
    for _step in range(STEPS):
        rx = tl.sqrt(x)
        ry = tl.sqrt(y)
        rz = tl.sqrt(z)
        step = rx * ry + ry * rz + rz * rx
        total += factor / (rz * (z + step))
        factor *= 0.25
        x = 0.25 * (x + step)
        y = 0.25 * (y + step)
        z = 0.25 * (z + step)
    mean = (x + y + 3 * z) / 5
    a = 1 - x / mean
    b = 1 - y / mean
    c = 1 - z / mean
    e2 = a * b - 6 * c * c
    e3 = (3 * a * b - 8 * c * c) * c
    return 3 * total + factor * (1 - 3 / 14 * e2 + e3 / 6) / (mean * tl.sqrt(mean))


@triton.jit
def _over(x, a, root):
    return x[0] / (a[0] + root), x[1] / (a[1] + root), x[2] / (a[2] + root)


@triton.jit
def past_ellipsoid(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    r"""``EllipsoidObstacle``: zero inside (Lamb 1932, 114).

    With :math:`\lambda` the larger root of :math:`\sum_i x_i^2 / (a_i^2 + \lambda) = 1` and
    :math:`\alpha_i(\lambda) = a b c \int_\lambda^\infty \frac{ds}{(a_i^2 + s) \Delta(s)}`, the potential is
    :math:`\sum_i v_i x_i \bigl(1 + \alpha_i(\lambda) / (2 - \alpha_i(0))\bigr)`.

    ``now``: the mean flow; ``OPTIONS``: whether it has a wake, steps of Newton to the root, and of :func:`carlson_rd`.
    ``numbers``: middle (3), axes (9), size (its longest half axis), drag, start of the wake, the half axes per size
    (3), and ``ellipsoid_strength`` along each axis (3).
    """
    axes = chosen(numbers, 3, 9)
    size = numbers[12]
    r = chosen(numbers, 15, 3)
    p = add3(x, -1.0, numbers)
    q = matvec(axes, p)
    q = (q[0] / size, q[1] / size, q[2] / size)
    w = matvec(axes, v)
    a = (r[0] * r[0], r[1] * r[1], r[2] * r[2])
    outside = q[0] * q[0] / a[0] + q[1] * q[1] / a[1] + q[2] * q[2] / a[2] >= 1
    q = (tl.where(outside, q[0], r[0]), tl.where(outside, q[1], r[1]), tl.where(outside, q[2], r[2]))
    # left of the root, so that Newton rises to it: every part of the sum is at most 1, and the longest half axis is 1
    sides = tl.maximum(tl.maximum(q[0] * q[0] - a[0], q[1] * q[1] - a[1]), q[2] * q[2] - a[2])
    root = tl.maximum(tl.maximum(sides, dot3(q, q) - 1), 0.0)
    for _step in range(OPTIONS[1]):
        n = _over(q, a, root)
        root = tl.maximum(root + (dot3(q, n) - 1) / dot3(n, n), 0.0)
    s = (a[0] + root, a[1] + root, a[2] + root)
    n = _over(q, a, root)
    volume = r[0] * r[1] * r[2]
    third_of = 2 / 3 * volume
    strong = (numbers[18] * w[0], numbers[19] * w[1], numbers[20] * w[2])
    along = strong[0] * q[0] / s[0] + strong[1] * q[1] / s[1] + strong[2] * q[2] / s[2]
    steep = -2 * volume / tl.sqrt(s[0] * s[1] * s[2]) * along / dot3(n, n)
    w = (
        w[0] + strong[0] * third_of * carlson_rd(s[1], s[2], s[0], OPTIONS[2]) + steep * n[0],
        w[1] + strong[1] * third_of * carlson_rd(s[2], s[0], s[1], OPTIONS[2]) + steep * n[1],
        w[2] + strong[2] * third_of * carlson_rd(s[0], s[1], s[2], OPTIONS[2]) + steep * n[2],
    )
    v = matvec(transpose(axes), _only(outside, w))
    if OPTIONS[0]:
        direction, _speed = _direction(now)
        flat = tl.maximum(tl.sqrt(direction[0] * direction[0] + direction[1] * direction[1]), 1e-12)
        side = (-direction[1] / flat, direction[0] / flat, 0.0)
        up = cross3(direction, side)
        wide = _across(side, axes, r) * size
        high = _across(up, axes, r) * size
        mean = tl.sqrt(tl.maximum(wide * high, 1e-12))
        left = dot3(p, side) * (mean / tl.maximum(wide, 1e-12))
        above = dot3(p, up) * (mean / tl.maximum(high, 1e-12))
        behind = dot3(p, direction) / mean
        aside = tl.sqrt(left * left + above * above) / mean
        v = scale3(1 - round_wake(behind, aside, 1.0, numbers[13], numbers[14]), v)
    return v


@triton.jit
def _across(direction, axes, r):
    along = matvec(axes, direction)
    half = (along[0] * r[0], along[1] * r[1], along[2] * r[2])
    return 2 * tl.sqrt(dot3(half, half))


@lru_cache(maxsize=64)
def ellipsoid_strength(radii: tuple[float, ...]) -> tuple[float, ...]:
    r""":math:`1 / (2 - \alpha_i(0))` of :func:`past_ellipsoid`, for the three axes i."""
    a = [(radius / max(radii)) ** 2 for radius in radii]
    integrals = (on_tensors(carlson_rd)(a[k - 2], a[k - 1], a[k], 9) for k in range(3))
    return tuple(1 / (2 - 2 / 3 * math.sqrt(math.prod(a)) * integral) for integral in integrals)


def wake_start(drag: float) -> float:
    r"""Standard deviation of a round wake at the body, per width: :math:`\tfrac14 \sqrt\beta` in :func:`round_wake`."""
    root = math.sqrt(1 - drag)
    return 0.25 * math.sqrt(0.5 * (1 + root) / root)


AnyObstacle = TypeVar("AnyObstacle", bound="Obstacle")


class Obstacle(WindEffect):
    """Base of bodies in the wind: potential flow round them, and a wake behind them.

    The flow is that of the wind at each place, gusts included: right for gusts much longer than the body. The wake lies
    in the direction of the mean flow; behind an ellipsoid it is as wide, and as high, as the body is across the flow.
    """

    recordable = True
    middle: Tensor

    def __init__(self, center: Sequence[float], drag: float) -> None:
        super().__init__()
        check_positive("drag", drag, allow_zero=True)
        self.center, self.drag = list(check_vector("center", center)), float(drag)
        self.register_buffer("middle", torch.tensor(self.center, dtype=torch.float64), persistent=False)

    def moved(self: AnyObstacle, frame: SimFrame, **values: Any) -> AnyObstacle:
        """A copy with its centre in metres, z up, and other values."""
        return changed(self, middle=torch.tensor(placed(frame, self.center), dtype=torch.float64), **values)


def _filled(like: Tensor, *values: float) -> list[Tensor]:
    """Numbers as tensors of one, made on the device."""
    return [torch.full_like(like[:1], value) for value in values]


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

    def twin(self) -> Twin:
        return Twin(
            past_cylinder,
            options=(self.drag > 0,),
            numbers=Numbers(
                8, lambda: torch.cat([self.middle, self.axis, *_filled(self.middle, self.radius, self.drag)])
            ),
            per_substep=Numbers(3, lambda moment: moment.flow),
            sources=(self,),
        )

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

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        return blown(self._twin(12, 9) if position.dtype == torch.float64 else self.twin(), velocity, position, moment)

    def twin(self) -> Twin:
        return self._twin(7, 5)  # from two thirds of the distance to the root, to float32

    def _twin(self, newton: int, duplications: int) -> Twin:
        def numbers() -> Tensor:
            radii = tuple(map(float, self.radii))
            size = max(radii)
            shape = [*(radius / size for radius in radii), *ellipsoid_strength(radii)]
            rest = _filled(self.middle, size, self.drag, wake_start(self.drag), *shape)
            return torch.cat([self.middle, self.axes.reshape(-1), *rest])

        return Twin(
            past_ellipsoid,
            options=(self.drag > 0, newton, duplications),
            numbers=Numbers(21, numbers),
            per_substep=Numbers(3, lambda moment: moment.flow),
            sources=(self,),
        )

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """In metres, z up."""
        radii = [radius * frame.metres_per_unit for radius in self.radii]
        return self.moved(frame, radii=radii, axes=frame.direction_to_sim(self.axes))
