"""Effects make the wind differ from place to place; a ``WindField`` applies them in order, after its modulations.

Here are those in closed form: profiles, a plume, and bodies that do not move, which the wind flows round.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.linalg import vectors
from gaussian_swaying.geometry.linalg_triton import add3, chosen, cross3, dot3, matvec, scale3, transpose, where3
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.kernels.derive import Memory, on_tensors
from gaussian_swaying.kernels.graphs import Component
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers

SPREAD = 58.0
"""The updraft of a plume falls off as exp(-SPREAD r^2 / z^2)."""


@triton.jit
def log_profile(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``Profile``; ``numbers``: height of the ground, roughness, one over the logarithm."""
    above = tl.maximum(x[2] - numbers[0], numbers[1])
    factor = tl.log(above / numbers[1]) * numbers[2]
    return scale3(factor, v)


@triton.jit
def power_profile(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``Profile`` with an exponent; ``numbers``: height of the ground, one over the height, exponent."""
    above = (x[2] - numbers[0]) * numbers[1]
    factor = tl.exp(numbers[2] * tl.log(tl.where(above > 0, above, 1.0)))
    factor = tl.where(above > 0, factor, 0.0)
    return scale3(factor, v)


@triton.jit
def plume(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """``Plume``; ``numbers``: its source (3), height of the source above the point, speed, spread."""
    a = x[0] - numbers[0]
    b = x[1] - numbers[1]
    above = x[2] - numbers[2]
    height = tl.maximum(above, 0.0) + numbers[3]
    off = numbers[5] * (a * a + b * b) / (height * height)
    fall = tl.exp(-off)
    series = 1 - off / 2 * (1 - off / 3 * (1 - off / 4 * (1 - off / 5)))
    share = tl.where(off < 1e-2, series, (1 - fall) / tl.maximum(off, 1e-2))
    up = numbers[4] * tl.exp(-tl.log(height) / 3)
    up = tl.where(above >= 0, up, 0.0)
    drawn = up / height * (fall - 5 / 6 * share)
    return v[0] + drawn * a, v[1] + drawn * b, v[2] + up * fall


@dataclass(frozen=True)
class Moment:
    """The wind at one time, as the effects get it; their device functions get n times at once.

    Attributes:
        time: The time [s], scalar float64 tensor; of a device function, shape (n,).
        flow: Flow without modulations and effects [m/s], shape (3,), float64; of a device function, (n, 3).
        carried: Displacement of the air by that flow since time zero [m]; likewise.
        gusts: Factor of gusts, see ``WindField.strength``; as ``time``.
    """

    time: Tensor
    flow: Tensor
    carried: Tensor
    gusts: Tensor


class WindEffect(Component, nn.Module):
    """Base of effects, which change the wind from place to place.

    A subclass has a ``device_function`` (:mod:`~gaussian_swaying.mpm.device_functions`), or else a ``forward`` in
    torch, with ``recordable = True`` if that can be recorded in a CUDA graph (see ``Force``). If all effects of a wind
    have a device function, kernels compute it. Places are in metres, z up, from the centre of the object at rest; in a
    configuration they are in scene units, and :meth:`in_frame` converts them.
    """

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        """Return the changed velocity: that of the device function, also of a subclass that has none of its own.

        Args:
            velocity: Air velocity so far [m/s], broadcastable to (..., P, 3).
            position: Places [m], z up, shape (..., P, 3).

        Returns:
            Velocity [m/s], broadcastable to (..., P, 3).
        """
        device_function = self.nearest_device_function()
        if device_function is None:
            raise NotImplementedError(
                f"{type(self).__name__} needs a `forward(velocity, position, moment)` or a `device_function`."
            )
        return blown(device_function, velocity, position, moment)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The same effect with its places converted from scene units to metres, z up; itself if it has none."""
        return self

    def along(self, flow: Tensor) -> WindEffect:
        """The effect for an initial flow [m/s], shape (3,), on the CPU; called when a wind is made."""
        return self


def blown(device_function: DeviceFunction, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
    """Evaluate an effect's device function on tensors, as :meth:`WindEffect.forward`."""

    def numbers(given: Any) -> tuple[Any, ...]:
        return tuple(given.to(position).reshape(-1).unbind()) if isinstance(given, Tensor) else tuple(given)

    once = Moment(*(value[None] for value in vars(moment).values()))
    now = device_function.per_substep.take(once) if device_function.per_substep.count else ()
    table = Memory(device_function.table.take()) if device_function.table.count else None
    air, place = velocity.to(position).unbind(-1), position.unbind(-1)
    found = on_tensors(device_function.function)(
        air, place, numbers(device_function.numbers.take()), numbers(now), table, device_function.options
    )
    return vectors(found)


def placed(frame: SimFrame, point: Sequence[float]) -> list[float]:
    """A point converted from scene units to metres, z up."""
    found: list[float] = frame.point_to_sim(torch.tensor([list(point)], dtype=torch.float64))[0].tolist()
    return found


class Profile(WindEffect):
    r"""A mean wind that grows with the height above the ground; gusts grow with it.

    The logarithmic profile of a neutral boundary layer over rough ground, zero below the roughness length, or with an
    ``exponent`` the power law, zero below the ground:

    .. math:: u(z) = u(h) \, \frac{\ln (z / z_0)}{\ln (h / z_0)}, \qquad u(z) = u(h) (z / h)^a

    Args:
        ground: A point on the ground, in scene units; only its height counts. In Python [m], z up.
        height: Height above the ground at which the wind is that of the ``flow`` [m].
        roughness: Roughness length z0 [m]: 0.001 for water, 0.01 for a lawn, 0.1 for a field with hedges, 1 for a town.
        exponent: a: about 0.1 over water, 0.14 over open land, 0.3 in towns; null for the logarithmic profile.
    """

    recordable = True

    def __init__(
        self,
        ground: Sequence[float] = (0.0, 0.0, 0.0),
        height: float = 10.0,
        roughness: float = 0.01,
        exponent: float | None = None,
    ) -> None:
        super().__init__()
        check_positive("height", height)
        check_positive("roughness", roughness)
        if exponent is not None:
            check_positive("exponent", exponent)
        elif not roughness < height:
            raise ValueError(f"Expected `roughness` ({roughness} m) to be below `height` ({height} m): lower it.")
        self.ground, self.height = list(check_vector("ground", ground)), float(height)
        self.roughness, self.exponent = float(roughness), exponent

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The ground in metres."""
        return changed(self, ground=placed(frame, self.ground))

    def device_function(self) -> DeviceFunction:
        if self.exponent is None:
            function, *shape = log_profile, self.roughness, 1 / math.log(self.height / self.roughness)
        else:
            function, *shape = power_profile, 1 / self.height, self.exponent
        return DeviceFunction(function, numbers=Numbers(3, lambda: [self.ground[2], *shape]), sources=(self,))


class Plume(WindEffect):
    r"""Warm air that rises over a fire or a radiator, and the air that it draws in from the sides, added to the wind.

    The mean flow of a round turbulent plume (Shabbir and George 1994), without divergence:

    .. math:: w = 3.4 \, B^{1/3} z^{-1/3} e^{-58 r^2 / z^2}, \qquad B = \frac{2 g Q}{7 p}

    with the heat Q, g = 9.81 m/s2, the pressure p = 101325 Pa, the distance r from the axis and the height z above a
    point below the source, at which the plume is as wide as the source. It does not bend, so it is for winds weaker
    than the updraft, and flames themselves are hotter and faster. There is nothing below the source.

    Args:
        source: Centre of the source, in scene units. In Python [m], z up.
        radius: Distance from the axis at which the updraft is 1/e of that in the middle at the source, in scene units.
        heat: Heat that goes into the air [W]: 50 for a candle, 1000 for a radiator, 10000 for a small fire.

    Raises:
        ValueError: If ``radius`` or ``heat`` is not positive.

    Example:
        >>> plume = Plume(radius=0.1, heat=10000.0)
        >>> moment = Moment(torch.zeros(()), torch.zeros(3), torch.zeros(3), torch.ones(()))
        >>> plume(torch.zeros(3), torch.tensor([[0.0, 0.0, 1.0]]), moment)
        tensor([[0.0000, 0.0000, 1.8343]])
    """

    recordable = True

    def __init__(self, source: Sequence[float] = (0.0, 0.0, 0.0), radius: float = 0.1, heat: float = 10000.0) -> None:
        super().__init__()
        check_positive("radius", radius)
        check_positive("heat", heat)
        self.source, self.radius, self.heat = list(check_vector("source", source)), float(radius), float(heat)

    @property
    def speed(self) -> float:
        """Updraft in the middle times the cube root of the height z [m^(4/3)/s]."""
        return 3.4 * (2 / 7 * 9.81 * self.heat / 101325) ** (1 / 3)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The source in metres."""
        return changed(self, source=placed(frame, self.source), radius=self.radius * frame.metres_per_unit)

    def device_function(self) -> DeviceFunction:
        numbers = Numbers(6, lambda: [*self.source, math.sqrt(SPREAD) * self.radius, self.speed, SPREAD])
        return DeviceFunction(plume, numbers=numbers, sources=(self,))


PLANE_GROWTH = tl.constexpr(0.29 / math.sqrt(2 * math.log(2)))
"""Standard deviation of a plane wake per root of thickness times distance (Wygnanski and others 1986)."""

ROUND_GROWTH = tl.constexpr(0.05)
"""Growth of the width of a round wake per distance: 0.03 in smooth wind, 0.05 in gusty wind (Bastankhah & Porté-Agel
2014).
"""


@triton.jit
def _direction(flow):
    speed = tl.sqrt(dot3(flow, flow))
    scale = 1 / tl.maximum(speed, 1e-12)
    return scale3(scale, flow), speed


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
    r"""``Obstacle`` without end: zero inside, and the part along the axis stays (Lamb 1932, 68).

    .. math::
        \mathbf{u} = \mathbf{v} + \frac{R^2}{r^2} \bigl(\mathbf{v}_\perp - 2 (\mathbf{v} \cdot \hat r) \hat r\bigr)

    ``numbers``: middle (3), axis (3), radius, drag; ``now``: the mean flow. ``OPTIONS``: whether it has a wake.
    """
    radius = numbers[6]
    axis = chosen(numbers, 3, 3)
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
    v = where3(outside, v, (0.0, 0.0, 0.0))
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
    r"""``Obstacle``: zero inside (Lamb 1932, 114).

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
    q = where3(outside, q, r)
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
    v = matvec(transpose(axes), where3(outside, w, (0.0, 0.0, 0.0)))
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


def _turned(frame: SimFrame, axes: Any) -> Any:
    return frame.direction_to_sim(torch.tensor(axes, dtype=torch.float64)).tolist()


class Obstacle(WindEffect):
    """An ellipsoid in the wind, such as a hill, a hedge, a flat wall or a long pole.

    Potential flow round it, and a wake behind it. The flow is that of the wind at each place, gusts included: right for
    gusts much longer than the body. The wake lies in the direction of the mean flow; behind an ellipsoid it is as wide,
    and as high, as the body is across the flow.

    Args:
        center: Its centre, in scene units.
        radii: Its half axes along the axes of the scene, in scene units; null for that of a pole without end, whose two
            others are the same.
        rotation: Rotation about its centre, as axis times angle [degrees], in scene axes.
        drag: Drag coefficient of its wake, below 1 for an ellipsoid; 0 for no wake, and null for 0.9, or 1.2 of a pole.
    """

    recordable = True

    def __init__(
        self,
        center: Sequence[float],
        radii: Sequence[float | None],
        rotation: Sequence[float] = (0.0, 0.0, 0.0),
        drag: float | None = None,
    ) -> None:
        super().__init__()
        for radius in check_vector("radii", [1.0 if radius is None else radius for radius in radii]):
            check_positive("radii", radius)
        self.radii = list(radii)
        self.long: int | None = self.radii.index(None) if None in radii else None
        if self.long is not None and (self.radii.count(None) > 1 or len(set(self.radii)) > 2):
            raise ValueError(f"Expected `radii` of a pole to be null and twice its radius, but got {self.radii}.")
        drag = (0.9 if self.long is None else 1.2) if drag is None else drag
        check_positive("drag", drag, allow_zero=True)
        if self.long is None and not drag < 1:
            raise ValueError(f"Expected `drag` of an ellipsoid to be below 1, but got {drag}: a wall has 0.9.")
        self.center, self.drag = check_vector("center", center), float(drag)
        self.rotation = check_vector("rotation", rotation)
        self.axes = rotation_of(torch.deg2rad(torch.tensor(self.rotation, dtype=torch.float64))).T.tolist()

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        fine = position.dtype == torch.float64 and self.long is None
        function = self._ellipsoid(12, 9) if fine else self.device_function()
        return blown(function, velocity, position, moment)

    def device_function(self) -> DeviceFunction:
        if self.long is None:
            return self._ellipsoid(7, 5)  # from two thirds of the distance to the root, to float32
        axis, radius = self.axes[self.long], self.radii[self.long - 1]
        return DeviceFunction(
            past_cylinder,
            options=(self.drag > 0,),
            numbers=Numbers(8, lambda: [*self.center, *axis, radius, self.drag]),
            per_substep=Numbers(3, lambda moment: moment.flow),
            sources=(self,),
        )

    def _ellipsoid(self, newton: int, duplications: int) -> DeviceFunction:
        def numbers() -> list[float]:
            radii = [radius or 0.0 for radius in self.radii]
            size = max(radii)
            shape = [*(radius / size for radius in radii), *ellipsoid_strength(tuple(radii))]
            return [*self.center, *chain(*self.axes), size, self.drag, wake_start(self.drag), *shape]

        return DeviceFunction(
            past_ellipsoid,
            options=(self.drag > 0, newton, duplications),
            numbers=Numbers(21, numbers),
            per_substep=Numbers(3, lambda moment: moment.flow),
            sources=(self,),
        )

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """In metres, z up."""
        radii = [None if radius is None else radius * frame.metres_per_unit for radius in self.radii]
        return changed(self, center=placed(frame, self.center), radii=radii, axes=_turned(frame, self.axes))
