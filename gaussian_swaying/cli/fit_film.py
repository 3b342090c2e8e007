"""From a film and a splat to the files of a fit: ``gaussian-swaying fit FILM --splat SPLAT``."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying import _program as program
from gaussian_swaying._files import write_json, write_text
from gaussian_swaying.cli.camera import CAMERAS, PICTURE, STILLS, VIEW, first_cameras, fov_of, painter_of, transforms
from gaussian_swaying.cli.preview import keep_aside, up_of, write_starter
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.hold import given_hold
from gaussian_swaying.gaussians.measures import DIRECTIONS
from gaussian_swaying.inverse.cameras import (
    Film,
    begins_to_move,
    first_frame,
    held_end,
    moving_box,
    moving_points,
    open_film,
    pixels_of_focal,
)
from gaussian_swaying.inverse.unknowns import SCALE
from gaussian_swaying.inverse.videos import Footage, read_videos
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.suggestion.suggest import suggest
from gaussian_swaying.suggestion.suggestion import Suggestion

PLAN, LOOK, RESULT = "fit.yaml", "preview", "result"
SECONDS = 1.5
"""Time of motion that is fitted; half as much again is predicted [s]."""
LEAD = 0.4
"""Longest time at rest that is kept before the motion [s]."""
SOFTER, STIFFER = 1 / 30, 30.0
"""Range of E, per that which the preview guesses."""
SPEED = (0.5, 25.0)
"""Range of the wind [m/s]."""
ROUGH = 1.2e-3
"""Distance of points from where a camera sees them with which it may be wrong, as a share of the picture's diagonal."""
UPRIGHT, NEARLY = 0.5, 0.85
"""Cosines of the angles to the film's own up within which a guess of up is right, and an axis is taken for it."""
OBJECT = "object"
"""Name of the whole in ``--length``."""
GRAVITY, SHORTER, LONGER = "gravity", 0.25, 4.0
"""Name in ``--length`` if the weight is to tell the scale, and the range of lengths, per the guess."""


@dataclass(frozen=True)
class Seen:
    """The first frame, the splat, the camera with its residual [pixels], and the splat's picture from there."""

    film: Film
    frame: Tensor
    cloud: GaussianCloud
    camera: Camera
    picture: RenderOutput
    residual: float


