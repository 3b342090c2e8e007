"""Other values that may explain the same film."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.inverse.unknowns import Unknown, Values, turn, values_at
from gaussian_swaying.simulation.model import Model, flow_of

SHAKEN = 0.12
"""Change of what is sought of the material, as a share of the range."""

FLAT = 0.8
"""Part of the area that faces one way, level with the ground, from which the wind may be mirrored: a mean square."""

SCANNED = 16
"""Values of Young's modulus over its range that are tried in a wind that bends the object as far."""

TURN, MIRROR = 5.0, 20.0
"""Least angle between the wind and its mirror image, and largest between that and another end [degrees]."""


def rivals_of(model: Model, unknowns: Sequence[Unknown], place: Sequence[float]) -> list[list[float]]:
    """Places from which to start again at the end of a fit, as shares of the ranges, within them.

    For each number of the material a smaller and a larger one, then the mirrored wind if there is one.
    """
    found, last = [], []
    for k, unknown in enumerate(unknowns):
        for side in (-SHAKEN, SHAKEN) if unknown.name.startswith("material.") else ():
            found.append([*place[:k], min(max(place[k] + side, 0.0), 1.0), *place[k + 1 :]])
        if unknown.name == "wind.azimuth" and (azimuth := mirrored(model, values_at(unknowns, place))) is not None:
            middle = 0.5 * (unknown.low + unknown.high)
            share = unknown.share(middle + turn(azimuth - middle))
            last += [[*place[:k], share, *place[k + 1 :]]] if 0 <= share <= 1 else []
    return found + last


def bent_alike(unknowns: Sequence[Unknown], place: Tensor) -> Tensor:
    r"""Places (P, U) over the range of ``material.E``, in winds that bend the object as far; none if not sought.

    The bend grows as :math:`w^2 / E`. A place that is several times too stiff and too windy bends as far, but swings
    too fast. The cost has a minimum there, and others on the way to the true one.
    """
    names = [unknown.name for unknown in unknowns]
    if not {"material.E", "wind.speed"} <= set(names):
        return place[:0, None]
    k, j = names.index("material.E"), names.index("wind.speed")
    stiffness, wind, found = unknowns[k], unknowns[j], place.repeat(SCANNED, 1)
    found[:, k] = (torch.arange(SCANNED) + 0.5) / SCANNED
    bent = wind.value(float(place[j])) / math.sqrt(stiffness.value(float(place[k])))
    for other in found:
        speed = bent * math.sqrt(stiffness.value(float(other[k])))
        other[j] = wind.share(min(max(speed, wind.low), wind.high))
    return found


def mirrored(model: Model, values: Values) -> float | None:
    r"""Return the azimuth of the wind mirrored at the normal of a sheet at rest [degrees]; None if nothing is flat.

    The pressure on a sheet with normal n depends on :math:`w \cdot n` and the speed, which the mirror image
    :math:`2 (w \cdot n) n - w` leaves. Level with the ground, that is the azimuth :math:`2 \beta - \alpha`, with the
    azimuth :math:`\beta` of n.
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
    return other if abs(turn(other - azimuth)) >= TURN else None


def is_mirrored(model: Model, unknowns: Sequence[Unknown], place: Sequence[float], end: Sequence[float]) -> bool:
    """True if the wind at the end of another start is about the mirror image of that at a place, both as shares."""
    values, there = values_at(unknowns, place), values_at(unknowns, end)
    other = mirrored(model, values) if "wind.azimuth" in values else None
    return other is not None and abs(turn(there["wind.azimuth"] - other)) < MIRROR
