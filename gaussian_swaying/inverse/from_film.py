"""From a film and a splat to a fit: the camera, when and what moves, what holds it, and first guesses."""

from __future__ import annotations

import math
import os
import re
import subprocess
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from gaussian_swaying import _program as program
from gaussian_swaying._arguments import checked
from gaussian_swaying._files import write_json, write_text
from gaussian_swaying._inputs import check_regular
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.hold import given_hold
from gaussian_swaying.gaussians.measures import plane_axes, sides
from gaussian_swaying.inverse.fit import run_fit
from gaussian_swaying.inverse.plan import FILM_START, read_plan
from gaussian_swaying.inverse.registration import (
    CAMERAS,
    FOUND,
    PICTURE,
    SOLID,
    STILLS,
    fov_of,
    in_space,
    pose_of,
    register,
    shown_in,
    transforms,
)
from gaussian_swaying.inverse.report import Fit, side_by_side
from gaussian_swaying.inverse.tracks import corners, follow, opencv
from gaussian_swaying.inverse.videos import check_wide, frames_of, scaled
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.suggestion.starter import keep_aside, write_starter
from gaussian_swaying.suggestion.suggest import suggest
from gaussian_swaying.suggestion.suggestion import Suggestion
from gaussian_swaying.suggestion.up import given_up

SIDE, SMALL = 960, 240  # longer sides of frames at most, and of those that show when it begins to move [pixels]
DIFFERENT, MOVED_SHARE = 8.0, 0.02  # grey levels by which a pixel has moved, and share of those in a frame
DIAGONAL = math.hypot(36, 24)  # of the film to which a focal length in mm is equivalent [mm]
FULL = 0.6  # share of the picture that a splat covers which has surroundings: then most of its points stand still
STRAY, IN_A_ROW = 1.5, 3  # motion of a point where most of the picture is still [pixels], and frames in which some do
LEAST_SHAKEN = 8  # fewest points that tell how a hand shakes
_FOCAL = re.compile(r"focal.?length\S*35mm\S*\s*:\s*([0-9.]+)", re.IGNORECASE)
PLAN, LOOK, RESULT = "fit.yaml", "preview", "result"
SECONDS, LEAD = 1.5, 0.4  # time of motion that is fitted, and time at rest that is kept before it [s]
SOFTER, STIFFER = 1 / 30, 30.0  # range of E, per that which the preview guesses
SPEED = (0.5, 25.0)  # range of the wind [m/s]
ROUGH = 1.2e-3  # residual of a camera that may be wrong, per diagonal of the picture
Length = tuple[str, float] | None


@dataclass(frozen=True, eq=False)
class Film:
    """A film whose frames are read in another size, by which it is ``full`` times as large.

    ``seconds`` is infinite, and ``focal`` (on 35 mm film [mm]) None, if the file does not say it. The ``first`` frame
    is uint8, (H, W, 3).
    """

    path: Path
    first: Tensor
    full: float
    fps: float
    seconds: float
    focal: float | None

    @property
    def size(self) -> tuple[int, int]:
        return self.first.shape[1], self.first.shape[0]


def open_film(path: str | Path, side: float | None = None) -> Film:
    """Read the head and the first frame of a film, whose frames are to have at most this longer side [pixels]."""
    file = check_regular(Path(path), "the film")
    with closing(frames_of(file)) as frames:
        head = next(frames)
        if next(frames, None) is None:
            raise ValueError(f"The film {file} has no frames: convert it to mp4.")
    width, height = head["size"]
    factor = max(1.0, max(width, height) / (side or SIDE))
    if not head["fps"] > 0:
        raise ValueError(f"The film {file} does not say its frame rate: convert it to mp4.")
    size = check_wide(file, round(width / factor), round(height / factor))
    with closing(frames_of(file, outputs=scaled(*size))) as frames:
        _, first = next(frames), torch.from_numpy(next(frames))
    return Film(file, first, factor, head["fps"], float(head["duration"]) or math.inf, _focal(file))


def _focal(path: Path) -> float | None:
    from imageio_ffmpeg import get_ffmpeg_exe

    words = [get_ffmpeg_exe(), "-hide_banner", "-i", str(path)]
    told = subprocess.run(words, capture_output=True, stdin=subprocess.DEVNULL, check=False)
    found = _FOCAL.search(told.stderr.decode(errors="replace"))
    value = float(found[1]) if found else 0.0
    return value if 5 <= value <= 1000 else None


