r"""Sand: the friction of the Drucker-Prager law, layers on an incline, and columns that collapse.

Which angle stands for "30 degrees" depends on the test. The cone meets the Mohr-Coulomb pyramid in triaxial compression
only: there the law mobilises 30.0 degrees, in steady simple shear 34.6 and in plane strain 43.9. So a layer on an
incline stands up to 34.6 degrees, and a planar column is stronger than real sand of 30 degrees.

The runs are in metres, seconds and kilograms, and in the ``updated`` formulation whatever the settings say.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.mpm.boundaries.boundary import Boundary, Nodes
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.laws.shared import lame_parameters
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints, MPMState
from gaussian_swaying.validation.settings import Axial, Result, Settings, follow, lattice

GRAVITY, DENSITY, POISSON = 9.81, 1600.0, 0.3
LENGTH = 0.1  # half width or radius of the column, and depth of the layer [m]
_FRAMES = 50


# ---- element tests


def _steady(law: ConstitutiveLaw, gradient: Sequence[Sequence[float]], steps: int, pressure: float) -> Tensor:
    """Kirchhoff stress over E, shape (3, 3), after ``steps`` increments of a velocity gradient that keeps the volume.

    Args:
        law: The law under test.
        gradient: Increment of strain, shape (3, 3), without trace.
        steps: Number of increments.
        pressure: Pressure at the start, over Young's modulus.
    """
    mu, lam = lame_parameters(torch.ones(1, dtype=torch.float64), torch.full((1,), POISSON, dtype=torch.float64))
    increment = torch.linalg.matrix_exp(torch.tensor(gradient, dtype=torch.float64))
    strain = -pressure * (1 - 2 * POISSON)
    F = math.exp(strain) * torch.eye(3, dtype=torch.float64)[None]
    internal = None if law.internal is None else torch.full_like(mu, law.internal)
    for _ in range(steps):
        F, internal = law.return_map(increment @ F, mu, lam, internal, 1.0)
    return law.kirchhoff(F, mu, lam, internal)[0]


def shear_angle(law: ConstitutiveLaw, steps: int = 100, increment: float = 1e-3, pressure: float = 1e-3) -> float:
    r"""Angle :math:`\arctan(\tau / \sigma_n)` in steady simple shear at constant volume [degrees].

    With Klar's return map the flow is coaxial and deviatoric, so in the steady state
    :math:`\tan = 6 \sin\phi / (\sqrt3 (3 - \sin\phi))`: 34.7 degrees for phi = 30.

    Args:
        law: The law under test.
        steps: Number of increments.
        increment: Shear of each.
        pressure: Confining pressure over Young's modulus.

    Returns:
        The angle.
    """
    stress = _steady(law, [[0, 0, increment], [0, 0, 0], [0, 0, 0]], steps, pressure)
    return math.degrees(math.atan2(float(stress[0, 2].abs()), -float(stress[2, 2])))


def _mobilised(stress: Tensor) -> float:
    """Mohr-Coulomb angle of a stress [degrees]."""
    values = torch.linalg.eigvalsh(stress)
    return math.degrees(math.asin(float((values[2] - values[0]) / -(values[2] + values[0]))))


def triaxial_angle(law: ConstitutiveLaw, steps: int = 100, increment: float = 1e-3, pressure: float = 1e-3) -> float:
    r"""Angle :math:`\arcsin((\sigma_1 - \sigma_3) / (\sigma_1 + \sigma_3))` in triaxial compression [degrees].

    Arguments as :func:`shear_angle`; the volume is kept. The cone is fitted to phi here.
    """
    half = increment / 2
    return _mobilised(_steady(law, [[half, 0, 0], [0, half, 0], [0, 0, -increment]], steps, pressure))


def plane_strain_angle(
    law: ConstitutiveLaw, steps: int = 100, increment: float = 1e-3, pressure: float = 1e-3
) -> float:
    """The same angle in plane strain [degrees]: 43.9 for phi = 30. Arguments as :func:`shear_angle`."""
    return _mobilised(_steady(law, [[increment, 0, 0], [0, 0, 0], [0, 0, -increment]], steps, pressure))


# ---- a layer on an incline


class _Invariant(Boundary):
    """Gives all nodes of one height the velocity of the one at x = y = 0: a layer without end.

    With the particles at x = y = 0 the stress along the layer does not act on that node, and its shear stress and mass
    are those of the layer.
    """

    needs_position = True

    def __init__(self, dx: float) -> None:
        super().__init__()
        self.dx = dx

    def forward(self, velocity: Tensor, nodes: Nodes) -> Tensor:
        """Copy the velocity along the layer."""
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
    compression: float = 1e-2,
) -> tuple[list[float], list[float], Result]:
    """Lay sand on rough inclines without end and find how fast it moves off.

    Nothing varies along the slope, so one column of particles is enough; each is put back to x = 0 after each substep.
    The layer starts with the stress under its weight on a level floor; gravity tilts over the first third of the time.

    Args:
        angles: Inclinations [degrees].
        settings: The numerics under test.
        cells: Grid cells over the depth of 0.1 m.
        friction_angle: Friction angle of the law [degrees].
        volume_correction: See :class:`~gaussian_swaying.mpm.laws.sand.Sand`.
        seconds: Time [s].
        compression: Weight of the layer over Young's modulus.

    Returns:
        For each angle the acceleration of the layer down the slope, over g, in the second half of the time, and its
        mean velocity at the end [m/s]; and ``simulated_s``, ``substeps``, ``wall_s`` and ``particles``.
    """
    settings = _flowing(settings)
    tilt = torch.deg2rad(torch.tensor(list(angles), device=settings.device, dtype=settings.dtype))
    solver, points, state = _layer(len(angles), settings, cells, friction_angle, volume_correction, compression)
    weight = (points.mass * GRAVITY)[..., None]
    across = weight.new_tensor([0.0, 1.0, 1.0])
    frame, taken, speeds = seconds / _FRAMES, 0, []
    with torch.inference_mode():
        start = _clock(settings)
        for _ in range(_FRAMES):
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
    late = series[_FRAMES // 2 :]
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
    r"""The steepest incline on which a layer stands.

    A layer flows if it gathers speed by more than 0.2 % of g. In theory it does so by
    :math:`g (\sin\theta - \mu \cos\theta)`; the dissipation of the grid takes some of it away, the more the coarser the
    grid.

    Args:
        settings: The numerics under test.
        cells: Grid cells over the depth.
        friction_angle: Friction angle of the law [degrees].
        angles: The inclinations tried, ascending [degrees]; at least the last two must flow.
        more: ``volume_correction``, ``seconds`` and ``compression``, see :func:`inclined_layer`.

    Returns:
        ``stands`` and ``flows``: the steepest inclination that stands, and the gentlest that flows [degrees];
        ``friction_deg``: where the acceleration vanishes, extrapolated from the two gentlest that flow [degrees];
        ``exact``: :func:`shear_angle`; ``error`` of ``friction_deg`` relative to it; ``acceleration_error`` on the
        steepest incline, relative to theory; ``simulated_s``, ``substeps``, ``wall_s`` and ``particles``.
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
    compression: float = 1e-2,
) -> Result:
    """Throw up a layer without end so that it is pulled apart, and let it fall back.

    Its velocity grows from zero at the floor to that which takes the surface up by ``rise``. Where sand is pulled apart
    the return map forgets the gap, and without correction the sand that falls back stands the taller for it.

    Args:
        settings: The numerics under test.
        cells: Grid cells over the depth of 0.1 m.
        friction_angle: Friction angle of the law [degrees].
        volume_correction: See :class:`~gaussian_swaying.mpm.laws.sand.Sand`.
        rise: How far the surface would fly, over the depth.
        seconds: Time [s].
        compression: Weight of the layer over Young's modulus.

    Returns:
        ``volume_ratio``: height of the centre of mass at the end, over that at the start; ``error``: that less one;
        ``highest``: the same height at its largest; ``simulated_s``, ``substeps``, ``wall_s`` and ``particles``.
    """
    settings = _flowing(settings)
    solver, points, state = _layer(
        1, settings, cells, friction_angle, volume_correction, compression, gravity=(0.0, 0.0, -GRAVITY)
    )
    up = math.sqrt(2 * GRAVITY * rise / LENGTH) * state.position[..., 2]
    state = state.replace(velocity=torch.stack([torch.zeros_like(up), torch.zeros_like(up), up], dim=-1))
    run = follow(solver, state, seconds / _FRAMES, _FRAMES, lambda s: s.position[..., 2].mean())
    height = run.series / run.series[0]
    ratio = float(height[-1])
    return run.result(ratio - 1, volume_ratio=ratio, highest=float(height.amax()), particles=points.mass.numel())


