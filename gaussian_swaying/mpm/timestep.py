r"""The length of substeps: stable limits, and the number of substeps in a frame.

For quadratic B-splines the sum :math:`\sum_i \nabla w_i \nabla w_i^T / w_i` of one particle is diagonal with entries
between 4 and 6 over :math:`\Delta x^2`. With lumped masses this bounds the highest frequency of any arrangement of
particles by that of a single one, :math:`\omega^2 \le 6 K / (\rho \Delta x^2)`, where K is the largest stiffness of the
material against a deformation gradient of norm one; symplectic Euler is stable for :math:`\Delta t \le 2 / \omega`.
"""

import math

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import largest_eigenvalue
from gaussian_swaying.kernels.graphs import Repeater
from gaussian_swaying.mpm.dispatch import LawDispatch
from gaussian_swaying.mpm.laws.law import lame_parameters
from gaussian_swaying.mpm.state import MaterialPoints, MPMState

MAX_CFL = 2.0
"""Courant number above which waves cross more than two cells in a substep and nothing is stable.

Inside a body with evenly spread points, a wave along an axis is unstable from 1.63 on, as the largest frequency of the
splines with lumped masses is sqrt(3/2) c / dx.
"""


def wave_speed(
    points: MaterialPoints,
    F: Tensor | None = None,
    internal: Tensor | None = None,
    *,
    spatial: bool = False,
    laws: LawDispatch | None = None,
) -> Tensor:
    r"""Speed of the fastest elastic wave [m/s]: :math:`\sqrt{(\lambda + 2 \mu) / \rho}` at rest.

    A deformed material may be stiffer; its law says how much (``ConstitutiveLaw.moduli``).

    Args:
        points: Material, shapes (..., P).
        F: Elastic deformation gradient, shape (..., P, 3, 3); None for the rest state.
        internal: Internal variable of the law, shape (..., P), if any has one.
        spatial: Also account for the stretch of space (``updated`` formulation: waves cross a stretched cell sooner).
        laws: The laws of ``points``, if already available.

    Returns:
        Shape (..., P).
    """
    density = points.mass / points.volume
    if F is None:
        mu, lam = lame_parameters(points.youngs_modulus, points.poisson_ratio)
        return ((lam + 2 * mu) / density).sqrt()
    squared = (laws or LawDispatch(points)).moduli(F, internal)[0] / density
    if spatial:
        squared = squared * largest_eigenvalue(F.mT @ F).clamp(min=1.0)
    return squared.sqrt()


def stable_limit(
    points: MaterialPoints,
    dx: float,
    F: Tensor | None = None,
    internal: Tensor | None = None,
    *,
    spatial: bool = False,
    laws: LawDispatch | None = None,
) -> Tensor:
    r"""Longest substep [s] that is stable for every arrangement of particles (see the module docstring).

    Args:
        points: Material, shapes (..., P).
        dx: Grid spacing [m].
        F: Elastic deformation gradient, shape (..., P, 3, 3); None for the rest state, where
            :math:`K = 2 \mu + 3 \lambda`.
        internal: Internal variable of the law, shape (..., P), if any has one.
        laws: The laws of ``points``, if already available.

    Returns:
        Shape (..., P).
    """
    density = points.mass / points.volume
    if F is None:
        mu, lam = lame_parameters(points.youngs_modulus, points.poisson_ratio)
        stiffness = 2 * mu + 3 * lam.clamp(min=0)
    else:
        stiffness = (laws or LawDispatch(points)).moduli(F, internal)[1]
        if spatial:
            stiffness = stiffness * (F.square().sum((-1, -2)) / 3).clamp(min=1.0)
    return dx * (density / stiffness).sqrt() * (2 / math.sqrt(6))


def substeps_per_frame(frame_dt: float, substep: float, *, exact: bool) -> int:
    """Number of equal substeps in a frame.

    Args:
        frame_dt: Length of a frame [s].
        substep: Longest allowed substep [s] or, with ``exact``, the wanted one.

    Returns:
        At least 1.
    """
    ratio = frame_dt / substep if substep > 0 else math.inf
    if not ratio < 2**53:
        raise ValueError(
            f"A frame of {frame_dt:g} s takes more substeps of {substep:.3g} s than can be counted: soften the "
            "material, raise its density or the grid spacing `dx`, or shorten the frame."
        )
    return max(1, round(ratio) if exact else math.ceil(ratio - 1e-6))


