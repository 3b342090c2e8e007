"""Dry sand: Hencky elasticity in a Drucker-Prager cone."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.mpm.laws.hencky import StVKHencky
from gaussian_swaying.mpm.laws.law import PlasticLaw
from gaussian_swaying.mpm.laws.shared import ROOT, continued_log, split_strain, stretch_of_log
from gaussian_swaying.mpm.twins import Numbers, Twin


def cone_slope(friction_angle: float) -> float:
    r"""Slope :math:`\alpha = \sqrt{2/3} \, 2 \sin \phi / (3 - \sin \phi)` of the Drucker-Prager cone.

    It meets the Mohr-Coulomb pyramid of the friction angle in triaxial compression (Klar et al. 2016); in simple shear
    the material sustains a steeper angle, 34.7 degrees for 30.

    Args:
        friction_angle: Angle phi [degrees].
    """
    sine = math.sin(math.radians(friction_angle))
    return ROOT * 2 * sine / (3 - sine)


def drucker_prager(
    stretch: Tensor,
    mu: Tensor,
    lam: Tensor,
    internal: Tensor | None,
    friction_angle: float,
    dt: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor | None]:
    r"""Sand: :math:`|\operatorname{dev} \varepsilon| + \alpha \tfrac{3 \lambda + 2 \mu}{2 \mu} \sum \varepsilon \le 0`.

    Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation", section 7.3 of the technical report: tension
    leaves no stress, shear flows without a change of volume. The internal variable, if there is one, is the volume
    :math:`v_c` [logarithm of a ratio] that the particle gained in tension; :math:`v_c / 3` is added to the strains, so
    the sand must lose it before it carries load again (Tampubolon et al. 2017, "Multi-species simulation of porous sand
    and water mixtures").

    Args:
        stretch: Trial principal stretches, shape (..., 3).
        mu: Shear modulus [Pa], shape (...).
        lam: First Lamé parameter [Pa], shape (...).
        internal: Volume v_c, shape (...), or None for no correction.
        friction_angle: Friction angle phi [degrees].
        dt: Substep [s]; not used.

    Returns:
        Stretches (..., 3) and v_c.
    """
    logs = continued_log(stretch)
    strain = logs if internal is None else logs + internal[..., None] / 3
    trace, _, norm, direction = split_strain(strain)
    excess = norm + cone_slope(friction_angle) * (3 * lam + 2 * mu) / (2 * mu) * trace
    kept = stretch if internal is None else stretch * (internal / 3).exp()[..., None]
    flowed = stretch_of_log(strain - excess.clamp(min=0)[..., None] * direction)
    new = torch.where((excess <= 0)[..., None], kept, flowed)
    # at rest (the tip of the cone) ``kept`` passes gradients
    new = torch.where((trace > 0)[..., None], torch.ones_like(new), new)
    if internal is None:
        return new, None
    return new, internal + logs.sum(-1) - continued_log(new).sum(-1)


class Sand(PlasticLaw, StVKHencky):
    """Dry granular material without cohesion: Hencky elasticity in a Drucker-Prager cone.

    Args:
        friction_angle: Friction angle in triaxial compression [degrees]; a slope can be steeper, 34.7 for 30.
        volume_correction: Whether sand that was pulled apart must lose the volume it gained before it carries load
            again.
    """

    def __init__(self, friction_angle: float = 30.0, volume_correction: bool = False) -> None:
        super().__init__()
        if not 0 < friction_angle < 90:
            raise ValueError(
                f"Expected `friction_angle` between 0 and 90 degrees, but got {friction_angle}; use 30 for dry sand."
            )
        self.friction_angle = float(friction_angle)
        self.internal = 0.0 if volume_correction else None

    def twin(self) -> Twin:
        from gaussian_swaying.mpm.laws.triton.sand import FUNCTIONS

        numbers = (cone_slope(self.friction_angle), 0.0 if self.internal is None else 1.0)
        return Twin(FUNCTIONS, numbers=Numbers(2, lambda: numbers))

    def flow(
        self, stretch: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None, dt: float | Tensor
    ) -> tuple[Tensor, Tensor | None]:
        internal = None if self.internal is None else internal
        return drucker_prager(stretch, mu, lam, internal, self.friction_angle)
