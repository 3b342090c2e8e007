"""Flow round bodies in closed form: potential flow and wakes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double

PLANE_GROWTH = 0.29 / math.sqrt(2 * math.log(2))
"""Standard deviation of a plane wake per root of thickness times distance (Wygnanski and others 1986)."""

ROUND_GROWTH = 0.05
"""Growth of the width of a round wake per distance: 0.03 in smooth wind, 0.05 in gusty wind (Bastankhah & Porté-Agel
2014).
"""


def cylinder_flow(velocity: Tensor, place: Tensor, axis: Tensor, radius: float) -> Tensor:
    r"""Potential flow round an endless cylinder through the origin; zero inside. The part along its axis stays.

    .. math::
        \mathbf{u} = \mathbf{v} + \frac{R^2}{r^2} \bigl(\mathbf{v}_\perp - 2 (\mathbf{v} \cdot \hat r) \hat r\bigr)

    (Lamb 1932, 68.)

    Args:
        velocity: Undisturbed velocity [m/s], broadcastable to (..., 3).
        place: Places [m], shape (..., 3).
        axis: Unit vector along the axis, shape (3,).
        radius: R [m].
    """
    away = place - (place * axis).sum(-1, keepdim=True) * axis
    across = velocity - (velocity * axis).sum(-1, keepdim=True) * axis
    square = away.square().sum(-1, keepdim=True)
    outside = square >= radius**2
    square = square.clamp(min=radius**2)
    along = (across * away).sum(-1, keepdim=True)
    return torch.where(outside, velocity + radius**2 / square * (across - 2 * along / square * away), 0.0)


def carlson_rd(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    r"""Carlson's elliptic integral :math:`R_D = \tfrac32 \int_0^\infty [(t+x)(t+y)]^{-1/2} (t+z)^{-3/2} dt`.

    By duplication (Carlson 1995, Numer. Algorithms 10, 13): each of nine steps quarters the spread of the arguments,
    and a series takes what remains. Its next terms are below 1e-17 if the arguments are within 1e12 of each other, as
    they are for half axes within 1e6.

    Args:
        x: Positive, any shape.
        y: Positive, any shape.
        z: Positive, any shape.

    Returns:
        As the arguments.
    """
    total, factor = torch.zeros_like(x + y + z), 1.0
    for _ in range(9):
        rx, ry, rz = x.sqrt(), y.sqrt(), z.sqrt()
        step = rx * ry + ry * rz + rz * rx
        total = total + factor / (rz * (z + step))
        factor *= 0.25
        x, y, z = 0.25 * (x + step), 0.25 * (y + step), 0.25 * (z + step)
    mean = (x + y + 3 * z) / 5
    a, b, c = 1 - x / mean, 1 - y / mean, 1 - z / mean
    e2 = a * b - 6 * c * c
    e3 = (3 * a * b - 8 * c * c) * c
    return 3 * total + factor * (1 - 3 / 14 * e2 + e3 / 6) / (mean * mean.sqrt())


@lru_cache(maxsize=64)
def ellipsoid_strength(radii: tuple[float, ...]) -> tuple[float, ...]:
    r""":math:`1 / (2 - \alpha_i(0))` of :func:`ellipsoid_flow`, for the three axes i."""
    with torch.device("cpu"):
        a = torch.tensor([(radius / max(radii)) ** 2 for radius in radii], dtype=torch.float64)
        return tuple((1 / (2 - 2 / 3 * a.prod().sqrt() * carlson_rd(a.roll(-1), a.roll(-2), a))).tolist())


def ellipsoid_flow(velocity: Tensor, place: Tensor, radii: Sequence[float]) -> Tensor:
    r"""Potential flow round an ellipsoid at the origin whose axes are those of the coordinates; zero inside.

    With :math:`\lambda` the larger root of :math:`\sum_i x_i^2 / (a_i^2 + \lambda) = 1` and
    :math:`\alpha_i(\lambda) = a b c \int_\lambda^\infty \frac{ds}{(a_i^2 + s) \Delta(s)}`, the potential is
    :math:`\sum_i v_i x_i \bigl(1 + \alpha_i(\lambda) / (2 - \alpha_i(0))\bigr)` (Lamb 1932, 114).

    Args:
        velocity: As in :func:`cylinder_flow`.
        place: As in :func:`cylinder_flow`; computed in float64.
        radii: Half axes a, b and c [m].
    """
    given, place, velocity = place, in_double(place), in_double(velocity)
    size = max(radii)
    squares = torch.stack([torch.full_like(place[..., 0], (radius / size) ** 2) for radius in radii], dim=-1)
    x = place / size
    outside = (x.square() / squares).sum(-1, keepdim=True) >= 1
    x = torch.where(outside, x, squares.sqrt())
    # left of the root, so that Newton rises to it: every part of the sum is at most 1, and the longest half axis is 1
    nearer = (x.square() - squares).amax(-1, keepdim=True)
    root = (x.square().sum(-1, keepdim=True) - 1).maximum(nearer).clamp(min=0)
    for _ in range(12):
        part = x.square() / (squares + root)
        root = (root + (part.sum(-1, keepdim=True) - 1) / (part / (squares + root)).sum(-1, keepdim=True)).clamp(min=0)
    volume = math.prod(radius / size for radius in radii)
    strong = ellipsoid_strength(tuple(map(float, radii)))
    strength = torch.stack([velocity[..., axis] * factor for axis, factor in enumerate(strong)], dim=-1)
    shifted = squares + root
    first, second = shifted.roll(-1, -1), shifted.roll(-2, -1)
    alpha = 2 / 3 * volume * carlson_rd(first, second, shifted)
    slope = -volume / (shifted * shifted.prod(-1, keepdim=True).sqrt())  # of alpha with the root
    normal = 2 * x / shifted / (x / shifted).square().sum(-1, keepdim=True)  # slope of the root with the place
    found = velocity + strength * alpha + (strength * x * slope).sum(-1, keepdim=True) * normal
    return torch.where(outside, found, 0.0).to(given)


def round_wake(behind: Tensor, aside: Tensor, width: float, drag: float, growth: float = ROUND_GROWTH) -> Tensor:
    r"""Velocity deficit in the wake of a body, as a share of the speed: a Gaussian that conserves the momentum.

    .. math::
        \Bigl(1 - \sqrt{1 - \tfrac{C_D}{8 (\sigma / d)^2}}\Bigr) e^{-r^2 / 2 \sigma^2}, \qquad
        \sigma / d = k x / d + \tfrac14 \sqrt{\beta}, \quad
        \beta = \tfrac12 \frac{1 + \sqrt{1 - C_D}}{\sqrt{1 - C_D}}

    (Bastankhah & Porté-Agel 2014, Renewable Energy 70.) Made for turbines and their thrust; a
    bluff body takes momentum in the same way, but its near wake, up to some three widths, is only an estimate.

    Args:
        behind: Distance x downwind of the centre [m], any shape; no wake where it is negative.
        aside: Distance r from the line behind the centre [m], as ``behind``.
        width: Width d of the body across the wind [m].
        drag: Its drag coefficient, below 1.
        growth: k.

    Returns:
        Between 0 and 1, as ``behind``.
    """
    sigma = growth * behind.clamp(min=0) / width + wake_start(drag)
    depth = 1 - (1 - drag / (8 * sigma.square())).clamp(min=0).sqrt()
    return torch.where(behind > 0, depth * torch.exp(-0.5 * (aside / (width * sigma)).square()), 0.0)


def wake_start(drag: float) -> float:
    r"""Standard deviation of a round wake at the body, per width: :math:`\tfrac14 \sqrt\beta` in :func:`round_wake`."""
    root = math.sqrt(1 - drag)
    return 0.25 * math.sqrt(0.5 * (1 + root) / root)


def plane_wake(behind: Tensor, aside: Tensor, width: float, drag: float) -> Tensor:
    r"""As :func:`round_wake`, behind a long body across the wind: a plane wake.

    Its half width at half of its depth is :math:`0.29 \sqrt{\theta x}` with the momentum thickness
    :math:`\theta = C_D d / 2` (Wygnanski, Champagne & Marasli 1986, J. Fluid Mech. 168, table 2, cylinder); the depth C
    follows from the momentum, :math:`\int u (U - u)\, dy = \theta U^2`:

    .. math:: C = \tfrac1{\sqrt2} \Bigl(1 - \sqrt{1 - \tfrac{2 \theta}{\sqrt\pi \sigma}}\Bigr)

    Args:
        behind: As in :func:`round_wake`.
        aside: Distance from the plane behind the axis [m].
        width: d [m].
        drag: C_D.
    """
    thickness = 0.5 * drag * width
    sigma = PLANE_GROWTH * (thickness * behind.clamp(min=0)).sqrt()
    sigma = sigma.clamp(min=2 * thickness / math.sqrt(math.pi))  # nearer, no wake of this shape takes the momentum
    depth = (1 - (1 - 2 * thickness / (math.sqrt(math.pi) * sigma)).clamp(min=0).sqrt()) / math.sqrt(2)
    return torch.where(behind > 0, depth * torch.exp(-0.5 * (aside / sigma).square()), 0.0)
