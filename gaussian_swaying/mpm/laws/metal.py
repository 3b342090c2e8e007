"""Ductile metal: Hencky elasticity in a von Mises cylinder that grows."""

from __future__ import annotations

from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.mpm.laws.hencky import StVKHencky
from gaussian_swaying.mpm.laws.law import PlasticLaw
from gaussian_swaying.mpm.laws.shared import von_mises
from gaussian_swaying.mpm.twins import Numbers, Twin


class Metal(PlasticLaw, StVKHencky):
    """Ductile metal: Hencky elasticity in a von Mises cylinder that grows with the plastic strain.

    Args:
        yield_stress: Yield stress in uniaxial tension [Pa].
        hardening: Increase of the yield stress with the accumulated plastic strain [Pa].
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

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.metal import FUNCTIONS

        return Twin(FUNCTIONS, numbers=Numbers(3, lambda: (self.yield_stress, self.hardening, 0.0)))

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        assert internal is not None
        return von_mises(stretch, mu, lam, internal, self.yield_stress, self.hardening)
