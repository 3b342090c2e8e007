"""A suggestion for the first configuration of a splat: bounds, up axis, sizes, and every number that a run needs.

Everything here is a guess, made with rules that are stated with the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying.captures.capture_camera import photo_azimuth
from gaussian_swaying.gaussians.area import patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.gaussians.repair import OPAQUE_LOGIT
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.geometry.regions import Box, Not, Region, Union
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.mpm.modes import MOST_LEAN
from gaussian_swaying.preview.framing import orbit_frame, whole_box
from gaussian_swaying.preview.hold import PIN_DEPTH, HoldGuess, end_region, given_hold, guess_hold
from gaussian_swaying.preview.kinds import KINDS, kind_of, with_materials
from gaussian_swaying.preview.natural import Natural, cloth_start, natural
from gaussian_swaying.preview.parts import FoundParts, plant_parts
from gaussian_swaying.preview.photos import CapturedFrom, ShownObject, shown_object
from gaussian_swaying.preview.shape import (
    FEWEST,
    bounds,
    quantile,
    rounded,
    sheet_normal,
)
from gaussian_swaying.preview.supports import (
    flag_on_pole,
    potted_parts,
    sheet_between_posts,
    standing_parts,
    swinging_parts,
)
from gaussian_swaying.preview.up import UpGuess, given_up, guess_up
from gaussian_swaying.simulation.body import suggest_spacing
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.turbulence import LOOKS

QUALITIES = {"draft": 16, "normal": 24, "fine": 48}  # cells along the longest side; normal is enough for bending
CELLS = QUALITIES["normal"]
MOST_CELLS = 96  # of a grid that is chosen by its time
CLOTH_E, CLOTH_THICKNESS = 6e3, 0.01  # Pa, m; a sheet: the cloth of the paper's flags
SHELL_E = 1e6  # Pa; of everything else, until its frequency is known
THRESHOLDS = (0.1, 0.05, 0.02, 0.01, 0.0)  # of opacity; the first is the paper's
KEPT_AREA = 0.95  # share of the visible area that the threshold must keep
POSTS = 2.5  # usual length of a washing line with its posts [m]
SURE = 0.1  # share of the Gaussians of an object that is no weak guess
MAX_BOXES = 8  # largest number of boxes that cut specks out of the region


@dataclass(frozen=True)
class RegionGuess:
    """A guess of the Gaussians to simulate.

    Attributes:
        simulated: The simulated ones, shape (N,).
        box: Lower and upper corner [scene units] of the region, or None for all of space.
        holes: Boxes inside it that are left out, as corners.
        opacity_threshold: Smallest simulated opacity.
        specks: Number of Gaussians above the threshold that are not part of the object, floor or surroundings.
        reason: In words.
        cuts: Further regions inside it that are left out: walls and everything behind them.
        confidence: ``low`` if few of the Gaussians are in it, else ``high``.
    """

    simulated: Tensor
    box: tuple[list[float], list[float]] | None
    holes: list[tuple[list[float], list[float]]]
    opacity_threshold: float
    specks: int
    reason: str
    cuts: tuple[Region, ...] = ()
    confidence: str = "high"

    def region(self) -> Region | None:
        """The region for a run; None for all of space."""
        if self.box is None:
            return None
        inside: Region = Box(*self.box)
        out = [*(Box(*hole) for hole in self.holes), *self.cuts]
        return Not(Union([Not(inside), *out])) if out else inside


def visible_weight(cloud: GaussianCloud) -> Tensor:
    """Opacity times area pi s1 s2 of each Gaussian [scene units²], shape (N,), with the largest 1 % clamped."""
    weight = (cloud.opacities.sigmoid() * patch_area(cloud.scales)).double()
    return weight.clamp(max=quantile(weight, 0.99))


def gaussian_statistics(cloud: GaussianCloud) -> dict[str, object]:
    """Count, opacities, shapes and sizes of the Gaussians, as plain numbers.

    Returns:
        Quantiles are lists of the 5, 50 and 95 % values. ``size_share`` is the largest standard deviation over the
        longest robust side. S1 >= S2 >= S3 are the standard deviations of a Gaussian.
    """
    opacity = cloud.opacities.sigmoid()
    s1, s2, s3 = cloud.scales.amax(-1), cloud.scales.median(-1).values, cloud.scales.amin(-1)  # logarithms
    corner = bounds(cloud.means)
    longest = max(b - a for a, b in zip(corner["robust_min"], corner["robust_max"], strict=True))
    return {
        "count": len(cloud),
        "sh_degree": cloud.sh_degree,
        "normals": cloud.normals is not None,
        "opacity": _three(opacity),
        "opacity_0_or_1": int((cloud.opacities.abs() == OPAQUE_LOGIT).sum()),
        "opacity_below": {str(t): float((opacity < t).double().mean()) for t in THRESHOLDS if t > 0},
        "S1_over_S2": _three((s1.double() - s2).exp_()),
        "S2_over_S3": _three((s2.double() - s3).exp_()),
        "size_share": _three(s1.double().exp_() / max(longest, 1e-30)),
    }


# ---- all of it


@dataclass(frozen=True)
class Suggestion:
    """Everything that a first configuration needs.

    Attributes:
        up: The up direction.
        region: The simulated part.
        hold: The end at which it is held.
        pin: That end as a region, None if it is not held, or is a part of ``parts`` that is.
        longest_side: Assumed length of the longest side of the object, without what is still [m].
        metres_per_unit: Resulting length of a scene unit [m].
        size: Sides of the object along the z-up axes [m].
        spacing: Particle spacing [m], see :func:`particle_spacing`.
        dx: Grid spacing [m].
        quality: Which quality that is, one of ``QUALITIES``, or in words how it was chosen.
        sheet: Whether the object is a thin sheet.
        azimuth: Azimuth of a camera that sees the broad side, or the side seen in photos [degrees].
        flow: Wind across the picture, or along a sheet from its held side [m/s], z up.
        start: Time at which a typical stretch of the turbulence begins [s].
        look: The name of the wind, one of :data:`~gaussian_swaying.wind.turbulence.LOOKS`.
        kind: What it is, one of :data:`~gaussian_swaying.preview.kinds.KINDS`.
        kind_reason: Why, in words.
        material: The known material of its surface, of the kind or as it was given.
        youngs_modulus: Young's modulus [Pa]; :mod:`~gaussian_swaying.preview.natural` finds that of the kind.
        density: Density of the surface [kg/m³].
        thickness: Thickness of the surface [m], also a first guess.
        drag: Factor on the coefficients of the wind's force.
        natural: Frequency, mass and lean of the kind, if it sways by modes or could.
        whole: Corners of the box of the whole object, including parts that do not move [scene units].
        camera_offset: Vector from the centre of the moving part to that of the whole, in multiples of the longest side
            of the moving part.
        camera_radius: Distance of a camera that shows the whole, in the same unit.
        parts: The parts of the object, if they are sure: a plant in a pot, a flag on its pole, what hangs from a cord,
            or a tree; else None.
        connected: ``scene.connected`` of the starter.
        connected_reason: Why it is ``surface``, in words, if that was not asked for.
        real: Whether the numbers are those of the material; if not, it sways as its kind does.
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
    quality: str
    sheet: bool
    azimuth: float
    flow: tuple[float, ...]
    look: str
    kind: str
    kind_reason: str
    material: str
    youngs_modulus: float
    density: float
    thickness: float
    whole: tuple[list[float], list[float]]
    camera_offset: tuple[float, ...]
    camera_radius: float
    parts: FoundParts | None = None
    start: float = 0.0
    drag: float = 1.0
    natural: Natural | None = None
    connected: str = "grid"
    connected_reason: str = ""
    real: bool = False

    @property
    def sways(self) -> bool:
        """True if its numbers are those of its kind: it is held, no cloth, and no material was given."""
        return self.fixed and not self.real and not KINDS[self.kind].cloth

    @property
    def by_modes(self) -> bool:
        """True if modes will do: it leans by less than :data:`MOST_LEAN`, or turns as one, which modes do exactly."""
        little = self.natural is None or self.natural.lean < MOST_LEAN or self.kind == "hanging"
        return self.sways and little

    @property
    def why_formulation(self) -> str:
        """The reason why it sways by modes or by material points, in words."""
        if self.by_modes:
            how = "turns as one" if self.kind == "hanging" else "leans by less than 40 %"
            return f"it is held, nothing touches, and it {how}"
        if self.sways:
            return "it leans by more than 40 %, which modes cannot do"
        if self.real:
            return "a material was given"
        return "cloth folds" if self.fixed else "nothing holds it"

    @property
    def fixed(self) -> bool:
        return self.pin is not None or self.parts is not None


