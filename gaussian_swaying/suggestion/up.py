"""The up direction of a splat, from its shape and from conventions of capturing and modelling programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from gaussian_swaying._checks import check_vector
from gaussian_swaying.gaussians.hold import balanced_base
from gaussian_swaying.gaussians.measures import (
    DIRECTIONS,
    FEWEST,
    Array,
    Gaussians,
    Guess,
    corners,
    extent,
    plane_axes,
    ranked,
    sheet_normal,
    sides,
)
from gaussian_swaying.geometry.rotations import rotation_from_z

CONVENTION = {"+z": 0.75, "-y": 0.75, "+y": 0.5, "-z": -1.0, "+x": -1.0, "-x": -1.0}
"""Points of each direction, by what capturing and modelling programs write."""
PROGRAMS = {"+z": "z is up in Blender", "-y": "y is down in COLMAP", "+y": "y is up in glTF"}


def wind_words(flow: Sequence[float], up: Sequence[float]) -> str:
    """A flow in words, with z up and, if z is not up in the scene, also in scene axes.

    Args:
        flow: Velocity [m/s], z up.

    Example:
        >>> wind_words([2.0, 5.0, 0.0], [0.0, -1.0, 0.0])
        '[2, 5, 0] m/s, z up ([2, 0, 5] in scene axes)'
    """
    rotation = rotation_from_z(up)
    turned = rotation @ torch.tensor(flow, dtype=torch.float64)
    here, there = (vector_words([round(v, 4) for v in vector]) for vector in (flow, turned.tolist()))
    words = f"{here} m/s, z up"
    return words if torch.equal(rotation, torch.eye(3).double()) else f"{words} ({there} in scene axes)"


def vector_words(values: Sequence[float]) -> str:
    """Numbers with three digits in brackets."""
    return "[" + ", ".join(f"{value + 0.0:.3g}" for value in values) + "]"


def floor_mask(splat: Gaussians, up: Sequence[float] | Array) -> Array:
    """Gaussians that form a level floor at the lower end of a scene, bool, shape (N,); all false if there is none.

    A floor is a layer with a thickness of 4 % of the longest side. It contains at least 15 % of the visible area, most
    of it level. There is almost nothing below it and something above it that is narrower.
    """
    axis, weight, none = np.asarray(up), splat.weight, np.zeros(len(splat), bool)
    side, total = extent(splat.means), weight.sum()
    if side <= 0 or total <= 0:
        return none
    height, level, half = splat.means @ axis, np.abs(splat.normals @ axis) > 0.8, 0.02 * side
    bins = ((height - height.min()) / half).astype(int).clip(max=9999)
    flat = np.bincount(bins, weight * level, bins.max() + 3)
    start = height.min() + half * (flat[:-1] + flat[1:]).argmax()
    below, above = height < start, height > start + 2 * half
    layer = ~below & ~above
    own, rest = weight[layer].sum(), weight[above].sum()
    if own < 0.15 * total or rest < 0.05 * total or weight[below].sum() > 0.03 * total:
        return none
    if weight[layer & level].sum() < 0.6 * own or above.sum() < FEWEST:
        return none
    wide, narrower = (sides(splat.means[m] @ plane_axes(axis), 0.02) for m in (layer, above))
    return none if (wide < 0.9 * narrower).any() else ~above


def guess_up(splat: Gaussians) -> tuple[Guess, Array]:
    """The scene axis that most likely points up, and the floor below, bool, shape (N,).

    Each of the six directions along an axis gets points: for convention (z up and y down 0.75, y up 0.5, others -1),
    for a floor below (3, less if things on it are flat), for the origin at the lower end (1), for a wide base in
    balance (0.5, not for sheets), and if the axis is the longest (log2 of its ratio to the next, up to 1.5). A thin
    sheet hangs, so its normal loses 1.
    """
    (low, high), sheet = corners(splat.means), sheet_normal(splat.means)
    side = high - low
    *_, second, longest = sorted(side)
    found, floors = {}, {}
    for name, direction in DIRECTIONS.items():
        axis, own = "xyz".index(name[1]), [(CONVENTION[name], PROGRAMS.get(name, ""))]
        floor = floors[name] = floor_mask(splat, direction)
        if floor.any():  # a thing on it that is flatter than 0.3 times its width counts less
            wide = sides(splat.means[floor] @ plane_axes(direction), 0.02).min()
            tall = extent(splat.means[~floor] @ direction, 0.02)
            own.append((3 * min(1.0, tall / max(0.3 * wide, 1e-30)), "there is a level floor at the lower end"))
        near, far = (low[axis], high[axis]) if name[0] == "+" else (high[axis], low[axis])
        if side[axis] > 0 and abs(near) < 0.05 * side[axis] < abs(far):
            own.append((1.0, "the origin is at the lower end"))
        if side[axis] == longest and longest > 1.3 * second:
            ratio = min(math.log2(longest / max(second, 1e-30)), 1.5)
            own.append((ratio, f"it is the longest side, {longest:.3g} against {second:.3g}"))
        if sheet is None and balanced_base(splat, np.array(direction)) is not None:
            own.append((0.5, "it would stand in balance on a wide base"))
        if sheet is not None and abs(sheet[axis]) > 0.8:
            own.append((-1.0, ""))
        found[name] = own
    best, other, confidence, scores = ranked(found)
    why = [f"{words} (+{points:.2g})" for points, words in found[best] if words]
    why.append(f"{other} comes next, {scores[best] - scores[other]:.2g} behind")
    return Guess(best, DIRECTIONS[best], confidence, tuple(why), scores, (best, other)), floors[best]


def given_up(up: str | Sequence[float] | Sequence[str]) -> Guess:
    """A given up direction: 3 numbers or ``+x`` to ``-z``, also as words of a command line."""
    words: list[Any] = [up] if isinstance(up, str) else list(up)
    told = " ".join(word if isinstance(word, str) else f"{word:g}" for word in words)
    try:
        direction = check_vector("--up", DIRECTIONS.get(told) or [float(word) for word in words])
    except ValueError:
        raise ValueError(f"Expected `--up` to be {', '.join(DIRECTIONS)} or 3 numbers, but got {told}.") from None
    length = math.hypot(*direction)
    if length == 0:
        raise ValueError("Expected `--up` to be a direction, for example 0 -1 0, but got zero.")
    return Guess("given", tuple(c / length for c in direction))


def camera_words(guess: Guess) -> tuple[str, ...]:
    """Values of ``--up`` for a direction and its opposite."""
    return tuple(" ".join(f"{sign * c + 0.0:.4g}" for c in guess.direction) for sign in (1.0, -1.0))
