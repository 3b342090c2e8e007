"""Make videos of cloth and of a soft post in wind, to find wind and material with ``gaussian-swaying fit``.

``python tools/datasets/make_fit_data.py``                            all cases: six flags and a curtain
``python tools/datasets/make_fit_data.py --case flag_wind2_a --cameras 8``
``python tools/datasets/make_fit_data.py --case soft``                a soft post, by Newton
``python tools/datasets/make_fit_data.py --preview``                  small and coarse, in a minute or two

Needs Blender as a Python module: ``pip install 'gaussian-swaying[blender]'``, Python 3.11; ``soft`` also needs the
extra ``peers``. Everything runs on the CPU.

docs/fit_data.md describes the cases and their files. What is there is not made again; where settings changed, the run
stops and names them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import soft_case
import yaml
from blender_cloth import require_bpy
from blender_images import Studio
from fit_cases import CASES, LAWS, FitVideo, case_of, fit_settings, scene_settings, truth_fields
from fit_video import (
    add_noise,
    composite,
    compress,
    frame_name,
    mask_name,
    mean_normal,
    ring_views,
    video_fields,
)
from flag_motion import read_cloth, settings_hash, solve_pattern
from flag_pictures import draw_texture
from flag_reference import FlagPattern
from make_flag_dataset import claim, missing_pictures
from newton_soft import require_newton
from soft_case import (
    SOFT,
    SoftPattern,
    moved_places,
    read_soft,
    skin,
    solve_soft,
    splat,
    texture,
)

from gaussian_swaying._files import atomic, write_json, write_text
from gaussian_swaying.gaussians.ply import write_ply

FAR = 60.0
"""Distance of the lamps, in longest sides of the body."""


@dataclass(frozen=True)
class Filmed:
    """A motion to be filmed.

    Attributes:
        positions: The vertices that are drawn, at each frame [m], shape (F, V, 3).
        normal: Direction from which the first two cameras look, see :func:`fit_video.ring_views`.
        fps: Frames per second.
        hash: Of the settings of the motion.
    """

    positions: np.ndarray
    normal: np.ndarray
    fps: float
    hash: str
    studio: Callable[[], Studio]


def filmed_cloth(pattern: FlagPattern, folder: Path, video: FitVideo) -> Filmed:
    """The motion ``cloth.npz`` of a folder."""
    motion = read_cloth(folder / "cloth.npz")
    normal = mean_normal(motion.positions, motion.faces, pattern.normal())
    grid, texture = pattern.grid(), draw_texture(pattern, 640)
    studio = partial(studio_of, grid.faces(), grid.uv(), texture, pattern.center(), pattern.longer_side, video)
    return Filmed(motion.positions, normal, pattern.fps, settings_hash(motion.settings), studio)


def filmed_soft(pattern: SoftPattern, folder: Path, video: FitVideo) -> Filmed:
    """The motion ``motion.npz`` of a folder."""
    positions, settings = read_soft(folder / "motion.npz")
    points, faces, uv = skin(pattern)
    middle = np.array([0.0, 0.0, 0.5 * pattern.height])
    studio = partial(studio_of, faces, uv, texture(pattern), middle, pattern.height, video)
    return Filmed(positions[:, points], np.array([0.0, -1.0, 0.0]), pattern.fps, settings_hash(settings), studio)


def make_pictures(filmed: Filmed, folder: Path, video: FitVideo) -> int:
    """Render a motion from all cameras; returns the number of pictures made."""
    from PIL import Image

    settings = {name: value for name, value in asdict(video).items() if name not in ("cameras", "threads")}
    claim(folder / "images", settings | {"cloth": filmed.hash})
    views = ring_views(filmed.positions, filmed.normal, video)
    frames = len(filmed.positions)
    wanted = {frame_name(camera, frame): (camera, frame) for frame in range(frames) for camera in range(len(views))}
    missing = missing_pictures(folder, list(wanted))
    if missing:
        studio = filmed.studio()
        for name in ("images", "masks"):
            for camera in range(len(views)):
                (folder / name / f"camera{camera}").mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            shown = None
            for name in missing:
                camera, frame = wanted[name]
                if frame != shown:
                    studio.move(filmed.positions[frame])
                    shown = frame
                studio.photograph(views[camera], Path(scratch) / "picture.png")
                rgba = np.asarray(Image.open(Path(scratch) / "picture.png"))
                with atomic(folder / mask_name(camera, frame)) as temporary:
                    Image.fromarray(np.where(rgba[..., 3] >= 128, 255, 0).astype(np.uint8)).save(temporary)
                picture = add_noise(composite(rgba, video.background), video, (camera, frame))
                with atomic(folder / name) as temporary:
                    temporary.write_bytes(compress(picture, video.quality))
    write_json(folder / "transforms.json", video_fields(views, frames, filmed.fps))
    return len(missing)


def studio_of(
    faces: np.ndarray, uv: np.ndarray, texture: np.ndarray, center: np.ndarray, longest: float, video: FitVideo
) -> Studio:
    """A body of a longest side, and a lamp on each side, so that both sides are lit alike.

    The lamps are far, so that the light is nearly parallel, as a shader's is.
    """
    light = np.array(video.light) / np.linalg.norm(video.light)
    lamps = np.stack([center + side * FAR * longest * light for side in (1, -1)])
    return Studio(
        faces,
        uv,
        texture,
        lamps,
        center,
        0.08 * FAR * longest,
        video.samples,
        transparent=True,
        threads=video.threads,
        ambient=video.ambient,
    )


def make_case(name: str, pattern: FlagPattern, folder: Path, video: FitVideo, law: str) -> None:
    """Make what is missing of one case."""
    report = partial(print, f"{name}:", flush=True)
    started = time.time()
    if solve_pattern(pattern, folder / "cloth.npz"):
        report(f"cloth solved in {time.time() - started:.0f} s")
    write_json(folder / "truth.json", truth_fields(pattern, video))
    write_yaml(folder / "scene.yaml", scene_settings(pattern, video, law, folder.as_posix()))
    write_yaml(folder / "fit.yaml", fit_settings(folder.as_posix()))
    _film(filmed_cloth(pattern, folder, video), folder, video, report)


def make_soft(pattern: SoftPattern, folder: Path, video: FitVideo) -> None:
    """Make what is missing of the soft post."""
    report = partial(print, f"{SOFT}:", flush=True)
    started = time.time()
    if solve_soft(pattern, folder / "motion.npz"):
        report(f"soft body solved in {time.time() - started:.0f} s")
    cloud = splat(pattern)
    write_ply(folder / "rest.ply", cloud)
    places = moved_places(pattern, read_soft(folder / "motion.npz")[0], cloud.means.double().numpy())
    with atomic(folder / "gaussians.npz") as temporary:
        np.savez_compressed(temporary, positions=places.astype(np.float32))
    write_json(folder / "truth.json", soft_case.truth_fields(pattern, video))
    write_yaml(folder / "scene.yaml", soft_case.scene_settings(pattern, video, folder.as_posix()))
    write_yaml(folder / "fit.yaml", fit_settings(folder.as_posix()) | {"unknowns": soft_case.SOUGHT})
    _film(filmed_soft(pattern, folder, video), folder, video, report)


def _film(filmed: Filmed, folder: Path, video: FitVideo, report: Callable[[str], None]) -> None:
    started = time.time()
    made = make_pictures(filmed, folder, video)
    seconds = time.time() - started
    report(f"{made} pictures in {seconds:.0f} s" + (f", {seconds / made:.2f} s each" if made else ""))


def write_yaml(path: Path, settings: dict[str, Any]) -> None:
    """Write a configuration."""
    write_text(path, yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=110))


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add, base = parser.add_argument, FitVideo()
    add("--out", type=Path, default=Path("outputs/fit_data"), help="folder to write (default: %(default)s)")
    add("--case", nargs="+", choices=sorted([*CASES, SOFT]), default=list(CASES), help="which (all of cloth)")
    add("--cameras", type=int, default=base.cameras, help="cameras, 1 to 8 (2)")
    add("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), help="pixels (480 270; soft: 270 480)")
    add("--samples", type=int, default=base.samples, help="light paths per pixel (1)")
    add("--noise", type=float, default=1.0, help="times the noise of a phone (1)")
    add("--quality", type=int, default=base.quality, help="of the JPEG files (85)")
    add("--seed", type=int, default=base.seed, help="of the noise (0)")
    add("--cells", type=int, help="cells of the mesh along the length (50, or 60; soft: along the width, 10)")
    add("--frames", type=int, help="number of frames, the first at rest (97; soft: 49)")
    add("--law", choices=LAWS, default="projected", help="force law in scene.yaml (projected)")
    add("--threads", type=int, default=base.threads, help="threads to render with; 0 for all (1)")
    add("--preview", action="store_true", help="coarse mesh, small pictures, one second")
    return parser.parse_args(argv)


def _video(options: argparse.Namespace, upright: bool) -> FitVideo:
    base = FitVideo()
    size = (160, 90) if options.preview else tuple(options.size or base.size)
    return replace(
        base,
        cameras=options.cameras,
        size=size[::-1] if upright and (options.preview or not options.size) else size,
        samples=options.samples,
        read_noise=options.noise * base.read_noise,
        shot_noise=options.noise**2 * base.shot_noise,
        quality=options.quality,
        seed=options.seed,
        threads=options.threads,
    )


def _do_cloth(name: str, options: argparse.Namespace) -> None:
    video = _video(options, upright=False)
    require_bpy()
    cells = options.cells or (20 if options.preview else None)
    pattern = case_of(name, cells, options.frames or (25 if options.preview else None))
    make_case(name, pattern, options.out / name, video, options.law)


def _do_soft(name: str, options: argparse.Namespace) -> None:
    video = _video(options, upright=True)
    require_newton()
    base = SoftPattern()
    cells = options.cells or (4 if options.preview else base.cells)
    pattern = replace(base, cells=cells, frames=options.frames or (13 if options.preview else base.frames))
    require_bpy()
    make_soft(pattern, options.out / name, video)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = parse(argv)
    try:
        for name in options.case:
            (_do_soft if name == SOFT else _do_cloth)(name, options)
    except (ImportError, ValueError, ArithmeticError) as error:
        print(f"make_fit_data.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
