r"""A stretched sheet, held at its two short ends: it wrinkles along the pull, as the ends do not let it get narrower.

Cerda and Mahadevan (2003), "Geometry and physics of wrinkling", Physical Review Letters 90, 074302. For a bending
stiffness B, a tension T to a unit of width and a length L between the ends, the wavelength is

.. math:: \lambda = 2 \sqrt{\pi} \, (B / T)^{1/4} L^{1/2}.

It is the least of :math:`B k^2 + T (\pi / L)^2 / k^2`, where :math:`k = 2 \pi / \lambda`: what resists a wrinkle that
is as long as the sheet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench.problems.settings import Result, Settings, follow
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.body import Material, Scene
from gaussian_swaying.simulation.simulation import Simulation

WIDTH, THICK = 0.2, 0.5e-3  # m; the thickness only shares E h and density h
HELD, PULL = 2, 2.0  # cells; time of the pull, in units of 1 / circular frequency of the stretched sheet
SHELL = {2e-7: (0.0299766, 4.33191), 1e-7: (0.0249513, 6.30922)}
"""Wavelength [m], and amplitude in thicknesses of a plate, of a shell of Kirchhoff and Love with the same numbers by
its bending stiffness: on splines of 40 cells across half the width, computed apart from the package (commit 7975e5a).
"""
FLAT = 0.5
"""Amplitude in thicknesses of a plate below which a sheet has no wrinkles."""


@dataclass(frozen=True)
class Strip:
    """A sheet between two ends that are pulled apart.

    Attributes:
        bending: Bending stiffness [N m].
        strain: How far the ends are pulled apart, over the length.
        length: Distance of the ends [m].
        nu: Poisson's ratio.
        stretch: E h [N/m].
        mass: Mass to a unit of area [kg/m²].
    """

    bending: float
    strain: float = 0.05
    length: float = 0.5
    nu: float = 0.45
    stretch: float = 100.0
    mass: float = 0.1

    @property
    def height(self) -> float:
        """The thickness of a plate with this stiffness [m]."""
        return math.sqrt(12 * self.bending * (1 - self.nu**2) / self.stretch)

    @property
    def wavelength(self) -> float:
        """That of Cerda and Mahadevan with T = E h strain [m]."""
        return 2 * math.sqrt(math.pi * self.length) * (self.bending / (self.stretch * self.strain)) ** 0.25


def wavelength(height: np.ndarray, width: float) -> float:
    """The wavelength at which the spectrum of a line is largest.

    Units: ``width`` [m].
    """
    count = len(height)
    power = np.abs(np.fft.rfft(height - height.mean(), 64 * count))
    return width / count * 64 * count / max(1, int(power.argmax()))


def wrinkles(
    bending: float,
    cells: int,
    rest: float = 20.0,
    seed: float = 2.0,
    layers: int = 3,
    settings: Settings | None = None,
) -> Result:
    r"""Pull a sheet by its ends, from a scene as a user makes it, and let it rest.

    It begins with a speed along its axis, as a sheet that is quite flat would stay so.

    Units: ``bending`` [N m].

    Returns:
        ``wavelength`` (0 if it stays flat), that of the shell (``exact``) and of the ``formula`` [m], ``error`` (from
        the shell's, relative), ``amplitude`` and that of the shell, ``exact_amplitude`` (half the height in the
        middle, in thicknesses of a plate), ``drift`` (change of the amplitude in the last tenth, relative),
        ``stretched`` (mean strain), ``span`` (of the outer layers [cells]), ``points`` and the common quantities.
    """
    settings = Settings(dtype=torch.float32) if settings is None else settings
    strip, dx = Strip(bending), WIDTH / cells
    held, spacing = HELD * dx, dx / 2
    free = round(strip.length / spacing) * spacing
    flag = FlagScene(width=free + 2 * held, height=WIDTH, spacing=spacing, ripple=0.0)
    ends = [Box([None] * 3, [held, None, None]), Box([held + free, None, None], [None] * 3)]
    omega = math.pi / free * math.sqrt(strip.stretch * strip.strain / strip.mass)
    pull = PULL / omega
    speed = strip.strain * free / 2 / pull
    boundaries: list[Boundary] = [PinnedRegion(ends[0], "clamp", velocity=[-speed, 0.0, 0.0], end=pull)]
    boundaries.append(PinnedRegion(ends[1], "clamp", velocity=[speed, 0.0, 0.0], end=pull))
    boundaries += [PinnedRegion(end, "clamp", start=pull) for end in ends]
    material = Material(E=strip.stretch / THICK, nu=strip.nu, density=strip.mass / THICK, thickness=THICK,
                        bending=bending)  # fmt: skip
    scene = Scene(generator=flag, metres_per_unit=1.0, layers=layers, points="gaussian")
    simulation = Simulation(scene, material, solver=settings.solver(dx, boundaries=boundaries, damping=omega),
                            device=settings.device)  # fmt: skip
    points, solver = simulation.scene.points, simulation.solver
    assert isinstance(solver, MPMSolver)
    place = simulation.scene.frame.point_to_scene(points.position.double())
    x, y = place[:, 0] - held - free / 2, place[:, 2] - WIDTH / 2
    dent = torch.cos(math.pi * x / free).clamp(min=0).square() * torch.exp(-(y / (strip.wavelength / 4)).square())
    velocity = torch.zeros_like(points.position)
    velocity[:, 1] = (seed * strip.height * omega * dent).to(velocity)
    start = solver.init_state(points, velocity, frame=simulation.scene.frame)
    line = (place[:, 1].abs() < 1e-6) & (x.abs() < 0.6 * spacing)  # one or two points at each place
    row = (place[line, 2] / spacing).long()

    def across(state: MPMState) -> Tensor:
        height = state.position[line, 1].double()
        return torch.zeros_like(height[: 2 * cells]).index_add(0, row, height) / torch.bincount(row)

    frames = 40
    run = follow(solver, start, (PULL + rest) / omega / frames, frames, across)
    heights = 0.5 * (run.series.amax(1) - run.series.amin(1)) / strip.height
    size = wavelength(run.series[-1].numpy(), WIDTH) if heights[-1] > FLAT else 0.0
    exact, high = SHELL[bending]
    return run.result(
        size / exact - 1,
        wavelength=size,
        exact=exact,
        formula=strip.wavelength,
        amplitude=float(heights[-1]),
        exact_amplitude=high,
        drift=float(heights[-1] / heights[-5]) - 1,
        stretched=float(run.state.F_total[x.abs() < free / 2, 0, 0].mean()) - 1,
        span=2 * float(place[:, 1].abs().max()) / dx,
        points=len(place),
    )
