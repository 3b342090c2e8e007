"""Elastic laws as pure functions of the deformation gradient."""

from torch import Tensor

from gaussian_swaying.mpm.linalg import cofactor, determinant, matmul3, polar_rotation


def lame_parameters(youngs_modulus: Tensor, poisson_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """Shear modulus mu and first Lamé parameter lambda [Pa] from E [Pa] and nu, elementwise."""
    mu = youngs_modulus / (2 * (1 + poisson_ratio))
    return mu, youngs_modulus * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))


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

    The cofactor form needs no inverse, so it is finite for a crushed element too.

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


def fixed_corotated_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    r"""Kirchhoff stress :math:`\tau = P F^T = 2 \mu (F - R) F^T + \lambda (J - 1) J I` [Pa].

    Paper, supplement, "Fixed Corotated Elasticity" (where the identity in the second term is missing).

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).

    Returns:
        Symmetric, shape (..., 3, 3).
    """
    return matmul3(fixed_corotated_pk1(F, mu, lam), F.mT)
