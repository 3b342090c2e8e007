"""Guess whether an object stands or hangs, and which of its ends is to be pinned."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gaussian_swaying._checks import check_choice
from gaussian_swaying.gaussians.measures import (
    DIRECTIONS,
    FEWEST,
    Array,
    Gaussians,
    Guess,
    breadth,
    corners,
    plane_axes,
    quantile,
    ranked,
    rounded,
    sheet_normal,
    snapped,
    width,
)
from gaussian_swaying.geometry.regions import Box, Cylinder, Region

PIN_DEPTH = 0.06  # depth of the pinned end, as a share of the object's length in that direction
ENDS = {"bottom": "lower", "top": "upper"}
AROUND = [a * 2**31 + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
"""From the key of a column to those of itself and its neighbours."""


def guess_hold(
    splat: Gaussians,
    up: Sequence[float],
    cell: float,
    left_out: Array | None = None,
    eyes: Array | None = None,
    wall: Sequence[float] | None = None,
) -> Guess:
    """The end at which the object is held: ``bottom``, ``top`` or ``side``.

    Each end gets points, and the highest sum wins:

    - Gaussians outside the region touch the object there (2);
    - the origin is at that end (1), or at a side of an upright sheet, as for a flag at its pole (2);
    - the object stands in balance on a wide base, or on a stalk (1);
    - it hangs in balance from something as thin as a cord (2.5);
    - photos were taken from below its lower end: it hangs (1); from above only: it stands (0.5);
    - most things stand (0.5), an upright sheet hangs (1), or flies from a pole somewhere else (0.5).

    Args:
        up: Up direction, a unit vector.
        cell: Grid spacing [scene units]: parts within two cells touch.
        left_out: Centres of solid Gaussians that are not simulated [scene units], shape (M, 3).
        eyes: Positions of the photos' cameras [scene units], shape (C, 3).
        wall: Unit vector from the object to a wall on which it hangs; it overrides everything else.
    """
    if wall is not None:
        return Guess("side", tuple(wall), "medium", ("a wall behind it was left out",))
    axis, points = np.array(up), splat.means
    height = points @ axis
    low, high = corners(height)
    found: dict[str, list[tuple[float, str]]] = {"bottom": [], "top": [], "side": []}
    for end, sign in (("bottom", -1.0), ("top", 1.0)):
        if left_out is not None and len(left_out) and _touched(points, left_out, sign * axis, cell):
            found[end].append((2.0, f"what was left out touches its {ENDS[end]} end"))
    sideways: tuple[float, ...] = (0.0, 0.0, 0.0)
    normal = sheet_normal(points)
    if normal is not None and abs(normal @ axis) < 0.5:
        found["top"].append((1.0, "it is an upright sheet, which hangs unless something else holds it"))
        sideways, known = _pole_side(points, np.cross(axis, normal))
        why = (
            "it is an upright sheet, and the origin lies at this side" if known else "a flag would be held at its pole"
        )
        found["side"].append((2.0 if known else 0.5, why))
    else:
        for end, near, far in (("bottom", low, high), ("top", high, low)):
            if abs(near) < 0.05 * (high - low) < abs(far):
                found[end].append((1.0, f"the origin lies at its {ENDS[end]} end"))
        base = standing_base(splat, axis)
        if base is not None:
            found["bottom"].append((1.0, base))
        cord = cord_heights(splat, axis)
        if cord is not None:
            long = f"{cord[1] - cord[0]:.2g} long, as thin as a cord"
            found["top"].append((2.5, f"it would hang in balance from something {long}"))
        found["bottom"].append((0.5, "most things stand"))
    if eyes is not None and len(eyes):
        views = eyes @ axis
        if (views < low - 0.05 * (high - low)).mean() > 0.1:
            found["top"].append((1.0, "photos were taken from below its lower end"))
        elif views.min() > low:
            found["bottom"].append((0.5, "all photos were taken from above its lower end"))
    end, second, confidence, scores = ranked(found)
    why, against = ("; ".join(f"{text} (+{points:g})" for points, text in found[name]) for name in (end, second))
    directions = {"bottom": tuple(0.0 - c for c in up), "top": tuple(up), "side": sideways}
    options = tuple(hold_option(name, sideways) for name in (end, second))
    reason = f"{why}; for the {second}: {against}" if against else why
    return Guess(end, directions[end], confidence, (reason,), scores, options)


def balanced_base(splat: Gaussians, up: Array) -> tuple[float, float] | None:
    """Widths of the base on which an object would balance, and of the object [scene units]; None without a base.

    The base is the part within 3 % of the length from the lower end. It must be at least 0.4 times as wide as the
    object, with the centre of the visible area above it.
    """
    height = splat.means @ up
    low, high = quantile(height, 0.002), quantile(height, 0.995)
    foot, wide = splat.means[height <= low + 0.03 * (high - low)], width(splat.means, up)
    if len(foot) >= FEWEST and width(foot, up) >= 0.4 * wide and _above(splat, foot, up, 0.0):
        return width(foot, up), wide
    return None


def standing_base(splat: Gaussians, up: Array) -> str | None:
    """Describe what an object would stand on: a wide base (:func:`balanced_base`) or a stalk; None if neither.

    A stalk is a lower end that is at most two thirds as wide as the upper one.
    """
    base = balanced_base(splat, up)
    if base is not None:
        return f"it would stand in balance on a base {base[0]:.3g} wide, itself {base[1]:.3g}"
    height = splat.means @ up
    low, high = quantile(height, 0.002), quantile(height, 0.995)
    depth = 0.08 * (high - low)
    top, bottom = (width(splat.means[mask], up) for mask in (height >= high - depth, height <= low + depth))
    if top > 1.5 * bottom:
        return f"the lower end is {bottom:.3g} wide, the upper {top:.3g}: like a stalk"
    return None


def cord_heights(splat: Gaussians, up: Array) -> tuple[float, float] | None:
    """Lower and upper end of the cord that an object would hang from [scene units along up]; None if there is none.

    A cord is an upright stretch of at least 15 % of the length, at most 15 % from the top, that is thinner than 0.04 of
    the length and than a quarter of the widest part.
    """
    height, slices = splat.means @ up, 20
    high = height.max()
    length = high - quantile(height, 0.001)
    if length <= 0:
        return None
    which = ((high - height) / length * slices).astype(int).clip(max=slices - 1)
    parts = [splat.means[which == k] for k in range(slices)]
    wide = [breadth(part, up, 0.03) for part in parts]  # one of the two widths of a plate is nearly zero
    limit = min(0.04 * length, 0.25 * max(wide))
    thin = [len(part) > 0 and value < limit for part, value in zip(parts, wide, strict=True)]
    start = next((k for k in range(4) if thin[k]), slices)
    stop = next((k for k in range(start, slices) if not thin[k]), slices)
    if stop - start < 3 or stop == slices:
        return None
    along = parts[start].mean(0) - parts[stop - 1].mean(0)
    slanted = np.linalg.norm(along - along @ up * up) > 0.1 * (stop - start) / slices * length
    if slanted or not _above(splat, parts[start], up, 0.05 * length):
        return None
    return high - stop / slices * length, high - start / slices * length


def _above(splat: Gaussians, end: Array, up: Array, margin: float) -> bool:
    angles = np.arange(8) * math.pi / 8
    along = plane_axes(up) @ [np.cos(angles), np.sin(angles)]
    at = np.average(splat.means, 0, splat.weight + 1e-300) @ along
    low, high = corners(end @ along, 0.01)
    return bool(((low - margin <= at) & (at <= high + margin)).all())


def _pole_side(points: Array, across: Array) -> tuple[tuple[float, ...], bool]:
    across = snapped(across / np.linalg.norm(across), 10)
    across = across * np.sign(across[np.abs(across).argmax()])
    along = points @ across
    low, high = along.min(), along.max()
    for end, sign, other in ((low, -1.0, high), (high, 1.0, low)):
        if abs(end) < 0.05 * (high - low) < abs(other):
            return tuple((sign * across + 0.0).tolist()), True
    return tuple((0.0 - across).tolist()), False


def hold_option(end: str, sideways: Sequence[float]) -> str:
    """The value of ``--hold`` for an end."""
    if end != "side":
        return end
    return max(DIRECTIONS, key=lambda name: float(np.dot(DIRECTIONS[name], sideways)))


def columns(flat: Array, cell: float) -> Array:
    """Number of the grid column of each place (N, 2)."""
    index = np.floor(flat / cell).astype(np.int64)
    return index[:, 0] * 2**31 + index[:, 1]


def _touched(points: Array, left_out: Array, outward: Array, cell: float) -> bool:
    """True if at least 30 % of the columns of cells at an end have others in or beside them within two cells."""
    axes, along, other = plane_axes(outward), points @ outward, left_out @ outward
    end = quantile(along, 0.995)
    mine = np.unique(columns(points[along > end - 1.5 * cell] @ axes, cell))
    near = left_out[(other > end - 0.5 * cell) & (other < end + 2.5 * cell)]
    theirs = np.unique(columns(near @ axes, cell))
    return len(theirs) > 0 and bool(np.isin(mine, np.add.outer(theirs, AROUND)).mean() >= 0.3)


def given_hold(end: str, up: Sequence[float]) -> Guess:
    """The end that an option names: ``top``, ``bottom``, ``none``, or the axis ``+x`` to ``-z`` towards it."""
    check_choice("--hold", end, ("top", "bottom", "none", *DIRECTIONS))
    if end in DIRECTIONS:
        return Guess("side", DIRECTIONS[end])
    return Guess(end, tuple(0.0 - c for c in up) if end == "bottom" else tuple(up))


def end_region(points: Array, direction: Sequence[float], cell: float) -> Region:
    """The end of an object as a region: a half-open box if the direction is an axis, else a cylinder.

    Its depth is 6 % of the length in that direction, at least one and a half cells. It is measured from the place
    beyond which there are 0.5 % of the points, so that a few stragglers do not matter.

    Args:
        points: Centres of the simulated Gaussians [scene units], shape (N, 3).
        cell: Grid spacing [scene units].
    """
    axis = np.array(direction)
    along = points @ axis
    low, high = along.min(), along.max()
    start = max(quantile(along, 0.995) - max(PIN_DEPTH * (high - low), 1.5 * cell), low)
    main = int(np.abs(axis).argmax())
    if abs(axis[main]) > 1 - 1e-6:
        corner: list[float | None] = [None, None, None]
        [corner[main]] = rounded([start * axis[main]], cell)
        return Box(corner, [None] * 3) if axis[main] > 0 else Box([None] * 3, corner)
    centre, height = points.mean(0), 2 * (high - low) + 4 * cell
    radius = 2 * np.linalg.norm(points - centre, axis=1).max()
    return slab(centre, axis, start, (radius, height), cell)


def slab(centre: Array, normal: Array, start: float, size: tuple[float, float], cell: float) -> Cylinder:
    """A cylinder along a normal, from an offset on, with ``size`` its radius and height [scene units]."""
    radius, height = rounded(size, cell)
    centre = centre + (start + 0.5 * size[1] - centre @ normal) * normal
    return Cylinder(rounded(centre, cell), [round(float(c), 6) for c in normal], radius, height)
