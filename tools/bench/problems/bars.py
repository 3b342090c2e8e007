r"""Bars along x: a standing wave, a bar under its weight, and a block that vibrates freely.

Fixed corotated elasticity is linear in one dimension at any strain: :math:`P_{11} = (\lambda + 2 \mu)(F_{11} - 1)` in a
bar that is confined laterally and :math:`E (F_{11} - 1)` for :math:`\nu = 0`, both from its energy by hand. So the
linear wave equation and the linear bar are exact at finite amplitude.
"""

from __future__ import annotations

import cmath
import math

import torch
from torch import Tensor

from bench.problems.settings import Axial, Result, Settings, block, fit_sinusoid, follow
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundary import Boundary
from gaussian_swaying.mpm.pins import PinnedPoints, PinnedRegion
from gaussian_swaying.mpm.state import MaterialPoints, MPMState

LENGTH, YOUNG, DENSITY = 25.0, 100.0, 1.0  # [m], [Pa], [kg/m³]: the vibrating bar of Buzzi et al. 2008, c = 10 m/s
_CLAMP = 2  # cells of material inside a clamp: no stencil extends beyond it


def wall_of(points: MaterialPoints, *places: float) -> PinnedPoints:
    """Walls across a bar at some x [m]: a held place for each row of points along it."""
    across = torch.unique(points.position[:, 1:], dim=0).tolist()
    return PinnedPoints([[x, *row] for x in places for row in across])


def vibrating_bar(
    cells: int,
    settings: Settings,
    ends: str = "free",
    confined: bool = True,
    poisson_ratio: float = 0.3,
    periods: int = 4,
    strain: float = 0.1,
    shift: float = 0.0,
    hold: str = "nodes",
) -> Result:
    r"""The lowest standing wave of a bar, started with its velocity.

    :math:`u = a\, \varphi(X) \sin \omega t` with :math:`c = \sqrt{(\lambda + 2 \mu) / \rho}` and, for ``free`` ends,
    :math:`\varphi = \cos(\pi X / L),\ \omega = \pi c / L`; ``fixed``: :math:`\varphi = \sin(\pi X / L)`, the same
    :math:`\omega`; ``fixed-free``: :math:`\varphi = \sin(\pi X / 2L),\ \omega = \pi c / 2L` (textbook wave equation).
    The middle of the free bar is at rest, so each half is a fixed-free bar with an ideal clamp.

    The bar must be ``confined``, without motion across, unless ``poisson_ratio`` is 0. A fixed end is a
    :class:`PinnedRegion` of two cells beyond it (``hold`` is ``nodes``), or :class:`PinnedPoints` at it (``points``).

    Units: ``shift`` of the bar off the planes of the nodes [cells].

    Returns:
        ``error`` (of the frequency, relative), ``frequency`` [Hz], ``loss`` (share of the amplitude lost per period),
        ``end_shift`` (by how many cells each fixed end appears farther out than it is) and the common quantities.
    """
    nu, dx = poisson_ratio, LENGTH / cells
    speed = math.sqrt(YOUNG * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / DENSITY)
    wave = math.pi / LENGTH / (2 if ends == "fixed-free" else 1)
    omega = wave * speed
    beyond = _CLAMP if hold == "nodes" else 0
    first, last = -beyond if ends != "free" else 0, cells + (beyond if ends == "fixed" else 0)
    across = 0 if confined else 1
    points = block(
        dx,
        (first, 0, 0),
        (last, across, across),
        settings,
        density=DENSITY,
        youngs_modulus=YOUNG,
        poisson_ratio=nu,
        shift=shift,
    )
    boundaries: list[Boundary] = [Axial((1, 2))] if confined else []
    walls = [shift * dx, LENGTH + shift * dx][: {"free": 0, "fixed-free": 1, "fixed": 2}[ends]]
    if hold == "points" and walls:
        boundaries.append(wall_of(points, *walls))
    else:
        boxes = [Box([None] * 3, [walls[0], None, None])] if walls else []
        boxes += [Box([walls[1], None, None], [None] * 3)] if len(walls) == 2 else []
        boundaries += [PinnedRegion(box, "nodes") for box in boxes]
    rest = points.position[:, 0] - shift * dx
    inside = (rest > 0) & (rest < LENGTH)
    mode = torch.where(inside, torch.cos(wave * rest) if ends == "free" else torch.sin(wave * rest), 0.0)
    velocity = torch.zeros_like(points.position)
    velocity[:, 0] = strain * speed * mode
    solver = settings.solver(dx, boundaries=boundaries)
    state = solver.init_state(points, velocity)

    def amplitude(state: MPMState) -> Tensor:
        return ((state.position[:, 0] - points.position[:, 0]) * mode).sum() / mode.square().sum()

    period = 2 * math.pi / omega
    run = follow(solver, state, period / 16, 16 * periods, amplitude)
    found, rate = fit_sinusoid(run.time, run.series)
    fixed = {"free": 0, "fixed-free": 1, "fixed": 2}[ends]
    return run.result(
        abs(found / omega - 1),
        frequency=found / (2 * math.pi),
        loss=1 - math.exp(-rate * 2 * math.pi / found),
        end_shift=(omega / found - 1) * cells / fixed if fixed else 0.0,
    )