def _layer(
    scenes: int,
    settings: Settings,
    cells: int,
    friction_angle: float,
    volume_correction: bool,
    compression: float,
    **more: Any,
) -> tuple[MPMSolver, MaterialPoints, MPMState]:
    """Scenes with one column of a layer on a rough floor, consolidated under its weight."""
    dx = LENGTH / cells
    points = MaterialPoints.create(
        lattice(dx, (0, 0, 0), (0, 0, cells), settings).expand(scenes, -1, -1),
        volume=dx**3 / 2,
        density=DENSITY,
        youngs_modulus=DENSITY * GRAVITY * LENGTH / compression,
        poisson_ratio=POISSON,
        law=Sand(friction_angle, volume_correction),
    )
    solver = settings.solver(dx, boundaries=[_Invariant(dx), Plane((0, 0, 0), (0, 0, 1), "sticky")], **more)
    return solver, points, _consolidated(solver.init_state(points, margin=2), points, LENGTH)


# ---- a column in a box, and one that is let go


def column_at_rest(
    settings: Settings | None = None, cells: int = 4, friction_angle: float = 30.0, seconds: float = 0.2, **more: Any
) -> Result:
    """A square of sand between smooth walls, as deep as wide, under the stress that its weight gives it.

    Args:
        settings: The numerics under test.
        cells: Grid cells along each side of 0.1 m.
        friction_angle: Friction angle of the law [degrees].
        seconds: Time [s].
        more: ``compression``, ``volume_correction`` and ``floor_friction``, see :func:`column_collapse`.

    Returns:
        ``error``: the largest displacement of a particle, over the width; ``settlement``: how far the surface sinks in
        equilibrium if the sand starts without stress, over the same; ``kinetic``: kinetic energy at the end over the
        weight times the depth; ``simulated_s``, ``substeps``, ``wall_s`` and ``particles``.
    """
    settings = _flowing(settings)
    dx = LENGTH / cells
    place = lattice(dx, (0, 0, 0), (cells, 0, cells), settings)
    wall = Plane((LENGTH, 0, 0), (-1, 0, 0), "slip")
    solver, points, state = _column(place, dx, LENGTH, settings, (1,), friction_angle, walls=[wall], **more)
    run = follow(solver, state, seconds / 10, 10, lambda s: _kinetic(s, points))
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
    floor_friction: float | None = None,
    compression: float = 1e-2,
    duration: float = 5.0,
) -> Result:
    r"""Let go a column of sand and watch it spread over a rough floor.

    Planar: half of a column, or one beside a smooth wall, in plane strain (one layer of particles, which does not move
    along y). Otherwise a quarter of a round column. It starts with the stress under its weight; the half width or
    radius :math:`L_0` is 0.1 m.

    The bulk is where the mass, spread with the B-spline of a cell and mirrored in floor and symmetry planes, comes to
    more than half of the density at rest: gaps inside do not count, nor does spray. The surface is the thickness of the
    bulk over each point of the floor.

    Coarse grids stop the sand too early: the transfers smooth the flow within a cell in every substep, so the run-out
    grows with the cells and falls with the substeps. At a = 1, planar: 0.57, 0.68, 0.77, 0.88 and 0.95 with 4, 8, 16,
    32 and 64 cells, and 0.68 with 16 cells and a third of the Courant number. Experiments with sand, which mobilises
    less friction in plane strain than this cone, gave 1.2; 20 degrees on 32 cells give 1.64.

    Args:
        aspect: Height over half width or radius, :math:`a = H_0 / L_0`.
        settings: The numerics under test.
        cells: Grid cells along the half width; ``aspect * cells`` must be a whole number.
        planar: Plane strain, or else a round column.
        friction_angle: Friction angle of the law [degrees].
        volume_correction: See :class:`~gaussian_swaying.mpm.laws.sand.Sand`.
        floor_friction: Coulomb coefficient of the floor, or None for a floor that holds what touches it.
        compression: Weight of the column over Young's modulus, about the compression at its foot.
        duration: Time over :math:`\sqrt{H_0 / g}`; in experiments a column rests after about 3.

    Returns:
        ``runout``: the 99th percentile of the distance of particles from the symmetry plane or axis, less that at the
        start, over :math:`L_0`; ``height``: of the surface over :math:`L_0`, largest; ``slope_deg``: of the surface
        between 80 and 20 % of that height; ``stop_s``: when the run-out had come within 1 % of :math:`L_0` of its last
        value [s], and ``stop``, the same over :math:`\sqrt{H_0 / g}`; ``volume_ratio``: bulk at the end over that at
        the start; ``kinetic``: kinetic energy at the end over its largest value; ``lost``: particles off the grid;
        ``lube`` and ``lajeunesse``: run-outs in experiments, the latter for a round column only; ``error``: run-out
        relative to ``lube``; ``simulated_s``, ``substeps``, ``wall_s`` and ``particles``.
    """
    check_positive("aspect", aspect)
    check_positive("compression", compression)
    settings = _flowing(settings)
    high = round(aspect * cells)
    if abs(high - aspect * cells) > 1e-9:
        raise ValueError(f"Expected `aspect * cells` to be a whole number, but got {aspect * cells:g}.")
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
        floor_friction=floor_friction,
        compression=compression,
    )
    scale = math.sqrt(height / GRAVITY)

    def observe(state: MPMState) -> Tensor:
        reach = torch.linalg.vector_norm(state.position[:, :2], dim=-1).quantile(0.99)
        return torch.stack([reach, _kinetic(state, points)])

    run = follow(solver, state, duration * scale / _FRAMES, _FRAMES, observe)
    reach, kinetic = run.series.unbind(-1)
    away = ((reach - reach[-1]).abs() > 0.01 * LENGTH).nonzero()
    stop = float(run.time[int(away[-1]) + 1]) if len(away) else 0.0
    before, after = (_bulk(p, points.volume, dx, planar) for p in (place, run.state.position))
    top, slope = _surface(*after[1:], dx)
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