def suggest(
    cloud: GaussianCloud,
    up: Sequence[float] | str | None = None,
    hold: str | None = None,
    region: tuple[Sequence[float], Sequence[float]] | None = None,
    longest_side: float | None = None,
    speed: float | None = None,
    capture: CapturedFrom | None = None,
    quality: str = "normal",
    found: tuple[UpGuess, RegionGuess] | None = None,
    look: str = "breeze",
    kind: str | None = None,
    more: bool = False,
) -> Suggestion:
    """Guess a first configuration.

    Args:
        cloud: The splat.
        up: Direction that points up, as 3 numbers or as ``+x`` to ``-z``; guessed if None.
        hold: ``top``, ``bottom``, ``none`` or ``+x`` to ``-z``; guessed if None.
        region: Corners of the box to simulate [scene units]; guessed if None.
        longest_side: Length of the longest side of the object [m]; the usual one of its kind if None.
        speed: Speed of the wind [m/s]; that of the look if None.
        capture: The cameras of the splat's photos, which define the up direction and the object.
        quality: ``draft``, ``normal`` or ``fine``. Only the grid spacing depends on it.
        found: The up direction and the simulated part, if they are known; ``up``, ``region`` and ``capture`` are then
            not used for them.
        look: ``breeze``, ``gusts`` or ``storm``.
        kind: One of :data:`~gaussian_swaying.preview.kinds.KINDS`; guessed if None.
        more: Whether the splat has more Gaussians, far away, so that the region must not be all of space.

    Returns:
        The suggestion.
    """
    if longest_side is not None:
        check_positive("--longest-side", longest_side)
    check_choice("--look", look, tuple(LOOKS))
    speed = LOOKS[look].speed if speed is None else speed
    check_positive("--wind", speed, allow_zero=True)
    if kind is not None:
        check_choice("--kind", kind, tuple(KINDS))
    unscaled, longest_side = longest_side is None, longest_side or 1.0
    check_choice("--quality", quality, tuple(QUALITIES))
    if len(cloud) < FEWEST:
        raise ValueError(f"The splat has {len(cloud)} Gaussians, too few for an object; at least {FEWEST} are needed.")
    means, opacity, weight = cloud.means.detach(), cloud.opacities.detach().sigmoid(), visible_weight(cloud)
    normals = smallest_axis_normal(cloud.quats, cloud.scales)
    shown = (
        None
        if capture is None or region is not None or found is not None
        else shown_object(means, opacity, weight, capture)
    )
    if found is not None:
        upward = found[0]
    elif up is not None:
        upward = given_up(up, means, normals, weight)
    elif capture is not None:
        upward = given_up(capture.up, means, normals, weight)
        upward = replace(upward, confidence=capture.confidence, reasons=[capture.reason], options=capture.options)
    else:
        upward = guess_up(means, normals, weight)
    if shown is not None:
        upward = replace(upward, ground=shown.floor(upward.direction))
    corner = bounds(means if shown is None else means[shown.mask])
    side = max(b - a for a, b in zip(corner["robust_min"], corner["robust_max"], strict=True))
    if side <= 0:
        raise ValueError("All Gaussians of the splat are at one point: there is no object to simulate.")
    if found is not None:
        chosen = found[1]
    elif region is None:
        cell = max(side / CELLS, 2 * particle_spacing(means if shown is None else means[shown.mask]))
        if shown is not None:  # the rest of a backdrop must not count as a part of the object
            cell = 0.5 * cell
        chosen = suggest_region(means, opacity, weight, upward.ground, cell, shown, more)
    else:
        chosen = given_region(means, opacity, weight, *region)
    plant = plant_parts(cloud, chosen.simulated, upward.direction, weight) if hold is None else None
    flag = flag_on_pole(cloud, chosen.simulated, upward.direction) if hold is None and plant is None else None
    alone = hold is None and plant is None and flag is None
    laundry = sheet_between_posts(cloud, chosen.simulated, upward.direction) if alone else None
    frame = SimFrame.fit(means[chosen.simulated], upward.direction, longest_side)
    if plant is not None and upward.confidence in ("low", "medium"):
        why = [*upward.reasons, "a plant stands in a pot at the lower end"]
        upward = replace(upward, confidence="high", reasons=why)
    found_parts = plant or laundry if flag is None else flag[0]
    if found_parts is not None:  # the length is that of the whole, with pot or pole and without the ground around it
        frame = SimFrame.fit(means[chosen.simulated & ~found_parts.around], upward.direction, longest_side)
        chosen = replace(chosen, simulated=chosen.simulated & ~found_parts.still)
        frame = SimFrame.fit(means[chosen.simulated], upward.direction, None, frame.metres_per_unit)
    points, visible = means[chosen.simulated], weight[chosen.simulated]
    metres = frame.point_to_sim(points.double())
    if found_parts is not None:
        longest_side = float((metres.amax(0) - metres.amin(0)).amax())
    spacing = particle_spacing(points) * frame.metres_per_unit
    dx = suggest_spacing(longest_side, spacing, CELLS)
    if plant is not None:
        down = tuple(0.0 - c for c in upward.direction)
        held = HoldGuess("bottom", down, "medium", f"a plant in a pot: {plant.reason}")
    elif flag is not None:
        held = HoldGuess("side", flag[1], "high", f"a flag on its pole: {flag[0].reason}")
    elif laundry is not None:
        held = HoldGuess("top", tuple(upward.direction), "high", f"on a line: {laundry.reason}")
    elif hold is None:
        rest = means[~chosen.simulated & (opacity >= chosen.opacity_threshold)]
        eyes = None if capture is None else capture.eyes
        wall = None if shown is None else shown.wall(upward.direction)
        held = guess_hold(points, visible, upward.direction, dx / frame.metres_per_unit, rest, eyes, wall)
    else:
        held = given_hold(hold, upward.direction)
    pin = (
        None
        if held.end == "none" or plant is not None
        else end_region(points, held.direction, dx / frame.metres_per_unit)
    )
    sure = held.confidence in ("high", "medium")
    if hold is None and found_parts is None and pin is not None and sure and held.end == "bottom":
        depth = max(PIN_DEPTH * float(metres[:, 2].amax() - metres[:, 2].amin()), 1.5 * dx) / frame.metres_per_unit
        found_parts = potted_parts(cloud, chosen.simulated, upward.direction, weight)
        found_parts = found_parts or standing_parts(cloud, chosen.simulated, upward.direction, weight, depth)
        pin = pin if found_parts is None else None
    flat = sheet_normal(points)
    name, why_kind = kind_of(cloud, chosen.simulated, upward.direction, weight, held.end, flat is not None, found_parts)
    if kind is not None:
        name, why_kind = kind, "given"
    if name == "hanging" and held.end == "top" and laundry is None:
        ends = end_region(points, held.direction, dx / frame.metres_per_unit)
        found_parts = swinging_parts(
            cloud, chosen.simulated, upward.direction, weight, ends, dx / frame.metres_per_unit
        )
        pin = None
    if unscaled:
        ratio = KINDS[name].side if laundry is None else POSTS
        frame = SimFrame.fit(means[chosen.simulated], upward.direction, None, frame.metres_per_unit * ratio)
        metres, spacing, longest_side = metres * ratio, spacing * ratio, longest_side * ratio
        dx = suggest_spacing(longest_side, spacing, CELLS)
    if found_parts is not None and flat is None:
        found_parts = with_materials(found_parts, KINDS[name], float(metres[:, 2].amax() - metres[:, 2].amin()))
    known = known_material(KINDS[name].material)
    azimuth, turn = broad_side(metres), 20.0  # the broad side, seen slightly from the side
    front = None if capture is None else photo_azimuth(capture.eyes, points.double().mean(0), frame.rotation)
    if front is not None:
        azimuth, turn = front, 0.0
    flow = _across_picture(azimuth, speed)
    if held.end == "side" and KINDS[name].cloth:  # along the sheet from the pole, and slightly onto it
        away = -frame.direction_to_sim(torch.tensor(held.direction, dtype=torch.float64))
        onto = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), away)
        flow = tuple(speed * float(c) for c in math.cos(0.25) * away + math.sin(0.25) * onto)
    elif flat is not None or name in ("hanging", "person"):  # what is flat is moved by wind that hits its face
        flow = _across_picture(azimuth - 90, speed)
        turn = turn if flat is not None or front is not None else 50.0
    outside = upward.ground if shown is None else upward.ground | ~shown.mask
    if found_parts is not None:
        outside = outside | found_parts.around
    whole = whole_box(means, opacity, chosen.simulated, outside, dx / frame.metres_per_unit)
    offset, radius = orbit_frame(whole, (points.amin(0).tolist(), points.amax(0).tolist()))
    suggestion = Suggestion(
        up=upward,
        region=chosen,
        hold=held,
        pin=pin,
        longest_side=float(longest_side),
        metres_per_unit=frame.metres_per_unit,
        size=tuple(float(v) for v in metres.amax(0) - metres.amin(0)),
        spacing=spacing,
        dx=dx,
        quality="normal",
        sheet=flat is not None,
        azimuth=round(azimuth + turn, 1),
        flow=tuple(round(c, 2) + 0.0 for c in flow),
        look=look,
        kind=name,
        kind_reason=why_kind,
        material=KINDS[name].material,
        youngs_modulus=CLOTH_E if KINDS[name].cloth else SHELL_E,
        density=KINDS[name].mass / CLOTH_THICKNESS if KINDS[name].cloth else known.density,
        thickness=CLOTH_THICKNESS if KINDS[name].cloth else known.thickness,
        whole=whole,
        camera_offset=offset,
        camera_radius=radius,
        parts=found_parts,
    )
    return at_quality(suggestion, quality)


