"""A flag in the wind. There is no closed form: runs are compared with the finest one, and checked for tears."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.problems.settings import Result, Run, Settings, follow
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.simulation.measure import TearingGauge
from gaussian_swaying.wind.field import SineSway, WindField
from gaussian_swaying.wind.force import AeroForce

WIDTH, HEIGHT, FRAME = 1.2, 0.8, 0.04  # m, m, s


def flag_points(spacing: float, settings: Settings, youngs_modulus: float, density: float) -> MaterialPoints:
    """A sheet of one layer of particles in the x-z plane, 1.2 m by 0.8 m and 0.01 m thick, with a slight ripple.

    Units: ``spacing`` [m]; ``youngs_modulus`` [Pa]; ``density`` [kg/m³].
    """
    x, z = (
        (torch.arange(round(side / spacing), dtype=torch.float64) + 0.5) * side / round(side / spacing)
        for side in (WIDTH, HEIGHT)
    )
    gx, gz = (g.reshape(-1) for g in torch.meshgrid(x, z, indexing="ij"))
    position = torch.stack([gx, 0.004 * torch.sin(5 * gx), gz], dim=-1).to(settings.device, settings.dtype)
    area = WIDTH * HEIGHT / len(position)
    return MaterialPoints.create(
        position, volume=area * 0.01, density=density, youngs_modulus=youngs_modulus, poisson_ratio=0.3
    )


def flag(
    dx: float,
    settings: Settings,
    *,
    frames: int = 25,
    spacing: float = 0.0125,
    youngs_modulus: float = 6e3,
    density: float = 30.0,
    wind: tuple[float, float, float] = (6.0, 1.5, 0.0),
) -> tuple[Result, Tensor]:
    """A flag pinned along a strip of 2.5 cm at its pole, in a swaying wind, with the paper's coefficients for flags.

    Units: ``dx``, ``spacing`` [m]; ``youngs_modulus`` [Pa]; ``density`` [kg/m³]; ``wind`` [m/s].

    Returns:
        The result (``error`` is not known: see :func:`distance`; ``torn``: particles with a neighbour farther than two
        cells; ``stretch_min`` and ``stretch_max``: singular values of F at the end; ``lost``), and the positions of
        each frame [m], shape (frames + 1, P, 3).
    """
    points = flag_points(spacing, settings, youngs_modulus, density)
    pin = PinnedRegion(Box([None, None, None], [0.025, None, None]))
    solver = settings.solver(dx, boundaries=[pin], gravity=(0.0, 0.0, -9.8))
    field = WindField(wind, modulations=[SineSway(amplitude=0.5, period=1.5)]).to(settings.device)
    aero = AeroForce(C_D=0.1, C_F=0.3, C_L=0.005).to(settings.device)
    normal = torch.zeros_like(points.position)
    normal[:, 1] = 1.0
    area = torch.full_like(points.mass, WIDTH * HEIGHT / points.count)

    def force(state: MPMState) -> Tensor:
        return aero(field(state.time), state.velocity, *deform_patch(state.F_total, normal, area))

    run = follow(solver, solver.init_state(points), FRAME, frames, lambda state: state.position, force)
    return _health(run, TearingGauge(solver)), run.series


def _health(run: Run, gauge: TearingGauge) -> Result:
    stretch = torch.linalg.svdvals(run.state.F_total.double())
    return run.result(
        float("nan"),
        torn=float(gauge(run.state.position).sum()),
        lost=float(run.state.lost.sum()),
        stretch_min=float(stretch.amin()),
        stretch_max=float(stretch.amax()),
    )


def distance(series: Tensor, reference: Tensor) -> float:
    """Mean distance of corresponding particles over all frames, as a share of the longer side of the flag.

    Units: ``series`` [m].

    Returns:
        The share; infinite if a position is infinite.
    """
    apart = torch.linalg.vector_norm(series - reference, dim=-1).mean()
    return float(apart) / WIDTH if bool(torch.isfinite(apart)) else float("inf")
