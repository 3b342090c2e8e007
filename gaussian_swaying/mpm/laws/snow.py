"""Snow: fixed corotated elasticity with bounded stretches."""

from __future__ import annotations

from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.mpm.laws.fixed_corotated import (
    fixed_corotated_energy,
    fixed_corotated_moduli,
    fixed_corotated_pk1,
)
from gaussian_swaying.mpm.laws.law import PlasticLaw
from gaussian_swaying.mpm.laws.shared import SNOW_RANGE
from gaussian_swaying.mpm.twins import Numbers, Twin


def snow_lame(mu: Tensor, lam: Tensor, plastic_volume: Tensor, hardening: float) -> tuple[Tensor, Tensor]:
    r"""Lamé parameters [Pa] of snow, multiplied by :math:`\exp(\xi (1 - J_p))`.

    Stomakhin et al. 2013, "A material point method for snow simulation", equation 2.

    Args:
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).
        plastic_volume: Plastic volume ratio J_p, shape (...); values below 0.6 count as 0.6.
        hardening: Hardening xi.

    Returns:
        Shapes (...).
    """
    factor = (hardening * (1 - plastic_volume.clamp(*SNOW_RANGE))).exp()
    return mu * factor, lam * factor


def snow_plasticity(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor,
    critical_compression: float,
    critical_stretch: float,
    dt: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor]:
    r"""Snow: stretches stay in :math:`[1 - \theta_c, 1 + \theta_s]`, the rest goes into the plastic volume ratio.

    Stomakhin et al. 2013, "A material point method for snow simulation", section 7.

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...); not used.
        lam: First Lamé parameter [Pa], shape (...); not used.
        internal: Plastic volume ratio J_p, shape (...); kept between 0.6 and 20.
        critical_compression: theta_c.
        critical_stretch: theta_s.
        dt: Substep [s]; not used.

    Returns:
        Stretches (..., 3) and J_p.
    """
    new = stretch.clamp(1 - critical_compression, 1 + critical_stretch)
    lost = stretch / new
    return new, (internal * lost[..., 0] * lost[..., 1] * lost[..., 2]).clamp(*SNOW_RANGE)


class Snow(PlasticLaw):
    """Snow: fixed corotated elasticity with bounded stretches, stiffer when packed and softer when pulled apart.

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

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.snow import FUNCTIONS

        numbers = (self.critical_compression, self.critical_stretch, self.hardening)
        return Twin(FUNCTIONS, numbers=Numbers(3, lambda: numbers))

    def _lame(self, mu: Tensor, lam: Tensor, internal: Tensor | None) -> tuple[Tensor, Tensor]:
        return (mu, lam) if internal is None else snow_lame(mu, lam, internal, self.hardening)

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`fixed_corotated_energy`, with the parameters of :func:`snow_lame`."""
        return fixed_corotated_energy(F, *self._lame(mu, lam, internal))

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """See :func:`fixed_corotated_pk1`, with the parameters of :func:`snow_lame`."""
        return fixed_corotated_pk1(F, *self._lame(mu, lam, internal))

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See :func:`fixed_corotated_moduli`, with the parameters of :func:`snow_lame`."""
        return fixed_corotated_moduli(F, *self._lame(mu, lam, internal))

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        assert internal is not None
        return snow_plasticity(stretch, mu, lam, internal, self.critical_compression, self.critical_stretch)