def of_material(suggestion: Suggestion, name: str) -> Suggestion:
    """The suggestion with the numbers of a known material, in place of those of its kind."""
    known = known_material(name, "--material")
    return replace(
        suggestion, material=name, real=True, youngs_modulus=known.E, density=known.density,
        thickness=known.thickness,
    )  # fmt: skip


def at_quality(suggestion: Suggestion, quality: str) -> Suggestion:
    """The same suggestion with the grid of another quality, one of ``QUALITIES``."""
    spacing = suggest_spacing(suggestion.longest_side, suggestion.spacing, QUALITIES[quality])
    return replace(suggestion, dx=spacing, quality=quality)


def finest_spacing(suggestion: Suggestion) -> float:
    """The finest grid spacing [m] that a time may choose: ``MOST_CELLS``, and at least twice the particle spacing."""
    return suggest_spacing(suggestion.longest_side, suggestion.spacing, MOST_CELLS)


def as_its_kind(suggestion: Suggestion, simulation: Simulation) -> Suggestion:
    """The suggestion with the numbers of its kind, and a typical stretch of its wind.

    Args:
        suggestion: What :func:`suggest` found.
        simulation: That of its starter; it gets the numbers, too, if it sways by modes.
    """
    kind, wind = KINDS[suggestion.kind], simulation.wind
    if suggestion.sways:
        assert isinstance(wind, WindField)
        found = natural(simulation, kind, wind.flows[0], LOOKS[suggestion.look].intensity)
        return with_natural(suggestion, found)
    if kind.cloth and suggestion.fixed:
        return replace(suggestion, start=cloth_start(simulation, kind, suggestion.size))
    return suggestion


