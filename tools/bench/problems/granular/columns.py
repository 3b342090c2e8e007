"""A column of sand in a box, and one that collapses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from bench.problems.granular.deposit import bulk, lajeunesse, lube, surface
from bench.problems.granular.shared import (
    COMPRESSION,
    DENSITY,
    FRAMES,
    GRAVITY,
    LENGTH,
    POISSON,
    consolidated,
    kinetic_energy,
    updated,
)
from bench.problems.settings import Axial, Result, Settings, follow, lattice
from gaussian_swaying.geometry.regions import HalfSpace
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.colliders import Wall
from gaussian_swaying.mpm.laws.law import lame_parameters
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState


def column_at_rest(
    settings: Settings | None = None, cells: int = 4, friction_angle: float = 30.0, seconds: float = 0.2, **more: Any
) -> Result:
    """A square of sand between smooth walls, as deep as wide, with the stress due to its weight.

    Units: ``friction_angle`` [degrees]; ``seconds`` [s].

    Returns:
        ``error``: the largest displacement of a particle, over the width; ``settlement``: how far the surface sinks in
        equilibrium if the sand starts without stress, over the same; ``kinetic``: kinetic energy at the end over the
        weight times the depth; and the common quantities.
    """
    settings = updated(settings)
    dx = LENGTH / cells
    place = lattice(dx, (0, 0, 0), (cells, 0, cells), settings)
    wall = Wall(HalfSpace((LENGTH, 0, 0), (-1, 0, 0)), "slip")
    solver, points, state = _column(place, dx, LENGTH, settings, (1,), friction_angle, walls=[wall], **more)
    run = follow(solver, state, seconds / 10, 10, lambda s: kinetic_energy(s, points))
    moved = torch.linalg.vector_norm(run.state.position - place, dim=-1).amax()
    mu, lam = lame_parameters(points.youngs_modulus[0], points.poisson_ratio[0])
    sinks = DENSITY * GRAVITY * LENGTH / float(2 * (lam + 2 * mu))
    return run.result(
        float(moved) / LENGTH,
        settlement=sinks,
        kinetic=float(run.series[-1]) / (float(points.mass.sum()) * GRAVITY * LENGTH),
        particles=points.count,
    )


def column_collapse(
    aspect: float,
    settings: Settings | None = None,
    cells: int = 8,
    planar: bool = True,
    friction_angle: float = 30.0,
    volume_correction: bool = True,
    duration: float = 5.0,
) -> Result:
    r"""Release a column of sand and let it spread over a rough floor.

    Planar: half of a column, or one beside a smooth wall, in plane strain (one layer of particles, which does not move
    along y). Otherwise a quarter of a round column. It starts with the stress due to its weight; the half width or
    radius :math:`L_0` is 0.1 m.

    The bulk is where the mass, spread with the B-spline of a cell and mirrored in floor and symmetry planes, is more
    than half of the density at rest: gaps inside and spray do not matter. The surface is the thickness of the bulk over
    each point of the floor.

    The transfers smooth the flow within a cell in every substep, so the run-out grows with the cells and falls with the
    substeps. At a = 1, planar: 0.57, 0.77 and 0.95 with 4, 16 and 64 cells. Experiments with sand, which mobilises less
    friction in plane strain than this cone, gave 1.2.

    Units: ``friction_angle`` [degrees].

    Returns:
        ``runout``: the 99th percentile of the distance of particles from the symmetry plane or axis, less that at the
        start, over :math:`L_0`; ``height``: of the surface over :math:`L_0`, largest; ``slope_deg``: of the surface
        between 80 and 20 % of that height; ``stop_s``: when the run-out had come within 1 % of :math:`L_0` of its last
        value [s], and ``stop``, the same over :math:`\sqrt{H_0 / g}`; ``volume_ratio``: bulk at the end over that at
        the start; ``kinetic``: kinetic energy at the end over its largest value; ``lost``: particles off the grid;
        ``lube`` and ``lajeunesse``: run-outs in experiments, the latter for a round column only; ``error``: run-out
        relative to ``lube``; and the common quantities.
    """
    settings = updated(settings)
    high = round(aspect * cells)
    dx, height = LENGTH / cells, aspect * LENGTH
    place = lattice(dx, (0, 0, 0), (cells, 0 if planar else cells, high), settings)
    place = place[torch.linalg.vector_norm(place[:, :2], dim=-1) < LENGTH]
    solver, points, state = _column(
        place,
        dx,
        height,
        settings,
        (1,) if planar else (),
        friction_angle,
        volume_correction=volume_correction,
    )
    scale = math.sqrt(height / GRAVITY)

    def observe(state: MPMState) -> Tensor:
        reach = torch.linalg.vector_norm(state.position[:, :2], dim=-1).quantile(0.99)
        return torch.stack([reach, kinetic_energy(state, points)])

    run = follow(solver, state, duration * scale / FRAMES, FRAMES, observe)
    reach, kinetic = run.series.unbind(-1)
    away = ((reach - reach[-1]).abs() > 0.01 * LENGTH).nonzero()
    stop = float(run.time[int(away[-1]) + 1]) if len(away) else 0.0
    before, after = (bulk(p, points.volume, dx, planar) for p in (place, run.state.position))
    top, slope = surface(*after[1:], dx)
    experiments = {"lube": lube(aspect, planar)} | ({} if planar else {"lajeunesse": lajeunesse(aspect)})
    runout = float(reach[-1] - reach[0]) / LENGTH
    return run.result(
        runout / experiments["lube"] - 1,
        runout=runout,
        height=top / LENGTH,
        slope_deg=slope,
        stop_s=stop,
        stop=stop / scale,
        volume_ratio=after[0] / before[0],
        kinetic=float(kinetic[-1] / kinetic.amax()),
        lost=float(run.state.lost.sum()),
        particles=points.count,
        **experiments,
    )


def _column(
    place: Tensor,
    dx: float,
    height: float,
    settings: Settings,
    held: Sequence[int],
    friction_angle: float,
    *,
    walls: Sequence[Boundary] = (),
    volume_correction: bool = True,
) -> tuple[MPMSolver, MaterialPoints, MPMState]:
    """Sand at ``place`` on a floor, with smooth walls at x = 0 and y = 0, consolidated under its weight."""
    points = MaterialPoints.create(
        place,
        volume=dx**3 / (4 if held else 8),
        density=DENSITY,
        youngs_modulus=DENSITY * GRAVITY * height / COMPRESSION,
        poisson_ratio=POISSON,
        law=Sand(friction_angle, volume_correction),
    )
    floor = Wall(HalfSpace((0, 0, 0), (0, 0, 1)), "sticky")
    sides: list[Boundary] = [Wall(HalfSpace((0, 0, 0), (1, 0, 0)), "slip")]
    sides.append(Axial(held) if held else Wall(HalfSpace((0, 0, 0), (0, 1, 0)), "slip"))
    solver = settings.solver(dx, gravity=(0.0, 0.0, -GRAVITY), boundaries=[*sides, *walls, floor])
    return solver, points, consolidated(solver.init_state(points), points, height)
