r"""A plate that bends in a steady flow: its drag against that of the elastica.

Gosselin, de Langre & Machado-Almeida (2010), "Drag reduction of flexible plates by reconfiguration", JFM 650, 319: a
plate held across the flow in its middle, each half of length l bends with the flow. One number describes it, the Cauchy
number :math:`C = \tfrac12 \rho C_D U^2 l^3 / D`, with D to a unit of width.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch

from bench.problems.settings import Result, Settings, follow
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, WindForce

LENGTH, WIDTH, YOUNG, AIR = 1.0, 0.125, 1e4, 1.225  # m, m, Pa, kg/m³; a plate of a single cell's width twists
BEHIND = 2
"""Cells of the plate that are held, before it begins."""
POWERS = {"projected": 1, "cross_flow": 2}
"""The laws, and the power of the cosine between normal and flow that their pressure on a plate at rest follows."""
HELD = Box([None] * 3, [None, None, 0.0])


def _from_the_tip(lean: float, law: str) -> tuple[float, float, float]:
    """C, R and the place of the tip of the plate whose tip leans from its rest direction by an angle [rad].

    In units in which D and the pressure across the flow are 1 the plate is integrated from its free end until it has
    its rest direction, at whatever length that is.
    """
    from scipy.integrate import solve_ivp

    def bent(_: float, y: np.ndarray) -> list[float]:
        angle, moment, across, along, _tip = y
        c, s = math.cos(angle), math.sin(angle)
        pressure = c * abs(c) ** (POWERS[law] - 1)
        return [-moment, across * c - along * s, pressure * c, -pressure * s, s]

    def upright(_: float, y: np.ndarray) -> float:
        return float(y[0])

    upright.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(bent, (0, 1e4), [lean, 0, 0, 0, 0], events=upright, rtol=1e-10, atol=1e-12)
    length, end = found.t_events[0][0], found.y_events[0][0]
    return length**3, end[2] / length, end[4] / length


@cache
def elastica(cauchy: float, law: str) -> tuple[float, float]:
    r"""Drag over that of the rigid plate, and the place of the tip along the flow over l, of an inextensible plate.

    With the angle :math:`\theta(s)` from the rest direction, the force F on what lies beyond s and the pressure
    :math:`p = C \cos\theta\,|\cos\theta|^{m-1}` along the normal, all in units of l and D:

    .. math:: \theta' = M, \quad M' = -(F_y \cos\theta - F_z \sin\theta), \quad F_y' = -p \cos\theta, \quad
        F_z' = p \sin\theta, \qquad \theta(0) = 0, \; M(1) = F_y(1) = F_z(1) = 0.
    """
    from scipy.optimize import brentq

    lean = brentq(lambda lean: math.log(_from_the_tip(lean, law)[0] / cauchy), 1e-6, math.pi / 2 - 1e-4, xtol=1e-12)
    _, drag, tip = _from_the_tip(lean, law)
    return float(drag), float(tip)


def plate(
    cells: int, slenderness: float, density: float, settings: Settings
) -> tuple[MaterialPoints, torch.Tensor, float]:
    """A plate from z = 0 to z = l across y, in three layers with Simpson's weights, and what is held before it.

    Returns:
        The points, which of them are in the middle plane, and the area of each there.
    """
    dx, thick = LENGTH / cells, LENGTH / slenderness
    along = (torch.arange(-2 * BEHIND, 2 * cells, dtype=torch.float64) + 0.5) * 0.5 * dx
    across = thick * torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64)
    columns = round(2 * WIDTH / dx)
    wide = (torch.arange(columns, dtype=torch.float64) + 0.5 - 0.5 * columns) * 0.5 * dx
    rest = torch.cartesian_prod(along, wide, across)[:, [1, 2, 0]]
    simpson = torch.tensor([1 / 6, 2 / 3, 1 / 6], dtype=torch.float64).repeat(len(rest) // 3)
    points = MaterialPoints.create(
        rest.to(settings.device, settings.dtype),
        volume=(simpson * thick * 0.25 * dx * dx).to(settings.device, settings.dtype),
        density=density,
        youngs_modulus=YOUNG,
        poisson_ratio=0.0,
    )
    return points, (rest[:, 1].abs() < 0.1 * thick) & (rest[:, 2] > 0), 0.25 * dx * dx


def reconfiguration(
    cauchy: float,
    law: str,
    cells: int = 32,
    settings: Settings | None = None,
    slenderness: float = 60.0,
    settle: float = 16.0,
) -> Result:
    r"""Bend a plate in a steady wind until it rests, and compare its drag with that of the elastica.

    Returns:
        ``error`` (of R, relative), ``drag`` (R), ``exact`` (that of the elastica), ``tip`` and ``exact_tip`` (its place
        along the flow over l), ``drift`` (relative change of the drag in the last eighth of the time) and the common
        quantities.
    """
    settings = Settings() if settings is None else settings
    exact, exact_tip = elastica(cauchy, law)
    thick = LENGTH / slenderness
    stiffness = YOUNG * thick**3 / 12
    speed = math.sqrt(cauchy * stiffness / (0.5 * AIR * LENGTH**3))
    # so heavy that the drag damps its lowest mode critically, rho U / (density h) = 2 omega; no heavier than at C = 30
    density = min(1.0, 30 / cauchy) * (0.5 * AIR * speed * LENGTH**2 / 3.516) ** 2 / (stiffness * thick)
    omega = 3.516 / LENGTH**2 * math.sqrt(stiffness / (density * thick))
    points, middle, area = plate(cells, slenderness, density, settings)
    normal = points.position.new_tensor([0.0, 1.0, 0.0]).expand_as(points.position)
    areas = torch.where(middle, area, 0.0).to(points.position)
    aero = AeroForce(C_D=1.0, C_F=0.0, C_L=0.0, air_density=AIR, law=law)
    force = WindForce(aero, WindField([0.0, speed, 0.0]), normal, areas).to(points.position.device)
    pins = PinnedRegion(HELD, "clamp")
    solver = settings.solver(LENGTH / cells, boundaries=[pins], damping=omega * max(1.0, cauchy ** (1 / 3)))
    rigid = 0.5 * AIR * speed * speed * float(areas.sum())

    last, before = (points.position[:, 2] > LENGTH * (1 - share / cells) for share in (0.5, 1.0))
    before = before & ~last

    def observe(state: MPMState) -> torch.Tensor:
        drag = force(state)[0][..., 1].sum() / rigid
        tip = 1.5 * state.position[last, 1].mean() - 0.5 * state.position[before, 1].mean()
        return torch.stack([drag, tip / LENGTH])

    run = follow(solver, solver.init_state(points), settle / omega / 64, 64, observe, force)
    drag, tip = run.series[-1].tolist()
    return run.result(
        drag / exact - 1,
        drag=drag,
        exact=exact,
        tip=tip,
        exact_tip=exact_tip,
        drift=float(run.series[-1, 0] / run.series[-9, 0]) - 1,
    )
