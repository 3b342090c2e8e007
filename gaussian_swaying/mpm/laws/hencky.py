"""Hencky elasticity: an energy quadratic in the logarithmic stretches."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import from_principal, spectrum
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.shared import LOG_LIMIT, continued_log, log_slope, spectral_moduli
from gaussian_swaying.mpm.twins import Twin


def stvk_hencky_energy(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Energy density :math:`\mu \sum_i l_i^2 + \tfrac{\lambda}{2} (\sum_i l_i)^2` [J/m³] with :math:`l_i = \log a_i`.

    Hencky 1928; the quadratic energy of the logarithmic principal stretches, which return maps of plasticity need
    (Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation"). Below a stretch of 0.05 the logarithm is
    continued by its tangent (:func:`continued_log`).

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (...).
    """
    log = continued_log(spectrum(F).stretch)
    return mu * log.square().sum(-1) + 0.5 * lam * log.sum(-1).square()


def _hencky_slope(stretch: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Derivative (..., 3) [Pa] of the Hencky energy by the principal stretches (..., 3)."""
    log = continued_log(stretch)
    tau = 2 * mu[..., None] * log + lam[..., None] * log.sum(-1, keepdim=True)
    return tau * log_slope(stretch)


def stvk_hencky_pk1(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`R V \operatorname{diag}((2 \mu l_i + \lambda \sum l) \, l'(a_i)) V^T` [Pa].

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    return from_principal(spectrum(F), lambda a: _hencky_slope(a, mu, lam), rotated=True)


def stvk_hencky_moduli(F: Tensor, mu: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    r"""Bounds on the stiffness [Pa] (see :mod:`~gaussian_swaying.mpm.laws.shared`), without gradient.

    With :math:`y_i = \partial \Psi / \partial a_i` and :math:`H_{ij} = \partial y_i / \partial a_j`, the eigenvalues of
    the Hessian are those of H and, for each pair, :math:`(y_i + y_j) / (a_i + a_j)` and
    :math:`(y_i - y_j) / (a_i - a_j)`. On :math:`m \otimes N` each :math:`H_{ij}` may be shifted from the former to the
    latter, which leaves the largest of :math:`H_{ii}` and of the two quotients less and plus :math:`H_{ij}`.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        ``wave`` and ``bound``, shape (...).
    """
    with torch.no_grad():
        a = spectrum(F.detach()).stretch
        y, slope = _hencky_slope(a, mu, lam), log_slope(a)
        own = (2 * mu[..., None] - torch.where(a < LOG_LIMIT, 0.0, y / slope)) * slope.square()
        mixed = lam[..., None, None] * slope[..., :, None] * slope[..., None, :]
        own = own + mixed.diagonal(dim1=-2, dim2=-1)
        return spectral_moduli(a, y, lambda s: _hencky_slope(s, mu, lam), own, mixed, mu, lam)


class StVKHencky(ConstitutiveLaw):
    """Elastic solid with an energy quadratic in the logarithmic stretches, the base of the plastic solids.

    It softens in tension beyond a stretch of about e, so do not use it for rubber.
    """

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return stvk_hencky_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return stvk_hencky_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return stvk_hencky_moduli(F, mu, lam)

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.hencky import FUNCTIONS

        return Twin(FUNCTIONS)
