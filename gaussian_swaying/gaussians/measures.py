"""The Gaussians of a splat as arrays, measures of clouds of points, and guesses with their reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.patches import smallest_axis_normal

Array = np.ndarray
SHEET = 0.1  # smallest over middle standard deviation of the centres of a sheet
FEWEST = 16  # smallest number of Gaussians in an object
GREEN = 0.08  # how much greener than red and blue, as a share of the brightness
SIGNS = {"+": 1.0, "-": -1.0}
DIRECTIONS = {s + a: tuple(sign * (a == b) + 0.0 for b in "xyz") for a in "xyz" for s, sign in SIGNS.items()}
"""Unit vectors by name, from ``+x`` to ``-z``."""


@dataclass(frozen=True)
class Gaussians:
    """Gaussians as arrays.

    Attributes:
        means: Centres [scene units], float64, shape (N, 3).
        normals: Unit normals of either sign, shape (N, 3).
        scales: Standard deviations, the largest first [scene units], shape (N, 3).
        opacity: Opacities, shape (N,).
        weight: Visible area: opacity times pi s1 s2 [scene units²], with the largest 1 % clamped, shape (N,).
        colour: The colour from all sides, from 0 to 1, shape (N, 3).
    """

    means: Array
    normals: Array
    scales: Array
    opacity: Array
    weight: Array
    colour: Array

    @classmethod
    @torch.no_grad()
    def of(cls, cloud: GaussianCloud) -> Gaussians:
        opacity = cloud.opacities.sigmoid()
        weight = (opacity * patch_area(cloud.scales)).double().numpy()
        return cls(
            cloud.means.double().numpy(),
            smallest_axis_normal(cloud.quats, cloud.scales).numpy(),
            np.sort(cloud.scales.exp().numpy())[:, ::-1],
            opacity.numpy(),
            np.minimum(weight, quantile(weight, 0.99)),
            (0.5 + SH_DC * cloud.sh[:, 0]).clamp(0, 1).numpy(),
        )

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, which: Array | slice) -> Gaussians:
        return Gaussians(*(getattr(self, field.name)[which] for field in fields(self)))

    @property
    def green(self) -> Array:
        """True for those whose colour is green, bool, shape (N,)."""
        red, green, blue = self.colour.T
        return green - 0.5 * (red + blue) > GREEN * self.colour.max(1)


@dataclass(frozen=True)
class Guess:
    """One of several possibilities, and why.

    Attributes:
        name: Its name: a direction or an end.
        direction: The direction that it stands for, a unit vector in scene axes.
        confidence: ``high``, ``medium`` or ``low``, by the lead over the next best; ``given`` if it was.
        scores: Points of each possibility; empty if there was one.
        options: Values of the option for this one and the next best; empty if it was given.
    """

    name: str
    direction: tuple[float, ...]
    confidence: str = "given"
    reasons: tuple[str, ...] = ("given",)
    scores: Mapping[str, float] | None = None
    options: tuple[str, ...] = ()


def ranked(reasons: Mapping[str, Sequence[tuple[float, str]]]) -> tuple[str, str, str, dict[str, float]]:
    """The best candidate, the runner-up, the confidence, and the score of each.

    A lead of 2 gives high confidence, a lead of 1 medium, and less low.
    """
    scores = {name: sum(points for points, _ in found) for name, found in reasons.items()}
    best, second = sorted(scores, key=lambda name: -scores[name])[:2]
    lead = scores[best] - scores[second]
    return best, second, "high" if lead >= 2 else "medium" if lead >= 1 else "low", scores


def quantile(values: Array, share: float) -> float:
    """The sample nearest to a quantile."""
    return float(np.quantile(values, share, method="nearest"))


def corners(points: Array, share: float = 0.005) -> Array:
    """Bounds of points (N, ...) without the outermost ``share`` at each end of each axis: shape (2, ...)."""
    return np.quantile(points, (share, 1 - share), axis=0, method="nearest")


def sides(points: Array, share: float = 0.005) -> Array:
    """Sides of the box of :func:`corners`, shape (...)."""
    return np.ptp(corners(points, share), axis=0)


def extent(points: Array, share: float = 0.005) -> float:
    """The longest of the :func:`sides` of points (N, ...)."""
    return float(sides(points, share).max())


def cells_of(points: Array, cell: float) -> Array:
    """The cell of each point (N, K), numbered from 0 in their order, shape (N,)."""
    return equal_rows(torch.from_numpy(np.floor(points / cell))).numpy()


def spacing_of(points: Array) -> float:
    """See :func:`particle_spacing`."""
    return particle_spacing(torch.from_numpy(points))


def plane_axes(axis: Sequence[float] | Array) -> Array:
    """Two unit vectors perpendicular to another, as columns: shape (3, 2)."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)], 1)


