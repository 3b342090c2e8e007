"""Guess whether an object stands or hangs, and which of its ends is to be pinned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice
from gaussian_swaying.geometry.regions import Box, Cylinder, Region
from gaussian_swaying.preview.shape import (
    DIRECTIONS,
    FEWEST,
    breadth,
    plane_axes,
    quantile,
    rounded,
    sheet_normal,
    snapped,
    width,
)

PIN_DEPTH = 0.06  # depth of the pinned end, as a share of the object's length in that direction
ENDS = {"bottom": "lower", "top": "upper"}


@dataclass(frozen=True)
class HoldGuess:
    """A guess of the end at which the object is held.

    Attributes:
        end: ``top``, ``bottom``, ``side`` or ``none``.
        direction: Unit vector in scene axes from the object to that end.
        confidence: ``high``, ``medium`` or ``low``, by the lead over the next end; ``given`` if the end was.
        reason: The reason, in words.
        scores: Points of each end; empty if it was given.
        options: The values of ``--hold`` for this end and the next best; empty if it was given.
    """

    end: str
    direction: tuple[float, ...]
    confidence: str
    reason: str
    scores: dict[str, float] = field(default_factory=dict)
    options: tuple[str, ...] = ()

    @property
    def option(self) -> str:
        """The value of ``--hold`` for this end."""
        return _option(self.end, self.direction)


def guess_hold(
    points: Tensor,
    weight: Tensor,
    up: Sequence[float],
    cell: float,
    left_out: Tensor | None = None,
    eyes: Tensor | None = None,
    wall: Sequence[float] | None = None,
) -> HoldGuess:
    """The end at which the object is held, from points for its bottom, its top or a side.

    Each end gets points, and the highest sum wins:

    - Gaussians outside the region touch the object there (2);
    - the origin is at that end (1), or at a side of an upright sheet, as for a flag at its pole (2);
    - the object stands in balance on a wide base, or on a stalk (1);
    - it hangs in balance from something as thin as a cord (2.5);
    - photos were taken from below its lower end: it hangs (1); from above only: it stands (0.5);
    - most things stand (0.5), an upright sheet hangs (1), or flies from a pole somewhere else (0.5).

    A lead of 2 gives high confidence, a lead of 1 medium, and less low.

    Args:
        points: Centres of the simulated Gaussians [scene units], shape (N, 3).
        weight: Their visible area, shape (N,).
        up: Up direction, a unit vector.
        cell: Grid spacing [scene units]: parts within two cells touch.
        left_out: Centres of solid Gaussians that are not simulated [scene units], shape (M, 3).
        eyes: Positions of the photos' cameras [scene units], shape (C, 3).
        wall: Unit vector from the object to a wall on which it hangs; it overrides everything else.

    Returns:
        The guess.
    """
    if wall is not None:
        return HoldGuess("side", tuple(wall), "medium", "a wall behind it was left out")
    axis = torch.tensor(up, dtype=torch.float64)
    where, weight = points.double(), weight.double()
    height = where @ axis
    low, high = quantile(height, 0.005), quantile(height, 0.995)
    found: dict[str, list[tuple[float, str]]] = {"bottom": [], "top": [], "side": []}
    for end, touched in zip(("bottom", "top"), _touched(where, left_out, axis, cell), strict=True):
        if touched:
            found[end].append((2.0, f"what was left out touches its {ENDS[end]} end"))
    sideways: tuple[float, ...] = ()
    normal = sheet_normal(points)
    if normal is not None and abs(sum(a * b for a, b in zip(normal, up, strict=True))) < 0.5:
        found["top"].append((1.0, "it is an upright sheet, which hangs unless something else holds it"))
        sideways, known = _pole_side(where, axis, normal)
        if known:
            found["side"].append((2.0, "it is an upright sheet, and the origin lies at this side"))
        else:
            found["side"].append((0.5, "a flag would be held at its pole"))
    else:
        for end, near, far in (("bottom", low, high), ("top", high, low)):
            if abs(near) < 0.05 * (high - low) < abs(far):
                found[end].append((1.0, f"the origin lies at its {ENDS[end]} end"))
        base = standing_base(where, weight, axis)
        if base is not None:
            found["bottom"].append((1.0, base))
        cord = cord_heights(where, weight, axis)
        if cord is not None:
            long = f"{cord[1] - cord[0]:.2g} long, as thin as a cord"
            found["top"].append((2.5, f"it would hang in balance from something {long}"))
        found["bottom"].append((0.5, "most things stand"))
    if eyes is not None and len(eyes):
        seen = eyes.double() @ axis
        if float((seen < low - 0.05 * (high - low)).double().mean()) > 0.1:
            found["top"].append((1.0, "photos were taken from below its lower end"))
        elif float(seen.amin()) > low:
            found["bottom"].append((0.5, "all photos were taken from above its lower end"))
    scores = {end: sum(points for points, _ in reasons) for end, reasons in found.items()}
    end, second = sorted(scores, key=lambda name: -scores[name])[:2]
    lead = scores[end] - scores[second]
    directions = {"bottom": tuple(0.0 - c for c in up), "top": tuple(up), "side": sideways}
    confidence = "high" if lead >= 2 else "medium" if lead >= 1 else "low"
    why = "; ".join(f"{text} (+{points:g})" for points, text in found[end])
    against = "; ".join(f"{text} (+{points:g})" for points, text in found[second])
    why += f"; for the {second}: {against}" if against else ""
    return HoldGuess(end, directions[end], confidence, why, scores, tuple(_option(e, sideways) for e in (end, second)))


def balanced_base(points: Tensor, weight: Tensor, up: Tensor) -> tuple[float, float] | None:
    """Widths of the base on which an object would balance, and of the object [scene units]; None without a base.

    The base is the part within 3 % of the length from the lower end. It must be at least 0.4 times as wide as the
    object, with the centre of the visible area above it.

    Args:
        points: Centres, float64, shape (N, 3).
        weight: Visible area, shape (N,).
        up: Up direction, float64, shape (3,).
    """
    height = points @ up
    low, high = quantile(height, 0.002), quantile(height, 0.995)
    foot, wide = points[height <= low + 0.03 * (high - low)], width(points, up)
    if len(foot) >= FEWEST and width(foot, up) >= 0.4 * wide and _above(points, weight, foot, up, 0.0):
        return width(foot, up), wide
    return None


def standing_base(points: Tensor, weight: Tensor, up: Tensor) -> str | None:
    """Describe what an object would stand on: a wide base (:func:`balanced_base`) or a stalk; None if neither.

    A stalk is a lower end that is at most two thirds as wide as the upper one.
    """
    base = balanced_base(points, weight, up)
    if base is not None:
        return f"it would stand in balance on a base {base[0]:.3g} wide, itself {base[1]:.3g}"
    height = points @ up
    low, high = quantile(height, 0.002), quantile(height, 0.995)
    depth = 0.08 * (high - low)
    top, bottom = (width(points[mask], up) for mask in (height >= high - depth, height <= low + depth))
    if top > 1.5 * bottom:
        return f"the lower end is {bottom:.3g} wide, the upper {top:.3g}: like a stalk"
    return None


def cord_heights(points: Tensor, weight: Tensor, up: Tensor) -> tuple[float, float] | None:
    """Lower and upper end of the cord that an object would hang from [scene units along up]; None if there is none.

    A cord is an upright stretch of at least 15 % of the length, at most 15 % from the top, that is thinner than 0.04 of
    the length and than a quarter of the widest part.
    """
    height = points @ up
    low, high = quantile(height, 0.001), float(height.amax())
    length, slices = high - low, 20
    if length <= 0:
        return None
    which = ((high - height) / length * slices).long().clamp(max=slices - 1)
    parts = [points[which == k] for k in range(slices)]
    across = plane_axes(up)  # one of the two widths of a plate is nearly zero
    wide = [breadth(part, across, 0.03) for part in parts]
    limit = min(0.04 * length, 0.25 * max(wide))
    thin = [bool(len(part)) and value < limit for part, value in zip(parts, wide, strict=True)]
    start = next((k for k in range(4) if thin[k]), None)
    if start is None:
        return None
    stop = next((k for k in range(start, slices) if not thin[k]), slices)
    if stop - start < 3 or stop == slices:
        return None
    first, last = (parts[k].mean(0) for k in (start, stop - 1))
    away = (first - last) - ((first - last) @ up) * up
    if float(away.norm()) > 0.1 * (stop - start) / slices * length:  # a slanted part is not a cord
        return None
    if not _above(points, weight, parts[start], up, 0.05 * length):
        return None
    return high - stop / slices * length, high - start / slices * length


def _above(points: Tensor, weight: Tensor, end: Tensor, up: Tensor, margin: float) -> bool:
    """True if the centre of the visible area is above or below the hull of one end, within a margin."""
    centre = (points * weight[:, None]).sum(0) / weight.sum().clamp(min=1e-300)
    one, other = plane_axes(up)
    for k in range(8):
        along = math.cos(k * math.pi / 8) * one + math.sin(k * math.pi / 8) * other
        where, at = end @ along, float(centre @ along)
        if not quantile(where, 0.01) - margin <= at <= quantile(where, 0.99) + margin:
            return False
    return True


def _pole_side(points: Tensor, up: Tensor, normal: Sequence[float]) -> tuple[tuple[float, ...], bool]:
    """Direction of the upright side of a sheet that contains the origin; if none does, one of the sides, and False."""
    across = torch.linalg.cross(up, torch.tensor(normal, dtype=torch.float64))
    across = torch.tensor(snapped(across), dtype=torch.float64)
    along = points @ across
    low, high = float(along.amin()), float(along.amax())
    for end, sign, other in ((low, -1.0, high), (high, 1.0, low)):
        if abs(end) < 0.05 * (high - low) < abs(other):
            return tuple(float(sign * c) + 0.0 for c in across), True
    return tuple(0.0 - float(c) for c in across), False


def _option(end: str, sideways: Sequence[float]) -> str:
    if end != "side" or not sideways:
        return end
    return max(DIRECTIONS, key=lambda name: sum(a * b for a, b in zip(DIRECTIONS[name], sideways, strict=True)))


def _touched(points: Tensor, left_out: Tensor | None, up: Tensor, cell: float) -> tuple[bool, bool]:
    """Return two booleans: excluded Gaussians are right below the lower end, and right above the upper one.

    That is so if at least 30 % of the columns of cells at that end have something in or beside them within two cells.
    """
    if left_out is None or len(left_out) == 0:
        return False, False
    axes = torch.stack(plane_axes(up))

    def columns(where: Tensor) -> Tensor:
        index = (where @ axes.T / cell).floor().long()
        return (index[:, 0] * 2**31 + index[:, 1]).unique()

    result = []
    for sign in (-1.0, 1.0):
        along, other = sign * (points @ up), sign * (left_out.double() @ up)
        end = quantile(along, 0.995)
        mine = columns(points[along > end - 1.5 * cell])
        near = left_out.double()[(other > end - 0.5 * cell) & (other < end + 2.5 * cell)]
        theirs = columns(near)
        shifts = [a * 2**31 + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
        reach = torch.cat([theirs + shift for shift in shifts])
        result.append(len(theirs) > 0 and float(torch.isin(mine, reach).double().mean()) >= 0.3)
    return result[0], result[1]


def given_hold(end: str, up: Sequence[float]) -> HoldGuess:
    """A given end: ``top``, ``bottom``, ``none``, or the axis ``+x`` to ``-z`` that points to it."""
    check_choice("--hold", end, ("top", "bottom", "none", *DIRECTIONS))
    if end in DIRECTIONS:
        return HoldGuess("side", DIRECTIONS[end], "given", "given")
    return HoldGuess(end, tuple(0.0 - c for c in up) if end == "bottom" else tuple(up), "given", "given")


def end_region(points: Tensor, direction: Sequence[float], cell: float) -> Region:
    """The end of an object as a region: a half-open box if the direction is an axis, else a cylinder.

    Its depth is 6 % of the length in that direction, at least one and a half cells. It is measured from the place
    beyond which there are 0.5 % of the points.

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
    solid_end = quantile(along, 0.995)  # so that a few stragglers do not matter
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
