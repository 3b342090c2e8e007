"""Base classes of the laws: stress, energy, the stiffness that limits the time step and, if plastic, a return map."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from gaussian_swaying.geometry.linalg import from_principal, matmul3, spectrum
from gaussian_swaying.mpm.twins import Twinned


class ConstitutiveLaw(Twinned, nn.Module, ABC):
    """Base class of all laws.

    A law is a subclass with :meth:`energy`, :meth:`pk1` and :meth:`moduli`; a plastic law is a subclass of
    :class:`PlasticLaw` with ``flow``. That is all that the torch substep needs. To run in the Triton kernels too, a law
    has a ``twin`` (:mod:`~gaussian_swaying.mpm.twins`). Elastic stiffness belongs to the particles (Lamé parameters);
    all other parameters of a law are arguments of its constructor.

    Attributes:
        plastic: Whether there is a return map. The deformation gradient is then only the elastic part of the
            deformation since rest, which needs the ``updated`` formulation.
        internal: Initial value of the one internal variable of each particle, or None if there is none.
        least_nu: Poisson's ratio below which the energy has no least value, and strongly deformed material runs away.
    """

    plastic: bool = False
    internal: float | None = None
    least_nu: float = -1.0

    @abstractmethod
    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """Elastic energy density [J/m³].

        Args:
            F: Elastic deformation gradient, shape (..., 3, 3).
            mu: Shear modulus [Pa], shape (...).
            lam: First Lamé parameter [Pa], shape (...).
            internal: Internal variable, shape (...); None for its initial value.

        Returns:
            Shape (...).
        """

    @abstractmethod
    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """First Piola-Kirchhoff stress [Pa], shape (..., 3, 3); arguments as :meth:`energy`."""

    def kirchhoff(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """Kirchhoff stress P F^T [Pa], symmetric, shape (..., 3, 3); arguments as :meth:`energy`."""
        return matmul3(self.pk1(F, mu, lam, internal), F.mT)

    def return_map(
        self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Elastic deformation gradient and internal variable after plastic flow.

        Args:
            F: Trial deformation gradient, as if the substep were elastic, shape (..., 3, 3).
            mu: Shear modulus [Pa], shape (...).
            lam: First Lamé parameter [Pa], shape (...).
            internal: Internal variable, shape (...), or None if the law has none.
            dt: Substep [s].

        Returns:
            Shapes (..., 3, 3) and (...) or None.
        """
        return F, internal

    @abstractmethod
    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        r"""Bounds on the elastic stiffness [Pa], for the time step.

        Args:
            F: Elastic deformation gradient, shape (..., 3, 3).
            mu: Shear modulus [Pa], shape (...).
            lam: First Lamé parameter [Pa], shape (...).
            internal: Internal variable, shape (...); None for its initial value.

        Returns:
            ``wave``, not less than density times the square of any wave speed (against reference gradients), and
            ``bound``, not less than any eigenvalue of :math:`\partial^2 \Psi / \partial F^2`; shape (...). Neither
            falls below its value at rest: lambda + 2 mu and 3 lambda + 2 mu in a solid, K and 3 K in a fluid.
        """


class PlasticLaw(ConstitutiveLaw):
    """A law whose return map acts on the principal stretches and keeps the principal axes."""

    plastic = True

    @abstractmethod
    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """New principal stretches (..., 3) and internal variable (...) from trial ones."""

    def return_map(
        self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """The return map on principal stretches; the rotation and axes of the trial are kept."""
        if internal is None and self.internal is not None:
            internal = torch.full_like(mu, self.internal)
        parts = spectrum(F)
        values, new = self.flow(parts.stretch, mu, lam, internal, dt)
        F = from_principal(parts, lambda a: self.flow(a, mu, lam, internal, dt)[0], values, rotated=True)
        return F, new
