"""Onset of flutter of a flag: linear theory of an ideal flow, and growth of small motion in computed air.

Lengths are in that of the flag, speeds in that of the flow, and the density of the fluid is 1: a mass ratio is the mass
of the flag per mass of fluid in a square of its length, and a bending stiffness is per rho U² L³. A flag that is
clamped at its front flutters below a stiffness that depends on its mass ratio.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.special import exp1

from bench.problems.filaments import Filament, flap

PANELS = 120
"""Vortices along the flag."""
MODES = 12
"""Vibrations of the flag that are superposed."""


def pressure(downwash: np.ndarray, kappa: float) -> np.ndarray:
    r"""Lift per length on a flat plate in an ideal flow that moves by a little, times :math:`e^{i\kappa t}`.

    Vortices at a quarter of each panel, no flow through three quarters, and a wake of vortices that the trailing edge
    sheds and the flow carries away, :math:`\gamma_w(x) = -i\kappa\Gamma e^{-i\kappa(x-1)}`
    (Katz and Plotkin 2001, Low-Speed Aerodynamics, chapter 13; the wake's integral is an exponential integral).

    Args:
        downwash: Velocity of the plate against the flow across it, :math:`\partial_t w + \partial_x w`, at three
            quarters of each panel, shape (N, ...).
        kappa: Angular frequency [U / L].

    Returns:
        At a quarter of each panel, shape (N, ...).
    """
    count = len(downwash)
    number = np.arange(count)
    vortex, place = (number + 0.25) / count, (number + 0.75) / count
    matrix = (-1 / (2 * math.pi * (place[:, None] - vortex))).astype(complex)
    behind = 1j * kappa * (1 - place)
    matrix -= (1j * kappa / (2 * math.pi) * np.exp(behind) * exp1(behind))[:, None]
    circulation = np.linalg.solve(matrix, downwash)
    before = np.cumsum(circulation, 0) - 0.5 * circulation
    return count * circulation + 1j * kappa * before


def mode(x: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """A vibration of a beam that is clamped at 0 and free at 1, of mean square 1, and its first derivative."""
    beta = _wave_number(number)
    both = math.sinh(beta) + math.sin(beta)
    ratio = (math.cosh(beta) + math.cos(beta)) / both
    less = (math.sin(beta) - math.cos(beta) - math.exp(-beta)) / both  # 1 - ratio, with all its digits
    rise, decay = 0.5 * less * math.exp(beta) * np.exp(beta * (x - 1)), 0.5 * (1 + ratio) * np.exp(-beta * x)
    sine, cosine = np.sin(beta * x), np.cos(beta * x)
    return rise + decay - cosine + ratio * sine, beta * (rise - decay + sine + ratio * cosine)


def _wave_number(number: int) -> float:
    """A solution of cos b cosh b = -1, from number 0."""
    middle = (number + 0.5) * math.pi
    return float(brentq(lambda b: math.cos(b) + 1 / math.cosh(b), middle - 0.5, middle + 0.5, xtol=1e-14))


def _stiffnesses(mass_ratio: float, kappa: float) -> np.ndarray:
    """Complex bending stiffnesses at which the flag vibrates steadily at a frequency; only real ones exist."""
    vortex, place = ((np.arange(PANELS) + part) / PANELS for part in (0.25, 0.75))
    shape = np.stack([mode(vortex, n)[0] for n in range(MODES)], 1)
    downwash = np.stack([1j * kappa * w + slope for w, slope in (mode(place, n) for n in range(MODES))], 1)
    work = shape.T @ pressure(downwash, kappa) / PANELS
    stiff = np.array([_wave_number(n) for n in range(MODES)]) ** 4
    found: np.ndarray = np.linalg.eigvals((work + kappa**2 * mass_ratio * np.eye(MODES)) / stiff[:, None])
    return found


def onset(mass_ratio: float, slowest: float = 0.2, fastest: float = 40.0, count: int = 800) -> tuple[float, float]:
    """The largest bending stiffness at which a flag in an ideal flow flutters, and the frequency then.

    Solutions whose stiffness is real, found by a sweep over frequencies (as V-g diagrams of aeroelasticity are).

    Args:
        mass_ratio: See the module.
        slowest: Angular frequency where the sweep begins [U / L].
        fastest: Where it ends.
        count: Frequencies.

    Returns:
        Stiffness / (rho U² L³), and angular frequency [U / L].
    """
    sweep = np.geomspace(slowest, fastest, count)
    best, before = (0.0, 0.0), _stiffnesses(mass_ratio, sweep[0])
    for low, high in itertools.pairwise(sweep):
        after = _stiffnesses(mass_ratio, high)
        match = np.abs(before[:, None] - after).argmin(1)
        for one, other in zip(before, after[match], strict=True):
            if one.imag * other.imag < 0 and abs(one - other) < 0.3 * abs(one):
                share = one.imag / (one.imag - other.imag)
                found = (1 - share) * one.real + share * other.real
                if found > best[0]:
                    best = (float(found), float(low + share * (high - low)))
        before = after
    return best


def growth(
    mass_ratio: float, bending: float, *, reynolds: float = 1000.0, cells: int = 24, until: float = 30.0
) -> float:
    """Rate at which small motion of a flag grows in computed air [U / L]; negative where it dies.

    Args:
        mass_ratio: See the module.
        bending: Stiffness.
        reynolds: Reynolds number.
        cells: Cells in the flag's length.
        until: Time.
    """
    flag = Filament.straight(2 * cells + 1, mass_ratio, bending, 0.05, held="clamp")
    found = flap([flag], [(0.0, 0.0)], cells=cells, reynolds=reynolds, until=until)
    return rate(found["tips"][:, 0].numpy(), found["dt"])


def rate(values: np.ndarray, dt: float) -> float:
    """Rate of growth from the second third to the last, by how far values are from their mean (root mean square)."""
    third = len(values) // 3
    return float(math.log(values[-third:].std() / values[third : 2 * third].std()) / (third * dt))


def neutral(growth: Callable[[float], float], start: float, step: float = 1.4) -> tuple[float, dict[str, float]]:
    """The stiffness at which small motion neither grows nor dies.

    Args:
        growth: The rate of growth at a stiffness; softer flags flutter.
        start: A first stiffness, from which others follow by factors of ``step`` until they are on both sides.
        step: The factor.

    Returns:
        The stiffness, between two by a straight line over its logarithm, and the growth at each that was tried.
    """
    tried = {start: growth(start)}
    up = tried[start] > 0
    last = start
    for _ in range(8):
        before, last = last, last * step if up else last / step
        tried[last] = growth(last)
        if (tried[last] > 0) != up:
            share = tried[before] / (tried[before] - tried[last])
            return float(before * (last / before) ** share), {f"{key:.5g}": rate for key, rate in sorted(tried.items())}
    raise RuntimeError("Expected another sign of the growth at eight further stiffnesses.")
