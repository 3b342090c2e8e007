"""The up direction of a splat, from its shape and from conventions of capturing and modelling programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying.geometry.rotations import rotation_from_z
from gaussian_swaying.preview.hold import balanced_base
from gaussian_swaying.preview.shape import (
    DIRECTIONS,
    FEWEST,
    bounds,
    extent,
    plane_axes,
    sheet_normal,
)

# conventions of capturing and modelling programs: z up (Blender), y down (COLMAP), y up (glTF)
CONVENTION = {"+z": 0.75, "-y": 0.75, "+y": 0.5, "-z": -1.0, "+x": -1.0, "-x": -1.0}


def wind_words(flow: Sequence[float], up: Sequence[float]) -> str:
    """A flow in words: with z up, as in ``wind.flow``, and in scene axes, as regions are, if z is not up in them.

    Args:
        flow: Velocity [m/s], z up.
        up: Direction that points up in the scene.

    Example:
        >>> wind_words([2.0, 5.0, 0.0], [0.0, -1.0, 0.0])
        '[2, 5, 0] m/s, z up ([2, 0, 5] in scene axes)'
    """
    rotation = rotation_from_z(up)
    turned = rotation @ torch.tensor(flow, dtype=torch.float64)
    here, there = (
        "[" + ", ".join(f"{round(v, 4) + 0.0:.3g}" for v in vector) + "]" for vector in (flow, turned.tolist())
    )
    words = f"{here} m/s, z up"
    return words if torch.equal(rotation, torch.eye(3).double()) else f"{words} ({there} in scene axes)"


@dataclass(frozen=True)
class UpGuess:
    """The up direction, and the reasons.

    Attributes:
        direction: Unit vector in scene axes.
        confidence: ``high``, ``medium`` or ``low``, by the lead over the next best direction; ``given`` if it was.
        scores: Points of each direction.
        reasons: The reasons for the winner, in words.
        ground: Which Gaussians form the floor below, shape (N,).
        options: The values of ``--up`` for this direction and the next best; empty if it was given.
    """

    direction: tuple[float, ...]
    confidence: str
    scores: dict[str, float]
    reasons: list[str]
    ground: Tensor
    options: tuple[str, ...] = ()


def floor_mask(points: Tensor, normals: Tensor, weight: Tensor, up: Sequence[float]) -> Tensor:
    """Gaussians that form a level floor at the lower end of a scene.

    A floor is a layer with a thickness of 4 % of the longest side. It contains at least 15 % of the visible area, most
    of it level. There is almost nothing below it and something above it that is narrower.

    Args:
        points: Centres [scene units], shape (N, 3).
        normals: Unit normals of either sign, shape (N, 3).
        weight: Visible area, shape (N,).
        up: Direction to try.

    Returns:
        Booleans, shape (N,), all false if there is no floor.
    """
    axis = torch.tensor(up, dtype=torch.float64)
    axis = axis / axis.norm()
    where, weight = points.double(), weight.double()
    height, level = where @ axis, (normals.double() @ axis).abs() > 0.8
    none = torch.zeros(len(points), dtype=torch.bool)
    corner = bounds(points)
    side = max(b - a for a, b in zip(corner["robust_min"], corner["robust_max"], strict=True))
    low, total = float(height.amin()), float(weight.sum())
    if side <= 0 or total <= 0:
        return none
    half = 0.02 * side
    bins = ((height - low) / half).long().clamp(max=9999)
    flat = torch.zeros(int(bins.max()) + 3, dtype=torch.float64).index_add_(0, bins, weight * level)
    start = low + half * float((flat[:-1] + flat[1:]).argmax())
    layer = (height >= start) & (height <= start + 2 * half)
    below, above = height < start, height > start + 2 * half
    held, rest = float(weight[layer].sum()), float(weight[above].sum())
    if held < 0.15 * total or rest < 0.05 * total or float(weight[below].sum()) > 0.03 * total:
        return none
    if float(weight[layer & level].sum()) < 0.6 * held or int(above.sum()) < FEWEST:
        return none
    for across in plane_axes(axis):
        along = where @ across
        wide, object_wide = (extent(along[m], 0.02) for m in (layer, above))
        if wide < 0.9 * object_wide:
            return none
    return layer | below


def _floor_score(points: Tensor, floor: Tensor, up: Sequence[float]) -> float:
    """Score of a floor: 3 if what stands on it is at least 0.3 times as tall as the floor is wide, less if flatter."""
    axis = torch.tensor(up, dtype=torch.float64)
    rest = points[~floor].double() @ axis
    width = min(extent(points[floor].double() @ a, 0.02) for a in plane_axes(axis))
    return 3 * min(1.0, extent(rest, 0.02) / max(0.3 * width, 1e-30))


def guess_up(points: Tensor, normals: Tensor, weight: Tensor) -> UpGuess:
    """The scene axis that most likely points up.

    Each of the six directions along an axis gets points: for convention (z up and y down 0.75, y up 0.5, others -1),
    for a floor below (3, less if things on it are flat), for the origin at the lower end (1), for a wide base in
    balance (0.5, not for sheets), and if the axis is the longest (log2 of its ratio to the next, up to 1.5). A thin
    sheet hangs, so its normal loses 1. A lead of 2 over the next gives high confidence, a lead of 1 medium.

    Args:
        points: Centres [scene units], shape (N, 3).
        normals: Unit normals of either sign, shape (N, 3).
        weight: Visible area, shape (N,).

    Returns:
        The guess.
    """
    corner = bounds(points)
    low, high = corner["robust_min"], corner["robust_max"]
    side = [b - a for a, b in zip(low, high, strict=True)]
    longest = sorted(side)[-2:]
    sheet = sheet_normal(points)
    scores: dict[str, float] = {}
    why: dict[str, list[str]] = {}
    floors: dict[str, Tensor] = {}
    for name, direction in DIRECTIONS.items():
        axis = "xyz".index(name[1])
        points_for, reasons = CONVENTION[name], []
        if points_for > 0:
            convention = {"+z": "z is up in Blender", "-y": "y is down in COLMAP", "+y": "y is up in glTF"}
            reasons.append(f"{convention[name]} (+{points_for:g})")
        floors[name] = floor_mask(points, normals, weight, direction)
        if bool(floors[name].any()):
            gain = _floor_score(points, floors[name], direction)
            points_for += gain
            reasons.append(f"there is a level floor at the lower end (+{gain:.2g})")
        near, far = (low[axis], high[axis]) if name[0] == "+" else (high[axis], low[axis])
        if side[axis] > 0 and abs(near) < 0.05 * side[axis] < abs(far):
            points_for += 1
            reasons.append("the origin is at the lower end (+1)")
        if side[axis] == longest[1] and longest[1] > 1.3 * longest[0]:
            gain = min(math.log2(longest[1] / max(longest[0], 1e-30)), 1.5)
            points_for += gain
            reasons.append(f"it is the longest side, {longest[1]:.3g} against {longest[0]:.3g} (+{gain:.2g})")
        up = torch.tensor(direction, dtype=torch.float64)
        if sheet is None and balanced_base(points.double(), weight.double(), up) is not None:
            points_for += 0.5
            reasons.append("it would stand in balance on a wide base (+0.5)")
        if sheet is not None and abs(sheet[axis]) > 0.8:
            points_for -= 1
        scores[name], why[name] = points_for, reasons
    best, second = sorted(scores, key=lambda name: -scores[name])[:2]
    lead = scores[best] - scores[second]
    confidence = "high" if lead >= 2 else "medium" if lead >= 1 else "low"
    reasons = [*why[best], f"{second} comes next, {lead:.2g} behind"]
    return UpGuess(DIRECTIONS[best], confidence, scores, reasons, floors[best], (best, second))


def given_up(up: Sequence[float] | str, points: Tensor, normals: Tensor, weight: Tensor) -> UpGuess:
    """A given up direction, as 3 numbers or as ``+x`` to ``-z``, with the floor below."""
    if isinstance(up, str):
        if up not in DIRECTIONS:
            raise ValueError(f"Expected `--up` to be {', '.join(DIRECTIONS)} or 3 numbers, but got {up!r}.")
        up = DIRECTIONS[up]
    direction = check_vector("--up", up)
    length = math.hypot(*direction)
    if length == 0:
        raise ValueError("Expected `--up` to be a direction, for example 0 -1 0, but got zero.")
    unit = tuple(c / length for c in direction)
    return UpGuess(unit, "given", {}, ["given"], floor_mask(points, normals, weight, unit))
