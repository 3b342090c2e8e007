"""Neo-Hookean elasticity."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import cofactor, determinant
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.shared import LOG_LIMIT, continued_log, log_slope, volumetric_moduli
from gaussian_swaying.mpm.twins import Twin


def neo_hookean_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density :math:`\tfrac{\mu}{2} (\operatorname{tr} F^T F - 3) - \mu \, l + \tfrac{\lambda}{2} l^2` [J/m³].

    Bonet & Wood 2008, "Nonlinear continuum mechanics for finite element analysis", section 6.4.3, with l = log J
    continued by its tangent below J = 0.05 (:func:`continued_log`).

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    log = continued_log(determinant(F))
    return 0.5 * mu * (F.square().sum((-1, -2)) - 3) - mu * log + 0.5 * lam * log.square()


def neo_hookean_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`\mu F + (\lambda l - \mu) \, l'(J) \operatorname{cof} F` [Pa].

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    cof = cofactor(F)
    det = determinant(F, cof)
    slope = (lam * continued_log(det) - mu) * log_slope(det)
    return mu[..., None, None] * F + slope[..., None, None] * cof


def neo_hookean_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds on the stiffness [Pa], as :func:`fixed_corotated_moduli`."""
    det = determinant(F)
    log, first = continued_log(det), log_slope(det)
    second = torch.where(det < LOG_LIMIT, 0.0, -first.square())
    wave, bound = volumetric_moduli(F, mu, (lam * log - mu) * first, lam * first.square() + (lam * log - mu) * second)
    return torch.maximum(wave, 2 * mu + lam), torch.maximum(bound, 2 * mu + 3 * lam.clamp(min=0))


class NeoHookean(ConstitutiveLaw):
    """Elastic solid that resists crushing without limit. It is the cheapest law: it needs no polar decomposition."""

    least_nu = 0.0

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return neo_hookean_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return neo_hookean_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return neo_hookean_moduli(F, mu, lam)

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.neo_hookean import FUNCTIONS

        return Twin(FUNCTIONS)
