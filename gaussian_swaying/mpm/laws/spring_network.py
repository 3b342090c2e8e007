"""A network of springs that are linear in their length."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import from_principal, spectrum
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.shared import LOG_LIMIT, spectral_moduli
from gaussian_swaying.mpm.twins import Twin


def spring_network_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density of a network of springs that are linear in their length [J/m³].

    With m the smaller of :math:`\mu` and :math:`\lambda` (0 where that is negative) and :math:`K = 15 \, m`,

    .. math::
        \Psi = \tfrac{K}{2} \langle (\lvert F e \rvert - 1)^2 \rangle_e
        + (\mu - m) \lVert S - I \rVert^2 + \tfrac{\lambda - m}{2} (\operatorname{tr} S - 3)^2 .

    The mean over all directions e is the mean over the 26 directions of Lebedev's rule of degree 7, aligned with the
    principal axes: the axes, the diagonals of their planes and the space diagonals, with weights 2/21, 16/105 and 9/35
    for each axis, for each plane and for the four space diagonals together. For small strain it is Hooke's law with
    equal Lamé parameters (Cauchy's solid); the other terms add what is missing from the given parameters. It stiffens
    in tension like a lattice of springs, the model of most cloth solvers; fixed corotated elasticity softens. Lengths
    of diagonals below 0.05 are continued by their tangent.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    a = spectrum(F).stretch
    least, shear, bulk = _network_parts(mu, lam)
    plane, space = (_continued_root(x) - 1 for x in _network_squares(a))
    mean = 2 / 21 * (a - 1).square().sum(-1) + 16 / 105 * plane.square().sum(-1) + 9 / 35 * space.square()[..., 0]
    return 7.5 * least * mean + shear * (a - 1).square().sum(-1) + 0.5 * bulk * (a.sum(-1) - 3).square()


def _network_parts(mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The modulus m of the network and what is left for the two other terms [Pa]."""
    least = torch.minimum(mu, lam).clamp(min=0)
    return least, mu - least, lam - least


def _network_squares(a: Tensor) -> tuple[Tensor, Tensor]:
    """Squared lengths of the diagonals of each plane (..., 3), named by its normal axis, and of space (..., 1)."""
    squares = a.square()
    total = squares.sum(-1, keepdim=True)
    return 0.5 * (total - squares), total / 3


def _continued_root(x: Tensor) -> Tensor:
    """Square root, continued by its tangent where it is below 0.05."""
    inside = x.clamp(min=LOG_LIMIT**2)
    root = inside.sqrt()
    return root + (x - inside) / (2 * root)


def _spring_pull(square: Tensor) -> Tensor:
    """Derivative of half the square of a spring's extension by half the square of its length l: (l - 1) / l."""
    return (_continued_root(square) - 1) / square.clamp(min=LOG_LIMIT**2).sqrt()


def _network_slope(a: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Derivative (..., 3) [Pa] of the energy of a network by the principal stretches (..., 3)."""
    least, shear, bulk = (part[..., None] for part in _network_parts(mu, lam))
    plane, space = _network_squares(a)
    pull, whole = _spring_pull(plane), _spring_pull(space)
    others = pull.sum(-1, keepdim=True) - pull  # the two planes that contain an axis
    mean = 2 / 21 * (a - 1) + a * (8 / 105 * others + 3 / 35 * whole)
    return 15 * least * mean + 2 * shear * (a - 1) + bulk * (a.sum(-1, keepdim=True) - 3)


def spring_network_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`U \operatorname{diag}(\partial \Psi / \partial a_i) V^T` [Pa].

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    return from_principal(spectrum(F), lambda a: _network_slope(a, mu, lam), rotated=True)


def spring_network_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds on the stiffness [Pa], as :func:`stvk_hencky_moduli`."""
    with torch.no_grad():
        a = spectrum(F.detach()).stretch
        least, shear, bulk = (part[..., None] for part in _network_parts(mu, lam))
        plane, space = _network_squares(a)
        pull, whole = _spring_pull(plane), _spring_pull(space)
        # derivative of (l - 1) / l by half the square of the length l; none where the length is continued
        turn, spread = (torch.where(x < LOG_LIMIT**2, 0.0, x.clamp(min=LOG_LIMIT**2).pow(-1.5)) for x in (plane, space))
        others, turns = (x.sum(-1, keepdim=True) - x for x in (pull, turn))
        common = 3 / 35 * (whole + spread / 3 * a.square())
        own = 15 * least * (2 / 21 + 8 / 105 * (others + 0.5 * turns * a.square()) + common) + 2 * shear + bulk
        mixed = torch.zeros_like(F)
        for i, j, k in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):  # a pair of axes, and the normal of their plane
            pair = a[..., i] * a[..., j] * (4 / 105 * turn[..., k] + spread[..., 0] / 35)
            mixed[..., i, j] = mixed[..., j, i] = 15 * least[..., 0] * pair + bulk[..., 0]
        slope = _network_slope(a, mu, lam)
        return spectral_moduli(a, slope, lambda s: _network_slope(s, mu, lam), own, mixed, mu, lam)


class SpringNetwork(ConstitutiveLaw):
    """Elastic solid of springs that are linear in their length: cloth, as in mass-spring solvers.

    It stiffens in tension, where fixed corotated elasticity softens: they differ by a tenth and more at a stretch of
    1.2.
    """

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return spring_network_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return spring_network_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return spring_network_moduli(F, mu, lam)

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.spring_network import FUNCTIONS

        return Twin(FUNCTIONS)