def kept_by_transfers(theta: float) -> float:
    """The share that APIC keeps of a wave of ``theta`` radians a cell in one transfer, two points to a cell (1D)."""

    def weight(x: float) -> float:
        return 0.75 - x * x if abs(x) < 0.5 else 0.5 * max(1.5 - abs(x), 0.0) ** 2

    mass = kept = 0j
    for x in (k / 2 + 0.25 for k in range(-4, 4)):  # the points around the node at 0
        nodes = [(i, weight(x - i) * cmath.exp(1j * theta * i)) for i in range(-4, 5)]
        velocity, affine = sum(w for _, w in nodes), 4 * sum(w * (i - x) for i, w in nodes)
        mass, kept = mass + weight(x), kept + weight(x) * (velocity - affine * x)
    return (kept / mass).real


def losses(cells: int = 16, periods: int = 2) -> Result:
    """Share of the amplitude that a free bar loses per period.

    Returns:
        With an ``adaptive`` and with a ``fixed`` substep in ``total``, and the ``ratio`` of the loss in ``updated``, at
        so small a strain that points keep their places in their cells, to what the transfers smooth of the kinetic half
        of the energy.
    """
    speed = math.sqrt(YOUNG * 0.7 / (1.3 * 0.4) / DENSITY)
    frame = 2 * LENGTH / speed / 16
    substep = frame / math.ceil(frame * speed * cells / (0.3 * LENGTH))  # of a Courant number of 0.3
    small = vibrating_bar(cells, Settings("updated", substep=substep), periods=periods, strain=0.001)
    smoothed = 0.5 * (1 - kept_by_transfers(math.pi / cells)) * small["substeps"] / periods
    return {
        "adaptive": vibrating_bar(cells, Settings())["loss"],
        "fixed": vibrating_bar(cells, Settings(substep=substep))["loss"],
        "ratio": small["loss"] / smoothed,
    }


def hanging_bar(
    cells: int,
    settings: Settings,
    clamp: str = "mirror",
    strain: float = 0.3,
    settle: float = 16.0,
    shift: float = 0.0,
) -> Result:
    r"""A bar that hangs from its top, stretched by its weight: :math:`u = \rho g (L X - X^2 / 2) / E`, X from the top.

    Exact at finite strain for fixed corotated elasticity with :math:`\nu = 0` (equilibrium in the rest configuration).
    The full load acts from the start, and critical damping of the lowest mode brings the bar to rest.

    The ``clamp`` ``mirror`` pulls both halves of a bar of twice the length away from its middle, which is at rest by
    symmetry: an ideal clamp. ``pin`` is a :class:`PinnedRegion` of two cells beyond the end that holds nodes,
    ``points`` are :class:`PinnedPoints` at the end.

    Units: ``strain`` at the top, rho g L / E; ``settle`` [1 / circular frequency of the lowest mode]; ``shift`` off
    the planes of the nodes [cells].

    Returns:
        ``error`` (of the displacement of the lowest points, relative to the closed form there), ``profile`` (root mean
        square of the error of all points, relative to the tip), ``end_shift`` (by how many cells the clamp appears
        farther up than it is), ``residual`` (speed of the tip, relative to its displacement and frequency) and the
        common quantities.
    """
    dx, speed = LENGTH / cells, math.sqrt(YOUNG / DENSITY)
    gravity = strain * YOUNG / (DENSITY * LENGTH)
    first = {"mirror": -cells, "pin": -_CLAMP, "points": 0}[clamp]
    points = block(
        dx,
        (first, 0, 0),
        (cells, 1, 1),
        settings,
        density=DENSITY,
        youngs_modulus=YOUNG,
        poisson_ratio=0.0,
        shift=shift,
    )
    omega = math.pi * speed / (2 * LENGTH)
    wall = shift * dx
    pins: list[Boundary] = []
    if clamp == "pin":
        pins.append(PinnedRegion(Box([None] * 3, [wall, None, None]), "nodes"))
    elif clamp == "points":
        pins.append(wall_of(points, wall))
    solver = settings.solver(dx, boundaries=pins, damping=2 * omega)
    along = points.position[:, 0] - shift * dx
    weight = torch.zeros_like(points.position)
    weight[:, 0] = points.mass * gravity * along.sign()
    run = follow(
        solver, solver.init_state(points), settle / omega / 64, 64, lambda s: s.position[:, 0], force=lambda _: weight
    )
    rest = along.double().cpu()
    exact = DENSITY * gravity / YOUNG * (LENGTH * rest - rest.square() / 2)
    moved = run.series[-1] - run.series[0]
    tip = rest > rest.max() - 0.1 * dx
    drop, known = moved[tip].mean(), exact[tip].mean()
    velocity = run.state.velocity[:, 0].double().cpu()[tip].abs().max()
    return run.result(
        float(abs(drop / known - 1)),
        profile=float((moved - exact)[rest > 0].square().mean().sqrt() / known),
        end_shift=float((drop - known) / (strain * dx)),
        residual=float(velocity / (omega * known)),
    )


