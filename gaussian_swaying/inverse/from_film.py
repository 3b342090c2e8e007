"""From a film and a splat to a fit: the camera, what moves, what holds it, and first guesses."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying import _program as program
from gaussian_swaying._arguments import checked
from gaussian_swaying._files import write_json, write_text
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.hold import given_hold
from gaussian_swaying.gaussians.measures import DIRECTIONS
from gaussian_swaying.inverse.film import (
    Film,
    begins_to_move,
    held_end,
    moving_box,
    moving_points,
    open_film,
    view_of_focal,
)
from gaussian_swaying.inverse.fit import run_fit
from gaussian_swaying.inverse.plan import read_plan
from gaussian_swaying.inverse.registration import (
    CAMERAS,
    FOUND,
    PICTURE,
    STILLS,
    fov_of,
    in_space,
    register,
    shown_in,
    transforms,
)
from gaussian_swaying.inverse.report import Fit, side_by_side, titled
from gaussian_swaying.inverse.unknowns import FILM_START, SCALE
from gaussian_swaying.inverse.videos import Footage, read_videos
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.suggestion.starter import keep_aside, write_starter
from gaussian_swaying.suggestion.suggest import suggest
from gaussian_swaying.suggestion.suggestion import Suggestion
from gaussian_swaying.suggestion.up import given_up

PLAN, LOOK, RESULT = "fit.yaml", "preview", "result"
SECONDS, LEAD = 1.5, 0.4  # time of motion that is fitted, and time at rest that is kept before it [s]
SOFTER, STIFFER = 1 / 30, 30.0  # range of E, per that which the preview guesses
SPEED = (0.5, 25.0)  # range of the wind [m/s]
ROUGH = 1.2e-3  # residual of a camera that may be wrong, per diagonal of the picture
UPRIGHT, NEARLY = 0.5, 0.85  # cosines to the film's up of a guess that is right, and of an axis that is taken
SHORTER, LONGER = 0.25, 4.0  # range of lengths, per the guess, if the weight is to tell them
Length = tuple[str, float] | Literal["gravity"] | None


class Seen(NamedTuple):
    """The first frame, the splat, the camera with its residual [pixels], and the splat's picture from there."""

    film: Film
    frame: Tensor
    cloud: GaussianCloud
    camera: Camera
    picture: RenderOutput
    residual: float


@checked
def fit_film(
    film: str | os.PathLike[str],
    splat: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    length: Length = None,
    up: str | Sequence[float] | None = None,
    hold: str | None = None,
    focal: float | None = None,
    device: str = "auto",
    progress: bool = True,
) -> Fit:
    """Find the wind and the material of a splat from a film that begins with it at rest.

    Args:
        film: The film.
        splat: The splat that it shows.
        output: Folder: the camera, guesses and ``fit.yaml``; the results go to ``result`` in it.
        length: A known length, such as ``("pole", 2.4)``: of the object, a part, or between two places ``X,Y:X,Y`` in
            the first frame [pixels], in metres; or ``gravity``, if the weight is to tell it.
        up: Direction in the splat that is up, an axis such as ``+z`` or (3,), instead of a guess.
        hold: End that is held, instead of a guess: ``top``, ``bottom``, ``none``, ``+x``, ... or ``-z``.
        focal: Focal length of the film, equivalent to 35 mm film [mm]; found if neither it nor the film says it.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: Print what is found, a line for each step, and a bar.

    Raises:
        ValueError: If the film does not show the splat, or nothing moves; the message names the remedy.
    """
    say = print if progress else lambda line: None
    file = prepare(film, splat, output, length, up, hold, focal, device, say)
    return run_fit(read_plan(file), file.parent / RESULT, device=device, progress=progress, in_use=[file])