def lube(aspect: float, planar: bool = True) -> float:
    """Run-out over half width or radius in the experiments of Lube et al. with sand and other grains.

    Planar: Lube et al. 2005, "Collapses of two-dimensional granular columns", 1.2 a, and 1.9 a^(2/3) where a > 2.3.
    Round: Lube et al. 2004, "Axisymmetric collapses of granular columns", 1.24 a, and 1.6 a^(1/2) where a > 1.7.

    Args:
        aspect: Height over half width or radius.
        planar: Whether the column is planar.

    Returns:
        The run-out.
    """
    if planar:
        return 1.2 * aspect if aspect <= 2.3 else 1.9 * aspect ** (2 / 3)
    return 1.24 * aspect if aspect <= 1.7 else 1.6 * math.sqrt(aspect)


def lajeunesse(aspect: float) -> float:
    """Run-out over the radius of a round column of glass beads: a, and 2 a^(1/2) where a > 0.74.

    Lajeunesse et al. 2004, "Spreading of a granular mass on a horizontal plane".

    Args:
        aspect: Height over radius.

    Returns:
        The run-out.
    """
    return aspect if aspect <= 0.74 else 2 * math.sqrt(aspect)


def _flowing(settings: Settings | None) -> Settings:
    return dataclasses.replace(Settings() if settings is None else settings, formulation="updated")


