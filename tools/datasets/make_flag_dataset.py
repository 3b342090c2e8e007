"""Make the flag data set: the motion of flags from Blender's cloth solver, photos of them, and a video.

``python tools/datasets/make_flag_dataset.py --preview``      the paper's three, small, in two minutes on two cores
``python tools/datasets/make_flag_dataset.py --pattern 2``    one, at full size
``python tools/datasets/make_flag_dataset.py --pattern 1 2 3 4 5 --only cloth``  only the motions
``python tools/datasets/make_flag_dataset.py --flag configs/flags/curtain.yaml``  any flag, described in a YAML file

Needs Blender as a Python module: ``pip install 'gaussian-swaying[blender]'``, Python 3.11. Everything runs on the CPU.

docs/flag_dataset.md describes the files. What is there is not made again; where settings changed, the run stops and
names them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from blender_cloth import require_bpy
from blender_images import TRANSFERS, Studio
from fit_video import write_h264
from flag_file import read_flag
from flag_motion import check_settings, read_cloth, settings_hash, solve_pattern
from flag_pictures import draw_texture, frame_order, lamp_position, reference_view, sphere_views, transforms_fields
from flag_reference import PAPER, PATTERNS, FlagPattern, least_quality

from gaussian_swaying._files import atomic, write_json

PARTS = ("cloth", "train", "video")
Report = Callable[[str], None]


@dataclass(frozen=True)
class Pictures:
    """Settings of the pictures.

    Attributes:
        size: Width and height of the video [pixels].
        samples: Light paths per pixel.
        views: Number of photos of the rest shape.
        view_size: Their width and height [pixels].
        transfer: ``linear``, pixel values proportional to light, which the paper's shading law assumes, or ``srgb``.
        every: Render only every ``every``-th frame of the video.
        threads: Threads to render with; 0 for all.
    """

    size: tuple[int, int] = (1920, 1080)
    samples: int = 16
    views: int = 200
    view_size: int = 400
    transfer: str = "linear"
    every: int = 1
    threads: int = 0


PREVIEW = Pictures(size=(320, 180), samples=4, views=24, view_size=128, every=10)


def claim(folder: Path, settings: dict[str, Any]) -> None:
    """Make a folder and record the settings of its contents."""
    path = folder / "settings.json"
    if path.exists():
        check_settings(folder, json.loads(path.read_text(encoding="utf-8")), settings)
    else:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(path, settings)


def picture_settings(pattern: FlagPattern, texture: np.ndarray, pictures: Pictures) -> dict[str, Any]:
    """The settings that all pictures of a flag depend on; pictures of its motion also depend on the motion."""
    shape = {name: getattr(pattern, name) for name in ("width", "height", "yaw", "ripple")}
    digest = hashlib.sha256(np.ascontiguousarray(texture).tobytes()).hexdigest()[:16]
    return shape | {"texture": digest, "samples": pictures.samples, "transfer": pictures.transfer}


def missing_pictures(folder: Path, names: list[str]) -> list[str]:
    """The pictures that do not exist yet, in the same order."""
    return [name for name in names if not (folder / name).is_file()]


def make_truth(pattern: FlagPattern, folder: Path) -> None:
    """Write the rest shape as ``truth.npz`` and ``mesh.ply``."""
    from plyfile import PlyData, PlyElement

    truth = pattern.truth()
    fields = ("x", "y", "z", "nx", "ny", "nz", "s", "t")
    rows = np.zeros(len(truth["vertices"]), dtype=[(name, "<f4") for name in fields])
    columns = np.concatenate([truth["vertices"], truth["normals"], truth["uv"]], axis=1)
    for index, name in enumerate(fields):
        rows[name] = columns[:, index]
    triangles = np.zeros(len(truth["faces"]), dtype=[("vertex_indices", "<i4", (3,))])
    triangles["vertex_indices"] = truth["faces"]
    ply = PlyData([PlyElement.describe(rows, "vertex"), PlyElement.describe(triangles, "face")], byte_order="<")

    folder.mkdir(parents=True, exist_ok=True)
    with atomic(folder / "truth.npz") as temporary:
        np.savez_compressed(temporary, area=np.float64(pattern.width * pattern.height), **truth)  # type: ignore[arg-type]
    with atomic(folder / "mesh.ply") as temporary:
        ply.write(str(temporary))


def make_train(pattern: FlagPattern, folder: Path, pictures: Pictures, report: Report) -> int:
    """Render the rest shape from all around.

    There is a lamp on each side. With only the video's lamp, every view from behind would be black.

    Returns:
        Number of pictures made.
    """
    texture = draw_texture(pattern)
    claim(folder, picture_settings(pattern, texture, pictures) | {"views": pictures.views, "size": pictures.view_size})
    views = sphere_views(pattern, pictures.views, pictures.view_size)
    names = [f"images/{index:04d}.png" for index in range(len(views))]
    (folder / "images").mkdir(exist_ok=True)
    wanted = missing_pictures(folder, names)
    if wanted:
        lamps = np.stack([lamp_position(pattern, side) for side in (1, -1)])
        studio = _studio(pattern, texture, lamps, pictures, transparent=True)
        studio.move(pattern.rest(pattern.grid().uv())[0])
        for done, name in enumerate(wanted, 1):
            studio.photograph(views[names.index(name)], folder / name)
            report(f"view {done}/{len(wanted)}")
    write_json(folder / "transforms.json", transforms_fields(views, names))
    return len(wanted)


def make_video(pattern: FlagPattern, cloth: Path, folder: Path, pictures: Pictures, report: Report) -> int:
    """Render the motion from one camera along the initial normal, with one lamp behind the camera.

    Every tenth frame is made first. The video itself is written once all frames exist.

    Returns:
        Number of pictures made.
    """
    motion = read_cloth(cloth)
    texture = draw_texture(pattern)
    width, height = pictures.size
    settings = picture_settings(pattern, texture, pictures) | {"size": [width, height]}
    claim(folder, settings | {"cloth": settings_hash(motion.settings)})
    view = reference_view(pattern, motion.positions, width, height)
    lamp = lamp_position(pattern)
    (folder / "frames").mkdir(exist_ok=True)
    fields = transforms_fields([view], ["frames/0000.png"])
    light = {"position": lamp.tolist(), "direction": pattern.normal().tolist(), "size": _lamp_size(pattern)}
    write_json(folder / "camera.json", fields | {"fps": pattern.fps, "light": light})
    count = len(motion.positions)
    names = {f"frames/{frame:04d}.png": frame for frame in frame_order(count) if frame % pictures.every == 0}
    wanted = missing_pictures(folder, list(names))
    if wanted:
        studio = _studio(pattern, texture, lamp[None], pictures, transparent=False)
        for done, name in enumerate(wanted, 1):
            studio.move(motion.positions[names[name]])
            studio.photograph(view, folder / name)
            report(f"frame {done}/{len(wanted)}")
    whole = pictures.every == 1
    if whole and (wanted or not (folder / "reference.mp4").exists()):
        drawn = (iio.imread(folder / name)[..., :3] for name in sorted(names))
        write_h264(folder / "reference.mp4", drawn, pictures.size, pattern.fps, crf=5)
    return len(wanted)


def _every_25th(report: Report, what: str, frames: int) -> Callable[[int], None]:
    def frame_done(frame: int) -> None:
        if frame % 25 == 0:
            report(f"{what}, frame {frame}/{frames}")

    return frame_done


def _lamp_size(pattern: FlagPattern) -> float:
    return 0.5 * pattern.longer_side


def _studio(
    pattern: FlagPattern, texture: np.ndarray, lamps: np.ndarray, pictures: Pictures, transparent: bool
) -> Studio:
    grid = pattern.grid()
    return Studio(
        grid.faces(),
        grid.uv(),
        texture,
        lamps,
        pattern.center(),
        _lamp_size(pattern),
        pictures.samples,
        transparent,
        pictures.transfer,
        pictures.threads,
    )


# ---- command line


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--out", type=Path, default=Path("outputs/flags"), help="folder to write (default: %(default)s)")
    add("--pattern", type=int, nargs="+", choices=sorted(PATTERNS), help="which flags (1 2 3, or none with --flag)")
    add("--flag", type=Path, nargs="+", default=[], metavar="FILE", help="YAML files of other flags")
    add("--only", nargs="+", choices=PARTS, default=list(PARTS), help="which parts")
    add("--preview", action="store_true", help="coarse mesh, small pictures, every tenth frame")
    add("--cells", type=int, help="cells of the mesh along the longer side (120, 120, 140, 112, 100)")
    add("--quality", type=int, help="solver steps per frame, a power of two (default: what the mesh needs)")
    add("--frames", type=int, help="number of frames, the first being the rest shape (250)")
    add("--self-collision", action="store_true", default=None, help="turn self-contact on")
    add("--self-distance", type=float, help="distance that the cloth then keeps from itself [m] (half a cell)")
    add("--size", type=_size, metavar="WIDTHxHEIGHT", help="size of the video [pixels] (1920x1080)")
    add("--samples", type=int, help="light paths per pixel (16)")
    add("--views", type=int, help="number of photos of the rest shape (200)")
    add("--view-size", type=int, help="width and height of the photos [pixels] (400)")
    add("--transfer", choices=TRANSFERS, help="linear: pixels proportional to light; srgb: as from a camera (linear)")
    add("--every", type=int, help="render only every N-th frame (1)")
    add("--threads", type=int, help="threads to render with; 0 for all (0)")
    return parser.parse_args(argv)


def flags_of(options: argparse.Namespace) -> dict[str, FlagPattern]:
    """The flags chosen on the command line, by the names of their folders."""
    numbers = (() if options.flag else PAPER) if options.pattern is None else options.pattern
    flags = {f"pattern{number}": PATTERNS[number] for number in numbers}
    for file in options.flag:
        flag = read_flag(file)
        if file.stem in flags:
            raise ValueError(f"Two flags would have the folder `{file.stem}`: rename {file}.")
        flags[file.stem] = flag
    return {name: flag_of(flag, options) for name, flag in flags.items()}


def flag_of(flag: FlagPattern, options: argparse.Namespace) -> FlagPattern:
    """A flag with the options of the command line."""
    names = ("frames", "self_collision", "self_distance", "cells")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.preview:
        given = {"cells": max(flag.cells // 4, 2)} | given
    flag = replace(flag, **given)
    return replace(flag, quality=options.quality or least_quality(flag))


def pictures_of(options: argparse.Namespace) -> Pictures:
    """The pictures chosen on the command line."""
    base = PREVIEW if options.preview else Pictures()
    given = {name: getattr(options, name) for name in asdict(base) if getattr(options, name) is not None}
    for name, value in given.items():
        least = 0 if name == "threads" else 1
        if isinstance(value, int) and value < least:
            raise ValueError(f"Expected `{name}` to be at least {least}, but got {value}.")
    return replace(base, **given)


def make(name: str, pattern: FlagPattern, options: argparse.Namespace) -> None:
    """Make the missing files of one flag, in a folder of that name."""
    pictures = pictures_of(options)
    folder = options.out / name

    report = partial(print, f"{name}:", flush=True)
    started = time.time()
    if "cloth" in options.only:
        solve_pattern(pattern, folder / "cloth.npz", _every_25th(report, "cloth", pattern.frames))
        make_truth(pattern, folder)
    if "train" in options.only:
        make_train(pattern, folder / "train", pictures, report)
    if "video" in options.only:
        make_video(pattern, folder / "cloth.npz", folder / "video", pictures, report)
    report(f"done in {time.time() - started:.0f} s: {folder}")


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = parse(argv)
    try:
        require_bpy()
        for name, flag in flags_of(options).items():
            make(name, flag, options)
    except (ImportError, ValueError, ArithmeticError, FileNotFoundError) as error:
        print(f"make_flag_dataset.py: {error}", file=sys.stderr)
        return 1
    return 0


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return int(width), int(height)


if __name__ == "__main__":
    sys.exit(main())