def prepare(
    film: str | os.PathLike[str], splat: str | os.PathLike[str], output: str | os.PathLike[str], length: Length,
    up: str | Sequence[float] | None, hold: str | None, focal: float | None, device: str,
    say: Callable[[str], object] = print,
) -> Path:  # fmt: skip
    """Write the files of :func:`fit_film` and pictures of what they rest on, say what was found; the fit file."""
    import imageio.v3 as iio

    if focal is not None and not 5 <= focal <= 1000:
        raise ValueError(f"Expected `--focal` from 5 to 1000 mm, but got {focal:g}.")
    if hold is not None:
        given_hold(hold, (0.0, 0.0, 1.0))  # refuses what is no end
    if Path(film).suffix.lower() in STILLS:
        raise ValueError(f"{film} is a picture: give a film, or find its camera with `camera`.")
    axis, folder = None if up is None else given_up(up).direction, Path(output)
    seen, told = registered(film, splat, axis, focal)
    say(told)
    folder.mkdir(parents=True, exist_ok=True)
    iio.imwrite(folder / PICTURE, titled(side_by_side(seen.frame, seen.picture)))
    moves = begins_to_move(seen.film, seen.picture, seen.camera)
    if moves is None:
        raise ValueError(
            f"Nothing moves in the film {film} where the splat is: look at {folder / PICTURE}, and give a film "
            "in which the wind moves it."
        )
    at_once = moves < 1.5 / seen.film.fps
    if at_once and seen.residual > ROUGH * math.hypot(seen.film.width, seen.film.height):
        raise ValueError(
            f"The film {film} begins in motion, and its camera was found to {seen.residual:.1f} pixels only: "
            "cut it so that it begins with the object at rest, or write a fit file with a camera that you know."
        )
    begin = max(0.0, moves - LEAD)
    seconds = min(1.5 * SECONDS + moves - begin, seen.film.seconds - begin)
    where = os.path.relpath(seen.film.path.resolve(), folder.resolve())
    data = transforms(seen.camera, where, seen.cloud.origin)
    data["frames"][0] |= {"begin": round(begin, 4), "seconds": round(seconds, 4)}
    write_json(folder / CAMERAS, data)
    wanted: dict[str, Any] = {"up": axis, "hold": hold, "device": device, "quality": "draft"}
    preview = suggest(splat, **wanted)
    shown, lines = _shown(seen, read_videos(folder / CAMERAS, origin=seen.cloud.origin)[0], preview, wanted)
    wanted |= shown
    preview = suggest(splat, **wanted) if shown else preview
    if isinstance(length, tuple):
        preview = suggest(splat, **wanted, longest_side=longest_side(*length, seen, preview))
    if length == "gravity" and not preview.falls:
        raise ValueError(
            "`--length gravity` is for a sheet alone, or for what nothing holds: anything else was captured in balance "
            "with its weight. Give a length that you know."
        )
    write_starter(preview, folder / LOOK, 250)
    iio.imwrite(folder / LOOK / "preview.png", preview.picture())
    text = plan_text(preview, _background(seen), None if at_once else moves - begin, length, folder)
    keep_aside(folder / PLAN, text)
    write_text(folder / PLAN, text)
    say(f"{film} moves from {moves:.2f} s on; {begin:.2f} s to {begin + seconds:.2f} s of it are used")
    for line in [*lines, *_guesses(preview, length)]:
        say(line)
    say(f"look at {folder / PICTURE}: frame and splat have to show the same; and at {folder / LOOK / 'preview.png'}")
    return folder / PLAN


def registered(
    film: str | os.PathLike[str], splat: str | os.PathLike[str], up: Sequence[float] | None, focal: float | None
) -> tuple[Seen, str]:
    """The first frame of a film with its camera, and a sentence on that."""
    head = open_film(os.fspath(film))
    frame, cloud = head.first_frame(), read_gaussians(splat, 0)
    known, found = focal or head.focal, None
    fov = None if known is None else view_of_focal(known, head.width, head.height)
    with suppress(ValueError):
        found, picture = register(frame, cloud, up, fov)
    if found is None or shown_in(picture, frame)[0] < FOUND:
        raise ValueError(
            f"The splat was not found in the first frame of {film}. It has to show the object at rest, large "
            "and with texture, from a side that was captured; `--up` and `--focal` help."
        )
    source = "found" if known is None else f"of {known:g} mm" + ("" if focal else ", as the film says")
    told = (
        f"camera: {found.agreeing} of {found.matches} points agree, {found.residual:.1f} pixels off; focal length "
        f"{source} ({fov_of(found.camera):.0f} degrees from top to bottom)"
    )
    return Seen(head, frame, cloud, found.camera, picture, found.residual), told


def _background(seen: Seen) -> list[float]:
    """The colour that most of the first frame has where the splat is not, or all of it."""
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
            up = shown["up"] = tuple(upright)
            told.append(f"up: {' '.join(f'{part:.4g}' for part in upright)}, as the film is upright")
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
        shown["hold"], own, others = held
        told.append(
            f"held: {shown['hold']}, as the film shows; that end moves by {own:.1f} pixels, the rest by {others:.0f}"
        )
    return shown, told


def upright_in(camera: Camera, guess: Sequence[float]) -> list[float] | None:
    """The direction of a splat, an axis if one is near, that is up in a film; None if a guess (3,) is, too."""
    up = -camera.world_to_camera[1, :3].double()
    if float(up @ torch.tensor(guess, dtype=torch.float64)) > UPRIGHT:
        return None
    best = max(DIRECTIONS.values(), key=lambda axis: float(up @ torch.tensor(axis, dtype=torch.float64)))
    return list(best) if float(up @ torch.tensor(best, dtype=torch.float64)) > NEARLY else up.tolist()


