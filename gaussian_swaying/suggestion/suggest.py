"""A first simulation of a captured splat: up, what moves, where it is held, its kind, its grid and its wind.

Everything here is a guess, made with rules that are stated with the result.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive
from gaussian_swaying.captures.capture_camera import photo_azimuth
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.connectivity import pieces
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.hold import PIN_DEPTH, end_region, given_hold, guess_hold
from gaussian_swaying.gaussians.measures import FEWEST, Array, Gaussians, extent, sheet_normal, spacing_of
from gaussian_swaying.gaussians.parts import Part, Parts
from gaussian_swaying.geometry.groups import equal_rows, joined
from gaussian_swaying.geometry.rotations import rotation_from_z
from gaussian_swaying.mpm.materials import known_material
from gaussian_swaying.mpm.modes import MOST_LEAN
from gaussian_swaying.simulation.body import SimulatedScene, suggest_spacing
from gaussian_swaying.simulation.simulation import classify
from gaussian_swaying.suggestion.cost import Stopwatch
from gaussian_swaying.suggestion.kinds import KINDS, kind_of, with_materials
from gaussian_swaying.suggestion.moves import (
    given_region,
    main_part,
    move_things,
    read_photos,
    shown_object,
    sky,
    survey,
)
from gaussian_swaying.suggestion.natural import cloth_start, natural
from gaussian_swaying.suggestion.parts import (
    AROUND,
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
    tune: bool = True,
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
        tune: Whether stiffness, mass and drag are made those of its kind, which takes seconds; if not, they are first
            guesses.
    """
    begin = Stopwatch()
    path = None if isinstance(splat, GaussianCloud) else Path(splat).resolve()
    cloud = whole_cloud = splat if isinstance(splat, GaussianCloud) else read_gaussians(splat)
    seconds = begin.quiet
    if longest_side is not None:
        check_positive("--longest-side", longest_side)
    check_choice("--look", look, tuple(LOOKS))
    speed = LOOKS[look].speed if wind is None else wind
    check_positive("--wind", speed, allow_zero=True)
    check_choice("--kind", kind or "plant", tuple(KINDS))
    check_choice("--quality", quality, tuple(QUALITIES))
    if move is not None and region is not None:
        raise ValueError("`--move` and `--region` both choose what moves: leave out one of them.")
    if len(cloud) < FEWEST:
        raise ValueError(f"The splat has {len(cloud)} Gaussians, too few for an object; at least {FEWEST} are needed.")
    # what moves
    photos = None if capture is None else read_photos(Path(capture), cloud.origin)
    all_of_it, near = Gaussians.of(cloud), None
    upward = given_up(up) if up is not None else None if photos is None else photos.up
    place, moves = None, tuple(move or (1,))
    if region is None and (photos is None or move is not None):  # photos alone show the object
        place = survey(all_of_it, upward, [] if photos is None else photos.cameras)
    if place is not None:
        near, moving = move_things(place, all_of_it, moves)
    elif move is not None:
        raise ValueError("`--move` chooses things of a place, and this splat is one object: leave it out.")
    elif region is None and photos is None and (far := sky(all_of_it)).any():
        near = ~far
    gaussians = all_of_it if near is None else all_of_it[near]
    _check_extent(gaussians.means)
    shown = None if photos is None or region is not None or place is not None else shown_object(gaussians, photos)
    if place is not None:
        upward, ground = place.up, place.ground[near]
    elif upward is None:
        upward, ground = guess_up(gaussians)
    else:
        ground = floor_mask(gaussians, upward.direction) if shown is None else shown.floor(upward.direction)
    if region is not None:
        moving = given_region(gaussians, *region)
    elif place is None:
        moving = main_part(gaussians, ground, CELLS, shown, near is not None)
    # its parts and its size
    axis, simulated = np.array(upward.direction), moving.simulated
    own, support = gaussians[simulated], None
    _check_extent(own.means)
    height = extent(own.means @ axis, 0.002)
    if hold is None and kind == "hanging":
        hold = "top"
    if hold is None:
        support = potted_plant(own, axis) or flag_on_pole(own, axis) or washing_line(own, axis)
    parts = labelled(gaussians, simulated, height, support and support[0])
    names = [] if parts is None else parts.names
    plant, laundry = "pot" in names, "post" in names
    if plant and upward.confidence in ("low", "medium"):
        why = (*upward.reasons, "a plant stands in a pot at the lower end")
        upward = replace(upward, confidence="high", reasons=why)
    rotation = rotation_from_z(upward.direction).numpy()
    turned, sized = gaussians.means @ rotation, simulated  # z up
    if parts is not None:  # the length is that of the whole, with pot or pole and without the ground around it
        sized, simulated = simulated & ~parts.mask(AROUND), simulated & ~parts.mask(role="still")
        own = gaussians[simulated]
    unit = (longest_side or 1.0) / np.ptp(turned[sized], axis=0).max()
    size, apart = np.ptp(turned[simulated], axis=0), spacing_of(own.means)
    dx = suggest_spacing(float(size.max() * unit), apart * unit, CELLS)
    # where it is held, and its kind
    cell, eyes = dx / unit, None if photos is None else photos.eyes
    if support is not None:
        held = support[1]
    elif hold is None:
        rest = gaussians.means[~simulated & (gaussians.opacity >= moving.opacity_threshold)]
        wall = None if shown is None else shown.wall(upward.direction)
        held = guess_hold(own, upward.direction, cell, rest, eyes, wall)
    else:
        held = given_hold(hold, upward.direction)
    pin = None if held.name == "none" or plant else end_region(own.means, held.direction, cell)
    if held.name == "bottom" and held.confidence in ("high", "medium") and parts is None:
        below = pot_by_colour(own, axis) or standing(own, axis, max(PIN_DEPTH * size[2], 1.5 * cell))
        parts = labelled(gaussians, simulated, height, below)
        pin = pin if parts is None else None
    sheet, leaves = sheet_normal(own.means) is not None, own
    if parts is not None:
        names, leaves = parts.names, gaussians[parts.mask("leaf") & simulated]
    name, why_kind = kind_of(own, axis, held.name, sheet, names, leaves)
    if kind is not None:
        name, why_kind = kind, "given"
    of = KINDS[name]
    if name == "hanging" and held.name == "top" and not laundry:
        swings = swinging(own, axis, end_region(own.means, held.direction, cell), cell)
        parts, pin = labelled(gaussians, simulated, height, swings), None
    if longest_side is None:
        unit *= POSTS if laundry else of.side
    size, apart = size * unit, apart * unit
    if parts is not None and not sheet:
        parts = with_materials(parts, of, float(size[2]))
    # the wind and the camera
    azimuth, turn = broad_side(turned[simulated]), 20.0  # the broad side, seen slightly from the side
    if eyes is not None:
        centre = torch.from_numpy(own.means.mean(0))
        front = photo_azimuth(torch.from_numpy(eyes), centre, torch.from_numpy(rotation.T))
        azimuth, turn = (azimuth, turn) if front is None else (front, 0.0)
    angle = math.radians(azimuth)
    flow = np.array([-math.sin(angle), math.cos(angle), 0.0])  # across the picture
    if held.name == "side" and of.cloth:  # along the sheet from the pole, and slightly onto it
        away = -np.array(held.direction) @ rotation
        flow = math.cos(0.25) * away + math.sin(0.25) * np.cross([0.0, 0.0, 1.0], away)
    elif sheet or name in ("hanging", "person"):  # what is flat is moved by wind that hits its face
        flow = np.array([math.cos(angle), math.sin(angle), 0.0])
        turn = turn if sheet or turn == 0 else 50.0
    outside = ground if shown is None else ground | ~shown.mask
    whole = whole_box(gaussians, simulated, outside if parts is None else outside | parts.mask(AROUND), dx / unit)
    known = known_material(material or of.material, "--material")
    numbers = (known.E if material else SHELL_E), known.density, known.thickness
    if of.cloth and material is None:
        numbers = CLOTH_E, of.mass / CLOTH_THICKNESS, CLOTH_THICKNESS
    found = Suggestion(
        cloud=cloud if near is None else cloud.select(torch.from_numpy(near)),
        path=path,
        up=upward,
        ground=ground,
        moving=replace(moving, simulated=simulated),
        hold=held,
        pin=pin,
        longest_side=float(size.max()),
        metres_per_unit=float(unit),
        size=tuple(size.tolist()),
        spacing=float(apart),
        dx=suggest_spacing(float(size.max()), float(apart), QUALITIES[quality]),
        quality=quality,
        sheet=sheet,
        azimuth=round(azimuth + turn, 1),
        flow=tuple(round(speed * float(c), 2) + 0.0 for c in flow),
        look=look,
        kind=name,
        kind_reason=why_kind,
        material=material or of.material,
        youngs_modulus=numbers[0],
        density=numbers[1],
        thickness=numbers[2],
        real=material is not None,
        whole=whole,
        camera=orbit_frame(whole, (own.means.min(0), own.means.max(0))),
        parts=parts,
        near=near,
        place=place,
        moves=moves if place is not None else (),
        seconds=seconds,
    )
    found = tuned(found, device) if tune else found
    if near is not None:  # the other Gaussians are still
        found = replace(found, cloud=whole_cloud, parts=found.parts and found.parts.within(near))
    return found