def prepare(options: argparse.Namespace, folder: Path) -> Path:
    """Write the files of a fit and pictures of what they rest on, and say what was found.

    Args:
        options: ``film``, ``splat``, ``length``, ``up``, ``hold``, ``focal`` and ``device``, see ``fit --help``.
        folder: Where to write.

    Returns:
        The fit file.
    """
    import imageio.v3 as iio

    length, weighed = _length(options.length), options.length == [GRAVITY]
    if options.focal is not None and not 5 <= options.focal <= 1000:
        raise ValueError(f"Expected `--focal` from 5 to 1000 mm, but got {options.focal:g}.")
    if options.hold is not None:
        given_hold(options.hold, (0.0, 0.0, 1.0))  # refuses what is no end
    if Path(options.film).suffix.lower() in STILLS:
        raise ValueError(f"{options.film} is a picture: give a film, or find its camera with `camera`.")
    seen, sentence = _registered(options, None if options.up is None else _direction(options.up))
    print(sentence, flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    _write_registration(seen, folder)
    moves = begins_to_move(seen.film, seen.picture, seen.camera)
    if moves is None:
        raise ValueError(
            f"Nothing moves in the film {options.film} where the splat is: look at {folder / PICTURE}, and give a film "
            "in which the wind moves it."
        )
    at_once = moves < 1.5 / seen.film.fps
    if at_once and seen.residual > ROUGH * math.hypot(seen.film.width, seen.film.height):
        raise ValueError(
            f"The film {options.film} begins in motion, and its camera was found to {seen.residual:.1f} pixels only: "
            "cut it so that it begins with the object at rest, or write a fit file with a camera that you know."
        )
    begin = max(0.0, moves - LEAD)
    seconds = min(1.5 * SECONDS + moves - begin, seen.film.seconds - begin)
    where = os.path.relpath(seen.film.path.resolve(), folder.resolve())
    data = transforms(seen.camera, where, seen.cloud.origin)
    data["frames"][0] |= {"begin": round(begin, 4), "seconds": round(seconds, 4)}
    write_json(folder / CAMERAS, data)
    look, wanted = folder / LOOK, {"up": options.up and _direction(options.up), "hold": options.hold}
    preview = _previewed(options, wanted)
    shown, told = _shown(seen, read_videos(folder / CAMERAS, origin=seen.cloud.origin)[0], preview, wanted)
    if shown:
        preview = _previewed(options, wanted | shown)
    if length is not None:
        longest = longest_side(*length, seen, preview)
        preview = _previewed(options, wanted | shown | {"longest_side": longest})
    if weighed and not preview.falls:
        raise ValueError(
            "`--length gravity` is for a sheet alone, or for what nothing holds: anything else was captured in balance "
            "with its weight. Give a length that you know."
        )
    write_starter(preview, look, 250)
    iio.imwrite(look / "preview.png", preview.picture())
    scaled = GRAVITY if weighed else "" if length is None else "length"
    text = plan_text(preview, _background(seen), None if at_once else moves - begin, scaled, folder)
    keep_aside(folder / PLAN, text)
    write_text(folder / PLAN, text)
    print(f"{options.film} moves from {moves:.2f} s on; {begin:.2f} s to {begin + seconds:.2f} s of it are used")
    print("\n".join(_guesses(preview, told, scaled)))
    print(f"look at {folder / PICTURE}: frame and splat have to show the same; and at {look / 'preview.png'}")
    return folder / PLAN


def _length(given: Sequence[str] | None) -> tuple[str, float] | None:
    """Name and metres of ``--length``."""
    if given is None or list(given) == [GRAVITY]:
        return None
    name, metres = given if len(given) == 2 else (given[0], " ".join(given[1:]) or "nothing")
    try:
        value = float(metres)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise ValueError(
            f"Expected `--length` to be gravity, or a name and a length in metres, such as pole 2.4, but got {metres}."
        )
    return name, value


def _registered(options: argparse.Namespace, up: Sequence[float] | None) -> tuple[Seen, str]:
    from gaussian_swaying.gaussians.formats import read_gaussians
    from gaussian_swaying.inverse.cameras import find_camera

    film = open_film(options.film)
    frame, cloud = first_frame(film), read_gaussians(options.splat, 0)
    draw = painter_of(cloud)
    focal, fov = options.focal or film.focal, VIEW
    if focal is not None:
        fov = 2 * math.degrees(math.atan(0.5 * film.height / pixels_of_focal(focal, film.width, film.height)))
    start = first_cameras(cloud, up, fov, film.width, film.height)
    try:
        found = find_camera(draw, frame, start, focal=focal is None)
    except ValueError as error:
        raise ValueError(
            f"The splat was not found in the first frame of {options.film}. It has to show the object at rest, large "
            "and with texture, from a side that was captured; `--up` and `--focal` help."
        ) from error
    source = "found" if focal is None else f"of {focal:g} mm" + ("" if options.focal else ", as the film says")
    told = (
        f"camera: {found.agreeing} of {found.matches} points agree, {found.residual:.1f} pixels off; focal length "
        f"{source} ({fov_of(found.camera):.0f} degrees from top to bottom)"
    )
    return Seen(film, frame, cloud, found.camera, draw(found.camera), found.residual), told


def _direction(words: Sequence[str]) -> list[float]:
    """The direction of ``--up``, shape (3,)."""
    found = up_of(words)
    direction = list(DIRECTIONS.get(found, ())) if isinstance(found, str) else list(found)
    if len(direction) != 3 or not any(direction):
        raise ValueError(f"Expected `--up` to be {', '.join(DIRECTIONS)} or 3 numbers, but got {' '.join(words)}.")
    return direction


def _write_registration(seen: Seen, folder: Path) -> None:
    import imageio.v3 as iio

    from gaussian_swaying.inverse.evidence import side_by_side, titled

    iio.imwrite(folder / PICTURE, titled(side_by_side(seen.frame, seen.picture.color, seen.picture.alpha)))


def _background(seen: Seen) -> list[float]:
    """The colour that most of the first frame has where the splat is not; that of all of it if it is everywhere."""
    around = seen.picture.alpha[..., 0].cpu() < 0.05
    pixels = seen.frame[around] if bool(around.any()) else seen.frame.flatten(0, 1)
    return [round(value / 255, 3) for value in pixels.median(0).values.tolist()]


def _shown(seen: Seen, video: Footage, preview: Suggestion, wanted: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Options of the preview that the film knows better than the splat, and sentences on them."""
    shown: dict[str, Any] = {}
    told: list[str] = []
    up = preview.up.direction
    if wanted["up"] is None and preview.up.confidence in ("low", "medium"):
        upright = upright_in(seen.camera, up)
        if upright is not None:
            up = shown["up"] = tuple(_direction(upright))
            told.append(f"up: {' '.join(upright)}, as the film is upright")
    if preview.parts is not None and not shown:
        return {}, []
    places, moved = moving_points(video, seen.picture)
    box = moving_box(places, moved, seen.cloud)
    if box is not None:
        low, high = box
        shown["region"] = [[round(value, 4) for value in corner.tolist()] for corner in box]
        told.append("what moves in the film: from {} to {}".format(*shown["region"]))
        inside = ((places >= low) & (places <= high)).all(-1)
        places, moved = places[inside], moved[inside]
    held = None if wanted["hold"] is not None else held_end(places, moved, up)
    if held is not None:
        shown["hold"] = held.name
        told.append(
            f"held: {held.name}, as the film shows; that end moves by {held.moves:.1f} pixels, the rest by "
            f"{held.others:.0f}"
        )
    return shown, told


def upright_in(camera: Camera, guess: Sequence[float]) -> list[str] | None:
    """The axis of a splat that is up in a film, or 3 numbers; None if a guess is up in it, too.

    Args:
        camera: Of the film, which nobody holds upside down.
        guess: A direction in the splat, shape (3,).
    """
    up = -camera.world_to_camera[1, :3].double()
    along = {name: float(up @ torch.tensor(axis, dtype=torch.float64)) for name, axis in DIRECTIONS.items()}
    if float(up @ torch.tensor(guess, dtype=torch.float64)) > UPRIGHT:
        return None
    best = max(along, key=along.__getitem__)
    return [best] if along[best] > NEARLY else [f"{part:.4f}" for part in up.tolist()]


def _previewed(options: argparse.Namespace, wanted: dict[str, Any]) -> Suggestion:
    return suggest(options.splat, device=options.device, quality="draft", **wanted)


def longest_side(name: str, metres: float, seen: Seen, preview: Suggestion) -> float:
    """The length of the longest side [m] with which a named length has so many metres.

    Args:
        name: ``object``, a part, or two places in the film's first frame [pixels], as X,Y:X,Y.
        metres: The length.
        seen: The first frame.
        preview: Of the splat with a longest side of 1 m.
    """
    if name == OBJECT:
        return metres
    if ":" in name:
        return metres / (float((_place(name, 0, seen) - _place(name, 1, seen)).norm()) * preview.metres_per_unit)
    parts = preview.parts
    names = [] if parts is None else parts.names
    if parts is None or name not in names:
        raise ValueError(
            f"The splat has no part {name!r}: `--length` may name {', '.join([*names, OBJECT])}, or two places in the "
            "first frame, such as 120,80:120,640 (pixels from its left and upper edges)."
        )
    return metres / (extent(seen.cloud.means[parts.mask(name)], preview.up.direction) * preview.metres_per_unit)


def extent(points: Tensor, up: Sequence[float]) -> float:
    """The longest side of an upright box around points (N, 3) [scene units], turned as they are seen from above."""
    axis = torch.tensor(up, dtype=torch.float64)
    axis = axis / axis.norm()
    centred = points.double() - points.double().mean(0)
    level = centred - (centred @ axis)[:, None] * axis
    sides = torch.linalg.eigh(level.T @ level)[1].T[1:]
    along = centred @ torch.cat([axis[None], sides]).T
    return float((along.quantile(0.998, 0) - along.quantile(0.002, 0)).max())


def _place(name: str, number: int, seen: Seen) -> Tensor:
    """The place in the splat that a pixel of the first frame shows, shape (3,)."""
    try:
        x, y = (float(value) / seen.film.full for value in name.split(":")[number].split(","))
    except ValueError:
        raise ValueError(f"Expected `--length` to have two places such as 120,80:120,640, but got {name}.") from None
    column, row = int(x), int(y)
    alpha = seen.picture.alpha[..., 0]
    if not (0 <= column < alpha.shape[1] and 0 <= row < alpha.shape[0]) or float(alpha[row, column]) < 0.5:
        raise ValueError(
            f"The place {name.split(':')[number]} of `--length` is not on the splat: look at {PICTURE} for places."
        )
    depth = float(seen.picture.depth[row, column, 0] / alpha[row, column])
    K, view = seen.camera.intrinsics.double(), seen.camera.world_to_camera.double()
    ray = torch.tensor([(x - float(K[0, 2])) / float(K[0, 0]), (y - float(K[1, 2])) / float(K[1, 1]), 1.0])
    return view[:3, :3].T @ (depth * ray.double() - view[:3, 3])


def plan_text(preview: Suggestion, background: Sequence[float], still: float | None, scaled: str, folder: Path) -> str:
    """The fit file.

    Args:
        preview: Of the splat.
        background: Colour behind it in the film.
        still: Time at rest before the motion [s]; None if the film may begin in motion.
        scaled: ``length`` if one is known, ``gravity`` if the weight is to tell it; empty if neither.
        folder: Of the fit file.
    """
    assumed = ["mass", *(() if scaled else ("length",)), *(() if still is not None else ("camera",))]
    low, high = (float(f"{preview.youngs_modulus * factor:.1e}") for factor in (SOFTER, STIFFER))
    middle, half = 0.0, 200.0  # more than all ways round, so that none is at an end of the range
    if preview.hold.name == "side":  # a flag flies away from its pole
        middle, half = math.degrees(math.atan2(preview.flow[1], preview.flow[0])), 120.0
    around = [round(middle - half), round(middle + half)]
    first, last = (-1.0, 0.1) if still is None else (0.0, round(still + 0.1, 2))
    still = still or 0.0
    sizes = [float(f"{preview.metres_per_unit * factor:.2g}") for factor in (SHORTER, LONGER)]
    again = program.command("fit", "--config", folder / PLAN, "--output", folder / RESULT)
    lines = [
        (f"base: {LOOK}/starter.yaml", "the splat, what holds it, its material: guesses, on a coarse grid"),
        (f"videos: {CAMERAS}", "the part of the film that is used, and its camera"),
        ("known:", "replaces what the base says"),
        ("  wind.effects: []", "a steady wind"),
        (f"  background: {list(background)}", "around the splat in the film"),
        (f"  material.density: {preview.density:g}", "kg/m3; not measured"),
        (f"  material.thickness: {preview.thickness:.4g}", "m; with the density it makes the mass of an area"),
        (f"assumed: [{', '.join(assumed)}]", "not measured; the result says what follows"),
        ("unknowns:", "with the ranges in which they are sought"),
        (f"  wind.speed: {{range: {list(SPEED)}}}", "m/s"),
        (f"  wind.azimuth: {{range: {around}}}", "degrees from +x towards +y, with z up"),
        (f"  material.E: {{range: [{low:.1e}, {high:.1e}]}}", "Pa"),
        *([(f"  {SCALE}: {{range: {sizes}}}", "m; told by the weight")] if scaled == GRAVITY else []),
        (f"  film.start: {{range: [{first}, {last}]}}", "s; when the motion starts; before 0 for a film in motion"),
        (f"until: {still + SECONDS:.2f}", "s of the used part that are fitted; the rest is predicted"),
        ("search: 48", "simulations of the coarse search"),
    ]
    head = f"# Made from a film. Every number may be changed; then:\n#   {again}\n"
    return head + "".join(f"{line:<44}# {told}\n" for line, told in lines)


def _guesses(preview: Suggestion, told: Sequence[str], scaled: str) -> list[str]:
    up, hold, lines = preview.up, preview.hold, list(told)
    if up.confidence != "given":
        direction = [round(part, 2) for part in up.direction]
        lines.append(f"guessed: up is {direction} (confidence {up.confidence})")
    if hold.confidence != "given":
        lines.append(f"guessed: held at the {hold.name} (confidence {hold.confidence}): {'; '.join(hold.reasons)}")
    if preview.parts is not None:
        lines.append("parts: " + ", ".join(f"{part.name} {part.role}" for part in preview.parts.parts.parts))
    size = " x ".join(f"{side:.3g}" for side in preview.size)
    known = {
        "length": "as --length says",
        GRAVITY: "a guess: the weight is to tell it",
        "": "which nobody measured: give --length, such as --length object 1.5",
    }
    lines.append(f"size of what moves: {size} m, {known[scaled]}")
    return lines
