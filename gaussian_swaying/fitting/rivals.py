"""Rivals: other values that may explain the same film, to be tried at the start of a fit and at its end.

A fit ends in the nearest minimum of its cost. Three kinds of others are known: of a body that swings, a stiffer one in
more wind; of a flapping flag, those of softer and stiffer materials; and of a sheet, that of the wind mirrored at its
normal, which presses as hard on it. Only the friction and the edges tell that from the true wind, so it explains nearly
as much of the motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch

from gaussian_swaying.fitting.unknowns import Unknown, values_at
from gaussian_swaying.simulation.model import Model, flow_of

SHAKEN = 0.12
"""Change of what is sought of the material, as a share of the range."""
FLAT = 0.8
"""Part of the area that faces one way, level with the ground, from which the wind may be mirrored: a mean square."""
SCANNED = 16
"""Values of Young's modulus over its range that are tried in a wind that bends the object as far."""
TURN = 5.0
"""Least angle between the wind and its mirror image [degrees]."""
MIRROR = 20.0
"""Largest angle between the end of another start and the mirror image of the wind that is still one [degrees]."""


def rivals_of(model: Model, unknowns: Sequence[Unknown], place: Sequence[float]) -> list[list[float]]:
    """Places from which to start again at the end of a fit, as shares of the ranges, within them.

    Args:
        model: The scene.
        unknowns: What is sought.
        place: Where the fit ended.

    Returns:
        For each number of the material a smaller and a larger one, then the mirrored wind if there is one.
    """
    found = []
    for k, unknown in enumerate(unknowns):
        for side in (-SHAKEN, SHAKEN) if unknown.name.startswith("material.") else ():
            found.append([*place[:k], min(max(place[k] + side, 0.0), 1.0), *place[k + 1 :]])
    names = [unknown.name for unknown in unknowns]
    if "wind.azimuth" in names:
        k = names.index("wind.azimuth")
        azimuth = mirrored(model, values_at(unknowns, place))
        share = unknowns[k].share(_within(azimuth, unknowns[k])) if azimuth is not None else -1.0
        if 0 <= share <= 1:
            found.append([*place[:k], share, *place[k + 1 :]])
    return found


def apart_by(unknowns: Sequence[Unknown], one: Sequence[float], other: Sequence[float]) -> float:
    """Return the largest distance of two places, as a share of a range; azimuths 360 degrees apart are the same."""
    most = 0.0
    for unknown, a, b in zip(unknowns, one, other, strict=True):
        away = abs(a - b)
        if unknown.name == "wind.azimuth":
            wide = unknown.high - unknown.low
            away = abs(_turned(wide * (a - b))) / wide
        most = max(most, away)
    return most


def bent_alike(unknowns: Sequence[Unknown], place: Sequence[float]) -> list[list[float]]:
    r"""Places with another Young's modulus, and the wind that bends the object as far.

    The bend grows as :math:`w^2 / E`. A place that is several times too stiff and too windy bends as far, but swings
    too fast. The cost has a minimum there, and others on the way to the true one.

    Args:
        unknowns: What is sought.
        place: Where the wind bends it as far as it should, as shares of the ranges.

    Returns:
        :data:`SCANNED` places over the range of ``material.E``; none if that or ``wind.speed`` is not sought.
    """
    names = [unknown.name for unknown in unknowns]
    if not {"material.E", "wind.speed"} <= set(names):
        return []
    k, j = names.index("material.E"), names.index("wind.speed")
    stiffness, wind, found = unknowns[k], unknowns[j], []
    for number in range(SCANNED):
        other = list(place)
        other[k] = (number + 0.5) / SCANNED
        ratio = stiffness.value(other[k]) / stiffness.value(place[k])
        speed = wind.value(place[j]) * math.sqrt(ratio)
        other[j] = wind.share(min(max(speed, wind.low), wind.high))
        found.append(other)
    return found


def mirrored(model: Model, values: Mapping[str, float]) -> float | None:
    r"""Return the azimuth of the wind mirrored at the normal of a sheet at rest [degrees]; None if nothing is flat.

    The pressure on a sheet with normal n depends on :math:`w \cdot n` and the speed, which the mirror image
    :math:`2 (w \cdot n) n - w` leaves. Level with the ground, that is the azimuth :math:`2 \beta - \alpha`, with the
    azimuth :math:`\beta` of n.

    Args:
        model: The scene.
        values: Values of the unknowns, with ``wind.azimuth``.
    """
    patches = model.scene.patches
    normal = patches.normal.double()[:, :2]
    weight = patches.area.double() / patches.area.double().sum()
    shares, axes = torch.linalg.eigh((weight[:, None, None] * normal[:, :, None] * normal[:, None, :]).sum(0).cpu())
    if not float(shares[-1]) >= FLAT:
        return None
    facing = math.degrees(math.atan2(float(axes[1, -1]), float(axes[0, -1])))
    x, y, _ = flow_of((1.0, 0.0, 0.0), values)
    azimuth = math.degrees(math.atan2(y, x))
    other = 2 * facing - azimuth
    return other if abs(_turned(other - azimuth)) >= TURN else None


def is_mirrored(model: Model, unknowns: Sequence[Unknown], place: Sequence[float], end: Sequence[float]) -> bool:
    """True if the wind at the end of another start is about the mirror image of that at a place, both as shares."""
    values, there = values_at(unknowns, place), values_at(unknowns, end)
    other = mirrored(model, values) if "wind.azimuth" in values else None
    return other is not None and abs(_turned(there["wind.azimuth"] - other)) < MIRROR


def _turned(angle: float) -> float:
    """An angle between -180 and 180 degrees."""
    return (angle + 180) % 360 - 180


def _within(azimuth: float, unknown: Unknown) -> float:
    middle = 0.5 * (unknown.low + unknown.high)
    return middle + _turned(azimuth - middle)
