"""What a splat looks like to the simulation: bounds, up axis, sizes, and a guess at each number that a run needs.

Everything here is a guess of a first configuration, made from rules that are stated with the result. None of them knows
what the object is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive, check_shape, check_vector
from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.gaussians.neighbours import nearest_neighbours
from gaussian_swaying.gaussians.ply import GaussianCloud
from gaussian_swaying.gaussians.selection import Box, Cylinder, Not, Region, Union
from gaussian_swaying.gaussians.subdivision import subdivide
from gaussian_swaying.gaussians.surface import smallest_axis_normal
from gaussian_swaying.simulation.frame import SimFrame

CELLS = 24  # along the longest side: enough to bend, few enough for a laptop
DRAFT_CELLS = 16  # the same for a first look
CLOTH_E, CLOTH_THICKNESS = 6e3, 0.01  # Pa, m; a sheet: the cloth of the paper's flags
SHELL_E, SHELL_THICKNESS = 5e5, 0.01  # Pa, share of the longest side; anything else: a shell of rubber
THRESHOLDS = (0.1, 0.05, 0.02, 0.01, 0.0)  # of opacity; the first is the paper's
KEPT_AREA = 0.95  # share of the visible area that the threshold has to leave
FEWEST = 16  # Gaussians that make an object
MAX_BOXES = 8  # boxes that cut specks out of the region
SHEET = 0.1  # smallest over middle standard deviation of the centres of a sheet
PIN_DEPTH = 0.06  # depth of the pinned end, as a share of the object's length towards it
DIRECTIONS = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
# what captures and modelling programs agree on: z up (Blender), y down (COLMAP), y up (glTF)
CONVENTION = {"+z": 0.75, "-y": 0.75, "+y": 0.5, "-z": -1.0, "+x": -1.0, "-x": -1.0}


@dataclass(frozen=True)
class UpGuess:
    """Which way is up, and why.

    Attributes:
        direction: Unit vector in scene axes.
        confidence: ``high``, ``medium`` or ``low``, by the lead over the next best direction; ``given`` if it was.
        scores: Points of each direction.
        reasons: What spoke for the winner, in words.
        ground: Which Gaussians form the floor below, shape (N,).
    """

    direction: tuple[float, ...]
    confidence: str
    scores: dict[str, float]
    reasons: list[str]
    ground: Tensor


@dataclass(frozen=True)
class RegionGuess:
    """Which Gaussians to simulate.

    Attributes:
        simulated: Those that would be, shape (N,).
        box: Lower and upper corner [scene units] of the region, or None for all of space.
        holes: Boxes within it that are left out, as corners.
        opacity_threshold: Smallest opacity that is simulated.
        specks: Gaussians above the threshold that are not part of the object, the floor apart.
        loose: Those of them that the region does not leave out.
        reason: In words.
    """

    simulated: Tensor
    box: tuple[list[float], list[float]] | None
    holes: list[tuple[list[float], list[float]]]
    opacity_threshold: float
    specks: int
    loose: int
    reason: str

    def region(self) -> Region | None:
        """The region as a run takes it; None for all of space."""
        if self.box is None:
            return None
        inside: Region = Box(*self.box)
        return Not(Union([Not(inside), *(Box(*hole) for hole in self.holes)])) if self.holes else inside


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


def visible_weight(cloud: GaussianCloud) -> Tensor:
    """Opacity times area pi s1 s2 of each Gaussian [scene units²], shape (N,), the largest 1 % cut to the next."""
    weight = (cloud.opacities.sigmoid() * patch_area(cloud.scales)).double()
    return weight.clamp(max=_quantile(weight, 0.99))


def bounds(points: Tensor, share: float = 0.005) -> dict[str, list[float]]:
    """Extremes and robust bounds of points.

    Args:
        points: Shape (N, 3).
        share: Share of the points beyond the robust bounds on each side.

    Returns:
        ``min``, ``max``, ``robust_min`` and ``robust_max``, 3 numbers each.
    """
    check_shape("points", points, None, 3)
    low, high = ([_quantile(c, q) for c in points.unbind(-1)] for q in (share, 1 - share))
    return {
        "min": [float(v) for v in points.amin(0)],
        "max": [float(v) for v in points.amax(0)],
        "robust_min": low,
        "robust_max": high,
    }


def gaussian_statistics(cloud: GaussianCloud) -> dict[str, object]:
    """Count, opacities, shapes and sizes of the Gaussians, as plain numbers.

    Returns:
        Quantiles are lists of the 5, 50 and 95 % values. ``size_share`` is the largest standard deviation over the
        longest robust side. S1 >= S2 >= S3 are the standard deviations of a Gaussian.
    """
    opacity = cloud.opacities.sigmoid()
    s1, s2, s3 = cloud.scales.double().exp().sort(-1, descending=True).values.unbind(-1)
    corner = bounds(cloud.means)
    longest = max(b - a for a, b in zip(corner["robust_min"], corner["robust_max"], strict=True))
    return {
        "count": len(cloud),
        "sh_degree": cloud.sh_degree,
        "normals": cloud.normals is not None,
        "opacity": _three(opacity),
        "opacity_below": {str(t): float((opacity < t).double().mean()) for t in THRESHOLDS if t > 0},
        "S1_over_S2": _three(s1 / s2),
        "S2_over_S3": _three(s2 / s3),
        "size_share": _three(s1 / max(longest, 1e-30)),
    }


# ---- all of it


@dataclass(frozen=True)
class Suggestion:
    """Everything that a first configuration needs.

    Attributes:
        up: Which way is up.
        region: What is simulated.
        hold: At which end it is held.
        pin: That end as a region, None if it is not held.
        longest_side: Length given to the longest side of the object [m].
        metres_per_unit: Length of a scene unit that follows [m].
        size: Sides of the object along the z-up axes [m].
        spacing: Particle spacing [m], see :func:`particle_spacing`.
        dx: Grid spacing [m].
        fill_spacing: Spacing of further points on large Gaussians [m], see :func:`suggest_fill`; None if not needed.
        sheet: Whether the object is a thin sheet.
        azimuth: Azimuth of a camera that sees the broad side [degrees].
        flow: Wind across the picture, or along a sheet from where it is held [m/s], z up.
        youngs_modulus: Young's modulus [Pa], a first guess; :mod:`~gaussian_swaying.simulation.calibration` finds a
            better one.
        thickness: Thickness of the surface [m], likewise.
        stiffness_reason: Why, in words.
    """

    up: UpGuess
    region: RegionGuess
    hold: HoldGuess
    pin: Region | None
    longest_side: float
    metres_per_unit: float
    size: tuple[float, ...]
    spacing: float
    dx: float
    fill_spacing: float | None
    sheet: bool
    azimuth: float
    flow: tuple[float, ...]
    youngs_modulus: float
    thickness: float
    stiffness_reason: str


def suggest(
    cloud: GaussianCloud,
    up: Sequence[float] | str | None = None,
    hold: str | None = None,
    region: tuple[Sequence[float], Sequence[float]] | None = None,
    longest_side: float = 1.0,
    speed: float = 6.0,
) -> Suggestion:
    """Guess a first configuration.

    Args:
        cloud: The splat.
        up: Direction that points up, as 3 numbers or as ``+x`` to ``-z``; guessed if None.
        hold: ``top``, ``bottom``, ``none`` or ``+x`` to ``-z``; guessed if None.
        region: Corners of the box to simulate [scene units]; guessed if None.
        longest_side: Length of the longest side of the object [m].
        speed: Speed of the wind [m/s].

    Returns:
        The suggestion.

    Raises:
        ValueError: If the splat has too few Gaussians, or what was given does not fit it.
    """
    check_positive("--longest-side", longest_side)
    check_positive("--wind", speed, allow_zero=True)
    if len(cloud) < FEWEST:
        raise ValueError(
            f"The splat holds {len(cloud)} Gaussians, too few for an object; at least {FEWEST} are needed."
        )
    means, opacity, weight = cloud.means.detach(), cloud.opacities.detach().sigmoid(), visible_weight(cloud)
    normals = smallest_axis_normal(cloud.quats, cloud.scales)
    upward = guess_up(means, normals, weight) if up is None else given_up(up, means, normals, weight)
    corner = bounds(means)
    side = max(b - a for a, b in zip(corner["robust_min"], corner["robust_max"], strict=True))
    if side <= 0:
        raise ValueError("All Gaussians of the splat lie at one point: there is no object to simulate.")
    if region is None:
        cell = max(side / CELLS, 2 * particle_spacing(means))
        chosen = suggest_region(means, opacity, weight, upward.ground, cell)
    else:
        chosen = given_region(means, opacity, weight, *region)
    points, visible = means[chosen.simulated], weight[chosen.simulated]
    frame = SimFrame.fit(points, upward.direction, longest_side)
    metres = frame.point_to_sim(points.double())
    spacing = particle_spacing(points) * frame.metres_per_unit
    dx = suggest_spacing(longest_side, spacing)
    ground = bool(upward.ground.any())
    held = guess_hold(points, visible, upward.direction, ground) if hold is None else given_hold(hold, upward.direction)
    pin = None if held.end == "none" else end_region(points, held.direction, dx / frame.metres_per_unit)
    azimuth = broad_side(metres)
    flow = _across_picture(azimuth, speed)
    flat = sheet_normal(points)
    if held.end == "side" and flat is not None:  # from the pole on, and a little onto the sheet
        away = -frame.direction_to_sim(torch.tensor(held.direction, dtype=torch.float64))
        onto = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), away)
        flow = tuple(speed * float(c) for c in math.cos(0.25) * away + math.sin(0.25) * onto)
    elif flat is not None:  # a curtain is moved by wind onto it
        flow = _across_picture(azimuth - 90, speed)
    return Suggestion(
        up=upward,
        region=chosen,
        hold=held,
        pin=pin,
        longest_side=float(longest_side),
        metres_per_unit=frame.metres_per_unit,
        size=tuple(float(v) for v in metres.amax(0) - metres.amin(0)),
        spacing=spacing,
        dx=dx,
        fill_spacing=suggest_fill(cloud.select(chosen.simulated), frame.metres_per_unit, dx),
        sheet=flat is not None,
        azimuth=round(azimuth + 20.0, 1),
        flow=tuple(round(c, 2) + 0.0 for c in flow),
        youngs_modulus=SHELL_E if flat is None else CLOTH_E,
        thickness=SHELL_THICKNESS * longest_side if flat is None else CLOTH_THICKNESS,
        stiffness_reason="rubber, not tried" if flat is None else "the cloth of the paper's flags, not tried",
    )


def _across_picture(azimuth: float, speed: float) -> tuple[float, ...]:
    """Horizontal flow to the right of a picture from an azimuth [degrees]."""
    angle = math.radians(azimuth)
    return (-speed * math.sin(angle), speed * math.cos(angle), 0.0)


# ---- up


def floor_mask(points: Tensor, normals: Tensor, weight: Tensor, up: Sequence[float]) -> Tensor:
    """Gaussians that form a level floor at the lower end of a scene.

    A floor is a layer, 4 % of the longest side thick, that holds at least 15 % of the visible area, most of it level,
    with next to nothing below, something above, and wider than that.

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
    for across in _plane_axes(axis):
        along = where @ across
        wide, object_wide = (_quantile(along[m], 0.98) - _quantile(along[m], 0.02) for m in (layer, above))
        if wide < 0.9 * object_wide:
            return none
    return layer | below