def with_natural(suggestion: Suggestion, found: Natural) -> Suggestion:
    """The suggestion with the numbers of its kind, that :func:`~gaussian_swaying.preview.natural.natural` found."""
    s, parts = suggestion, suggestion.parts
    frequency = 1.0 if found.lean < MOST_LEAN else found.frequency  # `total` has the ratio at 1 Hz

    def own(part: Part) -> Part:
        given = {name: getattr(part, name) for name in ("thickness", "E", "damping_ratio")}
        changed: dict[str, Any] = {}
        if given["thickness"] is not None:
            changed["thickness"] = given["thickness"] * found.thicker
        if given["E"] is not None:
            changed["E"] = found.stiffer.get(given["E"], given["E"])
        if given["damping_ratio"] is not None:
            changed["damping_ratio"] = given["damping_ratio"] * frequency
        return replace(part, **changed)

    if parts is not None:
        parts = replace(parts, parts=Parts(parts.parts.labels, [own(part) for part in parts.parts.parts]))
    return replace(
        s, youngs_modulus=found.stiffer.get(s.youngs_modulus, s.youngs_modulus), thickness=s.thickness * found.thicker,
        drag=s.drag * found.drag, parts=parts, natural=found, start=found.start,
    )  # fmt: skip


def _across_picture(azimuth: float, speed: float) -> tuple[float, ...]:
    """Horizontal flow to the right of a picture from an azimuth [degrees]."""
    angle = math.radians(azimuth)
    return (-speed * math.sin(angle), speed * math.cos(angle), 0.0)


