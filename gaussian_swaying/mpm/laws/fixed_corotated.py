"""Fixed corotated elasticity."""

from __future__ import annotations

import math

from torch import Tensor

from gaussian_swaying.geometry.linalg import cofactor, determinant, matmul3, polar_rotation, symmetric_eigenvalues
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.twins import Twin


def fixed_corotated_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density :math:`\mu \lVert F - R \rVert^2 + \tfrac{\lambda}{2} (J - 1)^2` [J/m³].

    Stomakhin et al. 2012, "Energetically consistent invertible elasticity".

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    return mu * (F - polar_rotation(F)).square().sum((-1, -2)) + 0.5 * lam * (determinant(F) - 1).square()


def fixed_corotated_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`2 \mu (F - R) + \lambda (J - 1) \operatorname{cof} F` [Pa].

    The cofactor form needs no inverse, so it is also finite for a crushed element.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    cof = cofactor(F)
    pressure = lam * (determinant(F, cof) - 1)
    return 2 * mu[..., None, None] * (F - polar_rotation(F)) + pressure[..., None, None] * cof


def fixed_corotated_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bounds on the stiffness [Pa]; :math:`\lambda + 2 \mu, 3 \lambda + 2 \mu` at rest.

    See :mod:`~gaussian_swaying.mpm.laws.shared` for what they bound.

    The term in mu adds at most :math:`2 \mu`, the term in lambda is
    :math:`\lambda (\operatorname{cof} F \otimes \operatorname{cof} F + (J - 1) M)`.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        ``wave`` and ``bound``, shape (...).
    """
    cof = cofactor(F)
    area = symmetric_eigenvalues(matmul3(cof.mT, cof))[..., 0]
    excess = (determinant(F, cof) - 1).abs() * F.square().sum((-1, -2)).sqrt()
    growth = cof.square().sum((-1, -2)) + 2 / math.sqrt(3) * excess
    return 2 * mu + lam * area.clamp(min=1.0), 2 * mu + lam.clamp(min=0) * growth.clamp(min=3.0)


class FixedCorotated(ConstitutiveLaw):
    """Elastic solid that stays defined when crushed or inverted: foliage, cloth, rubber at moderate strain."""

    least_nu = 0.0

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return fixed_corotated_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return fixed_corotated_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return fixed_corotated_moduli(F, mu, lam)

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.fixed_corotated import FUNCTIONS

        return Twin(FUNCTIONS)
