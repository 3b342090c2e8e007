r"""A cantilever that sags under its weight, compared with the elastica."""

from __future__ import annotations

import math

import torch

from gaussian_swaying._checks import check_choice
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.boundary import Boundary
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.validation.settings import Axial, Result, Settings, block, follow

HEIGHT, YOUNG, DENSITY = 1.0, 1e4, 1.0  # thickness [m], [Pa], [kg/m³]; the result depends only on b and L / h


def elastica(b: float, steps: int = 400) -> tuple[float, float, float]:
    r"""The inextensible cantilever under its weight, clamped horizontally.

    Solves :math:`\theta'' = -b\,(1 - s) \cos \theta,\ \theta(0) = 0,\ \theta'(1) = 0` (Euler's elastica with a
    distributed load; Rohde 1953) from the tip, by bisection for its slope and the classical Runge-Kutta rule.

    Args:
        b: Weight per length times length cubed over bending stiffness, w L³ / (E I).
        steps: Steps along the beam.

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
    clamp: str = "mirror",
    settle: float = 12.0,
    per_cell: int = 2,
) -> Result:
    r"""A horizontal cantilever in plane strain with :math:`\nu = 0`, released under its weight and damped critically.

    Thickness h, weight :math:`w = \rho g h` and :math:`I = h^3 / 12` to a unit of width make
    :math:`b = w L^3 / (E I) = 12 \rho g L^3 / (E h^2)`. Two effects are known in advance:

    - Shear, which the elastica neglects: Timoshenko's beam (1921; shear coefficient 5/6, :math:`G = E / 2`) drops
      further by :math:`4 E I / (\tfrac56 G h L^2) = 0.8\, (h / L)^2`, relative, at small deflection.
    - Quadrature: splines represent bending exactly, but m equal layers of points have the second moment of area
      :math:`(1 - 1 / m^2)\, I`, so the discrete beam is the elastica of a larger b.

    One cell with two layers is not a beam: a quadratic spline across it can have the value 0 and the slope 1 at both
    layers, which is bending without strain. With three layers per cell there is no such motion.

    Args:
        cells: Cells n through the thickness.
        settings: The numerics.
        b: Weight over stiffness.
        slenderness: Length over thickness.
        clamp: ``mirror`` supports a beam of twice the length at its middle, where the section stays upright by
            symmetry: an ideal clamp. ``pin`` is a :class:`PinnedRegion` of two cells beyond the end.
        settle: Time to simulate, in units of 1 / circular frequency of the lowest bending mode.
        per_cell: Points per cell and axis.

    Returns:
        ``error`` (of the drop of the tip against the elastica, relative), ``drop`` and ``shortening`` over the length,
        ``shortening_error`` (relative), ``shear`` and ``quadrature`` (by how much the two effects raise the drop),
        ``unexplained`` (the rest of the error after these two effects, relative), ``residual`` (speed of the tip,
        relative to its drop and frequency) and the common quantities.
    """
    check_choice("clamp", clamp, ("mirror", "pin"))
    dx, length = HEIGHT / cells, slenderness * HEIGHT
    gravity = b * YOUNG * HEIGHT**2 / (12 * DENSITY * length**3)
    along = slenderness * cells
    points = block(
        dx,
        (-along if clamp == "mirror" else -2, 0, 0),
        (along, 0, cells),
        settings,
        density=DENSITY,
        youngs_modulus=YOUNG,
        poisson_ratio=0.0,
        per_cell=per_cell,
    )
    boundaries: list[Boundary] = [Axial((1,))]
    if clamp == "pin":
        boundaries.append(PinnedRegion(Box([None] * 3, [0.0, None, None]), "nodes"))
    # first root of the clamped-free beam: 1.875104² = 3.516015 (textbook)
    omega = 3.516015 / length**2 * math.sqrt(YOUNG / DENSITY * HEIGHT**2 / 12)
    solver = settings.solver(dx, boundaries=boundaries, damping=2 * omega)
    rest = points.position
    load = torch.zeros_like(rest)
    load[:, 2] = -points.mass * gravity
    root = rest[:, 0].abs() < 0.6 * dx
    if clamp == "mirror":
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
    if clamp == "mirror":
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
