r"""A cantilever that sags under its weight, compared with the elastica, and one that vibrates, held in a region."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from bench.problems.settings import Axial, Result, Settings, block, follow
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints

HEIGHT, YOUNG, DENSITY = 1.0, 1e4, 1.0  # thickness [m], [Pa], [kg/m³]; the result depends only on b and L / h


def elastica(b: float, steps: int = 400) -> tuple[float, float, float]:
    r"""The inextensible cantilever under its weight, clamped horizontally.

    Solves :math:`\theta'' = -b\,(1 - s) \cos \theta,\ \theta(0) = 0,\ \theta'(1) = 0` (Euler's elastica with a
    distributed load; Rohde 1953) from the tip, by bisection for its slope and the classical Runge-Kutta rule.

    With ``b`` = w L³ / (E I), w the weight per length.

    Returns:
        Drop of the tip and its shortening (how far it moves back), both over the length, and its slope [rad].
    """
    ds = 1.0 / steps

    def rate(r: float, y: tuple[float, ...]) -> tuple[float, ...]:
        return (-y[1], b * r * math.cos(y[0]), math.sin(y[0]), math.cos(y[0]))

    def shoot(slope: float) -> tuple[float, ...]:
        y: tuple[float, ...] = (slope, 0.0, 0.0, 0.0)
        for k in range(steps):
            r = k * ds  # distance from the tip
            k1 = rate(r, y)
            k2 = rate(r + ds / 2, tuple(a + ds / 2 * d for a, d in zip(y, k1, strict=True)))
            k3 = rate(r + ds / 2, tuple(a + ds / 2 * d for a, d in zip(y, k2, strict=True)))
            k4 = rate(r + ds, tuple(a + ds * d for a, d in zip(y, k3, strict=True)))
            slopes = zip(y, k1, k2, k3, k4, strict=True)
            y = tuple(a + ds / 6 * (p + 2 * q + 2 * r_ + s) for a, p, q, r_, s in slopes)
        return y

    low, high = 0.0, math.pi / 2
    while high - low > 1e-13:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if shoot(middle)[0] < 0 else (low, middle)
    _, _, drop, reach = shoot(low)
    return drop, 1 - reach, low


def cantilever(
    cells: int,
    settings: Settings,
    b: float = 1.0,
    slenderness: int = 10,
    settle: float = 12.0,
    per_cell: int = 2,
) -> Result:
    r"""A horizontal cantilever in plane strain with :math:`\nu = 0`, released under its weight and damped critically.

    It is one half of a beam of twice the length, whose middle stays upright by symmetry: an ideal clamp.

    Thickness h, weight :math:`w = \rho g h` and :math:`I = h^3 / 12` to a unit of width make
    :math:`b = w L^3 / (E I) = 12 \rho g L^3 / (E h^2)`. Two effects are known in advance:

    - Shear, which the elastica neglects: Timoshenko's beam (1921; shear coefficient 5/6, :math:`G = E / 2`) drops
      further by :math:`4 E I / (\tfrac56 G h L^2) = 0.8\, (h / L)^2`, relative, at small deflection.
    - Quadrature: splines represent bending exactly, but m equal layers of points have the second moment of area
      :math:`(1 - 1 / m^2)\, I`, so the discrete beam is the elastica of a larger b.

    One cell with two layers bends without strain: a quadratic spline across it can have the value 0 and the slope 1 at
    both layers.

    Units: ``cells`` through the thickness; ``settle`` [1 / circular frequency of the lowest bending mode].

    Returns:
        ``error`` (of the drop of the tip against the elastica, relative), ``drop`` and ``shortening`` over the length,
        ``shortening_error`` (relative), ``shear`` and ``quadrature`` (by how much the two effects raise the drop),
        ``unexplained`` (the rest of the error after these two effects, relative), ``residual`` (speed of the tip,
        relative to its drop and frequency) and the common quantities.
    """
    dx, length = HEIGHT / cells, slenderness * HEIGHT
    gravity = b * YOUNG * HEIGHT**2 / (12 * DENSITY * length**3)
    along = slenderness * cells
    points = block(
        dx,
        (-along, 0, 0),
        (along, 0, cells),
        settings,
        density=DENSITY,
        youngs_modulus=YOUNG,
        poisson_ratio=0.0,
        per_cell=per_cell,
    )
    # first root of the clamped-free beam: 1.875104² = 3.516015 (textbook)
    omega = 3.516015 / length**2 * math.sqrt(YOUNG / DENSITY * HEIGHT**2 / 12)
    solver = settings.solver(dx, boundaries=[Axial((1,))], damping=2 * omega)
    rest = points.position
    load = torch.zeros_like(rest)
    load[:, 2] = -points.mass * gravity
    root = rest[:, 0].abs() < 0.6 * dx
    load[root, 2] += points.mass.sum() * gravity / root.sum()
    tip = rest[:, 0] > rest[:, 0].max() - 0.1 * dx

    run = follow(
        solver,
        solver.init_state(points),
        settle / omega / 64,
        64,
        lambda s: torch.stack([s.position[tip].mean(0), s.position[root].mean(0)]),
        force=lambda _: load,
    )
    moved = run.series[-1] - run.series[0]
    moved = moved - moved[1]
    # the last points are before the tip: extend the line with the slope of the elastica there
    known, short, slope = elastica(b)
    gap = 0.5 * dx / per_cell
    drop = (-float(moved[0, 2]) + gap * math.sin(slope)) / length
    shortening = (-float(moved[0, 0]) + gap * (1 - math.cos(slope))) / length
    shear, fewer = 0.8 / slenderness**2, elastica(b / (1 - 1 / (per_cell * cells) ** 2))[0]
    speed = float(run.state.velocity[tip].double().cpu().norm(dim=-1).max())
    return run.result(
        abs(drop / known - 1),
        drop=drop,
        shortening=shortening,
        shortening_error=abs(shortening / short - 1),
        shear=shear,
        quadrature=fewer / known - 1,
        unexplained=drop / (fewer * (1 + shear)) - 1,
        residual=speed / (omega * length * drop),
    )


def timoshenko_mode(
    length: float, thickness: float, second_moment: float, elements: int = 200
) -> tuple[float, torch.Tensor]:
    r"""Lowest bending mode of a clamped-free beam of unit width, with E = rho = 1 and G = 1/2.

    Timoshenko's beam (1921; shear coefficient 5/6) in linear elements with reduced integration of the shear (Hughes,
    Taylor & Kanoknukulchai 1977); 200 elements are within 1e-4 of the limit.

    Returns:
        The circular frequency, and displacement and rotation at the nodes of the elements, scaled to a displacement of
        one at the tip, shape (elements + 1, 2).
    """
    size = length / elements
    K, M = torch.zeros(2, 2 * elements + 2, 2 * elements + 2, dtype=torch.float64)
    turn = torch.tensor([0.0, -1.0, 0.0, 1.0], dtype=torch.float64)
    slide = torch.tensor([-1 / size, -0.5, 1 / size, -0.5], dtype=torch.float64)
    stiffness = second_moment / size * torch.outer(turn, turn) + 5 / 12 * thickness * size * torch.outer(slide, slide)
    shape = torch.tensor([[2.0, 1.0], [1.0, 2.0]], dtype=torch.float64) * size / 6
    mass = torch.kron(shape, torch.diag(torch.tensor([thickness, second_moment], dtype=torch.float64)))
    for k in range(elements):
        K[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += stiffness
        M[2 * k : 2 * k + 4, 2 * k : 2 * k + 4] += mass
    half = torch.linalg.inv(torch.linalg.cholesky(M[2:, 2:]))
    values, vectors = torch.linalg.eigh(half @ K[2:, 2:] @ half.T)
    mode = torch.nn.functional.pad((half.T @ vectors[:, 0]).reshape(-1, 2), (0, 0, 1, 0))
    return math.sqrt(float(values[0])), mode / mode[-1, 0]


def held_cantilever(
    settings: Settings,
    thickness: float,
    depth: float,
    place: tuple[float, float] = (0.0, 0.0),
    angle: float = 0.0,
    length: float | None = None,
    kind: str | None = None,
    per_cell: int = 4,
) -> Result:
    r"""The lowest bending frequency of a cantilever whose end lies in a :class:`PinnedRegion`, in plane strain, nu = 0.

    The free length begins halfway between the last held and the first free points: a body of points has no finer edge.
    Equal layers have the second moment of area :math:`(1 - 1 / m^2)\, I`; a strip thinner than a cell has three layers
    with the weights of Simpson's rule, which have I.

    With two points ``per_cell``, a beam of one or two cells that lies obliquely on the grid is too soft by up to 5 % in
    its frequency, also without any pin.

    Units: ``thickness``, ``depth`` of the region, ``place`` off the planes of the nodes along x and z, free ``length``
    (ten thicknesses, and at least 20, if None) [cells]; ``angle`` to the x axis, in the x-z plane [rad].

    Returns:
        ``ratio`` (frequency over that of Timoshenko's beam), ``error`` (its distance from one) and the common
        quantities.
    """
    length = max(10 * thickness, 20.0) if length is None else length
    strip = Strip.of(thickness, depth, length, per_cell)
    beam, span = strip.points, strip.span
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
    like = torch.zeros((), dtype=settings.dtype, device=settings.device)
    points = MaterialPoints.create(
        (beam @ turn.T + torch.tensor([place[0], 0.0, place[1]], dtype=torch.float64)).to(like),
        volume=strip.volume.to(like),
        density=1.0,
        youngs_modulus=1.0,
        poisson_ratio=0.0,
    )
    pin = PinnedRegion(Chosen(~strip.free), kind)
    solver = settings.solver(1.0, boundaries=[Axial((1,)), pin])
    # only the lowest mode moves, with the rotation of its sections, and only the lowest mode is listened to: the others
    # would shift the time at which the velocity passes zero
    omega, bent = strip.mode()
    shape = bent[:, :1] * turn[:, 2] - (bent[:, 1] * beam[:, 2])[:, None] * turn[:, 0]
    velocity = (1e-5 * omega * span * shape).to(like)
    weight = points.mass.double().cpu()[:, None] * shape
    many, until = 40, 2.4  # the velocity passes zero at 1.57 if the frequency is right
    run = follow(
        solver,
        solver.init_state(points, velocity),
        until / omega / many,
        many,
        lambda state: (weight * state.velocity.double().cpu()).sum(),
    )
    crossing = first_zero(run.time, run.series.reshape(-1))
    if crossing is None:
        return run.result(1.0, ratio=0.0)
    ratio = math.pi / 2 / (omega * crossing)
    return run.result(abs(ratio - 1), ratio=ratio)


def first_zero(time: torch.Tensor, series: torch.Tensor) -> float | None:
    """The time [s] at which a series (N,) that starts above zero passes it; None if it does not."""
    past = int((series <= 0).int().argmax())
    if past == 0:
        return None
    before, after = float(series[past - 1]), float(series[past])
    start, end = float(time[past - 1]), float(time[past])
    return start + (end - start) * before / (before - after)


@dataclass(frozen=True)
class Strip:
    """A straight beam along x of which one end is held, with the points of a body on a grid of side one.

    Attributes:
        points: Positions [cells], the middle line at y = z = 0, and the held part at x < 0, shape (P, 3), float64.
        volume: Volumes, for a width of one, shape (P,).
        free: Points that are not held, bool, shape (P,).
        edge: Where the free length begins: halfway between the last held and the first free points.
        moment: Second moment of area of the layers.
    """

    points: torch.Tensor
    volume: torch.Tensor
    free: torch.Tensor
    edge: float
    span: float
    thickness: float
    moment: float

    @classmethod
    def of(cls, thickness: float, depth: float, length: float, per_cell: int) -> Strip:
        """A strip of some thickness, length and held depth [cells], with points per cell along it."""
        along = (torch.arange(round((length + depth) * per_cell), dtype=torch.float64) + 0.5) / per_cell - depth
        layers = max(round(thickness * per_cell), 3)
        share = torch.full((layers,), 1 / layers, dtype=torch.float64)
        across = (torch.arange(layers, dtype=torch.float64) + 0.5) / layers - 0.5
        moment = thickness**3 / 12 * (1 - 1 / layers**2)
        if thickness < 1:
            across, share = across * layers / (layers - 1), torch.tensor([1 / 6, 2 / 3, 1 / 6], dtype=torch.float64)
            moment = thickness**3 / 12
        points = torch.cartesian_prod(along, torch.tensor([-0.25, 0.25], dtype=torch.float64), thickness * across)
        volume = share.repeat(2 * len(along)) * thickness / (2 * per_cell)
        edge = float(along[along > 0][0]) - 0.5 / per_cell
        span = float(along[-1]) + 0.5 / per_cell - edge
        return cls(points, volume, points[:, 0] > 0, edge, span, thickness, moment)

    def mode(self) -> tuple[float, torch.Tensor]:
        """Circular frequency of the lowest mode, and its displacement and rotation at the points, shape (P, 2)."""
        omega, mode = timoshenko_mode(self.span, self.thickness, self.moment)
        at = ((self.points[:, 0] - self.edge) / self.span).clamp(0, 1) * (len(mode) - 1)
        before = at.long().clamp(max=len(mode) - 2)
        return omega, torch.lerp(mode[before], mode[before + 1], (at - before)[:, None]) * self.free[:, None]


class Chosen(Region):
    """Particles by their number."""

    def __init__(self, mask: torch.Tensor) -> None:
        self.mask = mask

    def contains(self, points: torch.Tensor) -> torch.Tensor:
        """The mask, for any points."""
        return self.mask.to(points.device)
