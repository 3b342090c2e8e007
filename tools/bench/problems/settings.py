"""Shared by all problems: the numerics under test, bodies on a lattice, and the timed rollout."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.mpm.boundary import Boundary, Nodes
from gaussian_swaying.mpm.forces import ForceFunction
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState

Result = dict[str, float]
"""What a problem returns: ``error``, relative to the closed form, ``simulated_s``, ``substeps``, ``wall_s`` (the time
of the rollout alone) and further quantities."""


@dataclass(frozen=True)
class Settings:
    """The numerics under test.

    Attributes:
        formulation: ``total`` or ``updated``.
        cfl: Courant number of the adaptive substep.
        substep: Fixed substep [s] instead, or None.
        dtype: Type of every field of the state.
        device: Device of the run.
    """

    formulation: str = "total"
    cfl: float = 0.4
    substep: float | None = None
    dtype: torch.dtype = torch.float64
    device: str = "cpu"

    def solver(self, dx: float, **more: Any) -> MPMSolver:
        """A solver with these numerics, grid spacing ``dx`` [m] and no gravity unless it is in ``more``."""
        return MPMSolver(
            dx=dx,
            formulation=self.formulation,
            cfl=self.cfl,
            substep=self.substep,
            **({"gravity": (0.0, 0.0, 0.0)} | more),
        )


class Axial(Boundary):
    """Prevents motion along the given axes: lateral confinement, or plane strain."""

    def __init__(self, axes: Sequence[int]) -> None:
        super().__init__()
        self.axes = tuple(axes)

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Set the components along the axes to zero."""
        free = [0.0 if axis in self.axes else 1.0 for axis in range(3)]
        return velocity * velocity.new_tensor(free)


def lattice(dx: float, low: Sequence[int], high: Sequence[int], settings: Settings, per_cell: int = 2) -> Tensor:
    """Points in a box of whole cells, evenly spaced.

    Units: ``dx`` [m]; ``low``, ``high`` [cells].

    Returns:
        Positions [m], shape (P, 3).
    """
    axes = []
    for a, b in zip(low, high, strict=True):
        count = per_cell * (b - a)
        place = torch.arange(count, dtype=torch.float64) + 0.5 if count else torch.zeros(1, dtype=torch.float64)
        axes.append((a + place / per_cell) * dx)
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    return grid.to(settings.device, settings.dtype)


def block(
    dx: float,
    low: Sequence[int],
    high: Sequence[int],
    settings: Settings,
    *,
    density: float,
    youngs_modulus: float,
    poisson_ratio: float,
    per_cell: int = 2,
    shift: float = 0.0,
) -> MaterialPoints:
    """A block of fixed corotated material in a box of whole cells; a single layer counts as ``dx`` thick.

    Units: ``dx`` [m]; ``low``, ``high``, ``shift`` [cells]; ``density`` [kg/m³]; ``youngs_modulus`` [Pa].
    """
    volume = math.prod(dx / per_cell if b > a else dx for a, b in zip(low, high, strict=True))
    position = lattice(dx, low, high, settings, per_cell)
    return MaterialPoints.create(
        position + position.new_tensor([shift * dx, 0.0, 0.0]),
        volume=volume,
        density=density,
        youngs_modulus=youngs_modulus,
        poisson_ratio=poisson_ratio,
    )


@dataclass(frozen=True)
class Run:
    """The result of a rollout.

    Attributes:
        time: Times of the observations [s], shape (N,), including the start.
        series: The observations, shape (N, ...).
        wall_s: Wall-clock time of the rollout [s].
    """

    state: MPMState
    time: Tensor
    series: Tensor
    substeps: int
    wall_s: float

    def result(self, error: float, **more: float) -> Result:
        """The quantities returned by every problem, and ``more``."""
        seconds = float(self.state.time)
        numbers = {"error": error, "simulated_s": seconds, "substeps": self.substeps, "wall_s": self.wall_s} | more
        return {name: float(value) for name, value in numbers.items()}


def follow(
    solver: MPMSolver,
    state: MPMState,
    frame: float,
    frames: int,
    observe: Callable[[MPMState], Tensor],
    force: ForceFunction | None = None,
) -> Run:
    """Roll out frame by frame, each in equal substeps chosen by the solver, and observe after each.

    Units: ``frame`` [s]; ``force`` [N].

    Returns:
        The last state, the observations and the time taken.
    """
    cuda = state.position.is_cuda
    with torch.inference_mode():
        series, taken = [observe(state)], 0
        if cuda:
            torch.cuda.synchronize()
        start = time.perf_counter()
        for _ in range(frames):
            count = solver.substeps(state, frame)
            state = solver.rollout(solver.fit_grid(state, frame), frame / count, count, force)
            series.append(observe(state))
            taken += count
        if cuda:
            torch.cuda.synchronize()
        wall = time.perf_counter() - start
        values = torch.stack(series).double().cpu()
    return Run(state, torch.arange(frames + 1, dtype=torch.float64) * frame, values, taken, wall)


def fit_sinusoid(time: Tensor, values: Tensor) -> tuple[float, float]:
    r"""Fit :math:`e^{-\gamma t} (a \cos \omega t + b \sin \omega t)` to a series by least squares (Gauss-Newton).

    Units: ``time`` [s].

    Returns:
        Circular frequency and decay rate, both [1/s].
    """
    change = (values[:-1] * values[1:] < 0).nonzero()[:, 0]
    part = values[change] / (values[change] - values[change + 1])
    crossing = time[change] + part * (time[change + 1] - time[change])
    omega = math.pi * (len(crossing) - 1) / float(crossing[-1] - crossing[0])
    rate = 0.0
    for _ in range(20):
        c, s = torch.cos(omega * time), torch.sin(omega * time)
        decay = torch.exp(-rate * time)
        basis = decay[:, None] * torch.stack([c, s], dim=-1)
        a, b = torch.linalg.lstsq(basis, values[:, None]).solution[:, 0]
        slope = torch.stack([decay * time * (b * c - a * s), -decay * time * (a * c + b * s)], dim=-1)
        both = torch.cat([basis, slope], dim=-1)
        scale = both.norm(dim=0)
        found = torch.linalg.lstsq(both / scale, (values - basis @ torch.stack([a, b]))[:, None]).solution[:, 0] / scale
        omega, rate = omega + float(found[2]), rate + float(found[3])
    return omega, rate