def free_block(
    settings: Settings, periods: int = 100, cells: int = 4, strain: float = 0.05, window: int = 10
) -> Result:
    r"""An elastic cube that vibrates freely, mostly by stretching, and slowly spins and moves.

    In symplectic Euler the velocity is half a substep before the displacement, so its energy oscillates by up to
    :math:`\omega \Delta t / 2`, relative, about a constant mean. A cube has many modes without a common period, so the
    mean is taken over several periods 2 L / c of the wave that crosses the cube and returns.

    Units: ``periods`` [2 L / c], a multiple of ``window``, the periods of a mean; ``strain`` rate [circular frequency
    of that wave].

    Returns:
        ``error`` (the largest change of the mean energy, relative to the first mean), ``kept`` (last mean over the
        first), ``last_J`` (last mean [J]), ``rise`` (largest growth from one mean to the next, relative), ``growth``
        (the largest energy at the end of any frame over the first one, less 1), ``swing`` (the bound omega dt / 2 of
        that for symplectic Euler), ``linear`` and ``angular`` (largest relative change of the momenta) and the common
        quantities.
    """
    dx, young, density, nu = 1.0 / cells, 1e4, 100.0, 0.3
    points = block(dx, (0, 0, 0), (cells,) * 3, settings, density=density, youngs_modulus=young, poisson_ratio=nu)
    speed = math.sqrt(young * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / density)
    omega = math.pi * speed
    arm = points.position - 0.5
    velocity = torch.zeros_like(arm)
    velocity[:, 0] = -strain * speed * torch.cos(math.pi * points.position[:, 0])
    spin = arm.new_tensor([0.02, -0.03, 0.05]) * omega
    velocity = velocity + torch.linalg.cross(spin.expand_as(arm), arm) + 0.01 * speed
    solver = settings.solver(dx)

    def watch(state: MPMState) -> Tensor:
        energies, momenta = solver.energies(state), solver.momenta(state)
        total = energies["kinetic"] + energies["elastic"]
        return torch.cat([total[None], momenta["linear"], momenta["angular"]])

    frames = 8
    run = follow(solver, solver.init_state(points, velocity), 2 / speed / frames, frames * periods, watch)
    energy, linear, angular = run.series[:, 0], run.series[:, 1:4], run.series[:, 4:]
    mean = energy[1:].reshape(-1, frames * window).mean(-1)
    return run.result(
        float((mean / mean[0] - 1).abs().max()),
        kept=float(mean[-1] / mean[0]),
        last_J=float(mean[-1]),
        rise=float((mean[1:] / mean[:-1] - 1).max()) if len(mean) > 1 else 0.0,
        growth=float(energy.max() / energy[0] - 1),
        swing=0.5 * omega * float(run.state.time) / run.substeps,
        linear=float((linear - linear[0]).norm(dim=-1).max() / linear[0].norm()),
        angular=float((angular - angular[0]).norm(dim=-1).max() / angular[0].norm()),
    )