def view_of_focal(millimetres: float, width: int, height: int) -> float:
    """Vertical field of view [degrees] of a focal length that is equivalent to so many mm on 35 mm film.

    Example:
        >>> round(view_of_focal(43.27, 300, 400), 1)
        43.6
    """
    return 2 * math.degrees(math.atan(0.5 * height * DIAGONAL / (millimetres * math.hypot(width, height))))


def begins_to_move(film: Film, picture: RenderOutput, camera: Camera) -> float | None:
    """Time of the first frame in which the object, not only the camera, has moved [s]; None if there is none.

    Points around the splat tell how a hand shakes. If it fills the picture, most of its own points stand still.
    """
    cv2: Any = opencv()
    factor, in_a_row = max(1.0, max(film.size) / SMALL), 0
    small = scaled(*(round(side / factor) for side in film.size))
    with closing(frames_of(film.path, outputs=small, grey=True)) as frames:
        _, first = next(frames), next(frames)
        shape, scale = first.shape[::-1], camera.width / first.shape[1]
        alpha = cv2.resize(picture.alpha[..., 0].detach().cpu().numpy(), shape, interpolation=cv2.INTER_AREA)
        cover, inside = (alpha > SOLID).astype(np.uint8), alpha > 0.3
        around = (cv2.dilate(cover, np.ones((15, 15), np.uint8)) == 0).astype(np.uint8)
        start = corners(first, 600, 0.01, 4, around)
        full = len(start) < LEAST_SHAKEN and cover.mean() > FULL
        if full:
            start = corners(first, 600, 0.01, 4, cover)
            world, known = in_space(picture, camera, start * scale)
            lens = camera.intrinsics.double().numpy() / np.array([[scale], [scale], [1.0]])
        for number, grey in enumerate(frames, 1):
            moved = _differs(first, grey, inside)
            if moved:
                (_, place), (_, seen) = follow(np.stack([first, grey]), start)
            if moved and full:
                used = seen & known
                pose = pose_of(world[used], place[used], lens, STRAY) if used.sum() >= LEAST_SHAKEN else None
                agree, far = (np.zeros(1), np.zeros(1)) if pose is None else (pose[0], pose[3])
                least = max(LEAST_SHAKEN, MOVED_SHARE * used.sum())
                moved = 2 * agree.sum() >= used.sum() and (far > STRAY).sum() >= least
            elif moved and seen.sum() >= LEAST_SHAKEN:
                turn = cv2.estimateAffinePartial2D(start[seen], place[seen], ransacReprojThreshold=1.5)[0]
                how = {"flags": cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
                moved = turn is None or _differs(first, cv2.warpAffine(grey, turn, shape, **how), inside)
            in_a_row = in_a_row + 1 if moved else 0
            if in_a_row == (IN_A_ROW if full else 1):
                return (number + 1 - in_a_row) / film.fps
    return None


def _differs(first: Any, grey: Any, where: Any) -> bool:
    before, now = (picture[where].astype(float) for picture in (first, grey))
    level = now * (before.mean() / max(now.mean(), 1.0))
    return bool((abs(level - before) > DIFFERENT).mean() > MOVED_SHARE)


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
            the first frame [pixels], in metres.
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
    head, cloud, found = open_film(os.fspath(film)), read_gaussians(splat, 0), None
    known = focal or head.focal
    fov = None if known is None else view_of_focal(known, *head.size)
    with suppress(ValueError):
        found, picture = register(head.first, cloud, axis, fov)
    if found is None or shown_in(picture, head.first)[0] < FOUND:
        raise ValueError(
            f"The splat was not found in the first frame of {film}. It has to show the object at rest, large "
            "and with texture, from a side that was captured; `--up` and `--focal` help."
        )
    source = "found" if known is None else f"of {known:g} mm" + ("" if focal else ", as the film says")
    say(
        f"camera: {found.agreeing} of {found.matches} points agree, {found.residual:.1f} pixels off; focal length "
        f"{source} ({fov_of(found.camera):.0f} degrees from top to bottom)"
    )
    folder.mkdir(parents=True, exist_ok=True)
    iio.imwrite(folder / PICTURE, side_by_side(head.first, picture))
    moves = begins_to_move(head, picture, found.camera)
    if moves is None:
        raise ValueError(
            f"Nothing moves in the film {film} where the splat is: look at {folder / PICTURE}, and give a film "
            "in which the wind moves it."
        )
    at_once = moves < 1.5 / head.fps
    if at_once and found.residual > ROUGH * math.hypot(*head.size):
        raise ValueError(
            f"The film {film} begins in motion, and its camera was found to {found.residual:.1f} pixels only: "
            "cut it so that it begins with the object at rest, or write a fit file with a camera that you know."
        )
    begin = max(0.0, moves - LEAD)
    seconds = min(1.5 * SECONDS + moves - begin, head.seconds - begin)
    where = os.path.relpath(head.path.resolve(), folder.resolve())
    data = transforms(found.camera, where, cloud.origin)
    data["frames"][0] |= {"begin": round(begin, 4), "seconds": round(seconds, 4)}
    write_json(folder / CAMERAS, data)
    guess = partial(suggest, splat, up=axis, hold=hold, device=device, quality="draft")
    preview = guess()
    if length is not None:
        preview = guess(longest_side=longest_side(*length, cloud, found.camera, picture, head.full, preview))
    write_starter(preview, folder / LOOK, 250)
    iio.imwrite(folder / LOOK / "preview.png", preview.picture())
    around = picture.alpha[..., 0].cpu() < 0.05  # the colour that most of it has is the background
    pixels = head.first[around] if bool(around.any()) else head.first.flatten(0, 1)
    colour = [round(value / 255, 3) for value in pixels.median(0).values.tolist()]
    text = plan_text(preview, colour, None if at_once else moves - begin, length, folder)
    keep_aside(folder / PLAN, text)
    write_text(folder / PLAN, text)
    say(f"{film} moves from {moves:.2f} s on; {begin:.2f} s to {begin + seconds:.2f} s of it are used")
    for name in ("up", "held", "parts", "size"):
        if name in preview.reasons:
            say(f"{name}: {preview.reasons[name]}")
    if length is None:
        say("nobody measured the size: give --length, such as --length object 1.5")
    say(f"look at {folder / PICTURE}: frame and splat have to show the same; and at {folder / LOOK / 'preview.png'}")
    return folder / PLAN


def longest_side(
    name: str, metres: float, cloud: GaussianCloud, camera: Camera, picture: RenderOutput, full: float,
    preview: Suggestion,
) -> float:  # fmt: skip
    """The longest side [m] with which ``object``, a part, or two places X,Y:X,Y in the first frame have that length.

    That of the preview is 1 m. The film itself is ``full`` times as large as the picture of the splat.
    """
    if not 0 < metres < math.inf:
        raise ValueError(f"Expected `--length` to have a length above 0 m, but got {metres}.")
    if name == "object":
        return metres
    parts, names = preview.parts, [] if preview.parts is None else preview.parts.names
    if ":" in name:
        try:
            pixels = np.array([[float(value) for value in place.split(",")] for place in name.split(":")])
            (one, other), known = in_space(picture, camera, pixels.reshape(2, 2) / full)
        except ValueError:
            raise ValueError(
                f"Expected `--length` to have two places such as 120,80:120,640, but got {name}."
            ) from None
        if not known.all():
            raise ValueError(f"A place of `--length {name}` is not on the splat: look at {PICTURE} for places.")
        span = float(np.linalg.norm(one - other))
    elif parts is None or name not in names:
        raise ValueError(
            f"The splat has no part {name!r}: `--length` may name {', '.join([*names, 'object'])}, or two places in "
            "the first frame, such as 120,80:120,640 (pixels from its left and upper edges)."
        )
    else:
        span = extent(cloud.means[parts.mask(name)], preview.up.direction)
    return metres / (span * preview.metres_per_unit)


def extent(points: Tensor, up: Sequence[float]) -> float:
    """The longest side of an upright box around points (N, 3) [scene units], turned as they are seen from above."""
    axis, own = np.asarray(up) / np.linalg.norm(up), points.double().numpy()
    level = own @ plane_axes(axis)
    turned = level @ np.linalg.eigh(np.cov(level.T))[1]
    return float(sides(np.column_stack([own @ axis, turned]), 0.002).max())


def plan_text(
    preview: Suggestion, background: Sequence[float], still: float | None, length: Length, folder: Path
) -> str:
    """The fit file; ``still`` is the time at rest before the motion [s], None if the film may begin in motion."""
    middle, half = 0.0, 200.0  # more than all ways round, so that none is at an end of the range
    if preview.hold.name == "side":  # a flag flies away from its pole
        middle, half = math.degrees(math.atan2(preview.flow[1], preview.flow[0])), 120.0
    ranges: dict[str, Sequence[float]] = {
        "wind.speed": SPEED,
        "wind.azimuth": (round(middle - half), round(middle + half)),
        "material.E": [float(f"{preview.youngs_modulus * factor:.1e}") for factor in (SOFTER, STIFFER)],
        FILM_START: (-1.0, 0.1) if still is None else (0.0, round(still + 0.1, 2)),
    }
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
