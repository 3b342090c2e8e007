"""Learning rates."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gaussian_swaying._checks import check_positive
from gaussian_swaying.training.densification import PARAMETERS


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of Adam, one for each parameter, with the values of gsplat's example trainer.

    Attributes:
        means: Centres, as a share of the scene's extent; decays exponentially.
        means_final: Share of ``means`` that is left after the last step.
        scales: Logarithms of the scales.
        quats: Quaternions.
        opacities: Logits of the opacities.
        sh0: Constant harmonics.
        shN: The other harmonics.
    """

    means: float = 1.6e-4
    means_final: float = 0.01
    scales: float = 5e-3
    quats: float = 1e-3
    opacities: float = 5e-2
    sh0: float = 2.5e-3
    shN: float = 2.5e-3 / 20  # noqa: N815

    def __post_init__(self) -> None:
        for name in (*PARAMETERS, "means_final"):
            check_positive(f"rates.{name}", getattr(self, name), allow_zero=name != "means_final")


def means_rate(rates: LearningRates, scene_scale: float, step: int, max_steps: int, devices: int = 1) -> float:
    """Learning rate of the centres at a step: decays exponentially from ``rates.means`` times the scene's extent.

    Args:
        rates: The rates.
        scene_scale: Extent of the scene [scene units].
        step: Number of steps before.
        max_steps: Number of steps in all.
        devices: Number of devices that train together, see
            :func:`~gaussian_swaying.training.parallel.scaled_adam`.

    Returns:
        The rate [scene units].
    """
    share = min(step / max_steps, 1.0) if max_steps > 0 else 0.0
    return math.sqrt(devices) * rates.means * scene_scale * rates.means_final**share