# ---- what is simulated


def suggest_threshold(opacity: Tensor, weight: Tensor) -> float:
    """The highest of ``THRESHOLDS`` that keeps at least ``KEPT_AREA`` of the visible area."""
    total = float(weight.sum())
    for threshold in THRESHOLDS:
        if float(weight[opacity >= threshold].sum()) >= KEPT_AREA * total:
            return threshold
    return 0.0


def suggest_region(
    points: Tensor,
    opacity: Tensor,
    weight: Tensor,
    ground: Tensor,
    cell: float,
    shown: ShownObject | None = None,
    more: bool = False,
) -> RegionGuess:
    """The main object without floor, surroundings and specks.

    The object is the connected part (:func:`connected_parts`) with the largest visible area; one with few Gaussians
    counts less. Specks inside its box are cut out by smaller boxes, the largest first.

    Args:
        points: Centres [scene units], shape (N, 3).
        opacity: Opacities, shape (N,).
        weight: Visible area, shape (N,).
        ground: The floor, shape (N,).
        cell: Points farther apart than two such cells are not connected [scene units].
        shown: The object in photos, to which the result is limited; the part nearest to their common point counts most.
        more: Whether there are more Gaussians far away.

    Returns:
        The guess.
    """
    among = torch.ones_like(opacity, dtype=torch.bool) if shown is None else shown.mask
    threshold = suggest_threshold(opacity[among], weight[among])
    solid = (opacity >= threshold) & ~ground & among
    index = solid.nonzero()[:, 0]
    if len(index) < FEWEST:
        raise ValueError(
            f"Only {len(index)} Gaussians are left above the floor and an opacity of {threshold:g}, too few for an "
            "object: set another `--up`."
        )
    part = connected_parts(points[index], cell)
    counted = weight[index].double() if shown is None else weight[index].double() * shown.nearness(points[index])
    area = torch.zeros(int(part.max()) + 1, dtype=torch.float64).index_add_(0, part, counted)
    count = part.bincount()
    main = int((area * (count / (SURE * len(index))).clamp(max=1)).argmax())
    sure = shown is not None or int(count[main]) >= SURE * len(index)
    words = [f"{int((part == main).sum()):,} Gaussians of opacity {threshold:g} and more form one connected part"]
    if bool(ground.any()):
        words.append(f"a floor of {int(ground.sum()):,} lies below it")
    if shown is not None:
        words.append("the cameras look at it")
        if shown.backdrops:
            words.append("everything in or behind a wall or floor is left out")
    cuts = () if shown is None else tuple(backdrop.behind for backdrop in shown.backdrops)
    guess = region_around(points, opacity, index, part, main, threshold, ground, cell, cuts, words, more)
    return guess if sure else replace(guess, confidence="low")