def breadth(points: Array, axis: Sequence[float] | Array, share: float) -> float:
    """The larger of the extents of points (N, 3) perpendicular to an axis, see :func:`extent`; 0 for none."""
    return extent(points @ plane_axes(axis), share) if len(points) else 0.0


def width(points: Array, axis: Sequence[float] | Array) -> float:
    """Geometric mean of the widths of points perpendicular to an axis, robust."""
    return math.sqrt(sides(points @ plane_axes(axis), 0.03).clip(1e-9).prod())


def slices_of(height: Array, count: int, share: float = 0.005) -> Array:
    """The slice of each height from the lower to the upper end, numbered from 0, shape (N,)."""
    low, high = corners(height, share)
    return ((height - low) / max(high - low, 1e-30) * count).astype(int).clip(0, count - 1)


def sheet_normal(points: Array) -> Array | None:
    """Unit normal of points that are close to a plane (see ``SHEET``), set to an axis within 10 degrees."""
    values, axes = np.linalg.eigh(np.cov(points.T))
    spread = np.sqrt(values.clip(0))
    if spread[1] <= 0 or spread[0] > SHEET * spread[1]:
        return None
    return snapped(axes[:, 0] * np.sign(axes[np.abs(axes[:, 0]).argmax(), 0]), 10)


def snapped(direction: Array, degrees: float) -> Array:
    """A unit vector, replaced by an axis if one lies within an angle of it."""
    main = np.abs(direction).argmax()
    if abs(direction[main]) <= math.cos(math.radians(degrees)):
        return direction
    return np.eye(3)[main] * np.sign(direction[main]) + 0.0


def largest_plane(points: Array, weight: Array, half: float, axis: Array | None = None) -> tuple[Array, float] | None:
    """The plane with the most weight within a distance of it, the best of 400 through three points.

    Args:
        points: Shape (N, 3).
        axis: Direction from which the normal is at most 45 degrees away; None for any.

    Returns:
        Unit normal, on the side of ``axis``, and offset; None for too few points, or no such plane.
    """
    if len(points) < FEWEST:
        return None
    step = max(1, len(points) // 4000)
    points, weight = points[::step], weight[::step] + 1e-300
    a, b, c = points[np.random.default_rng(0).choice(len(points), (3, 400), p=weight / weight.sum())]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    fit = length > 1e-12
    normals /= length.clip(1e-30)[:, None]
    if axis is not None:
        fit &= np.abs(normals @ axis) > math.sqrt(0.5)
    if not fit.any():
        return None
    offsets = (normals * a).sum(1)
    inside = np.abs(points @ normals.T - offsets) <= half
    best = np.where(fit, weight @ inside, -1.0).argmax()
    normal, offset = normals[best], offsets[best]
    for _ in range(3):
        near = np.abs(points @ normal - offset) <= half
        middle = np.average(points[near], 0, weight[near])
        normal = np.linalg.eigh(np.cov(points[near].T, aweights=weight[near]))[1][:, 0]
        offset = middle @ normal
    sign = 1.0 if axis is None or normal @ axis >= 0 else -1.0
    return sign * normal, float(sign * offset)


def pieces(points: Array, cell: float) -> Array:
    """The number of each point's connected part, see :func:`connected_parts`."""
    return connected_parts(torch.from_numpy(points), cell).numpy()


def rounded(values: Sequence[float] | Array, cell: float) -> list[float]:
    """Coordinates rounded to about a hundredth of a cell."""
    return [round(float(value), max(0, 2 - math.floor(math.log10(cell)))) for value in values]
