r"""An inverted flag, clamped at its trailing edge: the wind at which it no longer stays straight.

Kim, Cossé, Huertas Cerdeira & Gharib (2013), "Flapping dynamics of an inverted flag", JFM 736, R1, show it in a wind
tunnel. Of a quasi-steady law without a wake only the static divergence can be asked.
"""

from __future__ import annotations

import cmath
import math
from functools import cache

import torch

from bench.problems.reconfiguration import AIR, HELD, LENGTH, YOUNG, plate
from bench.problems.settings import Result, Settings, follow
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, WindForce

BESIDE = 0.1
"""The plate is watched in winds whose pressure is so much below and above that at which it should diverge, relative."""


@cache
def critical() -> float:
    r"""The pressure at which a straight plate diverges, :math:`\kappa = \tfrac12 \rho C_D U^2 L^3 / D`.

    The slope u against the flow feels the pressure :math:`\kappa u` along the normal:

    .. math:: u''' = \kappa u, \qquad u(0) = 0, \; u'(1) = u''(1) = 0.

    The least :math:`\kappa` with a solution is the root of :math:`\sum_k e^{-r_k}` over the cube roots r of
    :math:`\kappa`.
    """
    from scipy.optimize import brentq

    def end(kappa: float) -> float:  # u with u'(1) = u''(1) = 0 is the sum of exp(r (s - 1)); here at s = 0
        return sum(cmath.exp(-(kappa ** (1 / 3)) * cmath.exp(2j * math.pi * k / 3)).real for k in range(3))

    return float(brentq(end, 1.0, 20.0, xtol=1e-12))


def divergence(cells: int = 32, settings: Settings | None = None, slenderness: float = 60.0) -> Result:
    r"""Push a plate that lies along the wind slightly aside, in a wind below and one above, and watch it grow.

    Once the other modes are gone the tip moves as :math:`e^{\sigma t}`, and :math:`\sigma^2 + c \sigma = -\lambda` with
    the damping c of the solver and of the air. The stiffness :math:`\lambda` of the mode falls with the pressure of the
    wind, and the plate diverges where it is zero.

    Returns:
        ``error`` (of the pressure at which it diverges, relative), ``kappa`` and ``exact``, ``below`` and ``above``
        (rates :math:`\sigma` in the two winds, in units of the circular frequency of the lowest mode without wind) and
        the common quantities of the second run.
    """
    settings = Settings() if settings is None else settings
    exact, thick = critical(), LENGTH / slenderness
    stiffness = YOUNG * thick**3 / 12
    pressures, found = [exact * (1 - BESIDE), exact * (1 + BESIDE)], []
    for pressure in pressures:
        speed = math.sqrt(pressure * stiffness / (0.5 * AIR * LENGTH**3))
        density = (0.5 * AIR * speed * LENGTH**2 / 3.516) ** 2 / (stiffness * thick)  # the air damps it by omega
        omega = 3.516 / LENGTH**2 * math.sqrt(stiffness / (density * thick))
        points, middle, area = plate(cells, slenderness, density, settings)
        normal = points.position.new_tensor([0.0, 1.0, 0.0]).expand_as(points.position)
        areas = torch.where(middle, area, 0.0).to(points.position)
        aero = AeroForce(C_D=1.0, C_F=0.0, C_L=0.0, air_density=AIR, law="projected")
        force = WindForce(aero, WindField([0.0, 0.0, -speed]), normal, areas).to(points.position.device)
        damping = 2 * omega
        solver = settings.solver(LENGTH / cells, boundaries=[PinnedRegion(HELD, "clamp")], damping=damping)
        velocity = torch.zeros_like(points.position)
        velocity[:, 1] = 1e-5 * omega * points.position[:, 2].clamp(min=0).square()
        last = points.position[:, 2] > LENGTH * (1 - 0.5 / cells)

        def tip(state: MPMState, last: torch.Tensor = last) -> torch.Tensor:
            return state.position[last, 1].double().mean()

        run = follow(solver, solver.init_state(points, velocity), 12 / omega / 64, 64, tip, force)
        rate = math.log(float(run.series[-1] / run.series[-17])) / float(run.time[-1] - run.time[-17])
        drag = damping + 0.5 * AIR * speed / (density * thick)
        found.append((rate / omega, -(rate**2 + drag * rate) / omega**2, run))
    (below, stiff, _), (above, soft, run) = found
    kappa = pressures[0] + (pressures[1] - pressures[0]) * stiff / (stiff - soft)
    return run.result(kappa / exact - 1, kappa=kappa, exact=exact, below=below, above=above)