def longest_side(name: str, metres: float, seen: Seen, preview: Suggestion) -> float:
    """The longest side [m] with which ``object``, a part, or two places X,Y:X,Y in the first frame have that length.

    That of the preview is 1 m.
    """
    if not 0 < metres < math.inf:
        raise ValueError(f"Expected `--length` to have a length above 0 m, but got {metres}.")
    if name == "object":
        return metres
    if ":" in name:
        return metres / (float((_place(name, 0, seen) - _place(name, 1, seen)).norm()) * preview.metres_per_unit)
    parts = preview.parts
    names = [] if parts is None else parts.names
    if parts is None or name not in names:
        raise ValueError(
            f"The splat has no part {name!r}: `--length` may name {', '.join([*names, 'object'])}, or two places in "
            "the first frame, such as 120,80:120,640 (pixels from its left and upper edges)."
        )
    return metres / (extent(seen.cloud.means[parts.mask(name)], preview.up.direction) * preview.metres_per_unit)


def extent(points: Tensor, up: Sequence[float]) -> float:
    """The longest side of an upright box around points (N, 3) [scene units], turned as they are seen from above."""
    axis = torch.nn.functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    centred = points.double() - points.double().mean(0)
    level = centred - (centred @ axis)[:, None] * axis
    sides = torch.linalg.eigh(level.T @ level)[1].T[1:]
    along = centred @ torch.cat([axis[None], sides]).T
    return float((along.quantile(0.998, 0) - along.quantile(0.002, 0)).max())


def _place(name: str, number: int, seen: Seen) -> Tensor:
    try:
        x, y = (float(value) / seen.film.full for value in name.split(":")[number].split(","))
    except ValueError:
        raise ValueError(f"Expected `--length` to have two places such as 120,80:120,640, but got {name}.") from None
    place, known = in_space(seen.picture, seen.camera, np.array([[x, y]]))
    if not known[0]:
        raise ValueError(
            f"The place {name.split(':')[number]} of `--length` is not on the splat: look at {PICTURE} for places."
        )
    return torch.from_numpy(place[0])


def plan_text(
    preview: Suggestion, background: Sequence[float], still: float | None, length: Length, folder: Path
) -> str:
    """The fit file; ``still`` is the time at rest before the motion [s], None if the film may begin in motion."""
    import yaml

    middle, half = 0.0, 200.0  # more than all ways round, so that none is at an end of the range
    if preview.hold.name == "side":  # a flag flies away from its pole
        middle, half = math.degrees(math.atan2(preview.flow[1], preview.flow[0])), 120.0
    ranges: dict[str, Sequence[float]] = {
        "wind.speed": SPEED,
        "wind.azimuth": (round(middle - half), round(middle + half)),
        "material.E": [float(f"{preview.youngs_modulus * factor:.1e}") for factor in (SOFTER, STIFFER)],
    }
    if length == "gravity":
        ranges[SCALE] = [float(f"{preview.metres_per_unit * factor:.2g}") for factor in (SHORTER, LONGER)]
    ranges[FILM_START] = (-1.0, 0.1) if still is None else (0.0, round(still + 0.1, 2))
    plan = {
        "base": f"{LOOK}/starter.yaml",
        "videos": CAMERAS,
        "known": {
            "wind.effects": [],
            "background": list(background),
            "material.density": float(f"{preview.density:g}"),
            "material.thickness": float(f"{preview.thickness:.4g}"),
        },
        "assumed": ["mass", *([] if length else ["length"]), *(["camera"] if still is None else [])],
        "unknowns": {name: {"range": list(ends)} for name, ends in ranges.items()},
        "until": round((still or 0.0) + SECONDS, 2),
        "search": 48,
    }
    again = program.command("fit", "--config", folder / PLAN, "--output", folder / RESULT)
    head = "# Made from a film, in m, s, kg, Pa and degrees. Every number may be changed (docs/fit.md); then:\n"
    return head + f"#   {again}\n" + yaml.safe_dump(plan, sort_keys=False, default_flow_style=None, width=120)


def _guesses(preview: Suggestion, length: Length) -> list[str]:
    up, hold, lines = preview.up, preview.hold, []
    if up.confidence != "given":
        lines.append(f"guessed: up is {[round(part, 2) for part in up.direction]} (confidence {up.confidence})")
    if hold.confidence != "given":
        lines.append(f"guessed: held at the {hold.name} (confidence {hold.confidence}): {'; '.join(hold.reasons)}")
    if preview.parts is not None:
        lines.append("parts: " + ", ".join(f"{part.name} {part.role}" for part in preview.parts.parts.parts))
    size = " x ".join(f"{side:.3g}" for side in preview.size)
    known = "which nobody measured: give --length, such as --length object 1.5"
    if length is not None:
        known = "as --length says" if length != "gravity" else "a guess: the weight is to tell it"
    return [*lines, f"size of what moves: {size} m, {known}"]