def _clock(settings: Settings) -> float:
    if torch.device(settings.device).type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


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
    floor_friction: float | None = None,
    compression: float = 1e-2,
) -> tuple[MPMSolver, MaterialPoints, MPMState]:
    """Sand at ``place`` on a floor, with smooth walls at x = 0 and y = 0, consolidated under its weight."""
    points = MaterialPoints.create(
        place,
        volume=dx**3 / (4 if held else 8),
        density=DENSITY,
        youngs_modulus=DENSITY * GRAVITY * height / compression,
        poisson_ratio=POISSON,
        law=Sand(friction_angle, volume_correction),
    )
    kind = "sticky" if floor_friction is None else "separate"
    floor = Plane((0, 0, 0), (0, 0, 1), kind, friction=floor_friction or 0.0)
    sides: list[Boundary] = [Plane((0, 0, 0), (1, 0, 0), "slip")]
    sides.append(Axial(held) if held else Plane((0, 0, 0), (0, 1, 0), "slip"))
    solver = settings.solver(dx, gravity=(0.0, 0.0, -GRAVITY), boundaries=[*sides, *walls, floor])
    return solver, points, _consolidated(solver.init_state(points), points, height)


def _consolidated(state: MPMState, points: MaterialPoints, height: float) -> MPMState:
    """The state with the vertical strain of a layer of the given height under its weight, without lateral strain."""
    mu, lam = lame_parameters(points.youngs_modulus, points.poisson_ratio)
    strain = -DENSITY * GRAVITY * (height - state.position[..., 2]) / (lam + 2 * mu)
    stretch = torch.stack([torch.ones_like(strain), torch.ones_like(strain), strain.exp()], dim=-1)
    F = stretch.diag_embed()
    return state.replace(F_elastic=F, F_total=F)


