"""Materials: a stress, a return map and the stiffness that limits the time step, for the solver to choose from."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_positive
from gaussian_swaying.mpm import constitutive, plasticity
from gaussian_swaying.mpm.linalg import from_principal, matmul3, spectrum


class ConstitutiveLaw(nn.Module, ABC):
    """Base of all materials.

    Elastic stiffness belongs to the particles (Lamé parameters); what a law adds of its own are its arguments.

    Attributes:
        plastic: Whether there is a return map. The deformation gradient is then only the elastic part of the
            deformation since rest, which needs the ``updated`` formulation.
        internal: Initial value of the one internal variable of each particle, or None if there is none.
    """

    plastic: bool = False
    internal: float | None = None

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


class FixedCorotated(ConstitutiveLaw):
    """Elastic solid that stays defined when crushed or inverted: foliage, cloth, rubber at moderate strain."""

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.fixed_corotated_energy`."""
        return constitutive.fixed_corotated_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.fixed_corotated_pk1`."""
        return constitutive.fixed_corotated_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See :func:`~gaussian_swaying.mpm.constitutive.fixed_corotated_moduli`."""
        return constitutive.fixed_corotated_moduli(F, mu, lam)


class NeoHookean(ConstitutiveLaw):
    """Elastic solid that resists crushing without limit, and the cheapest: it needs no polar decomposition."""

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.neo_hookean_energy`."""
        return constitutive.neo_hookean_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.neo_hookean_pk1`."""
        return constitutive.neo_hookean_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See :func:`~gaussian_swaying.mpm.constitutive.neo_hookean_moduli`."""
        return constitutive.neo_hookean_moduli(F, mu, lam)


class SpringNetwork(ConstitutiveLaw):
    """Elastic solid of springs that are linear in their length: cloth, as solvers of springs move it.

    It stiffens in tension, where fixed corotated elasticity softens: a tenth and more apart at a stretch of 1.2.
    """

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.spring_network_energy`."""
        return constitutive.spring_network_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.spring_network_pk1`."""
        return constitutive.spring_network_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See :func:`~gaussian_swaying.mpm.constitutive.spring_network_moduli`."""
        return constitutive.spring_network_moduli(F, mu, lam)


class StVKHencky(ConstitutiveLaw):
    """Elastic solid with an energy quadratic in the logarithmic stretches, the base of the plastic solids.

    It softens in tension beyond a stretch of about e, so it is no choice for rubber.
    """

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.stvk_hencky_energy`."""
        return constitutive.stvk_hencky_energy(F, mu, lam)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.stvk_hencky_pk1`."""
        return constitutive.stvk_hencky_pk1(F, mu, lam)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See :func:`~gaussian_swaying.mpm.constitutive.stvk_hencky_moduli`."""
        return constitutive.stvk_hencky_moduli(F, mu, lam)


class _Plastic(ConstitutiveLaw):
    """A law whose return map acts on the principal stretches and leaves the principal axes."""

    plastic = True

    @abstractmethod
    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """New principal stretches (..., 3) and internal variable (...) from trial ones."""

    def return_map(
        self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """The return map of the base class, with the trial's rotation and axes."""
        if internal is None and self.internal is not None:
            internal = torch.full_like(mu, self.internal)
        parts = spectrum(F)
        values, new = self.flow(parts.stretch, mu, lam, internal, dt)
        F = from_principal(parts, lambda a: self.flow(a, mu, lam, internal, dt)[0], values, rotated=True)
        return F, new


class Sand(_Plastic, StVKHencky):
    """Dry granular material without cohesion: Hencky elasticity in a Drucker-Prager cone.

    Args:
        friction_angle: Friction angle in triaxial compression [degrees]; a slope stands at a steeper one, 34.7 for 30.
        volume_correction: Take back the volume that sand gains where it is pulled apart, before it carries load again.
    """

    def __init__(self, friction_angle: float = 30.0, volume_correction: bool = False) -> None:
        super().__init__()
        if not 0 < friction_angle < 90:
            raise ValueError(
                f"Expected `friction_angle` between 0 and 90 degrees, but got {friction_angle}; dry sand has about 30."
            )
        self.friction_angle = float(friction_angle)
        self.internal = 0.0 if volume_correction else None

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :func:`~gaussian_swaying.mpm.plasticity.drucker_prager`."""
        internal = None if self.internal is None else internal
        return plasticity.drucker_prager(stretch, mu, lam, internal, self.friction_angle)


class Metal(_Plastic, StVKHencky):
    """Ductile metal: Hencky elasticity in a von Mises cylinder that grows with the plastic strain.

    Args:
        yield_stress: Yield stress in uniaxial tension [Pa].
        hardening: Its growth with the accumulated plastic strain [Pa].
    """

    internal = 0.0

    def __init__(self, yield_stress: float, hardening: float = 0.0) -> None:
        super().__init__()
        check_positive("yield_stress", yield_stress)
        if hardening < 0:
            raise ValueError(
                f"Expected `hardening` not to be negative, but got {hardening}; for softening use Plasticine."
            )
        check_positive("hardening", hardening, allow_zero=True)
        self.yield_stress, self.hardening = float(yield_stress), float(hardening)

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :func:`~gaussian_swaying.mpm.plasticity.von_mises`."""
        assert internal is not None
        return plasticity.von_mises(stretch, mu, lam, internal, self.yield_stress, self.hardening)


