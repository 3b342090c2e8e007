"""The wind mirrored at a sheet, which may explain the same film."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from gaussian_swaying.inverse.unknowns import Unknown, Values, turn, values_at
from gaussian_swaying.simulation.model import Model
from gaussian_swaying.wind.field import flow_of

FLAT = 0.8
"""Part of the area that faces one way, level with the ground, from which the wind may be mirrored: a mean square."""

TURN, MIRROR = 5.0, 20.0
"""Least angle between the wind and its mirror image, and largest between that and another end [degrees]."""


def mirrored_place(model: Model, unknowns: Sequence[Unknown], place: Sequence[float]) -> list[list[float]]:
    """The place with the mirrored wind, as shares of the ranges; none if there is none within them."""
    for k, unknown in enumerate(unknowns):
        if unknown.name == "wind.azimuth" and (azimuth := mirrored(model, values_at(unknowns, place))) is not None:
            middle = 0.5 * (unknown.low + unknown.high)
            share = unknown.share(middle + turn(azimuth - middle))
            return [[*place[:k], share, *place[k + 1 :]]] if 0 <= share <= 1 else []
    return []


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
