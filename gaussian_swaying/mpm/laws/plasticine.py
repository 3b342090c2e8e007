"""Clay: Hencky elasticity in a von Mises cylinder that shrinks."""

from __future__ import annotations

from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.mpm.laws.hencky import StVKHencky
from gaussian_swaying.mpm.laws.law import PlasticLaw
from gaussian_swaying.mpm.laws.shared import von_mises
from gaussian_swaying.mpm.twins import Numbers, Twin


class Plasticine(PlasticLaw, StVKHencky):
    """Clay that weakens as it is worked: a von Mises cylinder that shrinks with the plastic strain.

    Args:
        yield_stress: Yield stress in uniaxial tension before any flow [Pa].
        softening: Decrease of the yield stress with the accumulated plastic strain [Pa].
        residual: Lowest yield stress [Pa].
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

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.metal import FUNCTIONS

        return Twin(FUNCTIONS, numbers=Numbers(3, lambda: (self.yield_stress, -self.softening, self.residual)))

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        assert internal is not None
        return von_mises(stretch, mu, lam, internal, self.yield_stress, -self.softening, self.residual)
