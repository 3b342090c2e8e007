"""Which Gaussians of a splat move: the object without floor and specks, one thing of a place, or what photos show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from gaussian_swaying.captures.agreement import places_in_picture
from gaussian_swaying.captures.capture import common_focus, view_reach
from gaussian_swaying.captures.capture_camera import read_views
from gaussian_swaying.gaussians.hold import AROUND, columns, slab
from gaussian_swaying.gaussians.measures import (
    DIRECTIONS,
    FEWEST,
    Array,
    Gaussians,
    Guess,
    breadth,
    cells_of,
    extent,
    largest_plane,
    pieces,
    plane_axes,
    quantile,
    ranked,
    rounded,
    sheet_normal,
    sides,
    snapped,
    spacing_of,
)
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.geometry.regions import Box, Cylinder, Not, Region, Union
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.suggestion.up import CONVENTION, camera_words

THRESHOLDS = (0.1, 0.05, 0.02, 0.01, 0.0)  # of opacity; the first is the paper's
KEPT_AREA = 0.95  # share of the visible area that the threshold must keep
SURE = 0.1  # share of the Gaussians of an object that is no weak guess
MAX_BOXES = 8  # largest number of boxes that cut specks out of the region
# a place
SAMPLE = 300_000  # Gaussians from which up, ground and extent are guessed
FAR = 1.5  # extents of the fine detail from its middle, beyond which a Gaussian is background
LARGE, VERY_FAR = 0.25, 20.0  # size and distance of a sky, in extents of the fine detail
SPACINGS, CELLS = 3.0, 512  # a cell of connected parts: so many spacings, and at most so many along the extent
MEMBERS, SMALLEST = 64, 0.02  # Gaussians of a thing, and its longest side as a share of the extent
MOST, LOOKED_FOR = 8, 1000  # things that are listed; Gaussians of one that are looked for in the photos
WIDE = 0.5  # share of the extent beyond which a thing is a part of the surroundings
SPARSE = 0.3  # share of the cells of its box that a thing fills which is not thin
COLUMNS, FULL = 64, 8  # columns along the extent, whose lower ends are the ground; points of one that counts
OPEN = 3.0  # a ground so many times as wide as the one thing on it is a place, not what an object stands on
EVEN, GROUND = 0.01, 0.5  # of the extent: how uneven a ground may be; share of the columns that end on it
ALONE = "on its own"
# photos
SEEN = 0.6  # share of the photos in which the object lies
PLANES = 3  # backdrops to look for
UPRIGHT = math.sin(math.radians(25))  # of the angle by which backdrops may be off level or upright


@dataclass(frozen=True, eq=False)
class Moving:
    """The choice of Gaussians to simulate.

    Attributes:
        simulated: Which they are, bool, shape (N,).
        box: Lower and upper corner [scene units] of the region, or None for all of space.
        region: The region for a run; None for all of space.
        holes: Boxes inside it that are left out, as corners.
        specks: Number of Gaussians above the threshold that are not part of the object, floor or surroundings.
        confidence: ``low`` if few of the Gaussians are in it, else ``high``.
    """

    simulated: Array
    opacity_threshold: float
    reason: str = "given"
    box: tuple[list[float], list[float]] | None = None
    region: Region | None = None
    holes: list[tuple[list[float], list[float]]] = field(default_factory=list)
    specks: int = 0
    confidence: str = "high"


@dataclass(frozen=True, eq=False)
class Thing:
    """An object above the ground of a place.

    Attributes:
        members: Indices of its Gaussians, shape (M,).
        low: Lower corner of its box [scene units].
        reasons: What speaks for it, with its share of the score.
    """

    members: Array
    low: list[float]
    high: list[float]
    reasons: dict[str, float]

    @property
    def score(self) -> float:
        return round(sum(self.reasons.values()), 2)


@dataclass(frozen=True, eq=False)
class Place:
    """The parts of a capture of a place.

    Attributes:
        up: The up direction, the normal of the ground.
        ground: Which Gaussians are in or below the ground, bool, shape (N,).
        far: Which are background and haze.
        part: The connected part of those above the ground, near and opaque enough to be simulated; -1 of others.
        threshold: Smallest opacity of these.
        cell: Points in the same or in touching cells of this size are connected [scene units].
        below: The region of the ground and everything under it [scene units].
        things: What may move, the likeliest first.
    """

    up: Guess
    ground: Array
    far: Array
    part: Array
    threshold: float
    cell: float
    below: Cylinder
    things: list[Thing]


@dataclass(frozen=True, eq=False)
class Photos:
    """The cameras of photos, and what follows from them.

    Attributes:
        eyes: Their positions [scene units], shape (C, 3).
        up: The up direction, if they were held level.
        focus: The point nearest to all optical axes [scene units], shape (3,); None if there is no common point.
        reach: Distance to the side of it that the median camera sees [scene units].
    """

    path: str
    cameras: list[Camera]
    eyes: Array
    up: Guess
    focus: Array | None
    reach: float


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A plane behind or below the object in photos: a wall, a floor or a table top.

    Attributes:
        mask: Which points are in it or behind it, bool, shape (N,).
        normal: Unit normal towards the cameras.
        behind: Region of its front face and everything behind it [scene units].
    """

    mask: Array
    normal: Array
    behind: Cylinder