def fixed_substeps(frame_dt: float, substep: float, limit: float, dx: float) -> int:
    """Number of equal substeps in a frame for a fixed substep.

    Args:
        frame_dt: Length of a frame [s].
        substep: The fixed substep [s].
        limit: The stable one [s].
        dx: Grid spacing [m], for the message.
    """
    if substep > limit * (1 + 1e-6):
        raise ValueError(
            f"The fixed `substep` of {substep:g} s is longer than the stable one of {limit:.4g} s (at dx "
            f"= {dx:g} m and this material): lower it, or set it to null for the adaptive substep."
        )
    steps = substeps_per_frame(frame_dt, substep, exact=True)
    return steps if frame_dt / steps <= limit * (1 + 1e-6) else steps + 1


def check_pace(dt: float, cells: float, name: str) -> None:
    """Raise ValueError if an obstacle would skip nodes in a substep of ``dt`` [s]."""
    if dt * cells > 1:
        raise ValueError(
            f"An obstacle moves by {dt * cells:.3g} cells in a substep of {dt:g} s, so it would pass through the "
            f"material: lower `{name}` to at most {1 / cells:.3g} s."
        )


def rounding_speed(speed: float, dt: float, steps: float, dx: float, dtype: torch.dtype) -> float:
    r"""Speed up to which rounding of F shakes a material at rest within some substeps [m/s].

    The diagonal of :math:`F = I + \nabla u` is rounded to a multiple of eps above one and of eps / 2 below, with a mean
    square error of :math:`s^2 = 5/96\,\mathrm{eps}^2` (even in each interval). With :math:`M = \lambda + 2 \mu \ge
    \lambda` the diagonal of the stress is then off by at most :math:`\sqrt 3 M s`. The forces of these errors on the
    nodes are kicks. As in the module docstring, each node's kick is bounded by those of single particles (Cauchy and
    Schwarz), so that a substep adds at most :math:`27 s^2 c^2 (c \Delta t / \Delta x)^2` per mass to the energy, on
    average. The kicks of n substeps are independent while strains change by more than eps in a substep, and their
    energies add up:

    .. math:: v = \sqrt{54 \cdot 5/96}\;\mathrm{eps}\;c\;\frac{c \Delta t}{\Delta x} \sqrt n

    Evenly filled cells have a tenth of this speed or so, as the errors of their particles cancel.

    Args:
        speed: Speed of the fastest wave c [m/s].
        dt: Substep [s].
        dx: Grid spacing [m].
    """
    return math.sqrt(54 * 5 / 96 * steps) * torch.finfo(dtype).eps * speed * speed * dt / dx


def kick_time(state: MPMState, dt: float) -> float:
    """Time for which forces act in a substep of ``dt`` [s]; see ``MPMSolver.step``."""
    return min(0.5 * (state.substep + dt), 2 * dt) if state.substep > 0 else dt


@torch.no_grad()
def work_done(state: MPMState, after: MPMState, dt: float, force: Tensor, drag: Tensor | None) -> Tensor:
    """Work of the external force up to the end of a substep [J].

    It is computed at the mean velocity, which gives exactly what the step adds to the kinetic energy; with ``drag``,
    which acts at the nodes before boundaries do, to first order in the substep.
    """
    if drag is not None:
        force = force - drag[..., None] * (after.velocity - state.velocity)
    power = torch.linalg.vecdot(force, state.velocity + after.velocity).sum(-1)
    return state.work + ((0.5 * kick_time(state, dt)) * power).to(state.work.device)


def cfl_number(dt: float | Tensor, dx: float, speed: Tensor, velocity: Tensor | None) -> Tensor:
    """Largest Courant number ``dt (c + |v|) / dx``; leave out ``velocity`` where stencils do not move."""
    total = speed if velocity is None else speed + torch.linalg.vector_norm(velocity, dim=-1)
    return (dt * total / dx).amax()


def look_marks(steps: int, looks: int) -> list[int]:
    """Substeps after which to check: multiples of a CUDA graph's substeps, and the last one."""
    unit = max(size for size in Repeater.SIZES if size == 1 or looks * size <= 2 * steps)
    return sorted({min(unit * math.ceil((k + 1) * steps / (looks * unit)), steps) for k in range(looks)})
