"""Foam: Hencky elasticity whose shear above the yield stress relaxes slowly."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.mpm.laws.hencky import StVKHencky
from gaussian_swaying.mpm.laws.law import PlasticLaw
from gaussian_swaying.mpm.laws.shared import ROOT, continued_log, split_strain, stretch_of_log
from gaussian_swaying.mpm.twins import Numbers, Twin


def viscoplastic(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor | None,
    yield_stress: float,
    viscosity: float,
    dt: float | Tensor,
) -> tuple[Tensor, Tensor | None]:
    r"""Foam: shear stress above the yield stress relaxes at a rate given by a viscosity.

    Perzyna 1966, "Fundamental problems in viscoplasticity", with the linear overstress function (Simo & Hughes 1998,
    section 2.7): the overstress :math:`y = |\operatorname{dev} \tau| - \sqrt{2/3} \, \sigma_y` obeys
    :math:`\dot y = -2 \mu y / \eta`, which is integrated exactly, so two half substeps equal a full one.

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...); not used.
        internal: Returned unchanged.
        yield_stress: Yield stress in uniaxial tension [Pa].
        viscosity: Viscosity eta [Pa s]; zero for plastic flow without delay.
        dt: Substep [s].

    Returns:
        Stretches (..., 3) and ``internal``.
    """
    trace, deviator, norm, direction = split_strain(continued_log(stretch))
    over = 2 * mu * norm - ROOT * yield_stress
    # one minus the remaining factor, without loss of digits for a short substep
    relaxed = -torch.expm1(-2 * mu * dt / viscosity) if viscosity > 0 else torch.ones_like(mu)
    flow = over.clamp(min=0) * relaxed / (2 * mu)
    strain = deviator - flow[..., None] * direction + trace[..., None] / 3
    return torch.where((over > 0)[..., None], stretch_of_log(strain), stretch), internal


class Foam(PlasticLaw, StVKHencky):
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

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.foam import FUNCTIONS

        return Twin(FUNCTIONS, numbers=Numbers(2, lambda: (self.yield_stress, self.viscosity)))

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        return viscoplastic(stretch, mu, lam, internal, self.yield_stress, self.viscosity, dt)