@dataclass(frozen=True, eq=False)
class Shown:
    """The object that photos show.

    Attributes:
        mask: Gaussians visible in at least 60 % of the photos that are not in or behind a backdrop, bool, shape (N,).
        backdrops: Walls, floors and tables that were left out, with masks over all N Gaussians.
        near: Weight of each by its distance d from the point that the cameras look at: exp(-(2 d / reach)²).
    """

    mask: Array
    backdrops: list[Backdrop]
    near: Array

    def floor(self, up: Sequence[float]) -> Array:
        """Points of backdrops that are level within 25 degrees, bool, shape (N,)."""
        level = [b.mask for b in self.backdrops if b.normal @ up > math.sqrt(1 - UPRIGHT**2)]
        return np.any([np.zeros_like(self.mask), *level], 0)

    def wall(self, up: Sequence[float]) -> tuple[float, ...] | None:
        """Direction to the largest wall, a backdrop upright within 25 degrees; None without a wall or with a floor."""
        walls = [b for b in self.backdrops if abs(b.normal @ up) < UPRIGHT]
        return tuple((0.0 - walls[0].normal).tolist()) if walls and not self.floor(up).any() else None


# ---- an object


def suggest_threshold(splat: Gaussians) -> float:
    """Highest of ``THRESHOLDS`` that keeps at least ``KEPT_AREA`` of the visible area."""
    kept = ((t, splat.weight[splat.opacity >= t].sum()) for t in THRESHOLDS)
    return next(t for t, area in kept if area >= KEPT_AREA * splat.weight.sum() or t == 0)


def main_part(splat: Gaussians, ground: Array, cells: float, shown: Shown | None = None, more: bool = False) -> Moving:
    """The main object without floor, surroundings and specks.

    The object is the connected part with the largest visible area; one with few Gaussians counts less. Specks inside
    its box are cut out by smaller boxes, the largest first.

    Args:
        ground: The floor, bool, shape (N,).
    """
    among = np.ones(len(splat), bool) if shown is None else shown.mask
    own = splat[among]
    spacing = spacing_of(own.means)
    # the rest of a backdrop must not count as a part of the object
    cell = max(extent(own.means) / cells, 2 * spacing) * (1.0 if shown is None else 0.5)
    threshold = suggest_threshold(own)
    index = np.flatnonzero((splat.opacity >= threshold) & ~ground & among)
    if len(index) < FEWEST:
        raise ValueError(
            f"Only {len(index)} Gaussians are left above the floor and an opacity of {threshold:g}, too few for an "
            "object: set another `--up`."
        )
    part = pieces(splat.means[index], cell)
    counted = splat.weight[index] * (1.0 if shown is None else shown.near[index])
    count = np.bincount(part)
    main = int((np.bincount(part, counted) * (count / (SURE * len(index))).clip(max=1)).argmax())
    words = [f"{count[main]:,} Gaussians of opacity {threshold:g} and more form one connected part"]
    if ground.any():
        words.append(f"a floor of {ground.sum():,} lies below it")
    cuts: list[Region] = []
    if shown is not None:
        words.append("the cameras look at it")
        cuts += [backdrop.behind for backdrop in shown.backdrops]
        if cuts:
            words.append("everything in or behind a wall or floor is left out")
    whole = np.full(len(splat), -1)
    whole[index] = part
    moving = around_part(splat, whole, main, threshold, ground, cell, cuts, words, more)
    sure = shown is not None or count[main] >= SURE * len(index)
    return moving if sure else replace(moving, confidence="low")


