r"""Regularised collision of a lattice Boltzmann flow, with a Smagorinsky model of what the cells do not resolve.

After a regularised collision the 27 populations of a cell follow from ten moments, so only these are kept:

.. math:: \delta\rho = \rho - 1, \quad \mathbf u, \quad N = \Pi^{neq} \text{ after the collision},

as ``moments`` of shape (10, ...): density, velocity (x, y, z), and xx, yy, zz, xy, xz, yz of N, in units of the
lattice. The populations are the Hermite series up to third order with the recursive coefficients of Malaspinas (2015,
arXiv:1505.06900),

.. math:: f_i = w_i \Bigl(\rho + 3\,\mathbf c_i\cdot\rho\mathbf u
    + \tfrac92 \mathcal H^{(2)}_i : (\rho\mathbf{uu} + N) + \tfrac{27}{6} \mathcal H^{(3)}_i \vdots\, a^{(3)}\Bigr),
    \qquad a^{(3)}_{abc} = \rho u_a u_b u_c + u_a N_{bc} + u_b N_{ac} + u_c N_{ab}
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.air.lattice import DIRECTIONS, WEIGHTS

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""The axes of the six numbers of a symmetric tensor."""

MOMENTS = 4 + len(PAIRS)
"""Numbers that are kept for a cell."""


def population(moments: Tensor, number: int) -> Tensor:
    """The population of one velocity, less its weight, so that small differences keep their digits.

    Args:
        moments: Shape (10, ...).
        number: Number of the velocity in ``lattice.DIRECTIONS``.

    Returns:
        Shape (...).
    """
    c = DIRECTIONS[number]
    excess, u = moments[0], moments[1:4]
    rho = 1 + excess
    N = {pair: moments[4 + k] for k, pair in enumerate(PAIRS)} | {
        (b, a): moments[4 + k] for k, (a, b) in enumerate(PAIRS)
    }
    total = excess.clone()
    for a in range(3):
        if c[a]:
            total = total + 3 * c[a] * rho * u[a]
    for a, b in PAIRS:
        hermite = c[a] * c[b] - (a == b) / 3
        if hermite:
            total = total + 4.5 * (1 if a == b else 2) * hermite * (rho * u[a] * u[b] + N[a, b])
    for a in range(3):
        for b in range(3):
            hermite = (c[a] * c[a] - 1 / 3) * c[b]
            if a != b and hermite:
                third = u[b] * (rho * u[a] * u[a] + N[a, a]) + 2 * u[a] * N[a, b]
                total = total + 13.5 * hermite * third
    if math.prod(c):
        third = rho * u[0] * u[1] * u[2] + u[0] * N[1, 2] + u[1] * N[0, 2] + u[2] * N[0, 1]
        total = total + 27 * math.prod(c) * third
    return WEIGHTS[number] * total


def sums(populations: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Density less one, momentum and second moment less that at rest, of the populations less their weights.

    Args:
        populations: One of shape (...) for each velocity.

    Returns:
        Shapes (...), (3, ...) and (6, ...).
    """
    excess = torch.zeros_like(populations[0])
    momentum = [torch.zeros_like(excess) for _ in range(3)]
    second = [torch.zeros_like(excess) for _ in range(6)]
    for c, f in zip(DIRECTIONS, populations, strict=True):
        excess = excess + f
        for a in range(3):
            if c[a]:
                momentum[a] = momentum[a] + c[a] * f
        for k, (a, b) in enumerate(PAIRS):
            if c[a] * c[b]:
                second[k] = second[k] + c[a] * c[b] * f
    return excess, torch.stack(momentum), torch.stack(second)


def relaxation_time(stress: Tensor, rho: Tensor, molecular: float | Tensor, smagorinsky: float) -> Tensor:
    r"""Relaxation time with the eddy viscosity of Smagorinsky, :math:`\nu_t = (C_s h)^2 |S|`.

    The strain rate follows from the stress before the collision, :math:`S = -\tfrac{3}{2\rho\tau}\Pi^{neq}`, which
    gives a quadratic equation for the time (Hou and others 1996):

    .. math:: \tau = \tfrac12 \Bigl(\tau_0 + \sqrt{\tau_0^2 + 18\sqrt2\, C_s^2 \sqrt{\Pi^{neq}:\Pi^{neq}} / \rho}\Bigr)

    Args:
        stress: :math:`\Pi^{neq}` before the collision, shape (6, ...).
        rho: Density, shape (...).
        molecular: :math:`\tau_0` [steps].
        smagorinsky: :math:`C_s`; 0 for none.

    Returns:
        Shape (...).
    """
    square = (stress[:3].square()).sum(0) + 2 * (stress[3:].square()).sum(0)
    return 0.5 * (molecular + (molecular**2 + 18 * math.sqrt(2) * smagorinsky**2 * square.sqrt() / rho).sqrt())


def collide(
    excess: Tensor, momentum: Tensor, second: Tensor, molecular: float, smagorinsky: float, push: Tensor | None = None
) -> Tensor:
    """The moments after a collision, from the sums of the populations that arrived; mass and momentum are kept.

    Args:
        excess: Density less one, shape (...).
        momentum: Shape (3, ...).
        second: Second moment less that at rest, shape (6, ...).
        molecular: Relaxation time of the molecular viscosity [steps].
        smagorinsky: Smagorinsky's constant.
        push: Velocity that a force adds in the step, broadcastable to (3, ...). It is added to the velocity of the
            equilibrium (exact difference, Kupershtokh 2004); the velocity at the time of the step has half of it.

    Returns:
        Moments, shape (10, ...).
    """
    rho = 1 + excess
    u = momentum / rho
    stress = torch.stack(
        [second[k] - rho * u[a] * u[b] - (excess / 3 if a == b else 0) for k, (a, b) in enumerate(PAIRS)]
    )
    kept = 1 - 1 / relaxation_time(stress, rho, molecular, smagorinsky)
    return torch.cat([excess[None], u if push is None else u + push, kept * stress])
