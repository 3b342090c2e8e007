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
from scipy.sparse import csc_matrix
from torch import Tensor

from bench.problems.settings import Result, Settings, follow
from bench.problems.shells import Rest, settle, splines
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.boundary import Boundary
from gaussian_swaying.mpm.boundaries.handle import Handle
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.simulation.material import Material
from gaussian_swaying.simulation.scene import Scene
from gaussian_swaying.simulation.simulation import Simulation

WIDTH, THICK = 0.2, 0.5e-3  # m; the thickness only shares E h and density h
HELD, PULL = 2, 2.0  # cells; time of the pull, in units of 1 / circular frequency of the stretched sheet
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


class Quarter:
    """Cubic splines on a quarter of the sheet, from a held end to the middle and from the axis to a free edge.

    See :class:`~bench.problems.shells.Mesh`.
    """

    def __init__(self, strip: Strip, cells: tuple[int, int]) -> None:
        self.shape = rows, columns = cells[0] + 3, cells[1] + 3
        places, inside, weights, means = [], [], [], []
        points, share = np.polynomial.legendre.leggauss(3)
        for count, size in zip(cells, (strip.length / 2, WIDTH / 2), strict=True):
            knots = size * np.clip(np.arange(-3, count + 4) / count, 0, 1)
            at = size / count * (np.arange(count)[:, None] + 0.5 + 0.5 * points).ravel()
            places.append(splines(knots, at, count))
            inside.append(np.repeat(np.arange(count), 3)[:, None] + np.arange(4))
            weights.append(np.tile(share, count) * size / count / 2)
            means.append(np.array([knots[k + 1 : k + 4].mean() for k in range(count + 3)]))
        pairs = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
        found = [np.einsum("ai,bj->abij", places[0][a], places[1][b]) for a, b in pairs]
        self.values = np.stack(found).reshape(6, -1, 16)
        number = np.arange(rows * columns).reshape(self.shape)
        self.index = number[inside[0][:, None, :, None], inside[1][None, :, None, :]].reshape(-1, 16)
        self.weight = np.outer(*weights).ravel()
        self.r = np.ones_like(self.weight)
        along, across = np.meshgrid(*means, indexing="ij")
        self.rest = np.stack([along, across, 0 * along], axis=-1)
        self.rest[0, :, 0] -= strip.strain * strip.length / 2
        self.free = self._free()

    def _free(self) -> csc_matrix:
        """Both rows at the end hold the slope, the first the places; two rows beside a plane of symmetry are alike."""
        rows, columns = self.shape
        known: dict[tuple[int, int, int], int] = {}
        row, column = [], []
        for i in range(1, rows):
            for j in range(columns):
                for axis in range(3):
                    plane = (axis == 0 and i == rows - 1) or (axis == 1 and j == 0)
                    if plane or (axis == 2 and i == 1):
                        continue
                    like = rows - 1 if axis != 0 and i == rows - 2 else i, 0 if axis != 1 and j == 1 else j
                    row.append(3 * (i * columns + j) + axis)
                    column.append(known.setdefault((*like, axis), len(known)))
        return csc_matrix((np.ones(len(row)), (row, column)), shape=(3 * rows * columns, len(known)))


@dataclass(frozen=True)
class Wrinkled:
    """The wrinkles of a shell.

    Attributes:
        across: Height along a line across the middle, evenly spaced from edge to edge [m], shape (N,).
        reach: Length of the half wave along the axis that has as much slope as the wrinkles, over the length.
        rest: The shell at rest.
    """

    across: np.ndarray
    reach: float
    rest: Rest


def shell(strip: Strip, cells: tuple[int, int], seed: float = 2.0, steps: int = 200) -> Wrinkled:
    """The wrinkles of a shell that starts with a dent along its axis.

    Args:
        strip: The sheet.
        cells: Spline cells along half the length and across half the width.
        seed: Depth of the dent, in thicknesses of a plate.
        steps: Most steps of Newton's method.
    """
    mesh = Quarter(strip, cells)
    place = mesh.rest.copy()
    along, across = place[..., 0] / (strip.length / 2), place[..., 1] / (strip.wavelength / 4)
    place[..., 2] = seed * strip.height * np.sin(math.pi / 2 * along.clip(0, 1)) ** 2 * np.exp(-(across**2))
    tension = strip.stretch * strip.strain
    rate = 30 * tension / strip.mass * (math.pi / strip.length) ** 2
    rest = settle(mesh, strip, place, 0.0, rate, 1e-9 * tension * WIDTH, steps, strip.height)
    w, _ = _line(rest.place[-1, :, 2], cells[1], WIDTH / 2)
    axis, slope = _line(rest.place[:, 0, 2], cells[0], strip.length / 2)
    reach = math.pi * math.sqrt((axis**2).sum() / max((slope**2).sum(), 1e-300)) / strip.length
    return Wrinkled(np.concatenate([w[:0:-1], w]), reach, rest)