def _kinetic(state: MPMState, points: MaterialPoints) -> Tensor:
    return 0.5 * (points.mass * state.velocity.square().sum(-1)).sum(-1)


def _bulk(position: Tensor, volume: Tensor, dx: float, planar: bool) -> tuple[float, Tensor, Tensor]:
    """Volume of the bulk [m³], and its thickness [m] over points of the floor at given distances [m], both (N,).

    Sampled at the centres of squares or cubes of a quarter or half a cell, which floor and symmetry planes bound.
    """
    fine = 4 if planar else 2
    axes = (0, 2) if planar else (0, 1, 2)
    place = position.double().cpu()[:, axes] / dx * fine
    reach = torch.arange(3 * fine)
    index = (torch.floor(place - 1.5 * fine + 0.5)[..., None].long() + reach).unbind(-2)
    weight = torch.ones(len(place), 1, dtype=torch.float64)
    flat = torch.zeros(len(place), 1, dtype=torch.long)
    shape = [int(i.amax()) + 3 * fine for i in index]
    for axis, i in enumerate(index):
        away = ((i + 0.5) - place[:, axis, None]).abs() / fine
        spline = torch.where(away < 0.5, 0.75 - away.square(), 0.5 * (1.5 - away).clamp(min=0).square())
        mirrored = torch.where(i < 0, -1 - i, i)
        weight = (weight[..., None] * spline[:, None]).flatten(1)
        flat = (flat[..., None] * shape[axis] + mirrored[:, None]).flatten(1)
    part = volume.double().cpu() / dx**3
    density = torch.zeros(math.prod(shape), dtype=torch.float64)
    density.index_add_(0, flat.flatten(), (weight * part[:, None]).flatten())
    full = (density.reshape(shape) > 0.5).double()
    step = dx / fine
    thickness = full.sum(-1) * step
    ticks = [(torch.arange(n) + 0.5) * step for n in shape[:-1]]
    distance = torch.stack(torch.meshgrid(*ticks, indexing="ij")).square().sum(0).sqrt()
    area = step * (dx if planar else step)
    return float(thickness.sum()) * area, distance.flatten(), thickness.flatten()


def _surface(distance: Tensor, thickness: Tensor, dx: float) -> tuple[float, float]:
    """Height of a deposit [m], and slope between 80 and 20 % of it [degrees]: means over rings half a cell wide."""
    ring = (distance / (0.5 * dx)).long()
    count = torch.zeros(int(ring.amax()) + 1, dtype=torch.float64).index_add_(0, ring, torch.ones_like(thickness))
    height = torch.zeros_like(count).index_add_(0, ring, thickness) / count.clamp(min=1)
    radius = (torch.arange(len(count)) + 0.5) * 0.5 * dx
    top = float(height.amax())
    chosen = (height < 0.8 * top) & (height > 0.2 * top)
    if int(chosen.sum()) < 2:
        return top, math.nan
    x, y = radius[chosen] - radius[chosen].mean(), height[chosen] - height[chosen].mean()
    return top, math.degrees(math.atan(-float((x * y).sum() / x.square().sum())))
