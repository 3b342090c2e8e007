"""Identifiability: singular values of the sensitivities, and combinations of unknowns that a video leaves open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.fitting.unknowns import Unknown

LARGE = 0.25
"""Share of the largest part of a direction below which an unknown is not named."""


@dataclass(frozen=True)
class Direction:
    """A combination of the unknowns.

    Attributes:
        strength: Singular value: change of the residuals, in standard deviations, when the unknowns move along the
            direction by the whole of their ranges.
        parts: Share of each unknown, of length one.
        sentence: The direction in words.
    """

    strength: float
    parts: tuple[float, ...]
    sentence: str


def directions(matrix: Tensor, unknowns: Sequence[Unknown], place: Tensor) -> list[Direction]:
    """The principal directions of the sensitivities, the best known first.

    Args:
        matrix: J^T W J in shares of the ranges, shape (U, U).
        unknowns: The unknowns.
        place: Values at which the sensitivities were computed, as shares of the ranges, shape (U,).
    """
    values, vectors = torch.linalg.eigh(matrix)
    found = []
    for value, vector in zip(values.flip(0), vectors.flip(1).mT, strict=True):
        parts = tuple(vector.tolist())
        found.append(Direction(math.sqrt(max(float(value), 0.0)), parts, _sentence(parts, unknowns, place)))
    return found


def condition(found: Sequence[Direction]) -> float:
    """Largest singular value over the smallest."""
    return found[0].strength / max(found[-1].strength, 1e-300)


def check_apart(found: Sequence[Direction], unknowns: Sequence[Unknown], limit: float) -> None:
    """Raise ValueError if the unknowns cannot be told apart.

    Args:
        found: From :func:`directions`.
        unknowns: The unknowns.
        limit: Largest condition number.
    """
    if len(unknowns) < 2 or condition(found) <= limit:
        return
    worst = found[-1]
    largest = max(map(abs, worst.parts))
    names = [f"`{u.name}`" for u, part in zip(unknowns, worst.parts, strict=True) if abs(part) > LARGE * largest]
    if len(names) == 1:
        raise ValueError(
            f"The video does not tell {names[0]} (condition {condition(found):.3g}, limit {limit:g}): put it into "
            "`known`, or raise `limit`."
        )
    raise ValueError(
        f"The video cannot tell {', '.join(names[:-1])} and {names[-1]} apart: {worst.sentence} changes nothing that "
        f"is seen (condition {condition(found):.3g}, limit {limit:g}). Put one of them into `known`, or raise `limit`."
    )


def _sentence(parts: Sequence[float], unknowns: Sequence[Unknown], place: Tensor) -> str:
    """Describe a step along a direction in words, scaled so that its largest change is about 10 %."""
    lead = max(range(len(parts)), key=lambda k: abs(parts[k]))
    unknown = unknowns[lead]
    slope, value = unknown.slope(float(place[lead])), unknown.value(float(place[lead]))
    # how far along the direction until the largest part has changed by a tenth of its value, or of its range
    far = 0.1 * abs(value) / abs(slope) if value and unknown.scale == "log" else 0.1
    return changes([far / parts[lead] * part for part in parts], unknowns, place)


def changes(step: Sequence[float], unknowns: Sequence[Unknown], place: Tensor) -> str:
    """A step, in shares of the ranges, in words: ``raising wind.speed by 10% and lowering material.E by 20%``."""
    largest, words = max(map(abs, step)), []
    for u, part, share in zip(unknowns, step, place.tolist(), strict=True):
        if abs(part) <= LARGE * largest:
            continue
        change = part * u.slope(share)
        verb = "raising" if change > 0 else "lowering"
        own = abs(u.value(share))
        amount = f"{abs(change) / own:.0%}" if u.scale == "log" and own else f"{abs(change):.2g} {u.unit}".strip()
        words.append(f"{verb} {u.name} by {amount}")
    return " and ".join(words) if len(words) < 3 else ", ".join(words[:-1]) + " and " + words[-1]