def sheet_normal(points: Tensor) -> tuple[float, ...] | None:
    """Unit normal of points that lie close to a plane (see ``SHEET``), snapped to an axis within 10 degrees."""
    where = points.double()
    values, axes = torch.linalg.eigh(torch.cov((where - where.mean(0)).T))
    spread = values.clamp(min=0).sqrt()
    if float(spread[1]) <= 0 or float(spread[0] / spread[1]) > SHEET:
        return None
    return _snapped(axes[:, 0])


def _floor_score(points: Tensor, floor: Tensor, up: Sequence[float]) -> float:
    """3 for a floor from which something rises by 0.3 of its width or more, less for what is flat, as on a wall."""
    axis = torch.tensor(up, dtype=torch.float64)
    rest = points[~floor].double() @ axis
    width = min(
        _quantile(c, 0.98) - _quantile(c, 0.02) for c in (points[floor].double() @ a for a in _plane_axes(axis))
    )
    return 3 * min(1.0, (_quantile(rest, 0.98) - _quantile(rest, 0.02)) / max(0.3 * width, 1e-30))


def guess_up(points: Tensor, normals: Tensor, weight: Tensor) -> UpGuess:
    """The scene axis that most likely points up.

    Each of the six directions along an axis collects points: for convention (z up and y down 0.75, y up 0.5, others
    -1), for a floor below (3, less if
    what is on it is flat), for the origin at the lower end (1), and for the axis being the longest
    (log2 of its ratio to the next, up to 1.5); a thin sheet hangs, so its normal loses 1. A lead of 2 over the
    next is called high confidence, of 1 medium.

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
            reasons.append(f"a level floor lies at the lower end (+{gain:.2g})")
        near, far = (low[axis], high[axis]) if name[0] == "+" else (high[axis], low[axis])
        if side[axis] > 0 and abs(near) < 0.05 * side[axis] < abs(far):
            points_for += 1
            reasons.append("the origin lies at the lower end (+1)")
        if side[axis] == longest[1] and longest[1] > 1.3 * longest[0]:
            gain = min(math.log2(longest[1] / max(longest[0], 1e-30)), 1.5)
            points_for += gain
            reasons.append(f"it is the longest side, {longest[1]:.3g} against {longest[0]:.3g} (+{gain:.2g})")
        if sheet is not None and abs(sheet[axis]) > 0.8:
            points_for -= 1
        scores[name], why[name] = points_for, reasons
    best, second = sorted(scores, key=lambda name: -scores[name])[:2]
    lead = scores[best] - scores[second]
    confidence = "high" if lead >= 2 else "medium" if lead >= 1 else "low"
    reasons = [*why[best], f"{second} comes next, {lead:.2g} behind"]
    return UpGuess(DIRECTIONS[best], confidence, scores, reasons, floors[best])


def given_up(up: Sequence[float] | str, points: Tensor, normals: Tensor, weight: Tensor) -> UpGuess:
    """An up direction that was given, as 3 numbers or as ``+x`` to ``-z``, with the floor below.

    Raises:
        ValueError: If it is no direction.
    """
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


# ---- what is simulated


def suggest_threshold(opacity: Tensor, weight: Tensor) -> float:
    """The highest of ``THRESHOLDS`` above which at least ``KEPT_AREA`` of the visible area lies."""
    total = float(weight.sum())
    for threshold in THRESHOLDS:
        if float(weight[opacity >= threshold].sum()) >= KEPT_AREA * total:
            return threshold
    return 0.0


def connected_parts(points: Tensor, cell: float) -> Tensor:
    """Number of the connected part that each point is in; points in the same or in touching cells are connected.

    Args:
        points: Shape (N, 3).
        cell: Size of a cell.

    Returns:
        Numbers from 0 on, shape (N,).

    Raises:
        ValueError: If ``cell`` is not positive.
    """
    check_shape("points", points, None, 3)
    check_positive("cell", cell)
    low = points.amin(0).double()
    index = ((points.double() - low) / cell).floor().long().clamp(max=2**20 - 4) + 1
    key, of_point = ((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]).unique(return_inverse=True)
    pairs = []
    for x, y, z in torch.cartesian_prod(*(torch.arange(-1, 2),) * 3).tolist():
        wanted = key + (x << 42) + (y << 21) + z
        if (x, y, z) > (0, 0, 0):  # the other half of the neighbours finds the same pairs
            at = torch.searchsorted(key, wanted).clamp(max=len(key) - 1)
            found = (key[at] == wanted).nonzero()[:, 0]
            pairs.append(torch.stack([found, at[found]]))
    one, other = torch.cat(pairs, 1)
    label = torch.arange(len(key))
    while True:  # the smaller number spreads, by halving of paths
        smaller = torch.minimum(label[one], label[other])
        new = label.clone()
        for end in (one, other, label[one], label[other]):
            new.scatter_reduce_(0, end, smaller, "amin")
        new = new[new]
        if new.equal(label):
            break
        label = new
    return label.unique(return_inverse=True)[1][of_point]


def suggest_region(points: Tensor, opacity: Tensor, weight: Tensor, ground: Tensor, cell: float) -> RegionGuess:
    """The main object without floor and specks.

    The object is the connected part (:func:`connected_parts`) with the largest visible area. Specks within its box are
    cut out by boxes of their own, the largest first.

    Args:
        points: Centres [scene units], shape (N, 3).
        opacity: Opacities, shape (N,).
        weight: Visible area, shape (N,).
        ground: The floor, shape (N,).
        cell: What is farther apart than two such cells is not connected [scene units].

    Returns:
        The guess.

    Raises:
        ValueError: If hardly any Gaussian is left.
    """
    threshold = suggest_threshold(opacity, weight)
    solid = (opacity >= threshold) & ~ground
    index = solid.nonzero()[:, 0]
    if len(index) < FEWEST:
        raise ValueError(
            f"Only {len(index)} Gaussians are left above the floor and an opacity of {threshold:g}, too few for an "
            "object: give another `--up`."
        )
    part = connected_parts(points[index], cell)
    area = torch.zeros(int(part.max()) + 1, dtype=torch.float64).index_add_(0, part, weight[index].double())
    main = int(area.argmax())
    chosen = torch.zeros_like(solid)
    chosen[index[part == main]] = True
    low, high = _padded(points[chosen], 0.5 * cell)
    if bool(ground.any()):  # the box must not reach into the floor again
        low, high = _without(low, high, points[chosen], points[ground])
    box = Box(low, high)
    holes: list[tuple[list[float], list[float]]] = []
    stray = box.contains(points[index]) & (part != main)
    numbers, counts = part[stray].unique(return_counts=True)
    for number in numbers[counts.argsort(descending=True)][: 4 * MAX_BOXES].tolist():
        members = index[stray & (part == number)]
        hole = _padded(points[members], 0.05 * cell)
        caught = Box(*hole).contains(points) & chosen
        if len(holes) < MAX_BOXES and int(caught.sum()) <= len(members):  # worth what it costs the object
            holes.append(hole)
    guess = RegionGuess(chosen, (low, high), holes, threshold, len(index) - int(chosen.sum()), 0, "")
    region = guess.region()
    assert region is not None
    simulated = region.contains(points) & (opacity >= threshold)
    loose = int((simulated & ~chosen).sum())
    everything = bool(region.contains(points).all())
    words = [f"{int(chosen.sum()):,} Gaussians of opacity {threshold:g} and more form one connected part"]
    if bool(ground.any()):
        words.append(f"a floor of {int(ground.sum()):,} lies below it")
    if guess.specks:
        words.append(f"{guess.specks:,} float apart from it")
    words.append("the region is all of space" if everything else "the region is the box around it")
    if holes:
        words.append(f"without {len(holes)} boxes of specks")
    return RegionGuess(
        simulated, None if everything else (low, high), holes, threshold, guess.specks, loose, "; ".join(words)
    )


def given_region(
    points: Tensor, opacity: Tensor, weight: Tensor, low: Sequence[float], high: Sequence[float]
) -> RegionGuess:
    """A region that was given as the corners of a box, with a suggested threshold.

    Raises:
        ValueError: If it holds hardly any Gaussian.
    """
    box = Box(low, high)
    inside = box.contains(points)
    if int(inside.sum()) < FEWEST:
        span = [[round(float(v), 4) for v in corner] for corner in (points.amin(0), points.amax(0))]
        raise ValueError(
            f"The box of `--region` holds {int(inside.sum())} Gaussians, too few for an object: the splat reaches from "
            f"{span[0]} to {span[1]}."
        )
    threshold = suggest_threshold(opacity[inside], weight[inside])
    simulated = inside & (opacity >= threshold)
    corners = ([float(v) for v in low], [float(v) for v in high])
    return RegionGuess(simulated, corners, [], threshold, 0, 0, "given")


# ---- where it is held


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
        across = torch.tensor(_snapped(across), dtype=torch.float64)
        along = points.double() @ across
        low, high = float(along.amin()), float(along.amax())
        for end, sign, other in ((low, -1.0, high), (high, 1.0, low)):
            if abs(end) < 0.05 * (high - low) < abs(other):
                held = tuple(float(sign * c) + 0.0 for c in across)
                return HoldGuess("side", held, "medium", "it is an upright sheet, and the origin lies at this side")
        return HoldGuess("top", upward, "low", "it is an upright sheet, which hangs unless something else holds it")
    height = points.double() @ axis
    low, high = _quantile(height, 0.005), _quantile(height, 0.995)
    depth = 0.08 * (high - low)
    top, bottom = (_width(points[mask], axis) for mask in (height >= high - depth, height <= low + depth))
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
    solid_end = _quantile(along, 0.995)  # a few stragglers beyond do not move it
    depth = max(PIN_DEPTH * (high - low), 1.5 * cell)
    start = max(solid_end - depth, low)
    main = int(axis.abs().argmax())
    if abs(float(axis[main])) > 1 - 1e-6:
        corner: list[float | None] = [None, None, None]
        corner[main] = _rounded(start * float(axis[main]), cell)
        empty: list[float | None] = [None, None, None]
        return Box(corner, empty) if float(axis[main]) > 0 else Box(empty, corner)
    centre = points.double().mean(0)
    height = 2 * (high - low) + 4 * cell
    centre = centre + (start + 0.5 * height - float(centre @ axis)) * axis
    radius = 2 * float((points.double() - points.double().mean(0)).norm(dim=-1).amax())
    direction = [round(c, 6) for c in direction]
    return Cylinder(
        [_rounded(float(c), cell) for c in centre], direction, _rounded(radius, cell), _rounded(height, cell)
    )


# ---- sizes


def particle_spacing(points: Tensor, sample: int = 4000) -> float:
    """Distance to the nearest other point that 90 % of the points stay below, from an even sample."""
    check_shape("points", points, None, 3)
    step = max(1, len(points) // sample)
    distance, _ = nearest_neighbours(points, 2, points[::step])
    return _quantile(distance[:, 1], 0.9)


def suggest_spacing(longest_side: float, spacing: float, cells: int = CELLS) -> float:
    """Grid spacing: the longest side over ``cells``, no finer than twice the particle spacing, to 2 digits.

    Args:
        longest_side: Longest side of the object [m].
        spacing: From :func:`particle_spacing` [m].
        cells: Cells along the longest side.

    Returns:
        Grid spacing [m].
    """
    check_positive("longest_side", longest_side)
    return float(f"{max(longest_side / cells, 2 * spacing):.2g}")


def suggest_fill(cloud: GaussianCloud, metres_per_unit: float, dx: float) -> float | None:
    """``scene.particle_spacing``, if the splat has holes for the grid: points more than 0.6 cells from any centre.

    Args:
        cloud: What is simulated.
        metres_per_unit: Length of a scene unit [m].
        dx: Grid spacing [m].

    Returns:
        0.45 ``dx`` to 2 digits [m], or None if such points are fewer than two in a hundred, or far too many.
    """
    spacing = float(f"{0.45 * dx:.2g}")
    opacity = cloud.opacities.sigmoid()
    try:
        further = subdivide(cloud.means, cloud.quats, cloud.scales, opacity, spacing / metres_per_unit).means
    except ValueError:  # haze, on which nothing is to be put
        return None
    distance, _ = nearest_neighbours(cloud.means, 1, further)
    holes = int((distance * metres_per_unit > 0.6 * dx).sum())
    return spacing if holes > 0.02 * len(cloud) else None


def broad_side(points: Tensor) -> float:
    """Azimuth [degrees], from -90 to 90, of the horizontal direction in which points (N, 3), z up, reach least far."""
    flat = points.double()[:, :2]
    _, axes = torch.linalg.eigh(torch.cov((flat - flat.mean(0)).T))
    x, y = axes[:, 0].tolist()
    angle = math.degrees(math.atan2(y, x))
    return (angle + 90) % 180 - 90


def _quantile(values: Tensor, share: float) -> float:
    """Quantile without the limit of 2^24 values that torch.quantile has."""
    return float(values.double().kthvalue(1 + round(share * (len(values) - 1))).values)


def _three(values: Tensor) -> list[float]:
    return [_quantile(values, q) for q in (0.05, 0.5, 0.95)]


def _plane_axes(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors across another."""
    helper = torch.eye(3, dtype=torch.float64)[int(axis.abs().argmin())]
    first = torch.linalg.cross(axis, helper)
    first = first / first.norm()
    return first, torch.linalg.cross(axis, first)


