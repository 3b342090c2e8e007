"""Check that a fit ended at a local minimum: what a further Gauss-Newton step would still change."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from gaussian_swaying.fitting.identifiability import changes
from gaussian_swaying.fitting.least_squares import NO_STEP, Normal, expected_gain, step_from
from gaussian_swaying.fitting.unknowns import Unknown

FAR = 0.005
"""Step, as a share of a range, above which the values have not settled."""
GAIN = 0.003
"""Least expected relative decrease of the cost by such a step; below it, the step would change nothing visible."""

_BEGIN = "put `pixels` last in `stages`, raise `search`, or give a `start` that is nearer"


def unsettled(normal: Normal, place: Tensor, unknowns: Sequence[Unknown], ended: str) -> str:
    """Return a sentence that says why the end of a fit is not a local minimum; empty if it is one.

    The sentence names what the next Gauss-Newton step would change, and the remedy. A lower minimum elsewhere is not
    detected.

    Args:
        normal: The normal equations at the end.
        place: The values at the end, as shares of the ranges, shape (U,).
        unknowns: The unknowns.
        ended: The reason why the last iterations ended, see :class:`~gaussian_swaying.fitting.least_squares.Progress`;
            empty if their number ran out.
    """
    step = step_from(normal, place) - place
    gain = expected_gain(normal, step)
    if float(step.abs().amax()) <= FAR or gain <= GAIN:
        return ""
    why = {"": "`iterations` ran out", NO_STEP: "no step lowered the cost"}.get(ended, ended)
    remedy = _BEGIN if ended else "raise `iterations` and continue with --resume"
    told = f"{changes(step.tolist(), unknowns, place)}, to lower the cost by {gain:.2g} of itself"
    return f"The values have not settled: {why}, but the sensitivities ask for {told}: {remedy}."


__all__ = ["unsettled"]
