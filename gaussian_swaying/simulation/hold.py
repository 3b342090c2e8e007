"""Where an object is held: whether it stands or hangs, and the end that is pinned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice
from gaussian_swaying.gaussians.selection import Box, Cylinder, Region
from gaussian_swaying.simulation.shape import DIRECTIONS, quantile, rounded, sheet_normal, snapped, width

PIN_DEPTH = 0.06  # depth of the pinned end, as a share of the object's length towards it


@dataclass(frozen=True)
class HoldGuess:
    """Where the object is held.

    Attributes:
        end: ``top``, ``bottom``, ``side`` or ``none``.
        direction: Unit vector in scene axes from the object to that end.
        confidence: ``medium`` or ``low``; ``given`` if the end was.
        reason: In words.
    """

    end: str
    direction: tuple[float, ...]
    confidence: str
    reason: str


def guess_hold(points: Tensor, weight: Tensor, up: Sequence[float], ground: bool) -> HoldGuess:
    """The end at which the object is held.

    On a floor it stands. A sheet is held along the side at which the origin lies, else along its upper edge. Anything
    else is held at the narrower end, a stalk or a cord, if the other is at least 1.5 times as wide, else at the
    bottom.

    Args:
        points: Centres of the simulated Gaussians [scene units], shape (N, 3).
        weight: Their visible area, shape (N,).
        up: Up direction.
        ground: Whether there is a floor.

    Returns:
        The guess.
    """
    axis = torch.tensor(up, dtype=torch.float64)
    upward, downward = tuple(up), tuple(0.0 - c for c in up)
    if ground:
        return HoldGuess("bottom", downward, "medium", "it stands on a floor")
    normal = sheet_normal(points)
    if normal is not None and abs(sum(a * b for a, b in zip(normal, up, strict=True))) < 0.5:
        across = torch.linalg.cross(axis, torch.tensor(normal, dtype=torch.float64))
        across = torch.tensor(snapped(across), dtype=torch.float64)
        along = points.double() @ across
        low, high = float(along.amin()), float(along.amax())
        for end, sign, other in ((low, -1.0, high), (high, 1.0, low)):
            if abs(end) < 0.05 * (high - low) < abs(other):
                held = tuple(float(sign * c) + 0.0 for c in across)
                return HoldGuess("side", held, "medium", "it is an upright sheet, and the origin lies at this side")
        return HoldGuess("top", upward, "low", "it is an upright sheet, which hangs unless something else holds it")
    height = points.double() @ axis
    low, high = quantile(height, 0.005), quantile(height, 0.995)
    depth = 0.08 * (high - low)
    top, bottom = (width(points[mask], axis) for mask in (height >= high - depth, height <= low + depth))
    if bottom > 1.5 * top:
        reason = (
            f"the upper end is {top:.3g} wide, the lower {bottom:.3g}: it may hang there, and moves most if it does"
        )
        return HoldGuess("top", upward, "low", reason)
    if top > 1.5 * bottom:
        return HoldGuess(
            "bottom", downward, "medium", f"the lower end is {bottom:.3g} wide, the upper {top:.3g}: like a stalk"
        )
    return HoldGuess("bottom", downward, "low", "both ends are about as wide, and most things stand")


def given_hold(end: str, up: Sequence[float]) -> HoldGuess:
    """An end that was given: ``top``, ``bottom``, ``none``, or the axis ``+x`` to ``-z`` that points to it."""
    check_choice("--hold", end, ("top", "bottom", "none", *DIRECTIONS))
    if end in DIRECTIONS:
        return HoldGuess("side", DIRECTIONS[end], "given", "given")
    return HoldGuess(end, tuple(0.0 - c for c in up) if end == "bottom" else tuple(up), "given", "given")


def end_region(points: Tensor, direction: Sequence[float], cell: float) -> Region:
    """The end of an object as a region: a half-open box if the direction is an axis, else a cylinder.

    Its depth is 6 % of the length towards it, at least one and a half cells, counted from where 0.5 %
    of the points lie beyond.

    Args:
        points: Centres of the simulated Gaussians [scene units], shape (N, 3).
        direction: Unit vector from the object to the end.
        cell: Grid spacing [scene units].

    Returns:
        The region.
    """
    axis = torch.tensor(direction, dtype=torch.float64)
    along = points.double() @ axis
    low, high = float(along.amin()), float(along.amax())
    solid_end = quantile(along, 0.995)  # a few stragglers beyond do not move it
    depth = max(PIN_DEPTH * (high - low), 1.5 * cell)
    start = max(solid_end - depth, low)
    main = int(axis.abs().argmax())
    if abs(float(axis[main])) > 1 - 1e-6:
        corner: list[float | None] = [None, None, None]
        corner[main] = rounded(start * float(axis[main]), cell)
        empty: list[float | None] = [None, None, None]
        return Box(corner, empty) if float(axis[main]) > 0 else Box(empty, corner)
    centre = points.double().mean(0)
    height = 2 * (high - low) + 4 * cell
    centre = centre + (start + 0.5 * height - float(centre @ axis)) * axis
    radius = 2 * float((points.double() - points.double().mean(0)).norm(dim=-1).amax())
    direction = [round(c, 6) for c in direction]
    return Cylinder([rounded(float(c), cell) for c in centre], direction, rounded(radius, cell), rounded(height, cell))