def _width(points: Tensor, axis: Tensor) -> float:
    """Geometric mean of the widths of points across an axis, robust."""
    sides = [points.double() @ across for across in _plane_axes(axis)]
    return math.sqrt(math.prod(max(_quantile(s, 0.97) - _quantile(s, 0.03), 1e-9) for s in sides))


def _snapped(direction: Tensor) -> tuple[float, ...]:
    """A unit vector, made the axis that it is within 10 degrees of; its largest component positive."""
    unit = direction.double() / direction.double().norm()
    main = int(unit.abs().argmax())
    if float(unit[main]) < 0:
        unit = -unit
    if float(unit[main]) > math.cos(math.radians(10)):
        unit = torch.eye(3, dtype=torch.float64)[main]
    return tuple(float(c) + 0.0 for c in unit)


def _rounded(value: float, cell: float) -> float:
    """A coordinate with no more digits than matter: a hundredth of a cell."""
    return round(value, max(0, 2 - math.floor(math.log10(cell))))


def _padded(points: Tensor, margin: float) -> tuple[list[float], list[float]]:
    low = [_rounded(float(v) - margin, margin) for v in points.amin(0)]
    return low, [_rounded(float(v) + margin, margin) for v in points.amax(0)]


def _without(low: list[float], high: list[float], points: Tensor, ground: Tensor) -> tuple[list[float], list[float]]:
    """The box with the face that looks at the floor moved back onto the object, if it reaches into the floor."""
    for axis in range(3):
        first, last = float(points[:, axis].amin()), float(points[:, axis].amax())
        floor_low, floor_high = float(ground[:, axis].amin()), float(ground[:, axis].amax())
        if low[axis] < floor_high <= first:
            low[axis] = round(0.5 * (floor_high + first), 6)
        if high[axis] > floor_low >= last:
            high[axis] = round(0.5 * (floor_low + last), 6)
    return low, high