def around_part(
    splat: Gaussians,
    part: Array,
    main: int,
    threshold: float,
    ground: Array,
    cell: float,
    cuts: list[Region],
    words: list[str],
    more: bool = True,
) -> Moving:
    """The box around a connected part, without the floor and specks in it.

    Args:
        part: The connected part of those that may be simulated; -1 of others, shape (N,).
        ground: The floor, bool, shape (N,).
        cell: The box is half a cell larger [scene units].
    """
    means, chosen = splat.means, part == main
    low, high = _padded(means[chosen], 0.5 * cell)
    if ground.any():  # the box must not reach into the floor again: a face is moved to between floor and object
        (first, last), (lowest, highest) = ((some.min(0), some.max(0)) for some in (means[chosen], means[ground]))
        for k in range(3):
            if low[k] < highest[k] <= first[k]:
                low[k] = round(0.5 * float(highest[k] + first[k]), 6)
            if high[k] > lowest[k] >= last[k]:
                high[k] = round(0.5 * float(lowest[k] + last[k]), 6)
    other, holes = (part >= 0) & ~chosen, list[tuple[list[float], list[float]]]()
    stray = np.flatnonzero(contains(without(Box(low, high), cuts), means) & other)
    numbers, counts = np.unique(part[stray], return_counts=True)
    for number in numbers[np.argsort(-counts, kind="stable")][: 4 * MAX_BOXES]:
        members = means[stray[part[stray] == number]]
        hole = _padded(members, 0.05 * cell)
        # removes more specks than parts of the object
        if len(holes) < MAX_BOXES and (contains(Box(*hole), means) & chosen).sum() <= len(members):
            holes.append(hole)
    region = without(Box(low, high), [*(Box(*hole) for hole in holes), *cuts])
    inside, specks = contains(region, means), int(other.sum())
    everything = not more and bool(inside.all())
    if specks:
        words = [*words, f"{specks:,} float apart from it"]
    words = [*words, "the region is all of space" if everything else "the region is the box around it"]
    if holes:
        words.append(f"without {len(holes)} boxes of specks")
    box = None if everything else (low, high)
    simulated = inside & (splat.opacity >= threshold)
    return Moving(simulated, threshold, "; ".join(words), box, None if everything else region, holes, specks)


def without(box: Box, cuts: list[Region]) -> Region:
    """A box without some regions."""
    return Not(Union([Not(box), *cuts])) if cuts else box


def contains(region: Region, means: Array) -> Array:
    """Mask of the points in a region, in the precision of a run."""
    return region.contains(torch.from_numpy(means).float()).numpy()


def given_region(splat: Gaussians, low: Sequence[float], high: Sequence[float]) -> Moving:
    """A region given by the corners of a box, with a suggested threshold."""
    box = Box(low, high)
    inside = contains(box, splat.means)
    if inside.sum() < FEWEST:
        span = [[round(float(v), 4) for v in corner] for corner in (splat.means.min(0), splat.means.max(0))]
        raise ValueError(
            f"The box of `--region` contains {inside.sum()} Gaussians, too few for an object: the splat spans "
            f"{span[0]} to {span[1]}."
        )
    threshold, ends = suggest_threshold(splat[inside]), ([float(v) for v in low], [float(v) for v in high])
    return Moving(inside & (splat.opacity >= threshold), threshold, box=ends, region=box)