class Foam(_Plastic, StVKHencky):
    """Foam, cream, dough: shear above the yield stress relaxes slowly (Perzyna's viscoplasticity).

    Args:
        yield_stress: Yield stress in uniaxial tension [Pa]; zero for a fluid that flows under any load.
        viscosity: Viscosity of the overstress [Pa s]; zero for flow without delay.
    """

    def __init__(self, yield_stress: float, viscosity: float) -> None:
        super().__init__()
        check_positive("yield_stress", yield_stress, allow_zero=True)
        check_positive("viscosity", viscosity, allow_zero=True)
        self.yield_stress, self.viscosity = float(yield_stress), float(viscosity)

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :func:`~gaussian_swaying.mpm.plasticity.viscoplastic`."""
        return plasticity.viscoplastic(stretch, mu, lam, internal, self.yield_stress, self.viscosity, dt)


class Plasticine(_Plastic, StVKHencky):
    """Clay that weakens as it is worked: a von Mises cylinder that shrinks with the plastic strain.

    Args:
        yield_stress: Yield stress in uniaxial tension before any flow [Pa].
        softening: Its fall with the accumulated plastic strain [Pa].
        residual: Yield stress at which the fall ends [Pa].
    """

    internal = 0.0

    def __init__(self, yield_stress: float, softening: float, residual: float = 0.0) -> None:
        super().__init__()
        check_positive("yield_stress", yield_stress)
        check_positive("softening", softening, allow_zero=True)
        check_positive("residual", residual, allow_zero=True)
        if residual > yield_stress:
            raise ValueError(
                f"Expected `residual` not to exceed `yield_stress` ({yield_stress} Pa), but got {residual} Pa."
            )
        self.yield_stress, self.softening, self.residual = float(yield_stress), float(softening), float(residual)

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :func:`~gaussian_swaying.mpm.plasticity.von_mises`."""
        assert internal is not None
        return plasticity.von_mises(stretch, mu, lam, internal, self.yield_stress, -self.softening, self.residual)


class Snow(_Plastic):
    """Snow: fixed corotated within bounds of the stretches, stiffer when packed and softer when pulled apart.

    Its internal variable is the plastic volume ratio. The defaults are those of Stomakhin et al. 2013.

    Args:
        critical_compression: Compression at which a stretch becomes plastic, between 0 and 1.
        critical_stretch: Extension at which a stretch becomes plastic.
        hardening: Exponent of the stiffness in the plastic volume ratio.
    """

    internal = 1.0

    def __init__(
        self, critical_compression: float = 0.025, critical_stretch: float = 0.0075, hardening: float = 10.0
    ) -> None:
        super().__init__()
        if not 0 <= critical_compression < 1:
            raise ValueError(
                f"Expected `critical_compression` to lie in [0, 1), but got {critical_compression}; snow has 0.025."
            )
        check_positive("critical_stretch", critical_stretch, allow_zero=True)
        check_positive("hardening", hardening, allow_zero=True)
        self.critical_compression, self.critical_stretch = float(critical_compression), float(critical_stretch)
        self.hardening = float(hardening)

    def _lame(self, mu: Tensor, lam: Tensor, internal: Tensor | None) -> tuple[Tensor, Tensor]:
        return (mu, lam) if internal is None else constitutive.snow_lame(mu, lam, internal, self.hardening)

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.snow_energy`."""
        return constitutive.fixed_corotated_energy(F, *self._lame(mu, lam, internal))

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.snow_pk1`."""
        return constitutive.fixed_corotated_pk1(F, *self._lame(mu, lam, internal))

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See :func:`~gaussian_swaying.mpm.constitutive.fixed_corotated_moduli`."""
        return constitutive.fixed_corotated_moduli(F, *self._lame(mu, lam, internal))

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :func:`~gaussian_swaying.mpm.plasticity.snow_plasticity`."""
        assert internal is not None
        return plasticity.snow_plasticity(stretch, mu, lam, internal, self.critical_compression, self.critical_stretch)


class Fluid(_Plastic):
    """Weakly compressible fluid without viscosity; only the bulk modulus lambda + 2/3 mu of the particles counts.

    Args:
        gamma: Exponent of the pressure in the density, above 1; 7 for water.
    """

    def __init__(self, gamma: float = 7.0) -> None:
        super().__init__()
        if not 1 < gamma < float("inf"):
            raise ValueError(f"Expected `gamma` to be finite and above 1, but got {gamma}; water has 7.")
        self.gamma = float(gamma)

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.fluid_energy`."""
        return constitutive.fluid_energy(F, mu, lam, self.gamma)

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.fluid_pk1`."""
        return constitutive.fluid_pk1(F, mu, lam, self.gamma)

    def kirchhoff(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`~gaussian_swaying.mpm.constitutive.fluid_kirchhoff`."""
        return constitutive.fluid_kirchhoff(F, mu, lam, self.gamma)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See :func:`~gaussian_swaying.mpm.constitutive.fluid_moduli`."""
        return constitutive.fluid_moduli(F, mu, lam, self.gamma)

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :func:`~gaussian_swaying.mpm.plasticity.fluid`."""
        return plasticity.fluid(stretch, mu, lam, internal)
