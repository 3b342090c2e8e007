r"""A plate that falls in air that rests: what the quasi-steady law says of it, which is neither flutter nor tumbling.

The law gives a force to each patch from the flow against it alone. On a flat plate that does not turn it is the same
everywhere, so it acts at the middle and turns nothing; on one that turns, it resists. The plate keeps its angle.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from bench.problems.settings import Result, Settings, block, follow
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, WindForce

AIR, C_D, GRAVITY = 1.225, 1.2, 9.81  # kg/m³, flat plate, m/s²
SIDE, MASS = 0.2, 0.3  # m, kg/m²
YOUNG = 1e5  # Pa; only its stiffness, it bears no load that is not even


def terminal(tilt: float = 0.0) -> float:
    r"""Speed across the plate at which ``cross_flow`` bears it [m/s], :math:`\sqrt{2 m g \cos\alpha / (\rho C_D)}`.

    Units: ``tilt`` [degrees].
    """
    return math.sqrt(2 * MASS * GRAVITY * math.cos(math.radians(tilt)) / (AIR * C_D))


def sliding(tilt: float, law: str, times: np.ndarray) -> np.ndarray:
    """Speeds of a plate that keeps its angle, across and along itself [m/s], shape (N, 2), from rest.

    Units: ``tilt`` [degrees]; ``times`` [s].
    """
    from scipy.integrate import solve_ivp

    across, along = GRAVITY * math.cos(math.radians(tilt)), GRAVITY * math.sin(math.radians(tilt))

    def change(_: float, v: np.ndarray) -> list[float]:
        speed = math.hypot(*v) if law == "projected" else abs(v[0])
        return [across - 0.5 * AIR * C_D / MASS * speed * v[0], along]

    return solve_ivp(change, (0, times[-1]), [0.0, 0.0], t_eval=times, rtol=1e-9, atol=1e-12).y.T


def fall(
    tilt: float = 0.0,
    law: str = "cross_flow",
    spin: float = 0.0,
    cells: int = 8,
    settle: float = 3.0,
    settings: Settings | None = None,
) -> Result:
    r"""Let a plate fall from rest, and compare its speed at any time with that of a plate that keeps its angle.

    Units: ``tilt`` [degrees].

    Returns:
        ``error`` (largest difference of the speed, over the last one; with ``spin`` of the rate at which the spin
        decays, which is :math:`2 g / v`), ``speed`` and ``exact`` (across the plate, at the end [m/s]; with ``spin``
        the rates [1/s]), ``along`` (along the plate [m/s]), ``turned`` (how far the plate has turned [degrees]) and the
        common quantities.
    """
    settings = Settings() if settings is None else settings
    dx = SIDE / cells
    points = block(dx, (0, 0, 0), (cells, cells, 0), settings, density=MASS / dx, youngs_modulus=YOUNG,
                   poisson_ratio=0.0)  # fmt: skip
    rest = points.position - points.position.mean(0)
    c, s = math.cos(math.radians(tilt)), math.sin(math.radians(tilt))
    normal = rest.new_tensor([s, 0.0, c]).expand_as(rest)
    turn = rest.new_tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    points = replace(points, position=rest @ turn.mT)
    aero = AeroForce(C_D=C_D, C_F=0.0, C_L=0.0, air_density=AIR, law=law)  # type: ignore[arg-type]
    areas = points.volume / dx
    force = WindForce(aero, WindField([0.0, 0.0, 0.0]), normal, areas).to(rest.device)
    solver = settings.solver(dx, gravity=(0.0, 0.0, -GRAVITY))
    place = points.position
    final, arm = terminal(tilt), place[:, 0] * c - place[:, 2] * s
    start = torch.zeros_like(place)
    if spin:
        start[:, 2] = -final
        start += spin * arm[:, None] * normal
    inertia = (points.mass * arm.square()).sum()

    def observe(state: MPMState) -> torch.Tensor:
        mean = (points.mass[:, None] * state.velocity).sum(0) / points.mass.sum()
        turning = (points.mass * arm * (state.velocity @ normal[0])).sum() / inertia
        slope = (points.mass * arm * ((state.position - place) @ normal[0])).sum() / inertia
        return torch.stack([-(mean @ normal[0]), mean[0] * c - mean[2] * s, turning, slope])

    frame = settle * final / GRAVITY / 48
    run = follow(solver, solver.init_state(points, start), frame, 48, observe, force)
    speed, along, turning, slope = run.series.T
    turned = math.degrees(math.atan(float(slope[-1])))
    if spin:
        half = int((turning.abs() > 0.1 * spin).sum())
        rate = -float(np.polyfit(run.time[:half], turning[:half].abs().log(), 1)[0])
        exact = 2 * GRAVITY / final
        return run.result(rate / exact - 1, speed=rate, exact=exact, along=float(along[-1]), turned=turned)
    known = torch.from_numpy(sliding(tilt, law, run.time.numpy()))
    error = float((speed - known[:, 0]).abs().max() / known[-1, 0])
    return run.result(error, speed=float(speed[-1]), exact=float(known[-1, 0]), along=float(along[-1]), turned=turned)
