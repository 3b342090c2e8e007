"""Steps of the wind in the plane of its components, and not along its speed and azimuth.

A sheet feels mostly the wind across it. All winds with the same such component move it nearly alike, and they lie on a
straight line in the plane, but on a curve of speed and azimuth, along which a long step leaves the valley of the cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.fitting.least_squares import REACH, Retract
from gaussian_swaying.fitting.unknowns import Unknown

LEAST = 0.05
"""Least speed after a step, per that before."""


def straight(unknowns: Sequence[Unknown]) -> Retract:
    """Return the function that takes a step from a place, both as shares of the ranges (U,).

    Args:
        unknowns: What is sought. Without ``wind.speed`` and ``wind.azimuth``, a step is added.
    """
    names = [unknown.name for unknown in unknowns]
    if not {"wind.speed", "wind.azimuth"} <= set(names):
        return torch.add
    k, j = names.index("wind.speed"), names.index("wind.azimuth")
    speed, azimuth = unknowns[k], unknowns[j]

    def end_of(place: Tensor, step: Tensor) -> Tensor:
        end, here, begin = place + step, float(place[k]), float(place[j])
        along = max(1 + float(step[k]) * speed.slope(here) / speed.value(here), LEAST)
        across = math.radians(float(step[j]) * azimuth.slope(begin))
        turned = azimuth.value(begin) + math.degrees(math.atan2(across, along))
        end[k] = speed.share(speed.value(here) * math.hypot(along, across))
        end[j] = azimuth.share(min(max(turned, azimuth.low), azimuth.high))
        return end

    def moved(place: Tensor, step: Tensor) -> Tensor:
        if not speed.value(float(place[k])) > 0:  # it has no direction there
            return place + step
        while float(((end := end_of(place, step)) - place).abs().amax()) > 1.001 * REACH:  # shorter on the same line
            step = 0.5 * step
        return end

    return moved