def _padded(points: Array, margin: float) -> tuple[list[float], list[float]]:
    return rounded(points.min(0) - margin, margin), rounded(points.max(0) + margin, margin)


def nearby(points: Array, chosen: Array) -> Array:
    """Mask (N,) of points within one longest side of the box of the chosen ones."""
    low, high = points[chosen].min(0), points[chosen].max(0)
    side = (high - low).max()
    return ((points >= low - side) & (points <= high + side)).all(-1)


# ---- a place


def survey(splat: Gaussians, up: Guess | None = None, cameras: Sequence[Camera] = ()) -> Place | None:
    """Find the ground of a capture of a place, its background, and the things above the ground that may move.

    The fine half of the Gaussians tells where the cameras were near; what lies farther than :data:`FAR` of its extents
    from its middle is background. Things are connected parts of what is above the ground. Their scores add up:

    - near the middle, around which photos are taken (up to 2);
    - as long as a tenth of the place, or longer (up to 1);
    - not as wide as half of the place, and not at its border (1);
    - thin: it fills little of its box, which stands upright (up to 1);
    - green, as leaves are (up to 1);
    - flat, as a cloth is (1);
    - in the photos: how much of it lies in them, on average (up to 2), if their cameras are known.

    Returns:
        The parts, or None if it has no ground, or a single thing on a small one and no background: then it is an
        object.
    """
    means, step = splat.means, max(1, len(splat) // SAMPLE)
    middle, size = dense_part(splat[::step])
    if size <= 0:
        return None
    far = np.linalg.norm(means - middle, axis=1) > FAR * size
    near = np.flatnonzero(~far[::step]) * step
    found = _ground(means[near], size, up)
    if found is None:
        return None
    guess, normal, offset = found
    level = near[np.abs(means[near] @ normal - offset) <= EVEN * size]
    level = level[np.abs(splat.normals[level] @ normal) > 0.8]
    if len(level) < MEMBERS:
        return None
    kept = np.ones(len(level), bool)
    for _ in range(3):  # without outliers
        centre, before = means[level[kept]].mean(0), normal
        normal = np.linalg.eigh(np.cov(means[level[kept]].T))[1][:, 0]
        normal *= np.sign(normal @ before)
        offset = centre @ normal + quantile((means[level] - centre) @ normal, 0.5)
        away = np.abs(means[level] @ normal - offset)
        half = 3 * max(1.4826 * quantile(away, 0.5), 1e-12)
        kept = away <= half
    height = means @ normal - offset
    ground = ~far & (height <= half)
    above = ~far & ~ground
    if above.sum() < MEMBERS:
        return None
    threshold = suggest_threshold(splat[above])
    solid = above & (splat.opacity >= threshold)
    cell = max(SPACINGS * spacing_of(means[solid]), size / CELLS)
    part = np.full(len(splat), -1)
    part[solid] = pieces(means[solid], cell)
    things = _things(splat, part, middle, size, cell, np.c_[plane_axes(normal), normal], cameras)
    if not things or ALONE not in things[0].reasons:
        return None
    single = sum(len(thing.members) for thing in things[1:]) < 0.05 * solid.sum()
    wide = breadth(means[ground], normal, 0.02) > OPEN * np.subtract(things[0].high, things[0].low).max()
    if single and not wide and far.sum() < 0.01 * len(splat):
        return None
    deep = max(-height[ground].min(), size) + half
    below = slab(means[near].mean(0), normal, offset + half - deep, (4 * FAR * size, deep), cell)
    if up is None:
        direction = tuple(round(float(c), 4) + 0.0 for c in snapped(normal, 3))
        guess = replace(guess, direction=direction)
    return Place(guess, ground, far, part, threshold, cell, below, things)


def sky(splat: Gaussians) -> Array:
    """Mask (N,) of Gaussians far from the fine detail and as large as a quarter of it, or very far."""
    middle, size = dense_part(splat[:: max(1, len(splat) // SAMPLE)])
    away, large = np.linalg.norm(splat.means - middle, axis=1), splat.scales[:, 1] > LARGE * size
    return ((away > FAR * size) & large | (away > VERY_FAR * size)) & (size > 0)


def dense_part(splat: Gaussians) -> tuple[Array, float]:
    """Centre (3,) of the finer half of the Gaussians, and its longest side without a tenth at each end."""
    size = splat.scales[:, 0]
    fine = splat.means[size <= quantile(size, 0.5)]
    return np.median(fine, 0), extent(fine, 0.1)


def move_things(place: Place, splat: Gaussians, numbers: Sequence[int]) -> tuple[Array, Moving]:
    """Gaussians within one longest side of some things, bool, shape (N,), and which of them move.

    Args:
        numbers: Of the things, from 1 on.
    """
    part, main = place.part.copy(), int(place.part.max()) + 1
    for number in numbers:
        if not 1 <= number <= len(place.things):
            raise ValueError(f"Expected `--move` to name things from 1 to {len(place.things)}, but got {number}.")
        part[place.things[number - 1].members] = main
    around = nearby(splat.means, part == main)
    named = f"{'thing' if len(numbers) == 1 else 'things'} {', '.join(map(str, numbers))} of the place"
    words = [f"{named}, {(part == main).sum():,} Gaussians of opacity {place.threshold:g} and more"]
    of = splat[around], part[around], main, place.threshold, place.ground[around], place.cell
    return around, around_part(*of, [place.below], words)


def _things(
    splat: Gaussians, part: Array, middle: Array, size: float, cell: float, axes: Array, cameras: Sequence[Camera]
) -> list[Thing]:
    """The connected parts that are large enough, with their scores, for boxes along axes (3, 3) that stand upright."""
    count = np.bincount(part[part >= 0])
    red, green, blue = splat.colour.T
    leafy = (green > 1.08 * red) & (green > 1.08 * blue)
    order, start = np.argsort(part, kind="stable"), np.cumsum(count) - count + (part < 0).sum()
    found = []
    for number in np.argsort(-count, kind="stable")[: 8 * MOST]:
        if count[number] < MEMBERS:
            break
        members = order[start[number] : start[number] + count[number]]
        own = splat[members]
        points = (own.means - middle) @ axes
        low, high = points.min(0), points.max(0)
        side = (high - low).max() / size
        if side < SMALLEST:
            continue
        cells = int(cells_of(points - low, cell).max()) + 1
        reasons = {
            "near the middle": 2 * math.exp(-((np.linalg.norm(0.5 * (low + high)) / (0.25 * size)) ** 2)),
            "of a size": min(1.0, 10 * side),
            ALONE: 0.0 if side > WIDE or max(high.max(), -low.min()) > 0.75 * size else 1.0,
            "thin": max(0.0, 1 - cells / np.ceil((high - low) / cell).clip(1).prod() / SPARSE),
            "green": own.weight[leafy[members]].sum() / own.weight.sum(),
            "flat": 0.0 if sheet_normal(points) is None else 1.0,
        }
        if cameras:
            reasons["in the photos"] = 2 * seen_share(own.means[:: max(1, len(own) // LOOKED_FOR)], cameras).mean()
        reasons = {why: round(float(value), 2) for why, value in reasons.items() if value >= 0.05}
        found.append(Thing(members, own.means.min(0).tolist(), own.means.max(0).tolist(), reasons))
    return sorted(found, key=lambda thing: -thing.score)[:MOST]


def _ground(points: Array, size: float, up: Guess | None) -> tuple[Guess, Array, float] | None:
    """The direction whose lower side is a ground: most columns of the place end on one plane there.

    Args:
        points: Centres that are near, or a sample of them, shape (N, 3).
        size: Extent of the place [scene units].

    Returns:
        The guess, normal and offset of the plane; None if there is no ground.
    """
    shares, planes = {}, {}
    for name, direction in (DIRECTIONS if up is None else {"given": up.direction}).items():
        lowest = _lowest(points, np.array(direction), size / COLUMNS)
        plane = largest_plane(lowest, np.ones(len(lowest)), EVEN * size, np.array(direction))
        if plane is not None:
            planes[name] = plane
            shares[name] = float((np.abs(lowest @ plane[0] - plane[1]) <= EVEN * size).mean())
    if up is not None:
        return (up, *planes["given"]) if shares.get("given", 0.0) >= GROUND else None
    scores = {name: [(10 * shares.get(name, -9.0), ""), (CONVENTION[name], "")] for name in DIRECTIONS}
    best, second, confidence, points_of = ranked(scores)
    if shares.get(best, 0.0) < GROUND:
        return None
    reason = f"{shares[best]:.0%} of the place end on one plane at the lower end"
    return Guess(best, DIRECTIONS[best], confidence, (reason,), points_of, (best, second)), *planes[best]


def _lowest(points: Array, axis: Array, side: float) -> Array:
    """The lowest point, but one of twenty, of each column with at least 8 points; shape (C, 3).

    Columns are wider than ``side`` where most of them would have fewer points.
    """
    for _ in range(4):
        column = cells_of(points @ plane_axes(axis), side)
        count = np.bincount(column)
        if quantile(count, 0.5) >= FULL:
            break
        side *= 1.5
    order = np.lexsort((points @ axis, column))
    return points[order[(np.cumsum(count) - count + count // 20)[count >= FULL]]]


# ---- photos


def read_photos(path: Path, origin: Origin = NO_ORIGIN) -> Photos:
    """Read the cameras of a capture; its photos need not exist.

    Args:
        path: A transforms.json, a COLMAP model, or a folder that contains one.
    """
    cameras = [camera for _, camera in read_views(path, origin=origin)]
    eyes = np.array([camera.position.tolist() for camera in cameras])
    focus = common_focus(cameras)
    reach = 0.0 if focus is None else view_reach(cameras, focus)
    return Photos(str(path), cameras, eyes, cameras_up(cameras), None if focus is None else focus.numpy(), reach)


def cameras_up(cameras: Sequence[Camera]) -> Guess:
    """The up direction, assuming that photos are held level, so that their rows of pixels are horizontal.

    It is the direction perpendicular to the rows of all photos, on the side of the upper edge of most photos. If all
    rows are parallel, or photos were not held level, it is the mean of their upward directions. A direction within 8
    degrees of an axis is set to the axis.
    """
    rows, columns_down = np.array([c.world_to_camera[:2, :3].tolist() for c in cameras]).swapaxes(0, 1)
    agreement = np.linalg.norm(columns_down.mean(0))
    up = -columns_down.mean(0) / max(agreement, 1e-12)
    confidence, why = ("medium" if agreement > 0.7 else "low"), "the mean of the upward directions of the photos"
    values, axes = np.linalg.eigh(rows.T @ rows / len(cameras))
    tilt = math.degrees(math.asin(min(1.0, max(0.0, values[0]) ** 0.5)))
    across = axes[:, 0] * (1.0 if axes[:, 0] @ up >= 0 else -1.0)
    if values[1] > 0.05 and tilt < 15 and across @ up > 0.7:
        up, confidence = across, "high" if len(cameras) >= 8 else "medium"
        why = f"the {len(cameras)} photos were held level to {tilt:.1f} degrees"
    elif agreement < 1e-6:
        up = np.array([0.0, 0.0, 1.0])
    axis = snapped(up, 8)
    if axis is not up:
        name = max(DIRECTIONS, key=lambda n: float(axis @ DIRECTIONS[n]))
        why += f", {math.degrees(math.acos(min(1.0, float(axis @ up)))):.1f} degrees from {name}"
    guess = Guess("photos", tuple(axis.tolist()), confidence, (why,))
    return replace(guess, options=camera_words(guess))


def seen_share(points: Array, cameras: Sequence[Camera]) -> Array:
    """Share of the pictures that contain each point (N, 3), ignoring occlusion; shape (N,)."""
    where = torch.from_numpy(points).float()
    return np.mean([places_in_picture(where, camera)[1].numpy() for camera in cameras], 0)


def shown_object(splat: Gaussians, view: Photos) -> Shown:
    """The object that the photos of a capture show, without its background.

    It is in at least 60 % of the photos, and within reach of their common point.
    """
    if view.focus is None:
        raise ValueError(
            f"The cameras of {view.path} do not look at a common point, so the object is not known: set `--region`."
        )
    away = np.linalg.norm(splat.means - view.focus, axis=1)
    mask = (away < 1.5 * view.reach) & (seen_share(splat.means, view.cameras) >= SEEN)
    if mask.sum() < FEWEST:
        focus = [round(float(c), 3) for c in view.focus]
        raise ValueError(
            f"The cameras of `--capture` look at {focus}, where the splat has {mask.sum()} Gaussians: use the "
            "capture that it was trained on, or set `--region`."
        )
    solid, found = np.flatnonzero(mask & (splat.opacity >= 0.1)), []
    for backdrop in backdrops(splat.means[solid], splat.weight[solid], view.eyes, view.reach, 0.02 * view.reach):
        everywhere = backdrop.behind.contains(torch.from_numpy(splat.means)).numpy()
        everywhere[solid[backdrop.mask]] = True
        found.append(replace(backdrop, mask=everywhere))
        mask = mask & ~everywhere
    return Shown(mask, found, np.exp(-((away / (0.5 * view.reach)) ** 2)))


def backdrops(points: Array, weight: Array, eyes: Array, reach: float, cell: float) -> list[Backdrop]:
    """Walls, floors and tables behind what photos show, the largest first.

    A backdrop is a plane with a thickness of 6 % of the longest side. It contains at least 15 % of the visible area in
    front of the backdrops found before, is at least 0.8 times as wide as photos reach to a side, and is at least 25
    degrees from the others. Nine of ten cameras are in front of it, and so is something that is at least 1.2 times
    narrower than the plane in both directions. Points up to three half thicknesses in front of it also belong to it,
    unless something stands out farther there: this is the roughness of a wall.

    Args:
        points: Centres of the Gaussians in the photos [scene units], shape (N, 3).
        weight: Their visible area, shape (N,).
        eyes: Positions of the cameras [scene units], shape (C, 3).
        reach: Distance to the side that photos show [scene units].
        cell: Coordinates of the regions are rounded to a hundredth of it [scene units].
    """
    side = extent(points)
    half = 0.03 * side
    left = np.ones(len(points), bool)  # neither in a backdrop nor behind one
    tried, found = np.zeros_like(left), list[Backdrop]()
    for _ in range(PLANES):
        plane = largest_plane(points[left & ~tried], weight[left & ~tried], half)
        if plane is None:
            break
        sign = -1.0 if (eyes @ plane[0] - plane[1]).mean() < 0 else 1.0
        normal, offset = sign * plane[0], sign * plane[1]
        height = points @ normal - offset
        layer, behind, front = left & (np.abs(height) <= half), height < -half, left & (height > half)
        tried |= layer
        if any(other.normal @ normal > math.sqrt(1 - UPRIGHT**2) for other in found):
            continue  # something fixed to a wall is not another wall
        own, ahead = weight[layer].sum(), weight[front].sum()
        if (eyes @ normal - offset > half).mean() < 0.9 or own < 0.15 * weight[left].sum() or front.sum() < FEWEST:
            continue
        flat = points @ plane_axes(normal)
        wide, narrower = (sides(flat[part], 0.05) for part in (layer, front))
        if ahead < 0.05 * (own + ahead) or (wide <= np.maximum(0.8 * reach, 1.2 * narrower)).any():
            continue
        depth = 4 * side + 2 * half
        region = slab(points[layer].mean(0), normal, offset + half - depth, (4 * side, depth), cell)
        high, key = front & (height > 3 * half), columns(flat, 2 * half)
        full, count = np.unique(key[high], return_counts=True)
        rough = front & ~high & ~np.isin(key, np.add.outer(full[count >= 3], AROUND))
        found.append(Backdrop(((height <= half) | rough) & left | behind, normal, region))
        left &= (height > half) & ~rough
    return found
