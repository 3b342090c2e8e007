"""An infinite layer of sand: on inclines, and thrown up."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from bench.problems.granular.angles import shear_angle
from bench.problems.granular.shared import (
    COMPRESSION,
    DENSITY,
    FRAMES,
    GRAVITY,
    LENGTH,
    POISSON,
    consolidated,
    updated,
)
from bench.problems.settings import Result, Settings, follow, lattice
from gaussian_swaying.geometry.regions import HalfSpace
from gaussian_swaying.mpm.boundary import Boundary, Nodes
from gaussian_swaying.mpm.colliders import Wall
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState


class _Invariant(Boundary):
    """Gives all nodes at one height the velocity of the node at x = y = 0, as in an infinite layer.

    With the particles at x = y = 0 the stress along the layer does not act on that node, and its shear stress and mass
    are those of the layer.
    """

    needs_position = True

    def __init__(self, dx: float) -> None:
        super().__init__()
        self.dx = dx

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        assert nodes.position is not None
        place = nodes.position.reshape(-1, *nodes.position.shape[-2:])[0]
        column = velocity[..., (place[:, :2].abs() < 0.5 * self.dx).all(-1), :]
        return column.repeat(*[1] * (velocity.ndim - 2), velocity.shape[-2] // column.shape[-2], 1)


def inclined_layer(
    angles: Sequence[float],
    settings: Settings | None = None,
    cells: int = 8,
    friction_angle: float = 30.0,
    volume_correction: bool = False,
    seconds: float = 0.3,
) -> tuple[list[float], list[float], Result]:
    """Put sand on infinite rough inclines and measure how fast it accelerates.

    Nothing varies along the slope, so one column of particles is enough; each particle is moved back to x = 0 after
    each substep. The layer starts with the stress due to its weight on a level floor; gravity is tilted during the
    first third of the time.

    Units: ``angles``, ``friction_angle`` [degrees]; ``seconds`` [s].

    Returns:
        For each angle the acceleration of the layer down the slope, over g, in the second half of the time, and its
        mean velocity at the end [m/s]; and the common quantities.
    """
    settings = updated(settings)
    tilt = torch.deg2rad(torch.tensor(list(angles), device=settings.device, dtype=settings.dtype))
    solver, points, state = _layer(len(angles), settings, cells, friction_angle, volume_correction)
    weight = (points.mass * GRAVITY)[..., None]
    across = weight.new_tensor([0.0, 1.0, 1.0])
    frame, taken, speeds = seconds / FRAMES, 0, []
    with torch.inference_mode():
        start = _clock(settings)
        for _ in range(FRAMES):
            count = solver.substeps(state, frame)
            for _ in range(count):
                now = tilt * (3 * state.time / seconds).clamp(max=1.0).to(tilt)
                direction = torch.stack([now.sin(), torch.zeros_like(now), -now.cos()], dim=-1)
                state = solver.step(state, frame / count, force=weight * direction[:, None])
                state = state.replace(position=state.position * across)
            taken += count
            speeds.append(state.velocity[..., 0].mean(-1))
        wall = _clock(settings) - start
    series = torch.stack(speeds).double().cpu()
    late = series[FRAMES // 2 :]
    clock = torch.arange(len(late), dtype=torch.float64) * frame
    clock = clock - clock.mean()
    slope = (clock[:, None] * late).sum(0) / (clock.square().sum() * GRAVITY)
    numbers = {"simulated_s": seconds, "substeps": taken, "wall_s": wall, "particles": points.mass.numel()}
    return slope.tolist(), series[-1].tolist(), {name: float(value) for name, value in numbers.items()}


def angle_of_repose(
    settings: Settings | None = None,
    cells: int = 8,
    friction_angle: float = 30.0,
    angles: Sequence[float] = tuple(range(30, 41)),
    **more: Any,
) -> Result:
    r"""The steepest incline on which a layer stays at rest.

    A layer flows if it accelerates by more than 0.2 % of g. In theory the acceleration is
    :math:`g (\sin\theta - \mu \cos\theta)`. The dissipation of the grid reduces it, and more so on coarser grids.

    Units: ``friction_angle``, ``angles`` [degrees].

    Returns:
        ``stands`` and ``flows``: the steepest angle at rest, and the gentlest that flows [degrees]; ``friction_deg``:
        where the acceleration vanishes, extrapolated from the two gentlest that flow [degrees]; ``exact``:
        :func:`shear_angle`; ``error`` of ``friction_deg`` relative to it; ``acceleration_error`` on the steepest
        incline, relative to theory; and the common quantities.
    """
    found, _, numbers = inclined_layer(angles, settings, cells, friction_angle, **more)
    flows = [k for k, gain in enumerate(found) if gain > 2e-3]
    exact = shear_angle(Sand(friction_angle))
    friction = math.nan
    if len(flows) > 1:
        k, n = flows[:2]
        friction = angles[k] - found[k] * (angles[n] - angles[k]) / (found[n] - found[k])
    last, rest = math.radians(angles[-1]), math.radians(exact)
    theory = math.sin(last) - math.tan(rest) * math.cos(last)
    return numbers | {
        "error": friction / exact - 1,
        "stands": max((a for k, a in enumerate(angles) if k not in flows), default=math.nan),
        "flows": angles[flows[0]] if flows else math.nan,
        "friction_deg": friction,
        "exact": exact,
        "acceleration_error": found[-1] / theory - 1,
    }


def tossed_layer(
    settings: Settings | None = None,
    cells: int = 4,
    friction_angle: float = 30.0,
    volume_correction: bool = True,
    rise: float = 0.3,
    seconds: float = 0.6,
) -> Result:
    """Throw an infinite layer up so that it is pulled apart, and let it fall back.

    Its velocity grows from zero at the floor to the value that lifts the surface by ``rise``. Where sand is pulled
    apart, the return map forgets the gap. Without correction the layer is therefore taller after it falls back.

    Units: ``friction_angle`` [degrees]; ``seconds`` [s].

    Returns:
        ``volume_ratio``: height of the centre of mass at the end, over that at the start; ``error``: that less one;
        ``highest``: the same height at its largest; and the common quantities.
    """
    settings = updated(settings)
    solver, points, state = _layer(1, settings, cells, friction_angle, volume_correction, gravity=(0.0, 0.0, -GRAVITY))
    up = math.sqrt(2 * GRAVITY * rise / LENGTH) * state.position[..., 2]
    state = state.replace(velocity=torch.stack([torch.zeros_like(up), torch.zeros_like(up), up], dim=-1))
    run = follow(solver, state, seconds / FRAMES, FRAMES, lambda s: s.position[..., 2].mean())
    height = run.series / run.series[0]
    ratio = float(height[-1])
    return run.result(ratio - 1, volume_ratio=ratio, highest=float(height.amax()), particles=points.mass.numel())


def _layer(
    scenes: int,
    settings: Settings,
    cells: int,
    friction_angle: float,
    volume_correction: bool,
    **more: Any,
) -> tuple[MPMSolver, MaterialPoints, MPMState]:
    dx = LENGTH / cells
    points = MaterialPoints.create(
        lattice(dx, (0, 0, 0), (0, 0, cells), settings).expand(scenes, -1, -1),
        volume=dx**3 / 2,
        density=DENSITY,
        youngs_modulus=DENSITY * GRAVITY * LENGTH / COMPRESSION,
        poisson_ratio=POISSON,
        law=Sand(friction_angle, volume_correction),
    )
    solver = settings.solver(dx, boundaries=[_Invariant(dx), Wall(HalfSpace((0, 0, 0), (0, 0, 1)), "sticky")], **more)
    return solver, points, consolidated(solver.init_state(points, margin=2), points, LENGTH)


def _clock(settings: Settings) -> float:
    if torch.device(settings.device).type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()
