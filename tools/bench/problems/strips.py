r"""A thin strip on hinges that sags under a uniform side load, compared with Euler's and Bernoulli's beam."""

from __future__ import annotations

import math

import torch

from bench.problems.settings import Axial, Result, Settings, follow
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints

LENGTH, YOUNG, DENSITY = 1.0, 1e4, 1.0  # [m], [Pa], [kg/m³]; the result depends only on L / h and the deflection
_BEYOND = 2  # cells of material inside a pin that holds nodes


def hinged_strip(
    cells: int,
    settings: Settings,
    hold: str = "hinge",
    slenderness: int = 40,
    sag: float = 0.01,
    settle: float = 12.0,
    shift: float = 0.0,
    per_cell: int = 2,
    layers: int = 3,
) -> Result:
    r"""A strip in plane strain with :math:`\nu = 0` and three layers, or one, held at both ends and loaded across.

    For a load q per length and :math:`D = E h^3 / 12` (both to a unit of width), :math:`D w'''' = q` with
    :math:`w = w'' = 0` at both hinges gives :math:`w = q x (L^3 - 2 L x^2 + x^3) / (24 D)`: the middle moves by
    :math:`5 q L^4 / (384 D)`, the slope at a hinge is :math:`q L^3 / (24 D)`, and the bending moment
    :math:`q x (L - x) / 2` vanishes there. With clamps, :math:`w = w' = 0`, the middle moves by
    :math:`q L^4 / (384 D)`, a fifth. Three layers with the weights of Simpson's rule have the exact D.

    Known in advance, and part of the closed form of three layers: shear (Timoshenko 1921; coefficient 5/6, G = E / 2)
    adds :math:`q L^2 / (8 \tfrac56 G h)`, which is :math:`1.92\,(h / L)^2`, relative. Neglected: the tension of a strip
    whose ends do not approach each other, some :math:`3\,(w / h)^2`, relative; so the deflection is small.

    Units: ``shift`` [cells].

    Returns:
        ``error`` (of the deflection of the middle, relative to that with hinges), ``slope`` (at the ends, over that
        with hinges), ``moment`` (of three layers: largest error of the bending moment in the cell at an end, over that
        in the middle), ``residual`` (speed of the middle, relative to its deflection and frequency) and the common
        quantities.
    """
    dx, thick = LENGTH / cells, LENGTH / slenderness
    like = torch.zeros((), dtype=settings.dtype, device=settings.device)
    beyond = _BEYOND if hold == "nodes" else 0
    count = per_cell * (cells + 2 * beyond)
    along = ((torch.arange(count, dtype=torch.float64) + 0.5) / per_cell - beyond + shift) * dx
    heights, shares = ([-0.5, 0.0, 0.5], [1 / 6, 2 / 3, 1 / 6]) if layers == 3 else ([0.0], [1.0])
    across = thick * torch.tensor(heights, dtype=torch.float64) + shift * dx
    rest = torch.cartesian_prod(along, torch.zeros(1, dtype=torch.float64), across)
    simpson = torch.tensor(shares, dtype=torch.float64).repeat(count)
    stiffness, area = YOUNG * thick**3 / 12, dx * dx / per_cell  # dx wide
    up = torch.tensor([0.0, 0.0, 1.0]).to(like).expand(len(rest), 3)
    bends = {"normal": up, "bending": stiffness * area} if layers == 1 else {}
    points = MaterialPoints.create(
        rest.to(like),
        volume=(simpson * thick * area).to(like),
        density=DENSITY,
        youngs_modulus=YOUNG,
        poisson_ratio=0.0,
        **bends,
    )
    ends = [shift * dx, LENGTH + shift * dx]
    boundaries: list[Boundary] = [Axial((1,))]
    if hold == "nodes":
        boxes = [Box([None] * 3, [ends[0], None, None]), Box([ends[1], None, None], [None] * 3)]
        boundaries += [PinnedRegion(box, "nodes") for box in boxes]
    else:
        boundaries.append(PinnedPoints([[x, 0.0, shift * dx] for x in ends], hold))
    shear = 1.92 / slenderness**2 if layers == 3 else 0.0
    load = sag * thick * 384 * stiffness / (5 * LENGTH**4 * (1 + shear))  # per length, to a unit of width
    omega = math.pi**2 / LENGTH**2 * math.sqrt(stiffness / (DENSITY * thick))
    solver = settings.solver(dx, boundaries=boundaries, damping=2 * omega)
    inside = (rest[:, 0] > ends[0]) & (rest[:, 0] < ends[1])
    force = torch.zeros_like(points.position)
    force[:, 2] = points.mass * (inside.to(like) * load / (DENSITY * thick))
    run = follow(
        solver,
        solver.init_state(points),
        settle / omega / 64,
        64,
        lambda state: state.position[:, 2],
        force=lambda _: force,
    )
    place = rest[:, 0] - shift * dx
    middle = (rest[:, 2] - shift * dx).abs() < 0.1 * thick
    moved = run.series[-1] - run.series[0]

    def exact(x: torch.Tensor) -> torch.Tensor:
        return load * x * (LENGTH**3 - 2 * LENGTH * x**2 + x**3) / (24 * stiffness)

    near = middle & ((place - LENGTH / 2).abs() < 0.75 * dx)
    deflection = float((moved[near] / (exact(place[near]) / (sag * thick / (1 + shear)))).mean())
    F = run.state.F_elastic.double().cpu()
    end = middle & (place > 0) & (place < dx / per_cell)
    slope = float(F[end, 2, 0].mean()) / (load * LENGTH**3 / (24 * stiffness))
    speed = float(run.state.velocity[:, 2].double().cpu()[near].abs().max())
    residual = speed / (omega * sag * thick)
    if layers == 1:
        return run.result(abs(deflection / (sag * thick) - 1), slope=slope, residual=residual)
    bending = (YOUNG * (F[:, 0, 0] - 1) * (rest[:, 2] - shift * dx) * simpson * thick).reshape(-1, 3).sum(-1)
    x = place.reshape(-1, 3)[:, 0]
    wanted = load * x * (LENGTH - x) / 2
    some = (x > 0) & (x < dx)
    moment = float((bending - wanted)[some].abs().max()) / (load * LENGTH**2 / 8)
    return run.result(abs(deflection / (sag * thick) - 1), slope=slope, moment=moment, residual=residual)
