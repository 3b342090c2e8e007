"""Onset of flutter of a flag in a plane, clamped at its front: linear theory of an ideal flow, and computed air.

Lengths are in that of the flag, speeds in that of the flow, and the density of the fluid is 1: a mass ratio is the mass
of the flag per mass of fluid in a square of its length, and a bending stiffness is per rho U² L³.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.special import exp1, hankel2

from bench.problems.air import WIND, units_of
from gaussian_swaying.air.flow import LatticeFlow
from gaussian_swaying.air.immersed import give, look

VORTICES, MODES = 40, 8
VORTEX, BETWEEN = (0.5 - 0.5 * np.cos((2 * np.arange(VORTICES) + i) * math.pi / (2 * VORTICES + 1)) for i in (1, 2))
"""Places of vortices, and those where no air flows through the flag."""


def vortices(downwash: np.ndarray, kappa: float) -> np.ndarray:
    r"""Vortices of a flat plate in an ideal flow that moves by a little, times :math:`e^{i\kappa t}`.

    The places are those of a Gaussian quadrature, exact for a steady flow (Stark 1970, AIAA J. 8). Behind the plate is
    a wake that the flow carries away, :math:`\gamma(x) = -i\kappa\Gamma e^{-i\kappa(x-1)}`.

    ``downwash`` is the plate's velocity against the flow across it at :data:`BETWEEN`, shape (N, ...).
    """
    behind = 1j * kappa * (1 - BETWEEN)
    wake = 1j * kappa / (2 * math.pi) * np.exp(behind) * exp1(behind)
    return np.linalg.solve(-1 / (2 * math.pi * (BETWEEN[:, None] - VORTEX)) - wake[:, None], downwash)


def theodorsen(kappa: float) -> complex:
    """Force against a plate that moves up and down, per velocity (Theodorsen 1935, NACA report 496)."""
    one, zero = hankel2(1, kappa / 2), hankel2(0, kappa / 2)
    return complex(0.25j * math.pi * kappa + math.pi * one / (one + 1j * zero))


def heaving(kappa: float) -> float:
    """Relative error of the lift of vortices on a plate that moves up and down."""
    lift = (1 + 1j * kappa * (1 - VORTEX)) @ vortices(np.ones(VORTICES), kappa)
    return abs(lift / theodorsen(kappa) + 1)


def wave_number(number: int) -> float:
    """A solution of cos b cosh b = -1, from number 0."""
    middle = (number + 0.5) * math.pi
    return float(brentq(lambda b: math.cos(b) + 1 / math.cosh(b), middle - 0.5, middle + 0.5, xtol=1e-14))


def vibration(x: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A vibration of a beam that is clamped at 0 and free at 1, of mean square 1, its slope and its integral from x."""
    b = wave_number(number)
    ratio = (math.cosh(b) + math.cos(b)) / (math.sinh(b) + math.sin(b))
    sinh, cosh, sin, cos = np.sinh(b * x), np.cosh(b * x), np.sin(b * x), np.cos(b * x)
    third = sinh - sin - ratio * (cosh + cos)  # its third derivative, 0 at 1, per b³; the fourth is b⁴ times itself
    return cosh - cos - ratio * (sinh - sin), b * (sinh + sin - ratio * (cosh - cos)), -third / b


def stiffnesses(mass_ratio: float, kappa: float) -> np.ndarray:
    """Complex stiffnesses at which the flag vibrates steadily at an angular frequency; only real ones exist."""
    w, _, beyond = np.moveaxis([vibration(VORTEX, n) for n in range(MODES)], 1, 0)
    there, slope, _ = np.moveaxis([vibration(BETWEEN, n) for n in range(MODES)], 1, 0)
    work = (w + 1j * kappa * beyond) @ vortices((1j * kappa * there + slope).T, kappa)  # lift: gamma, and its integral
    stiff = np.array([wave_number(n) for n in range(MODES)]) ** 4
    return np.asarray(np.linalg.eigvals((work + kappa**2 * mass_ratio * np.eye(MODES)) / stiff[:, None]))


def neutral(mass_ratio: float) -> Iterator[tuple[float, float]]:
    """Stiffnesses at which small motion neither grows nor dies, and their angular frequencies."""
    sweep = np.geomspace(0.5, 20.0, 300)
    before = stiffnesses(mass_ratio, sweep[0])
    for low, high in itertools.pairwise(sweep):
        after = stiffnesses(mass_ratio, high)
        for one, other in zip(before, after[np.abs(before[:, None] - after).argmin(1)], strict=True):
            if one.imag * other.imag < 0 and abs(one - other) < 0.3 * abs(one):
                share = one.imag / (one.imag - other.imag)
                yield float((1 - share) * one.real + share * other.real), float(low + share * (high - low))
        before = after


