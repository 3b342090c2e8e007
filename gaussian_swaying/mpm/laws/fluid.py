"""A weakly compressible fluid."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg import cofactor, determinant
from gaussian_swaying.mpm.laws.law import PlasticLaw
from gaussian_swaying.mpm.laws.shared import FLUID_LIMIT, LOG_LIMIT, volumetric_moduli
from gaussian_swaying.mpm.twins import Numbers, Twin


def bulk_modulus(mu: Tensor, lam: Tensor) -> Tensor:
    """Bulk modulus K [Pa] from the Lamé parameters, elementwise."""
    return lam + 2 / 3 * mu


def fluid_pressure(det: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    r"""Pressure :math:`p = \tfrac{K}{\gamma} (J^{-\gamma} - 1)` [Pa] of a weakly compressible fluid.

    Monaghan 1994, "Simulating free surface flows with SPH", after Tait; below J = 0.5 continued by its tangent.

    Args:
        det: Volume ratio J, shape (...).
        mu: Shear modulus [Pa], shape (...); used only for the bulk modulus.
        lam: First Lamé parameter [Pa], shape (...).
        gamma: Exponent, above one.

    Returns:
        Shape (...).
    """
    bulk, inside = bulk_modulus(mu, lam), det.clamp(min=FLUID_LIMIT)
    return bulk / gamma * (inside.pow(-gamma) - 1) - bulk * inside.pow(-gamma - 1) * (det - inside)


def fluid_energy(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    r"""Energy density [J/m³] whose derivative by J is minus :func:`fluid_pressure`; zero at J = 1.

    :math:`\tfrac{K}{\gamma} (J - 1 + (J^{1 - \gamma} - 1) / (\gamma - 1))`, below J = 0.5 continued as a parabola.

    Args:
        F: Deformation gradient, shape (..., 3, 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).
        gamma: Exponent, above one.

    Returns:
        Shape (...).
    """
    det = determinant(F)
    bulk, inside = bulk_modulus(mu, lam), det.clamp(min=FLUID_LIMIT)
    rest = det - inside
    pressure = bulk / gamma * (inside.pow(-gamma) - 1)
    energy = bulk / gamma * (inside - 1 + (inside.pow(1 - gamma) - 1) / (gamma - 1))
    return energy - pressure * rest + 0.5 * bulk * inside.pow(-gamma - 1) * rest.square()


def fluid_pk1(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    r"""First Piola-Kirchhoff stress :math:`-p \operatorname{cof} F` [Pa], arguments as :func:`fluid_energy`."""
    cof = cofactor(F)
    return -fluid_pressure(determinant(F, cof), mu, lam, gamma)[..., None, None] * cof


def fluid_kirchhoff(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> Tensor:
    """Kirchhoff stress -p J I [Pa], arguments as :func:`fluid_energy`; shape (..., 3, 3)."""
    det = determinant(F)
    pressure = -fluid_pressure(det, mu, lam, gamma) * det
    return pressure[..., None, None] * torch.eye(3, dtype=F.dtype, device=F.device)


def fluid_moduli(F: Tensor, mu: Tensor, lam: Tensor, gamma: float = 7.0) -> tuple[Tensor, Tensor]:
    """Bounds on the stiffness [Pa], as :func:`fixed_corotated_moduli`; K and 3 K at rest."""
    det, bulk = determinant(F), bulk_modulus(mu, lam)
    curvature = bulk * det.clamp(min=FLUID_LIMIT).pow(-gamma - 1)
    wave, bound = volumetric_moduli(F, 0.0, -fluid_pressure(det, mu, lam, gamma), curvature)
    return torch.maximum(wave, bulk), torch.maximum(bound, 3 * bulk)


def fluid_flow(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor | None,
    dt: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor | None]:
    """Fluid: keeps the volume ratio J, at least 0.05, and discards the change of shape.

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...); not used.
        lam: First Lamé parameter [Pa], shape (...); not used.
        internal: Returned unchanged.
        dt: Substep [s]; not used.

    Returns:
        Stretches (..., 3), all the cube root of J, and ``internal``.
    """
    volume = (stretch[..., 0] * stretch[..., 1] * stretch[..., 2]).clamp(min=LOG_LIMIT)
    return volume.pow(1 / 3)[..., None].expand_as(stretch), internal


class Fluid(PlasticLaw):
    """Weakly compressible fluid without viscosity; it uses only the bulk modulus lambda + 2/3 mu of the particles.

    Args:
        gamma: Exponent of the density in the pressure, above 1; 7 for water.
    """

    def __init__(self, gamma: float = 7.0) -> None:
        super().__init__()
        if not 1 < gamma < float("inf"):
            raise ValueError(f"Expected `gamma` to be finite and above 1, but got {gamma}; use 7 for water.")
        self.gamma = float(gamma)

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.fluid import FUNCTIONS

        return Twin(FUNCTIONS, numbers=Numbers(1, lambda: (self.gamma,)))

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return fluid_energy(F, mu, lam, self.gamma)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return fluid_pk1(F, mu, lam, self.gamma)

    def kirchhoff(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        return fluid_kirchhoff(F, mu, lam, self.gamma)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return fluid_moduli(F, mu, lam, self.gamma)

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        return fluid_flow(stretch, mu, lam, internal)
