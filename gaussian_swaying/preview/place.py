"""The parts of a capture of a place: its ground, what is far away, and the things between, the likeliest first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.geometry.regions import Cylinder
from gaussian_swaying.preview.framing import nearby
from gaussian_swaying.preview.photos import seen_share
from gaussian_swaying.preview.shape import (
    DIRECTIONS,
    FAR,
    breadth,
    dense_part,
    largest_plane,
    plane_axes,
    rounded,
    sheet_normal,
)
from gaussian_swaying.preview.suggest import RegionGuess, region_around, suggest_threshold, visible_weight
from gaussian_swaying.preview.up import CONVENTION, UpGuess, given_up
from gaussian_swaying.rendering.cameras.camera import Camera

SAMPLE = 300_000  # Gaussians from which up, ground and extent are guessed
SPACINGS, CELLS = 3.0, 512  # a cell of connected parts: so many spacings, and at most so many along the extent
FEWEST, SMALLEST = 64, 0.02  # Gaussians of a thing, and its longest side as a share of the extent
MOST = 8  # things that are listed
MEMBERS = 1000  # Gaussians of a thing that are looked for in the photos
WIDE = 0.5  # share of the extent beyond which a thing is a part of the surroundings
SPARSE = 0.3  # share of the cells of its box that a thing fills which is not thin
COLUMNS = 64  # columns along the extent, whose lower ends are the ground
FULL = 8  # points of a column that counts
LARGE, VERY_FAR = 0.25, 20.0  # size and distance of a sky, in extents of the fine detail
OPEN = 3.0  # a ground so many times as wide as the one thing on it is a place, not what an object stands on
EVEN = 0.01  # of the extent: how uneven a ground may be
GROUND = 0.5  # share of the columns that end on it
ALONE = "on its own"
SNAP = 3.0  # an up direction this close to an axis is taken as the axis [degrees]


@dataclass(frozen=True)
class Thing:
    """Something that stands or hangs above the ground of a place.

    Attributes:
        members: Indices of its Gaussians, shape (M,).
        low: Lower corner of its box [scene units].
        high: Upper corner.
        score: How likely it is to be what should move, the sum of ``reasons``.
        reasons: What speaks for it, with its share of the score.
    """

    members: Tensor
    low: tuple[float, ...]
    high: tuple[float, ...]
    score: float
    reasons: dict[str, float]

    @property
    def size(self) -> tuple[float, ...]:
        """Sides of its box [scene units]."""
        return tuple(b - a for a, b in zip(self.low, self.high, strict=True))


@dataclass(frozen=True)
class Place:
    """The parts of a capture of a place.

    Attributes:
        up: The up direction, the normal of the ground, with the ground of all Gaussians.
        far: Which Gaussians are background and haze, shape (N,).
        solid: Which are above the ground, near and opaque enough to be simulated, shape (N,).
        threshold: Smallest opacity of these.
        cell: Points in the same or in touching cells of this size are connected [scene units].
        below: The region of the ground and everything under it [scene units].
        part: The connected part of each solid Gaussian, in their order.
        things: What may move, the likeliest first.
    """

    up: UpGuess
    far: Tensor
    solid: Tensor
    threshold: float
    cell: float
    below: Cylinder
    part: Tensor
    things: list[Thing]


def survey(
    cloud: GaussianCloud, up: Sequence[float] | str | None = None, cameras: Sequence[Camera] = ()
) -> Place | None:
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

    Args:
        cloud: The splat.
        up: Direction that points up, as 3 numbers or as ``+x`` to ``-z``; guessed if None.
        cameras: Those of the photos.

    Returns:
        The parts, or None if it has no ground, or a single thing on a small one and no background: then it is an
        object.
    """
    means, opacity, weight = cloud.means, cloud.opacities.sigmoid(), visible_weight(cloud)
    step = max(1, len(cloud) // SAMPLE)
    middle, extent = dense_part(means[::step], cloud.scales[::step])
    if extent <= 0:
        return None
    far = (means - middle.to(means)).norm(dim=-1) > FAR * extent
    near = (~far[::step]).nonzero()[:, 0] * step
    found = _ground(means[near].double(), extent, None if up is None else _unit(up))
    if found is None:
        return None
    upward, normal, offset = found
    level = near[((means[near].double() @ normal - offset).abs() <= EVEN * extent)]
    level = level[(smallest_axis_normal(cloud.quats[level], cloud.scales[level]).double() @ normal).abs() > 0.8]
    if len(level) < FEWEST:
        return None
    normal, offset, half = _plane(means[level].double(), normal)
    height = means @ normal.to(means) - offset
    ground = ~far & (height <= half)
    upward = replace(upward, direction=_snapped(normal) if up is None else upward.direction, ground=ground)
    above = ~far & ~ground
    if int(above.sum()) < FEWEST:
        return None
    threshold = suggest_threshold(opacity[above], weight[above])
    solid = above & (opacity >= threshold)
    points = means[solid]
    cell = max(SPACINGS * particle_spacing(points), extent / CELLS)
    part = connected_parts(points, cell)
    axes = torch.stack([*plane_axes(normal), normal])
    things = _things(cloud, solid, part, weight, middle, extent, cell, axes, cameras)
    alone = sum(len(thing.members) for thing in things[1:]) < 0.05 * int(solid.sum())
    if not things or ALONE not in things[0].reasons:
        return None
    wide = breadth(means[ground].double(), plane_axes(normal), 0.02) > OPEN * max(things[0].size)
    if alone and not wide and int(far.sum()) < 0.01 * len(cloud):
        return None
    low = float(height[ground].amin())
    deep = max(-low, extent) + half
    centre = means[near].double().mean(0)
    centre = centre + (offset + half - 0.5 * deep - float(centre @ normal)) * normal
    below = Cylinder(
        [rounded(float(c), cell) for c in centre],
        [round(float(c), 6) for c in normal],
        rounded(4 * FAR * extent, cell),
        rounded(deep, 0.1 * cell),
    )
    return Place(upward, far, solid, threshold, cell, below, part, things)


def sky(cloud: GaussianCloud) -> Tensor:
    """Gaussians that are far from the fine detail and as large as a quarter of it, or very far: a mask, shape (N,)."""
    step = max(1, len(cloud) // SAMPLE)
    middle, extent = dense_part(cloud.means[::step], cloud.scales[::step])
    away = (cloud.means - middle.to(cloud.means)).norm(dim=-1)
    large = cloud.scales.median(-1).values.exp() > LARGE * extent
    return ((away > FAR * extent) & large | (away > VERY_FAR * extent)) & (extent > 0)


def excerpt(place: Place, cloud: GaussianCloud, chosen: Sequence[int]) -> tuple[GaussianCloud, UpGuess, RegionGuess]:
    """All that a configuration for some things needs: the Gaussians around them, the up direction, and the region.

    Args:
        place: The parts of the splat.
        cloud: The splat.
        chosen: Numbers of the things, from 1 on.

    Returns:
        The Gaussians at most one longest side away, and the guesses for them.
    """
    mine, around = _members(place, cloud, chosen), near_things(place, cloud, chosen)
    part = torch.full((len(cloud),), -1)
    part[place.solid] = place.part
    part[mine] = int(place.part.max()) + 1
    shown = cloud.select(around)
    upward = replace(place.up, ground=place.up.ground[around])
    index = place.solid[around].nonzero()[:, 0]
    numbers = ", ".join(map(str, chosen))
    region = region_around(
        shown.means, shown.opacities.sigmoid(), index, part[around][index], int(place.part.max()) + 1,
        place.threshold, upward.ground, place.cell, (place.below,),
        [f"{'thing' if len(chosen) == 1 else 'things'} {numbers} of the place, "
         f"{int(mine.sum()):,} Gaussians of opacity {place.threshold:g} and more"],
    )  # fmt: skip
    return shown, upward, region


def near_things(place: Place, cloud: GaussianCloud, chosen: Sequence[int]) -> Tensor:
    """The Gaussians at most one longest side away from some things, bool, shape (N,), as :func:`excerpt` takes them."""
    return nearby(cloud.means, _members(place, cloud, chosen))


def _members(place: Place, cloud: GaussianCloud, chosen: Sequence[int]) -> Tensor:
    """The Gaussians of some things, bool, shape (N,)."""
    for number in chosen:
        if not 1 <= number <= len(place.things):
            raise ValueError(f"Expected `--move` to name things from 1 to {len(place.things)}, but got {number}.")
    mine = torch.zeros(len(cloud), dtype=torch.bool)
    for number in chosen:
        mine[place.things[number - 1].members] = True
    return mine


def _things(
    cloud: GaussianCloud,
    solid: Tensor,
    part: Tensor,
    weight: Tensor,
    middle: Tensor,
    extent: float,
    cell: float,
    axes: Tensor,
    cameras: Sequence[Camera],
) -> list[Thing]:
    """The connected parts that are large enough, with their scores, for boxes along axes (3, 3) that stand upright."""
    middle = axes @ middle.to(axes)
    index = solid.nonzero()[:, 0]
    count = part.bincount()
    red, green, blue = (0.5 + SH_DC * cloud.sh[:, 0, k] for k in range(3))
    leafy = (green > 1.08 * red) & (green > 1.08 * blue)
    order = part.argsort(stable=True)
    start = count.cumsum(0) - count
    found = []
    for number in count.argsort(descending=True)[: 8 * MOST].tolist():
        if int(count[number]) < FEWEST:
            break
        members = index[order[int(start[number]) : int(start[number] + count[number])]]
        points = cloud.means[members].double()
        ends = tuple(points.amin(0).tolist()), tuple(points.amax(0).tolist())
        points = points @ axes.T
        low, high = points.amin(0), points.amax(0)
        side = float((high - low).amax()) / extent
        if side < SMALLEST:
            continue
        away = (0.5 * (low + high) - middle).norm() / (0.25 * extent)
        border = float((torch.maximum(high - middle, middle - low)).amax()) > 0.75 * extent
        cells = int(equal_rows(((points - low) / cell).floor()).max()) + 1
        filled = cells / float(((high - low) / cell).ceil().clamp(min=1).prod())
        own = weight[members].double()
        share = float(own[leafy[members]].sum() / own.sum())
        reasons = {
            "near the middle": 2 * math.exp(-(float(away) ** 2)),
            "of a size": min(1.0, 10 * side),
            ALONE: 0.0 if side > WIDE or border else 1.0,
            "thin": max(0.0, 1 - filled / SPARSE),
            "green": share,
            "flat": 0.0 if sheet_normal(points) is None else 1.0,
        }
        if cameras:
            some = cloud.means[members[:: max(1, len(members) // MEMBERS)]]
            reasons["in the photos"] = 2 * float(seen_share(some, cameras).mean())
        reasons = {why: round(value, 2) for why, value in reasons.items() if value >= 0.05}
        found.append(Thing(members, *ends, round(sum(reasons.values()), 2), reasons))
    return sorted(found, key=lambda thing: -thing.score)[:MOST]


def _unit(up: Sequence[float] | str) -> dict[str, tuple[float, ...]]:
    """The given up direction as the only one to try."""
    none = torch.zeros(1, 3)
    return {"given": given_up(up, none, none, none[:, 0]).direction}


def _ground(
    points: Tensor, extent: float, given: dict[str, tuple[float, ...]] | None
) -> tuple[UpGuess, Tensor, float] | None:
    """The direction whose lower side is a ground: most columns of the place end on one plane there.

    Args:
        points: Centres that are near, or a sample of them, float64, shape (N, 3).
        extent: Extent of the place [scene units].
        given: The direction to try, instead of six.

    Returns:
        The guess, without the mask of the ground; normal and offset of the plane; None if there is no ground.
    """
    scores, planes = {}, {}
    for name, direction in (given or DIRECTIONS).items():
        axis = torch.tensor(direction, dtype=torch.float64)
        lowest = _lowest(points, axis, extent / COLUMNS)
        plane = largest_plane(lowest, lowest.new_ones(len(lowest)), EVEN * extent, axis)
        if plane is None:
            continue
        normal, offset = plane
        planes[name] = plane
        scores[name] = float(((lowest @ normal - offset).abs() <= EVEN * extent).double().mean())
    if not scores:
        return None
    liked = {name: share + 0.1 * CONVENTION.get(name, 0.0) for name, share in scores.items()}
    best, *others = sorted(liked, key=lambda name: -liked[name])
    if scores[best] < GROUND:
        return None
    lead = liked[best] - liked[others[0]] if others else math.inf
    confidence = "given" if given else "high" if lead >= 0.2 else "medium" if lead >= 0.1 else "low"
    reasons = [f"{scores[best]:.0%} of the place end on one plane at the lower end"]
    none = torch.zeros(0, dtype=torch.bool)
    options = () if given else (best, *others[:1])
    direction = (given or DIRECTIONS)[best]
    return UpGuess(direction, confidence, liked, reasons, none, options), *planes[best]


def _lowest(points: Tensor, axis: Tensor, side: float) -> Tensor:
    """The lowest point, but one of twenty, of each column with at least 8 points; shape (C, 3).

    Columns are wider than ``side`` where most of them would have fewer points.
    """
    height = points @ axis
    for _ in range(4):
        column = equal_rows(torch.stack([points @ across for across in plane_axes(axis)], -1).div(side).floor())
        if float(column.bincount().median()) >= FULL:
            break
        side *= 1.5
    order = torch.argsort(height, stable=True)
    order = order[torch.argsort(column[order], stable=True)]
    count = column.bincount()
    start = count.cumsum(0) - count
    return points[order[(start + count // 20)[count >= FULL]]]


def _plane(points: Tensor, axis: Tensor) -> tuple[Tensor, float, float]:
    """Normal, offset and half thickness of the ground, from its level Gaussians; three times without outliers."""
    kept = torch.ones(len(points), dtype=torch.bool)
    for _ in range(3):
        centre = points[kept].mean(0)
        normal = torch.linalg.eigh(torch.cov((points[kept] - centre).T))[1][:, 0]
        normal = normal if float(normal @ axis) > 0 else -normal
        away = (points - centre) @ normal
        middle = away.median()
        spread = 1.4826 * float((away - middle).abs().median())
        kept = (away - middle).abs() <= 3 * max(spread, 1e-12)
    return normal, float(centre @ normal) + float(middle), 3 * spread


def _snapped(normal: Tensor) -> tuple[float, ...]:
    """The normal, or an axis within :data:`SNAP` of it."""
    main = int(normal.abs().argmax())
    if float(normal[main].abs()) > math.cos(math.radians(SNAP)):
        sign = math.copysign(1.0, float(normal[main]))
        return tuple(sign if k == main else 0.0 for k in range(3))
    return tuple(round(float(c), 4) for c in normal)