def region_around(
    points: Tensor,
    opacity: Tensor,
    index: Tensor,
    part: Tensor,
    main: int,
    threshold: float,
    ground: Tensor,
    cell: float,
    cuts: tuple[Region, ...],
    words: list[str],
    more: bool = False,
) -> RegionGuess:
    """The box around a connected part, without the floor and specks in it.

    Args:
        points: Centres [scene units], shape (N, 3).
        opacity: Opacities, shape (N,).
        index: Those that may be simulated, shape (M,).
        part: The connected part of each of them, shape (M,).
        main: The part that is simulated.
        threshold: Smallest simulated opacity.
        ground: The floor, shape (N,).
        cell: The box is half a cell larger [scene units].
        cuts: Further regions that are left out.
        words: Why it is this part.
        more: Whether there are more Gaussians far away.
    """
    chosen = torch.zeros(len(points), dtype=torch.bool)
    chosen[index[part == main]] = True
    low, high = _padded(points[chosen], 0.5 * cell)
    if bool(ground.any()):  # the box must not reach into the floor again
        low, high = _without(low, high, points[chosen], points[ground])
    box: Region = Box(low, high)
    if cuts:
        box = Not(Union([Not(box), *cuts]))
    holes: list[tuple[list[float], list[float]]] = []
    stray = box.contains(points[index]) & (part != main)
    numbers, counts = part[stray].unique(return_counts=True)
    for number in numbers[counts.argsort(descending=True)][: 4 * MAX_BOXES].tolist():
        members = index[stray & (part == number)]
        hole = _padded(points[members], 0.05 * cell)
        caught = Box(*hole).contains(points) & chosen
        if len(holes) < MAX_BOXES and int(caught.sum()) <= len(members):  # removes more specks than parts of the object
            holes.append(hole)
    guess = RegionGuess(chosen, (low, high), holes, threshold, len(index) - int(chosen.sum()), "", cuts)
    region = guess.region()
    assert region is not None
    simulated = region.contains(points) & (opacity >= threshold)
    everything = not more and bool(region.contains(points).all())
    words = list(words)
    if guess.specks:
        words.append(f"{guess.specks:,} float apart from it")
    words.append("the region is all of space" if everything else "the region is the box around it")
    if holes:
        words.append(f"without {len(holes)} boxes of specks")
    return RegionGuess(
        simulated, None if everything else (low, high), holes, threshold, guess.specks, "; ".join(words), cuts
    )


