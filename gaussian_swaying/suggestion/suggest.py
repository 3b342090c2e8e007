"""A first simulation of a captured splat: up, what moves, where it is held, its kind, its grid and its wind.

Everything here is a guess, made with rules that are stated with the result.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying.captures.capture_camera import photo_azimuth
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.connectivity import pieces
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.hold import PIN_DEPTH, end_region, given_hold, guess_hold
from gaussian_swaying.gaussians.measures import FEWEST, Array, Gaussians, Guess, corners, sheet_normal
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.geometry.groups import equal_rows, joined
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.rotations import rotation_from_z
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.mpm.modes import MOST_LEAN
from gaussian_swaying.simulation.body import SimulatedScene, suggest_spacing
from gaussian_swaying.simulation.simulation import classify
from gaussian_swaying.suggestion.kinds import KINDS, kind_of, with_materials
from gaussian_swaying.suggestion.moves import (
    Photos,
    given_region,
    main_part,
    move_things,
    read_photos,
    shown_object,
    sky,
    survey,
)
from gaussian_swaying.suggestion.natural import Natural, cloth_start, natural
from gaussian_swaying.suggestion.parts import (
    AROUND,
    FoundParts,
    Labels,
    flag_on_pole,
    labelled,
    pot_by_colour,
    potted_plant,
    standing,
    swinging,
    washing_line,
)
from gaussian_swaying.suggestion.picture import orbit_frame, whole_box
from gaussian_swaying.suggestion.suggestion import Suggestion
from gaussian_swaying.suggestion.up import floor_mask, given_up, guess_up
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.turbulence import LOOKS

QUALITIES = {"draft": 16, "normal": 24, "fine": 48}  # cells along the longest side; normal is enough for bending
CELLS = QUALITIES["normal"]
CLOTH_E, CLOTH_THICKNESS = 6e3, 0.01  # Pa, m; a sheet: the cloth of the paper's flags
SHELL_E = 1e6  # Pa; of everything else, until its frequency is known
POSTS = 2.5  # usual length of a washing line with its posts [m]
REACH = 3  # cells that a node reaches
ENOUGH = 0.1  # share of the Gaussians that lie beside something else, from which on nodes of their own help


def suggest(
    splat: GaussianCloud | str | os.PathLike[str],
    *,
    up: Sequence[float] | str | None = None,
    hold: str | None = None,
    region: Sequence[Sequence[float]] | None = None,
    move: Sequence[int] | None = None,
    longest_side: float | None = None,
    look: str = "breeze",
    wind: float | None = None,
    kind: str | None = None,
    material: str | None = None,
    quality: str = "normal",
    capture: str | os.PathLike[str] | None = None,
    device: str = "auto",
) -> Suggestion:
    """Suggest a first simulation of a captured splat, with the numbers with which it sways as its kind does.

    Args:
        splat: The Gaussians, or their file.
        up: Direction that points up, as 3 numbers or as ``+x`` to ``-z``; guessed if None.
        hold: End that is held: ``top``, ``bottom``, ``none`` or ``+x`` to ``-z``; guessed if None.
        region: Corners of the box to simulate [scene units]; guessed if None.
        move: Numbers of the things of a place that move; the likeliest one if None.
        longest_side: Length of the longest side of the object [m]; the usual one of its kind if None.
        look: Mean speed and turbulence of the wind: ``breeze``, ``gusts`` or ``storm``.
        wind: Speed of the wind [m/s]; that of the look if None.
        kind: One of :data:`~gaussian_swaying.suggestion.kinds.KINDS`; guessed if None.
        material: A known material, whose numbers replace those of the kind.
        quality: Fineness of the grid: ``draft``, ``normal`` or ``fine``.
        capture: The cameras of the splat's photos (COLMAP or transforms.json), which show up and the object.
        device: Of the simulation.

    Returns:
        The suggestion.
    """
    path = None if isinstance(splat, GaussianCloud) else Path(splat).resolve()
    cloud = splat if isinstance(splat, GaussianCloud) else read_gaussians(splat)
    photos = None if capture is None else read_photos(Path(capture), cloud.origin)
    found = guess(
        cloud, up=up, hold=hold, region=region, move=move, longest_side=longest_side, look=look, wind=wind, kind=kind,
        material=material, quality=quality, photos=photos,
    )  # fmt: skip
    return in_whole(swaying(replace(found, path=path), device), cloud)


def in_whole(found: Suggestion, cloud: GaussianCloud) -> Suggestion:
    """The suggestion of some Gaussians for all, of which the others are still."""
    if found.near is None:
        return found
    return replace(found, cloud=cloud, parts=None if found.parts is None else found.parts.within(found.near))


def guess(
    cloud: GaussianCloud,
    *,
    up: Sequence[float] | str | None = None,
    hold: str | None = None,
    region: Sequence[Sequence[float]] | None = None,
    move: Sequence[int] | None = None,
    longest_side: float | None = None,
    look: str = "breeze",
    wind: float | None = None,
    kind: str | None = None,
    material: str | None = None,
    quality: str = "normal",
    photos: Photos | None = None,
) -> Suggestion:
    """Guess all but the numbers with which it sways; of a place only the Gaussians near what moves are in the result.

    See :func:`suggest`.
    """
    if longest_side is not None:
        check_positive("--longest-side", longest_side)
    check_choice("--look", look, tuple(LOOKS))
    speed = LOOKS[look].speed if wind is None else wind
    check_positive("--wind", speed, allow_zero=True)
    if kind is not None:
        check_choice("--kind", kind, tuple(KINDS))
    check_choice("--quality", quality, tuple(QUALITIES))
    if move is not None and region is not None:
        raise ValueError("`--move` and `--region` both choose what moves: leave out one of them.")
    if len(cloud) < FEWEST:
        raise ValueError(f"The splat has {len(cloud)} Gaussians, too few for an object; at least {FEWEST} are needed.")
    splat, near = Gaussians.of(cloud), None
    upward = given_up(up) if up is not None else None if photos is None else photos.up
    place, moves = None, tuple(move or (1,))
    if region is None and (photos is None or move is not None):  # photos alone show the object
        place = survey(splat, upward, [] if photos is None else photos.cameras)
    if place is not None:
        near, moving = move_things(place, splat, moves)
    elif move is not None:
        raise ValueError("`--move` chooses things of a place, and this splat is one object: leave it out.")
    elif region is None and photos is None and (far := sky(splat)).any():
        near = ~far
    if near is not None:
        cloud, splat = cloud.select(torch.from_numpy(near)), splat[near]
    if np.ptp(corners(splat.means), axis=0).max() <= 0:
        raise ValueError("All Gaussians of the splat are at one point: there is no object to simulate.")
    shown = None if photos is None or region is not None or place is not None else shown_object(splat, photos)
    if place is not None:
        upward, ground = place.up, place.ground[near]
    elif upward is None:
        upward, ground = guess_up(splat)
    else:
        ground = floor_mask(splat, upward.direction) if shown is None else shown.floor(upward.direction)
    if region is not None:
        moving = given_region(splat, *region)
    elif place is None:
        moving = main_part(splat, ground, CELLS, shown, near is not None)
    axis, simulated = np.array(upward.direction), moving.simulated

    def found_parts(found: Labels | None) -> FoundParts | None:
        height = float(np.ptp(corners(splat.means[simulated] @ axis, 0.002)))
        return labelled(splat, simulated, height, found)

    plant = flag = laundry = parts = None
    if hold is None:
        own = splat[simulated]
        plant = found_parts(potted_plant(own, axis))
        flag = flag_on_pole(own, axis) if plant is None else None
        laundry = found_parts(washing_line(own, axis)) if plant is None and flag is None else None
        parts = plant or laundry or (found_parts(flag[0]) if flag else None)
    if plant is not None and upward.confidence in ("low", "medium"):
        why = (*upward.reasons, "a plant stands in a pot at the lower end")
        upward = replace(upward, confidence="high", reasons=why)
    turned = splat.means @ rotation_from_z(upward.direction).numpy()  # z up
    sized = simulated
    if parts is not None:  # the length is that of the whole, with pot or pole and without the ground around it
        sized, simulated = simulated & ~parts.mask(AROUND), simulated & ~parts.mask(role="still")
        moving = replace(moving, simulated=simulated)
    unit = (longest_side or 1.0) / np.ptp(turned[sized], axis=0).max()
    own, metres = splat[simulated], turned[simulated] * unit
    size, spacing = np.ptp(metres, axis=0), particle_spacing(torch.from_numpy(own.means)) * unit
    dx = suggest_spacing(float(size.max()), spacing, CELLS)
    cell, eyes = dx / unit, None if photos is None else photos.eyes
    if plant is not None:
        down = tuple(0.0 - c for c in upward.direction)
        held = Guess("bottom", down, "medium", (f"a plant in a pot: {plant.reason}",))
    elif flag is not None:
        held = Guess("side", flag[1], "high", (f"a flag on its pole: {flag[0][2]}",))
    elif laundry is not None:
        held = Guess("top", upward.direction, "high", (f"on a line: {laundry.reason}",))
    elif hold is None:
        rest = splat.means[~simulated & (splat.opacity >= moving.opacity_threshold)]
        wall = None if shown is None else shown.wall(upward.direction)
        held = guess_hold(own, upward.direction, cell, rest, eyes, wall)
    else:
        held = given_hold(hold, upward.direction)
    pin = None if held.name == "none" or plant is not None else end_region(own.means, held.direction, cell)
    sure = hold is None and parts is None and held.confidence in ("high", "medium")
    if pin is not None and sure and held.name == "bottom":
        depth = max(PIN_DEPTH * float(size[2]), 1.5 * dx) / unit
        parts = found_parts(pot_by_colour(own, axis) or standing(own, axis, depth))
        pin = pin if parts is None else None
    sheet, names = sheet_normal(own.means) is not None, [] if parts is None else parts.names
    leaves = own if parts is None else splat[parts.mask("leaf") & simulated]
    name, why_kind = kind_of(own, axis, held.name, sheet, names, leaves)
    if kind is not None:
        name, why_kind = kind, "given"
    of = KINDS[name]
    if name == "hanging" and held.name == "top" and laundry is None:
        parts = found_parts(swinging(own, axis, end_region(own.means, held.direction, cell), cell))
        pin = None
    if longest_side is None:
        ratio = of.side if laundry is None else POSTS
        unit, metres, size, spacing = unit * ratio, metres * ratio, size * ratio, spacing * ratio
        dx = suggest_spacing(float(size.max()), spacing, CELLS)
    if parts is not None and not sheet:
        parts = with_materials(parts, of, float(size[2]))
    rotation = rotation_from_z(upward.direction).T
    azimuth, turn = broad_side(metres), 20.0  # the broad side, seen slightly from the side
    centre = torch.from_numpy(own.means.mean(0))
    front = None if eyes is None else photo_azimuth(torch.from_numpy(eyes), centre, rotation)
    if front is not None:
        azimuth, turn = front, 0.0
    flow = across_picture(azimuth)
    if held.name == "side" and of.cloth:  # along the sheet from the pole, and slightly onto it
        away = -rotation.numpy() @ held.direction
        flow = math.cos(0.25) * away + math.sin(0.25) * np.cross([0.0, 0.0, 1.0], away)
    elif sheet or name in ("hanging", "person"):  # what is flat is moved by wind that hits its face
        flow = across_picture(azimuth - 90)
        turn = turn if sheet or front is not None else 50.0
    outside = ground if shown is None else ground | ~shown.mask
    outside = outside if parts is None else outside | parts.mask(AROUND)
    whole = whole_box(splat, simulated, outside, dx / unit)
    known = known_material(of.material)
    numbers: dict[str, Any] = {"material": of.material, "youngs_modulus": SHELL_E}
    numbers |= {"density": known.density, "thickness": known.thickness}
    if of.cloth:
        numbers |= {"density": of.mass / CLOTH_THICKNESS, "thickness": CLOTH_THICKNESS, "youngs_modulus": CLOTH_E}
    if material is not None:
        known = known_material(material, "--material")
        numbers = {"material": material, "youngs_modulus": known.E, "real": True}
        numbers |= {"density": known.density, "thickness": known.thickness}
    return Suggestion(
        cloud=cloud,
        path=None,
        up=upward,
        ground=ground,
        moving=moving,
        hold=held,
        pin=pin,
        longest_side=float(size.max()),
        metres_per_unit=float(unit),
        size=tuple(size.tolist()),
        spacing=float(spacing),
        dx=suggest_spacing(float(size.max()), float(spacing), QUALITIES[quality]),
        quality=quality,
        sheet=sheet,
        azimuth=round(azimuth + turn, 1),
        flow=tuple(round(speed * float(c), 2) + 0.0 for c in flow),
        look=look,
        kind=name,
        kind_reason=why_kind,
        whole=whole,
        camera=orbit_frame(whole, (own.means.min(0), own.means.max(0))),
        parts=parts,
        near=near,
        place=place,
        moves=moves if place is not None else (),
        **numbers,
    )


def swaying(found: Suggestion, device: str = "auto") -> Suggestion:
    """The suggestion with the numbers of its kind, a typical stretch of its wind, and its simulation."""
    kind = KINDS[found.kind]
    leafy = found.kind in ("plant", "succulent")  # whose leaves are seen one by one
    simulation = replace(found, connected="surface" if leafy else "grid").to_simulation(device)
    if leafy:
        why = why_apart(simulation.scene, found.dx, classify(simulation).pinned)
        found = replace(found, connected_reason=why or "", connected="grid" if why is None else "surface")
        simulation = found.to_simulation(device) if why is None else simulation
    wind = simulation.wind
    if found.sways:
        assert isinstance(wind, WindField)
        found = with_natural(found, natural(simulation, kind, wind.flows[0], LOOKS[found.look].intensity))
        if not found.by_modes:
            simulation = found.to_simulation(device)
    elif kind.cloth and found.fixed:
        found = replace(found, start=cloth_start(simulation, kind, found.size))
    return replace(found, simulation=simulation)


def with_natural(found: Suggestion, numbers: Natural) -> Suggestion:
    """The suggestion with the numbers of its kind, that :func:`~gaussian_swaying.suggestion.natural.natural` found."""
    s, parts = found, found.parts
    frequency = 1.0 if numbers.lean < MOST_LEAN else numbers.frequency  # `total` has the ratio at 1 Hz

    def own(part: Part) -> Part:
        if not part.has_material:
            return part
        changed: dict[str, Any] = {"E": numbers.stiffer.get(part.E, part.E) if part.E is not None else None}
        for name, factor in (("thickness", numbers.thicker), ("damping_ratio", frequency)):
            value = getattr(part, name)
            changed[name] = None if value is None else value * factor
        return replace(part, **changed)

    if parts is not None:
        parts = replace(parts, parts=Parts(parts.parts.labels, [own(part) for part in parts.parts.parts]))
    E = numbers.stiffer.get(s.youngs_modulus, s.youngs_modulus)
    return replace(
        s, youngs_modulus=E, thickness=s.thickness * numbers.thicker, drag=s.drag * numbers.drag, parts=parts,
        natural=numbers, start=numbers.start,
    )  # fmt: skip


def why_apart(scene: SimulatedScene, dx: float, held: Tensor) -> str | None:
    """The reason for nodes of their own, in words; None if parts should share them.

    They should not share them if much lies beside what it is not attached to, and all hangs together with what is held:
    what does not would fall, though a grid may hold it.

    Args:
        scene: A scene of ``scene.connected: surface``.
        dx: Grid spacing [m].
        held: Which Gaussians are held, bool, shape (N,).
    """
    assert scene.pairs is not None
    piece = joined(len(scene.simulated), scene.pairs.T)
    hangs = torch.isin(piece, piece[held[scene.simulated.cpu()]])
    side = REACH * dx / scene.frame.metres_per_unit
    cell = equal_rows((scene.model.means.detach().cpu().double()[scene.simulated.cpu()] / side).floor())
    beside = float(pieces(cell, scene.pairs)[1].double().mean())
    if beside < ENOUGH or not bool(hangs.all()):
        return None
    return f"{100 * beside:.0f} % lie within reach of a node beside what they are not attached to"


def across_picture(azimuth: float) -> Array:
    """Unit vector to the right of a picture from an azimuth [degrees], z up."""
    angle = math.radians(azimuth)
    return np.array([-math.sin(angle), math.cos(angle), 0.0])


def broad_side(points: Array) -> float:
    """Azimuth [degrees], from -90 to 90, of the horizontal direction of smallest extent of points (N, 3), z up."""
    x, y = np.linalg.eigh(np.cov(points[:, :2].T))[1][:, 0]
    return (math.degrees(math.atan2(y, x)) + 90) % 180 - 90