def _line(height: np.ndarray, cells: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Heights and slopes at 401 places of a line of splines, from the heights of its control points."""
    knots = size * np.clip(np.arange(-3, cells + 4) / cells, 0, 1)
    at = np.linspace(0, size, 401)
    first = np.minimum((at / size * cells).astype(int), cells - 1)[:, None] + np.arange(4)
    value, slope, _ = splines(knots, at, cells)
    return (value * height[first]).sum(1), (slope * height[first]).sum(1)


def wavelength(height: np.ndarray, width: float) -> float:
    """The wavelength at which the spectrum of a line is largest.

    Args:
        height: Evenly spaced along the line, shape (N,).
        width: Length of the line [m].
    """
    count = len(height)
    power = np.abs(np.fft.rfft(height - height.mean(), 64 * count))
    return width / count * 64 * count / max(1, int(power.argmax()))


def of_shell(
    bending: float,
    strain: float = 0.05,
    length: float = 0.5,
    cells: int = 40,
    settings: Settings | None = None,
) -> Result:
    """The wrinkles of the shell.

    Args:
        bending: See :class:`Strip`.
        strain: See :class:`Strip`.
        length: See :class:`Strip`.
        cells: Spline cells across half the width; half as many along half the length.
        settings: Not used: the shell has numerics of its own.

    Returns:
        ``wavelength`` (0 if it stays flat) and that of the formula, ``formula`` [m], ``error`` (from the formula's,
        relative), ``amplitude`` (half the height in the middle, in thicknesses of a plate), ``reach`` (see
        :class:`Wrinkled`), ``steps`` and ``residual`` (force on a control point over that of the pull).
    """
    strip = Strip(bending, strain, length)
    found = shell(strip, (cells // 2, cells))
    height = 0.5 * float(np.ptp(found.across)) / strip.height
    size = wavelength(found.across, WIDTH) if height > FLAT else 0.0
    return {"wavelength": size, "formula": strip.wavelength, "error": size / strip.wavelength - 1,
            "amplitude": height, "reach": found.reach,
            "steps": found.rest.steps,
            "residual": found.rest.force / (strip.stretch * strip.strain * WIDTH)}  # fmt: skip


def wrinkles(
    bending: float,
    cells: int,
    strain: float = 0.05,
    length: float = 0.5,
    rest: float = 20.0,
    seed: float = 2.0,
    shell_cells: int = 40,
    layers: int = 3,
    settings: Settings | None = None,
) -> Result:
    r"""Pull a sheet by its ends, from a scene as a user makes it, and let it rest.

    It begins with a speed along its axis, as a sheet that is quite flat would stay so.

    Args:
        bending: See :class:`Strip`.
        cells: Cells across the width.
        strain: See :class:`Strip`.
        length: See :class:`Strip`.
        rest: Time after the pull, in units of 1 / circular frequency of the stretched sheet.
        seed: Height that the speed would reach without a force, in thicknesses of a plate.
        shell_cells: Spline cells of the shell across half the width.
        layers: Layers of points: 3, or 1 with a bending stiffness of their own.
        settings: The numerics.

    Returns:
        ``wavelength`` (0 if it stays flat), that of the shell (``exact``) and of the ``formula`` [m], ``error`` (from
        the shell's, relative), ``amplitude`` and that of the shell, ``exact_amplitude`` (half the height in the
        middle, in thicknesses of a plate), ``drift`` (change of the amplitude in the last tenth, relative),
        ``stretched`` (mean strain), ``span`` (of the outer layers [cells]), ``points`` and the common quantities.
    """
    settings = Settings(dtype=torch.float32) if settings is None else settings
    strip, dx = Strip(bending, strain, length), WIDTH / cells
    held, spacing = HELD * dx, dx / 2
    free = round(length / spacing) * spacing
    flag = FlagScene(width=free + 2 * held, height=WIDTH, spacing=spacing, ripple=0.0)
    ends = [Box([None] * 3, [held, None, None]), Box([held + free, None, None], [None] * 3)]
    omega = math.pi / free * math.sqrt(strip.stretch * strain / strip.mass)
    pull = PULL / omega
    speed = strain * free / 2 / pull
    boundaries: list[Boundary] = [Handle(ends[0], [-speed, 0.0, 0.0], kind="clamp", end=pull)]
    boundaries.append(Handle(ends[1], [speed, 0.0, 0.0], kind="clamp", end=pull))
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
    known = of_shell(bending, strain, length, shell_cells)
    return run.result(
        size / known["wavelength"] - 1,
        wavelength=size,
        exact=known["wavelength"],
        formula=strip.wavelength,
        amplitude=float(heights[-1]),
        exact_amplitude=known["amplitude"],
        drift=float(heights[-1] / heights[-5]) - 1,
        stretched=float(run.state.F_total[x.abs() < free / 2, 0, 0].mean()) - 1,
        span=2 * float(place[:, 1].abs().max()) / dx,
        points=len(place),
    )
