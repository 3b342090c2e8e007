r"""A manufactured solution with large rotation and shear: the generalised vortex (Kamojjala et al. 2015).

Kamojjala, Brannon, Sadeghirad & Guilkey, "Verification tests in solid mechanics", Engineering with Computers 31, 193:
every circle of an annulus rotates rigidly by :math:`\alpha(R, t) = G(t)\, h(R)`, with
:math:`h = 1 - 32 (R - 1)^2 + 256 (R - 1)^4` on :math:`0.75 < R < 1.25`. Both h and its slope are zero on the rims, so
the rims are free of load. Here :math:`G = A \sin^2(\pi t / T)`, which starts from rest.

The annulus is filled with rings of points, so that its rims are round and the error is that of the method.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bench.problems.settings import Axial, Result, Settings, follow
from gaussian_swaying.mpm.state import MaterialPoints, MPMState

YOUNG, POISSON, DENSITY, PERIOD = 1000.0, 0.3, 1000.0, 1.0  # [Pa], [kg/m³], [s]


def turning(time: Tensor, amplitude: float) -> tuple[Tensor, Tensor, Tensor]:
    """G and its first two derivatives in time [rad, rad/s, rad/s²]."""
    rate = 2 * math.pi / PERIOD
    phase = rate * time
    half = 0.5 * amplitude
    return half * (1 - torch.cos(phase)), half * rate * torch.sin(phase), half * rate**2 * torch.cos(phase)


def _profile(radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    s = radius - 1
    return 1 - 32 * s**2 + 256 * s**4, -64 * s + 1024 * s**3, -64 + 3072 * s**2


def placement(rest: Tensor, time: Tensor, amplitude: float) -> Tensor:
    """Positions of the points of the vortex [m], shape (..., 3)."""
    angle = turning(time, amplitude)[0].to(rest) * _profile(rest[..., :2].norm(dim=-1))[0]
    c, s = torch.cos(angle), torch.sin(angle)
    x, y, z = rest.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)


def body_force(rest: Tensor, time: Tensor, amplitude: float, mu: float, density: float) -> Tensor:
    r"""Force per mass [m/s²] that drives the vortex: acceleration less :math:`\operatorname{Div} P / \rho`.

    In the polar basis turned by :math:`\alpha` the motion is a simple shear of amount :math:`\gamma = G R h'`. Its
    rotation is :math:`\varphi = \arctan(\gamma / 2)` and its volume is constant, so fixed corotated elasticity gives
    :math:`P_{RR} = P_{\theta\theta} = 2 \mu (1 - \cos\varphi)`, :math:`P_{R\theta} = 2 \mu \sin\varphi` and
    :math:`P_{\theta R} = 2 \mu (\gamma - \sin\varphi)`; the divergence is taken in polar coordinates.

    Units: ``rest`` [m]; ``time`` [s]; ``amplitude`` [rad]; ``mu`` [Pa]; ``density`` [kg/m³].

    Returns:
        Shape (..., 3).
    """
    g, g1, g2 = (v.to(rest) for v in turning(time, amplitude))
    radius = rest[..., :2].norm(dim=-1)
    h, h1, h2 = _profile(radius)
    gamma, gamma1, twist = g * radius * h1, g * (h1 + radius * h2), g * h1
    phi = torch.atan(gamma / 2)
    phi1 = 0.5 * gamma1 / (1 + gamma.square() / 4)
    normal, shear, across = 1 - torch.cos(phi), gamma - torch.sin(phi), torch.sin(phi)
    # along the turned radius and the turned circle
    div_r = torch.sin(phi) * phi1 - twist * shear
    div_t = gamma1 - torch.cos(phi) * phi1 + twist * normal + (shear + across) / radius
    stiff = 2 * mu / density
    force_r = -radius * (g1 * h).square() - stiff * div_r
    force_t = radius * g2 * h - stiff * div_t
    x, y, z = placement(rest, time, amplitude).unbind(-1)
    x, y = x / radius, y / radius
    return torch.stack([force_r * x - force_t * y, force_r * y + force_t * x, torch.zeros_like(z)], dim=-1)


def annulus(cells: int) -> tuple[Tensor, Tensor]:
    """Rings of points, two per cell along the radius and along each ring, one cell thick.

    Returns:
        Positions [m], shape (P, 3), and volumes [m³], shape (P,), float64.
    """
    rings = cells
    spacing = 0.5 / rings
    position, volume = [], []
    for k in range(rings):
        radius = 0.75 + (k + 0.5) * spacing
        count = round(4 * math.pi * radius * cells)
        # neighbouring rings are shifted against each other, and none is aligned with the axes
        angle = (torch.arange(count, dtype=torch.float64) + 0.1 + 0.5 * (k % 2)) * (2 * math.pi / count)
        position.append(radius * torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)], dim=-1))
        volume.append(torch.full_like(angle, 2 * math.pi * radius * spacing / (count * cells)))
    return torch.cat(position), torch.cat(volume)


def vortex(cells: int, settings: Settings, amplitude: float = 1.0, part: float = 0.5) -> Result:
    """Follow the vortex in plane strain.

    The velocity of symplectic Euler is half a substep before its displacement, so it starts with the exact velocity at
    that time.

    Units: ``amplitude`` [rad].

    Returns:
        ``error`` (root mean square of the error of the displacement at the end, relative to the largest root mean
        square displacement), ``worst`` (the largest such error at any frame) and the common quantities.
    """
    dx = 1.0 / cells
    rest, volume = (v.to(settings.device, settings.dtype) for v in annulus(cells))
    points = MaterialPoints.create(rest, volume=volume, density=DENSITY, youngs_modulus=YOUNG, poisson_ratio=POISSON)
    mu = YOUNG / (2 * (1 + POISSON))
    solver = settings.solver(dx, boundaries=[Axial((2,))])
    frames = max(round(32 * part), 1)
    frame = part * PERIOD / frames
    zero = torch.zeros((), dtype=torch.float64, device=rest.device)
    half = frame / solver.substeps(solver.init_state(points), frame) / 2
    rate = turning(zero - half, amplitude)[1].to(rest) * _profile(rest[:, :2].norm(dim=-1))[0]
    before = placement(rest, zero - half, amplitude)
    velocity = rate[:, None] * torch.stack([-before[:, 1], before[:, 0], torch.zeros_like(rate)], dim=-1)

    def force(state: MPMState) -> Tensor:
        return points.mass[:, None] * body_force(rest, state.time, amplitude, mu, DENSITY)

    def watch(state: MPMState) -> Tensor:
        exact = placement(rest, state.time, amplitude)
        off = (state.position - exact).square().sum(-1).mean().sqrt()
        return torch.stack([off, (exact - rest).square().sum(-1).mean().sqrt()])

    run = follow(solver, solver.init_state(points, velocity), frame, frames, watch, force)
    largest = float(run.series[:, 1].max())
    return run.result(float(run.series[-1, 0]) / largest, worst=float(run.series[:, 0].max()) / largest)