def given_region(
    points: Tensor, opacity: Tensor, weight: Tensor, low: Sequence[float], high: Sequence[float]
) -> RegionGuess:
    """A region given by the corners of a box, with a suggested threshold."""
    box = Box(low, high)
    inside = box.contains(points)
    if int(inside.sum()) < FEWEST:
        span = [[round(float(v), 4) for v in corner] for corner in (points.amin(0), points.amax(0))]
        raise ValueError(
            f"The box of `--region` contains {int(inside.sum())} Gaussians, too few for an object: the splat spans "
            f"{span[0]} to {span[1]}."
        )
    threshold = suggest_threshold(opacity[inside], weight[inside])
    simulated = inside & (opacity >= threshold)
    corners = ([float(v) for v in low], [float(v) for v in high])
    return RegionGuess(simulated, corners, [], threshold, 0, "given")


# ---- sizes


def broad_side(points: Tensor) -> float:
    """Azimuth [degrees], from -90 to 90, of the horizontal direction of smallest extent of points (N, 3), z up."""
    flat = points.double()[:, :2]
    _, axes = torch.linalg.eigh(torch.cov((flat - flat.mean(0)).T))
    x, y = axes[:, 0].tolist()
    angle = math.degrees(math.atan2(y, x))
    return (angle + 90) % 180 - 90


def _three(values: Tensor) -> list[float]:
    return [quantile(values, q) for q in (0.05, 0.5, 0.95)]


def _padded(points: Tensor, margin: float) -> tuple[list[float], list[float]]:
    low = [rounded(float(v) - margin, margin) for v in points.amin(0)]
    return low, [rounded(float(v) + margin, margin) for v in points.amax(0)]


def _without(low: list[float], high: list[float], points: Tensor, ground: Tensor) -> tuple[list[float], list[float]]:
    """The box, with a face that extends into the floor moved back to between floor and object."""
    for axis in range(3):
        first, last = float(points[:, axis].amin()), float(points[:, axis].amax())
        floor_low, floor_high = float(ground[:, axis].amin()), float(ground[:, axis].amax())
        if low[axis] < floor_high <= first:
            low[axis] = round(0.5 * (floor_high + first), 6)
        if high[axis] > floor_low >= last:
            high[axis] = round(0.5 * (floor_low + last), 6)
    return low, high
