r"""Round rods thinner than a cell, which bend with their own stiffness; the reference is Timoshenko's beam."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bench.problems.beams import Chosen, first_zero, timoshenko_mode
from bench.problems.settings import Result, Settings, follow
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints, MPMState


def section(diameter: float, count: int) -> Tensor:
    r"""Points on a circle that have the second moment of a disc, :math:`\pi d^4 / 64`, about every axis.

    Returns:
        Places across the rod, shape (count, 2), float64.
    """
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count + 0.3
    return diameter / math.sqrt(8) * torch.stack([angle.cos(), angle.sin()], -1)


def rod(
    settings: Settings,
    diameter: float,
    place: tuple[float, float, float] = (0.0, 0.0, 0.0),
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0),
    length: float = 20.0,
    per_cell: int = 4,
    around: int = 8,
) -> Result:
    r"""The lowest bending frequencies, about two axes, of a clamped rod.

    The rod has ``around`` points in each section (:func:`section`). Two cells of it lie in a :class:`PinnedRegion`.

    Units: ``diameter``, ``place``, ``length`` [cells].

    Returns:
        ``lowest`` and ``highest`` of the two frequencies over that of Timoshenko's beam, ``error``, the largest
        distance from one, and the common quantities.
    """
    depth = 2.0
    along = (torch.arange(round((length + depth) * per_cell), dtype=torch.float64) + 0.5) / per_cell - depth
    across = section(diameter, around)
    body = torch.cat([along.repeat_interleave(around)[:, None], across.repeat(len(along), 1)], 1)
    free = body[:, 0] > 0
    edge = float(along[along > 0][0]) - 0.5 / per_cell
    span = float(along[-1]) + 0.5 / per_cell - edge
    first = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    up = torch.eye(3, dtype=torch.float64)[first.abs().argmin()]
    second = torch.nn.functional.normalize(torch.linalg.cross(first, up), dim=0)
    frame = torch.stack([first, second, torch.linalg.cross(first, second)], 1)
    like = torch.zeros((), dtype=settings.dtype, device=settings.device)
    area, moment = math.pi * diameter**2 / 4, math.pi * diameter**4 / 64
    points = MaterialPoints.create(
        (body @ frame.T + torch.tensor(place, dtype=torch.float64)).to(like),
        volume=area / (per_cell * around),
        density=1.0,
        youngs_modulus=1.0,
        poisson_ratio=0.0,
    )
    omega, mode = timoshenko_mode(span, area, moment)
    at = ((body[:, 0] - edge) / span).clamp(0, 1) * (len(mode) - 1)
    before = at.long().clamp(max=len(mode) - 2)
    bent = torch.lerp(mode[before], mode[before + 1], (at - before)[:, None]) * free[:, None]
    ratios = []
    for side in (1, 2):
        shape = bent[:, :1] * frame[:, side] - (bent[:, 1] * body[:, side])[:, None] * frame[:, 0]
        weight = points.mass.double().cpu()[:, None] * shape
        solver = settings.solver(1.0, boundaries=[PinnedRegion(Chosen(~free), "clamp")])
        start = solver.init_state(points, (1e-5 * omega * span * shape).to(like))

        def speed(state: MPMState, weight: Tensor = weight) -> Tensor:
            return (weight * state.velocity.double().cpu()).sum()

        run = follow(solver, start, 2.4 / omega / 40, 40, speed)
        crossing = first_zero(run.time, run.series.reshape(-1))
        ratios.append(0.0 if crossing is None else math.pi / 2 / (omega * crossing))
    error = max(abs(ratio - 1) for ratio in ratios)
    return run.result(error, lowest=min(ratios), highest=max(ratios))
