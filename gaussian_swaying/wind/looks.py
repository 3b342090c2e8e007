"""Winds by their look: breeze, gusts and storm, as turbulence that is coherent in space and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying.wind.carried import Turbulence
from gaussian_swaying.wind.field import WindField

CELLS = (128, 64, 64)
"""Cells of the box of turbulence, each a sixteenth of the length."""


@dataclass(frozen=True)
class Look:
    """A wind at the height of the object, in the open.

    Attributes:
        speed: Mean speed [m/s].
        intensity: Standard deviation of the component along the wind over the mean speed.
        words: What it does, on Beaufort's scale.
    """

    speed: float
    intensity: float
    words: str


LOOKS = {
    "breeze": Look(3.0, 0.30, "leaves and twigs move"),
    "gusts": Look(8.0, 0.25, "small branches and small trees move"),
    "storm": Look(15.0, 0.22, "whole trees move"),
}
"""The looks by name."""


def turbulence_length(height: float) -> float:
    """Integral length scale of the turbulence at a height above the ground [m]: 3.2 heights, and at least 1.5 m.

    That puts the peak of Kaimal's spectrum where it was measured near the ground (Kaimal et al. 1972).
    """
    return max(3.2 * height, 1.5)


def look(
    name: str,
    direction: Sequence[float] = (1.0, 0.0, 0.0),
    *,
    height: float = 0.5,
    speed: float | None = None,
    seed: int = 0,
) -> WindField:
    """A wind of a look: its mean speed, with turbulence of von Karman's spectrum that the wind carries along.

    Args:
        name: ``breeze``, ``gusts`` or ``storm``.
        direction: Where the wind blows to, z up, of any length.
        height: Height of the middle of the object above the ground [m].
        speed: Another mean speed [m/s], with the intensity of the look.
        seed: Another seed is another turbulence.

    Example:
        >>> look("breeze").flows
        tensor([[3., 0., 0.]], dtype=torch.float64)
    """
    check_choice("look", name, tuple(LOOKS))
    check_positive("height", height)
    given = LOOKS[name]
    along = torch.tensor(check_vector("direction", direction), dtype=torch.float64)
    if not bool(along.any()):
        raise ValueError("Expected `direction` of the wind to have a length, but got zero: say where it blows to.")
    if speed is not None:
        check_positive("speed", speed, allow_zero=True)
    flow = (given.speed if speed is None else speed) * along / along.norm()
    gusts = Turbulence(given.intensity, turbulence_length(height), cells=CELLS, seed=seed)
    return WindField(flow, effects=[gusts], seed=seed)
