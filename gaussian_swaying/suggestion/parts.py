"""The parts of plants in pots, flags on poles, washing lines, trees and hanging things, by shape and colour."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import torch

from gaussian_swaying.gaussians.hold import cord_heights
from gaussian_swaying.gaussians.measures import (
    FEWEST,
    Array,
    Gaussians,
    Guess,
    breadth,
    cells_of,
    corners,
    extent,
    pieces,
    plane_axes,
    quantile,
    sheet_normal,
    slices_of,
)
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.suggestion.moves import contains

SLICES, SECTORS = 40, 16  # of the height; of a slice
# of a plant in a pot
COVERED = 0.75  # share of the sectors of a slice in which a pot must be
ROUND = 0.12  # standard deviation of its radius over the sectors, as a share of the radius
POT, SLENDER = (0.05, 0.6), 5.0  # height of a pot, as a share of that of the object; most radii, or it is a trunk
PLANT, LEAFY = 0.1, 0.5  # share of the visible area that must be above the rim, and the share of it that must be green
WALL, SAUCER = 0.88, 1.25  # radii from the axis between which the wall lies, as shares of the radius there
OPENING, INSIDE = 0.7, 0.4  # part of the radius in which soil is looked for, and share of its cells that must have some
LEVEL = 0.015  # of the height: how far above its plane soil may lie
NEIGHBOURS = 12  # whose most frequent label a Gaussian near the pot gets
RIM, POT_GREEN = (0.25, 0.8), 0.15  # height of the rim of a pot known by colour alone; green share of what is below it
# of stems
CELL, NEAR = 0.006, 0.03  # of the height: cells in which shapes are looked at, and how far around
SEEN = 8  # cells around that show a shape
THIN, LONG, THREAD = 0.25, 0.5, 0.12  # third over second variance of the places around, and second over first (twice)
HAZE, TOUCHES = 0.1, 2.0  # opacity below which a Gaussian lies on what it touches; standard deviations that it reaches
# of poles and posts
SLIM, BARE = 0.04, 0.08  # width of a pole, as a share of the height; share of the slices in which it is alone
CLOTH = 0.3  # width of a slice with cloth, as a share of the widest
OUTSIDE = 0.02  # share of the Gaussians of a flag that may lie on the other side of its pole
RIPPLED = 0.35  # depth of a flag over its length, seen from above
COLUMNS, LEVELS = 50, 20  # in which the posts of a washing line are looked for
THICK, ARM, HEM = 0.12, 0.1, 0.05  # width of a post and of its foot and arms beside it; height of the hem, as shares
# of trees and what hangs
FOOT = 5  # slices in which the ground around a trunk may be wide
TRUNK, CROWN = 0.12, 0.5  # height of a bare trunk, as a share of that of the tree; green share of what is above
NARROW = 0.35  # width of a trunk, as a share of that of the crown
POST, SLIGHT = 0.25, 0.08  # height and width of a post, as shares of the height of the object
NECK, NECK_SHARE = 3.0, 0.1  # cells, share of the height: what bends above a hanging body

POT_LABEL, SOIL, STEM, LEAF, OTHER = range(5)
AROUND = "surroundings"
Labels = tuple[Array, list[Part], str]
"""The label of each Gaussian of an object, the parts by label, and what was found, in words."""
Support = tuple[Labels, Guess]
"""Parts that tell where the object is held."""


@dataclass(frozen=True, eq=False)
class FoundParts:
    """The parts of a splat.

    Attributes:
        parts: A label for each Gaussian.
        reason: What was found, in words.
    """

    parts: Parts
    reason: str

    @property
    def names(self) -> list[str]:
        return [part.name for part in self.parts.parts]

    def mask(self, name: str | None = None, role: str | None = None) -> Array:
        """The Gaussians of a part or a role, bool, shape (N,); none if there is no such part."""
        if name is not None and name not in self.names:
            return np.zeros(len(self.parts), bool)
        return self.parts.mask(name, role=role).numpy()

    def words(self) -> str:
        named = zip(self.parts.parts, self.parts.labels.bincount(minlength=len(self.names)).tolist(), strict=True)
        return ", ".join(f"{part.name} {part.role} ({number:,} Gaussians)" for part, number in named)

    def within(self, of: Array) -> FoundParts:
        """The same parts in a larger splat: ``of``, bool, shape (M,), marks these Gaussians; the others are still."""
        parts = [*self.parts.parts, *([] if AROUND in self.names else [Part(AROUND, "still")])]
        labels = torch.full((len(of),), [part.name for part in parts].index(AROUND))
        labels[torch.from_numpy(of)] = self.parts.labels
        return replace(self, parts=Parts(labels, parts))


def labelled(splat: Gaussians, simulated: Array, size: float, found: Labels | None) -> FoundParts | None:
    """Parts of a splat, without those that have no Gaussians.

    What is near the object, or faint and touches it, goes with it; others are around.

    Args:
        simulated: Those of the object, bool, shape (N,).
        size: Height of the object [scene units].
        found: Labels of the object; the label after the last part is that of what is around it.
    """
    from scipy.spatial import cKDTree

    if found is None:
        return None
    label, parts, reason = found
    labels = np.full(len(splat), len(parts))
    labels[simulated] = label
    rest = np.flatnonzero(labels == len(parts))
    if len(rest):
        distance, near = cKDTree(splat.means[simulated]).query(splat.means[rest])
        reach = NEAR * size + np.where(splat.opacity[rest] < HAZE, TOUCHES, 0.0) * splat.scales[rest, 0]
        labels[rest] = np.where(distance < reach, label[near], len(parts))
    used, place = np.unique(labels, return_inverse=True)
    every = [*parts, Part(AROUND, "still")]
    return FoundParts(Parts(torch.from_numpy(place), [every[k] for k in used]), reason)


def green_shares(own: Gaussians, which: Array) -> tuple[Array, Array]:
    """The green share of the visible area of each slice, and its sum, shape (SLICES,) each."""
    area = np.bincount(which, own.weight, SLICES)
    return np.bincount(which, own.weight * own.green, SLICES) / area.clip(1e-30), area


# ---- a plant in a pot


@dataclass(frozen=True, eq=False)
class _Pot:
    """A surface of revolution: centre and radius at heights, and the height of its rim."""

    heights: Array
    centres: Array
    radii: Array
    rim: float = 0.0

    def share(self, across: Array, height: Array) -> Array:
        """Distance from the axis as a share of the radius at that height, shape (N,)."""
        centre = np.stack([np.interp(height, self.heights, c) for c in self.centres.T], -1)
        return np.linalg.norm(across - centre, axis=1) / np.interp(height, self.heights, self.radii)


def potted_plant(own: Gaussians, up: Array) -> Support | None:
    """Pot, soil, stems and leaves of a plant that stands in a pot.

    A pot is round about the up axis, at the lower end, and not green. It ends where the round wall ends, and most of
    what is above that is green. Soil is what lies level inside, and not green. Leaves are flat, stems are the rest.
    The pot is still, or held if no soil is seen in it; the soil is held, stems and leaves are soft.
    """
    low, high = corners(own.means @ up, 0.002)
    size, green = high - low, own.green
    if size <= 0:
        return None
    height, across = (own.means @ up - low) / size, own.means @ plane_axes(up) / size
    pot = _find_pot(across, height, own.weight, green)
    if pot is None:
        return None
    above, share = height > pot.rim, pot.share(across, height)
    in_pot, over, leafy = (own.weight[some].sum() for some in (~above & (share < SAUCER), above, above & green))
    if over < PLANT * (in_pot + over) or leafy < LEAFY * over:
        return None
    soil, level = _find_soil(across, height, share, green, pot)
    label = np.full(len(own), STEM)
    below, lowest = height < pot.rim + 0.25 * LEVEL, (height < 2 / SLICES) & ~green
    label[below & (share >= WALL) & (share < SAUCER) & ~green] = POT_LABEL
    label[lowest] = np.where(share[lowest] < SAUCER, POT_LABEL, OTHER)
    if level is not None:
        label[soil] = SOIL
        label[below & (share < WALL) & (height < level - 3 * LEVEL)] = POT_LABEL  # under the surface
    else:
        label[below & (share < WALL) & ~green] = POT_LABEL
    near = height < pot.rim + 2 * LEVEL
    for _ in range(2):
        label[near] = _most_frequent(own.means[near], label[near])
    if level is not None:
        label[(label == SOIL) & (height < level - 5 * LEVEL)] = POT_LABEL
    plant = np.flatnonzero(label == STEM)
    piece = pieces(own.means[plant], 0.5 * NEAR * size)
    top = np.full(piece.max(initial=0) + 1, -np.inf)
    np.maximum.at(top, piece, height[plant])
    label[plant[(top[piece] < pot.rim) & (share[plant] < SAUCER)]] = POT_LABEL  # spots on the wall
    plant = np.flatnonzero(label == STEM)
    if len(plant) < FEWEST:
        return None
    label[plant] = np.where(woody(own.means[plant], green[plant], size), STEM, LEAF)
    inside = "no soil is seen in it" if level is None else f"with soil at {level:.2f}"
    reason = f"a round wall up to {pot.rim:.2f} of the height, {inside}, and green above"
    parts = [Part("pot", "held" if level is None else "still"), Part("soil", "held"), Part("stem"), Part("leaf")]
    held = Guess("bottom", tuple((0.0 - up).tolist()), "medium", (f"a plant in a pot: {reason}",))
    return (label, parts, reason), held


def _find_pot(across: Array, height: Array, weight: Array, green: Array) -> _Pot | None:
    slices = np.floor(height * SLICES)
    rings: list[tuple[float, Array, float]] = []
    missed = 0
    for k in range(-1, int(POT[1] * SLICES) + 2):
        own = (slices == k) & ~green
        ring = _ring(across[own], weight[own])
        if ring is not None and rings:
            centre, radius = rings[-1][1:]
            if np.linalg.norm(ring[0] - centre) > 0.25 * radius or not 0.75 < ring[1] / radius < 1.35:
                if len(rings) == 1:  # that was a floor or a saucer
                    rings.clear()
                else:
                    ring = None
        if ring is not None:
            rings.append(((k + 0.5) / SLICES, *ring))
            missed = 0
        elif rings:
            missed += 1
        if missed == 2 or (not rings and k > 3):
            break
    if len(rings) < 3:
        return None
    # soil or leaves may hide the wall of a slice: medians of five
    heights = np.array([height for height, _, _ in rings])
    around = [rings[max(0, k - 2) : k + 3] for k in range(len(rings))]
    centres = np.array([np.median([centre for _, centre, _ in some], axis=0) for some in around])
    radii = np.array([np.median([radius for _, _, radius in some]) for some in around])
    pot, last = _Pot(heights, centres, radii), heights[-1]
    wall = np.abs(pot.share(across, height) - 1) < ROUND
    near = wall & ~green & (height > last - 1 / SLICES) & (height < last + 1.5 / SLICES)
    rim = quantile(height[near], 0.95) if near.sum() >= FEWEST else last + 0.5 / SLICES
    return replace(pot, rim=rim) if POT[0] < rim < min(POT[1], SLENDER * np.median(radii)) else None


def _ring(points: Array, weight: Array) -> tuple[Array, float] | None:
    if len(points) < SECTORS:
        return None
    centre = np.average(points, 0, weight + 1e-300)
    for _ in range(3):
        arm = points - centre
        radius = np.linalg.norm(arm, axis=1)
        sector = ((np.arctan2(arm[:, 1], arm[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
        order, count = np.lexsort((radius, sector)), np.bincount(sector, minlength=SECTORS)
        if (count > 0).sum() < COVERED * SECTORS:
            return None
        outer = points[order[(np.cumsum(count) - count + (0.9 * (count - 1)).astype(int))[count > 0]]]
        # a circle by least squares: |x|² = 2 c·x + (r² - |c|²)
        system = np.c_[2 * outer, np.ones(len(outer))]
        centre = np.linalg.lstsq(system, (outer**2).sum(1), rcond=None)[0][:2]
    radii = np.linalg.norm(outer - centre, axis=1)
    return None if radii.std(ddof=1) > ROUND * radii.mean() else (centre, float(radii.mean()))


def _find_soil(across: Array, height: Array, share: Array, green: Array, pot: _Pot) -> tuple[Array, float | None]:
    """The Gaussians of the soil, bool, shape (N,), and its mean height; None if too little of the opening shows it."""
    inside = (share < WALL) & ~green & (height < pot.rim + LEVEL) & (height > 0.3 * pot.rim)
    system = np.c_[across, np.ones(len(height))]
    bins = np.floor(height[inside] / (0.5 * LEVEL)).astype(int)
    above = height - (np.bincount(bins).argmax() + 0.5) * 0.5 * LEVEL if len(bins) else height
    for _ in range(4):
        close = inside & (np.abs(above) < 2 * LEVEL)
        if close.sum() < FEWEST:
            return close, None
        above = height - system @ np.linalg.lstsq(system[close], height[close], rcond=None)[0]
    soil = inside & (np.abs(above) < 2 * LEVEL)
    soil |= (share < WALL) & (above < 0.5 * LEVEL) & (above > -2 * LEVEL)
    soil &= ~(green & (above > 0.5 * LEVEL))
    cells = np.floor(across[soil & (share < OPENING)] / (0.25 * pot.radii[-1]))
    if len(np.unique(cells, axis=0)) > INSIDE * np.pi * (OPENING / 0.25) ** 2:
        return soil, float((height - above)[close].mean())
    return soil, None


def _most_frequent(points: Array, label: Array) -> Array:
    from scipy.spatial import cKDTree

    if len(points) <= NEIGHBOURS:
        return label
    near = label[cKDTree(points).query(points, NEIGHBOURS + 1)[1]]
    return (near[:, None] == np.arange(OTHER + 1)[:, None]).sum(2).argmax(1)


def woody(points: Array, green: Array, size: float) -> Array:
    """Mask (N,) of stems: not green, or locally longer than wide and not flat."""
    from scipy.sparse import coo_array
    from scipy.spatial import cKDTree

    of_point = cells_of(points, CELL * size)
    cells = coo_array((np.ones(len(points)), (of_point, np.arange(len(points))))).tocsr()
    count = cells.sum(1)
    centre = (cells @ (points - points.mean(0)) / count[:, None]) / size
    stem = cells @ green.astype(float) < 0.5 * count
    tree = cKDTree(centre)
    for reach in (0.5 * NEAR, NEAR):
        first, second = tree.query_pairs(reach, output_type="ndarray").T
        near = coo_array((np.ones(len(first)), (first, second)), (len(centre),) * 2)
        near = (near + near.T).tocsr()
        near.setdiag(1.0)
        many = near.sum(1)
        mean = near @ centre / many[:, None]
        square = near @ (centre[:, :, None] * centre[:, None]).reshape(-1, 9) / many[:, None]
        covariance = square.reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None]
        third, middle, main = np.linalg.eigvalsh(covariance).T
        longer = (third > THIN * middle) & (middle < LONG * main) | (middle < THREAD * main)
        stem |= longer & (many >= SEEN)
    for _ in range(2):  # most of those around decide
        stem = near @ stem.astype(float) > 0.5 * many
    return stem[of_point]


def pot_by_colour(own: Gaussians, up: Array) -> Labels | None:
    """A plant in a pot by colour alone: the lower part is not green and as wide as the plant; the pot is held."""
    which = slices_of(own.means @ up, SLICES)
    leafy, _ = green_shares(own, which)
    wide = [breadth(own.means[which == k], up, 0.05) for k in range(SLICES)]
    rim = next((k for k in range(SLICES) if leafy[k] > 0.5), SLICES)
    if not RIM[0] * SLICES <= rim < RIM[1] * SLICES or leafy[:rim].sum() > POT_GREEN * rim:
        return None
    if min(wide[:rim]) < 0.4 * max(wide) or leafy[rim:].sum() < 0.5 * (SLICES - rim):
        return None
    reason = f"not green and as wide as the rest up to {rim / SLICES:.2f} of the height, and green above"
    return (which >= rim).astype(int), [Part("pot", "held"), Part("leaf")], reason


# ---- flags, washing lines, what hangs, trees


def _along_sheet(means: Array, up: Array) -> Array | None:
    normal = sheet_normal(means)
    if normal is None:  # a foot makes the whole no sheet, and ripples the cloth
        height = means @ up
        cloth = means[height > corners(height, 0.01).mean()]
        values, axes = np.linalg.eigh(np.cov((cloth - (cloth @ up)[:, None] * up).T))  # the first is upright
        if max(values[1], 0.0) < RIPPLED**2 * max(values[2], 1e-30):
            normal = axes[:, 1] * np.sign(axes[np.abs(axes[:, 1]).argmax(), 1])
    if normal is None or abs(normal @ up) > 0.3:
        return None
    aside = np.cross(up, normal)
    return aside / np.linalg.norm(aside)


def flag_on_pole(own: Gaussians, up: Array) -> Support | None:
    """Find the pole of a flag: a slim upright part that is seen alone below or above a cloth, which is on one side.

    The pole is still, and the cloth is held at the side of the pole.
    """
    aside = _along_sheet(own.means, up)
    if aside is None:
        return None
    height, along = own.means @ up, own.means @ aside
    size = np.ptp(height)
    limit, which = SLIM * size, slices_of(height, SLICES, 0.0)
    slices = [along[which == k] for k in range(SLICES)]
    if min(map(len, slices)) == 0:
        return None
    ends = np.array([corners(one, 0.02) for one in slices])
    wide, centre = np.ptp(ends, axis=1), ends.mean(1)
    slim, cloths = np.flatnonzero(wide < limit), np.flatnonzero(wide > CLOTH * wide.max())
    if len(slim) < BARE * SLICES or len(cloths) < 3:
        return None
    middle = quantile(centre[slim], 0.5)
    if (np.abs(centre[slim] - middle) > limit).any():
        return None  # it leans, or there are two
    beside = along - middle
    radius = max(quantile(np.abs(beside[np.isin(which, slim)]), 0.98), 1e-3 * size)
    beyond = [(sign * beside > 3 * radius).mean() for sign in (1.0, -1.0)]
    if min(beyond) > OUTSIDE or max(beyond) < 10 * OUTSIDE:
        return None
    toward, (first, last) = 1.0 if beyond[0] > beyond[1] else -1.0, (cloths[0], cloths[-1])
    if len(np.unique(which[(np.abs(beside) < 1.5 * radius) & (which >= first) & (which <= last)])) <= last - first:
        return None  # the pole does not go through
    cloth = (which >= first) & (which <= last) & (toward * beside > 1.4 * radius)
    if min(cloth.sum(), (~cloth).sum()) < FEWEST:
        return None
    alone = len(slim) / SLICES
    reason = f"a slim upright pole, alone over {alone:.2f} of its height, with a sheet on one side of it"
    parts, toward_pole = [Part("cloth"), Part("pole", "still")], tuple((-toward * aside).tolist())
    held = Guess("side", toward_pole, "high", (f"a flag on its pole: {reason}",))
    return ((~cloth).astype(int), parts, reason), held


def washing_line(own: Gaussians, up: Array) -> Support | None:
    """Find the posts of a washing line: slim columns from below the hem of an upright sheet to above it.

    Posts with their feet and arms are still, line and cloth are soft; None without two posts.
    """
    aside = _along_sheet(own.means, up)
    if aside is None:
        return None
    height, along = own.means @ up, own.means @ aside
    low, high = corners(height)
    if high <= low or np.ptp(along) <= 0:
        return None
    column, level = slices_of(along, COLUMNS, 0.0), slices_of(height, LEVELS)
    there = np.zeros((COLUMNS, LEVELS), bool)
    there[column, level] = True
    whole = there.mean(1) > 0.9  # from the ground to the top
    runs = [list(run) for full, run in groupby(range(COLUMNS), lambda k: bool(whole[k])) if full]
    if len(runs) < 2 or max(map(len, runs)) > COLUMNS * THICK:
        return None
    post = np.any([(column >= run[0] - 1) & (column <= run[-1] + 1) for run in runs], 0)
    near = np.any([(column >= run[0] - ARM * COLUMNS) & (column <= run[-1] + ARM * COLUMNS) for run in runs], 0)
    if (~near).sum() < FEWEST:
        return None
    hem, line = corners(height[~near], 0.01)
    if hem < low + HEM * (high - low):
        return None
    label = post | (near & ((height < hem) | (height > line)))
    reason = f"a sheet that ends above the ground between {len(runs)} slim posts"
    held = Guess("top", tuple(up.tolist()), "high", (f"on a line: {reason}",))
    return (label.astype(int), [Part("cloth"), Part("post", "still")], reason), held


def swinging(own: Gaussians, up: Array, hook: Region, cell: float) -> Labels:
    """Parts of a hanging thing: its upper end is held, a cord or neck below it bends, and the rest is rigid.

    Args:
        cell: Grid spacing [scene units].
    """
    height, held = own.means @ up, contains(hook, own.means)
    size, ends = np.ptp(height), cord_heights(own, up)
    lowest = height[held].min() if held.any() else height.max()
    bends = lowest - max(NECK * cell, NECK_SHARE * size) if ends is None else min(ends[0], lowest - NECK * cell)
    what = f"a neck of {(lowest - bends) / size:.2f} of the height" if ends is None else "a cord"
    label = np.where(held, 0, np.where(height > bends, 1, 2))
    return label, [Part("hook", "held"), Part("cord"), Part("body", "rigid")], f"it hangs from its upper end by {what}"


def standing(own: Gaussians, up: Array, depth: float) -> Labels | None:
    """Find the trunk of a tree (narrow, not green, below a green crown), or the post of another thing.

    Its foot, of a depth [scene units], is held, wood and leaves are soft, or post and head; None if there is no such
    trunk or post.
    """
    height = own.means @ up
    size, which = extent(height, 0.002), slices_of(height, SLICES, 0.002)
    wide = np.array([breadth(own.means[which == k], up, 0.05) for k in range(SLICES)])
    narrow = (wide > 0) & (wide < NARROW * wide.max())
    start = next((k for k in range(FOOT) if narrow[k]), 0)  # above a lawn or a disc of soil
    bare = next((k for k in range(start, SLICES) if not narrow[k]), SLICES)
    if not TRUNK * SLICES <= bare < 0.85 * SLICES:
        return None
    share, area = green_shares(own, which)
    brown = 1 - np.average(share[start:bare], weights=area[start:bare])
    leafy = np.average(share[bare:], weights=area[bare:])
    tree = brown >= 0.8 and leafy >= CROWN
    slim = start == 0 and wide[:bare].max() < SLIGHT * size
    if not tree and (leafy >= CROWN or bare < POST * SLICES or not slim):
        return None
    trunk = (which < bare) & (which >= start)
    label = np.where(trunk | woody(own.means, own.green, size) if tree else trunk, 1, 2)
    label[(which < start) | (trunk & (height < quantile(height[trunk], 0.01) + depth))] = 0
    if (label == 2).sum() < FEWEST:
        return None
    names, what, above = (
        (("wood", "leaf"), "a trunk, bare", "green") if tree else (("post", "head"), "a post, slim", "something wider")
    )
    reason = f"{what} up to {bare / SLICES:.2f} of the height, and {above} above"
    return label, [Part("foot", "held"), *map(Part, names)], reason