def tuned(s: Suggestion, device: str) -> Suggestion:
    """The suggestion with stiffness, mass and drag of its kind, a typical stretch of wind, and its simulation."""
    kind, begin = KINDS[s.kind], Stopwatch()
    leafy = s.kind in ("plant", "succulent")  # whose leaves are seen one by one
    simulation = replace(s, connected="surface" if leafy else "grid").to_simulation(device)
    if leafy:
        why = why_apart(simulation.scene, s.dx, classify(simulation).pinned)
        s = replace(s, connected_reason=why or "", connected="grid" if why is None else "surface")
        simulation = s.to_simulation(device) if why is None else simulation
    wind, parts = simulation.wind, s.parts
    if kind.cloth and s.fixed and not s.real:
        s = replace(s, start=cloth_start(simulation, kind, s.size))
    elif s.sways:
        assert isinstance(wind, WindField)
        found = natural(simulation, kind, wind.flows[0], LOOKS[s.look].intensity)
        ratio = 1.0 if found.lean < MOST_LEAN else found.frequency  # `total` has the ratio at 1 Hz

        def own(part: Part) -> Part:
            factors = {"thickness": found.thicker, "damping_ratio": ratio}
            values = {name: (getattr(part, name), factor) for name, factor in factors.items()}
            scaled = {name: value * factor for name, (value, factor) in values.items() if value is not None}
            return replace(part, **scaled, E=part.E and found.stiffer.get(part.E, part.E))

        if parts is not None:
            parts = replace(parts, parts=Parts(parts.parts.labels, [own(part) for part in parts.parts.parts]))
        E, thickness = found.stiffer.get(s.youngs_modulus, s.youngs_modulus), s.thickness * found.thicker
        s = replace(s, youngs_modulus=E, thickness=thickness, drag=found.drag, parts=parts, natural=found)
        s = replace(s, start=found.start)
        if not s.by_modes:
            simulation = s.to_simulation(device)
    return replace(s, simulation=simulation, seconds=s.seconds + begin.quiet)


def why_apart(scene: SimulatedScene, dx: float, held: Tensor) -> str | None:
    """The reason for separate nodes per part (``connected: surface``), in words; None if parts should share nodes.

    They should not share them if much lies beside what it is not attached to, and all hangs together with what is held:
    what does not would fall, though a grid may hold it.

    Args:
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


def _check_extent(points: Array) -> None:
    if extent(points, 0.0) <= 0:
        raise ValueError("All Gaussians of the object are at one point: there is nothing to simulate.")


def broad_side(points: Array) -> float:
    """Azimuth [degrees], from -90 to 90, of the horizontal direction of smallest extent of points (N, 3), z up."""
    x, y = np.linalg.eigh(np.cov(points[:, :2].T))[1][:, 0]
    return (math.degrees(math.atan2(y, x)) + 90) % 180 - 90