def in_air(
    move: Callable[[np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]], cells: int, until: float
) -> None:
    """Let a plate move in computed air of a Reynolds number of 1000.

    ``move`` gets the velocity of the air across the plate at its points and the mass of the layer of air there, per
    depth, both of shape (N,), and a time step. It returns how far the points are across the flow, and the momenta
    that they take from the air.
    """
    h, units, points = 1 / cells, units_of(1 / cells, 1000.0), 2 * cells + 1
    flow = LatticeFlow((7 * cells, 1, 6 * cells), units, faces=("open", "periodic", "open"), smagorinsky=0)
    now = flow.start([1.0, 0.0, 0.0]).moments
    spare, area = torch.empty_like(now), torch.full((points,), cells / (points - 1))
    place, loss, depth = torch.zeros(points, 3), torch.zeros(points, 3), units.cell_mass / h
    place[:, 0] = torch.linspace(2, 3, points) / h - 0.5
    w = np.zeros(points)
    for _ in range(round(until / units.dt)):
        place[:, 2] = torch.tensor((w + 3) / h - 0.5)
        seen, layer = look(now, area, place, flow.kind)
        w, taken = move(seen[:, 2].double().numpy() * units.speed, layer.double().numpy() * depth, units.dt)
        loss[:, 0] = layer * seen[:, 0]  # it does not move along the flow
        loss[:, 2] = torch.tensor(taken / (depth * units.speed))
        give(now, loss, place, flow.kind)
        flow.advance(now, spare, WIND)
        now, spare = spare, now


def growth(mass_ratio: float, bending: float, cells: int, until: float = 20.0) -> tuple[float, float]:
    """Rate at which small motion of a flag grows in computed air [U / L], and its angular frequency."""
    points, ds = 2 * cells + 1, 0.5 / cells
    w, v, mass = 0.05 * np.linspace(0, 1, points) ** 2, np.zeros(points), np.full(points, mass_ratio * ds)
    mass[-1] /= 2
    curve = np.diff(np.eye(points + 1), 2, axis=0)[:, 1:]  # one more point before the clamp stays at 0
    stiff, tips = -bending / ds**3 * curve.T @ curve, []

    def move(air: np.ndarray, layer: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        substeps = math.ceil(dt * 4 / ds**2 * math.sqrt(bending / mass_ratio) / 0.8)
        step, share, taken = dt / substeps, layer / substeps, np.zeros(points)
        for _ in range(substeps):
            push = mass * share / (mass + share) * (air - v)
            taken += push
            v[:] += (step * stiff @ w + push) / mass
            v[0] = 0
            w[:] += step * v
        tips.append((w[-1], dt))
        return w, taken

    in_air(move, cells, until)
    values, dt = np.array(tips).T
    each = round(0.1 / dt[0])
    return strongest(values[round(5 / dt[0]) :: each], each * dt[0])


def heaving_in_air(cells: int, kappa: float = 2.8) -> dict[str, float]:
    """Damping and added mass of a plate that moves up and down in computed air, per Theodorsen's."""
    found, time = [], 0.0

    def move(air: np.ndarray, layer: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        nonlocal time
        taken = layer * (air - 0.02 * kappa * math.cos(kappa * time))
        found.append((time, taken.sum() / dt))
        time += dt
        return np.full(len(air), 0.02 * math.sin(kappa * time)), taken

    in_air(move, cells, 10 * math.pi / kappa)
    times, lift = np.array(found[2 * len(found) // 5 :]).T
    waves = np.stack([np.cos(kappa * times), np.sin(kappa * times), np.ones(len(times))], 1)
    damping, inertia, _ = np.linalg.lstsq(waves, lift, rcond=None)[0] / (0.02 * kappa)
    exact = theodorsen(kappa)
    return {"damping": float(-damping / exact.real), "mass": float(inertia / exact.imag)}


def strongest(values: np.ndarray, dt: float, count: int = 6) -> tuple[float, float]:
    """Growth and angular frequency of the largest at the end of some sines (matrix pencil, Hua and Sarkar 1990)."""
    rows = np.lib.stride_tricks.sliding_window_view(values, len(values) // 3 + 1)
    basis = np.linalg.svd(rows, full_matrices=False)[2][:count].T
    rates = np.log(np.linalg.eigvals(np.linalg.pinv(basis[:-1]) @ basis[1:]).astype(complex)) / dt
    waves = np.exp(np.outer(np.arange(len(values)) * dt, rates))
    size = np.abs(np.linalg.lstsq(waves, values.astype(complex), rcond=None)[0] * waves[-1])
    best = rates[np.where(rates.imag > 0.5, size, -1).argmax()]
    return float(best.real), float(best.imag)


def onset(mass_ratio: float, cells: int) -> dict[str, float]:
    """Speed at which a flag begins to flutter in computed air per that of linear theory, and both frequencies."""
    linear, expected = max(neutral(mass_ratio))
    stiffness, found = linear, growth(mass_ratio, linear, cells)
    factor = 1.4 if found[0] > 0 else 1 / 1.4
    for _ in range(8):
        before, last = found[0], stiffness
        stiffness = last * factor
        found = growth(mass_ratio, stiffness, cells)
        if before * found[0] < 0:
            stiffness = last * factor ** (before / (before - found[0]))
            return {"speed": (linear / stiffness) ** 0.5, "frequency": found[1], "linear": linear, "expected": expected}
    raise RuntimeError("Expected another sign of the growth at eight further stiffnesses.")
