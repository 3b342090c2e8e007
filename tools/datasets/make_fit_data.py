"""Make videos of cloth in wind, for finding the wind and the material with ``gaussian-swaying fit``.

``python tools/datasets/make_fit_data.py``                            all cases: six flags and a curtain
``python tools/datasets/make_fit_data.py --case flag_wind2_a --cameras 8``
``python tools/datasets/make_fit_data.py --preview``                  small and coarse, in a minute or two

Needs Blender as a Python module: ``pip install 'gaussian-swaying[blender]'``, Python 3.11. Everything runs on the CPU.

Blender's cloth solver makes the motion and its path tracer the pictures, so neither shares anything with this package.
The folder of each case holds ``transforms.json`` with ``images/`` and ``masks/``, ``scene.yaml`` and ``fit.yaml`` with
wrong values for what is sought, ``truth.json``, and the true motion ``cloth.npz``. docs/fit_data.md describes them. The
same settings give the same files; what is there is not made again, and where settings changed, the run stops and names
them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
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
from make_flag_dataset import claim, make_uncertainty, missing_pictures

from gaussian_swaying._files import atomic, write_json, write_text

UNCERTAINTY = ("steps doubled", "coarser")
"""How else the motions are solved, see :func:`flag_difference.variants`."""


def make_pictures(pattern: FlagPattern, folder: Path, video: FitVideo) -> int:
    """Render the motion ``cloth.npz`` from all cameras; returns the number of pictures made."""
    from PIL import Image

    motion = read_cloth(folder / "cloth.npz")
    settings = {name: value for name, value in asdict(video).items() if name not in ("cameras", "threads")}
    claim(folder / "images", settings | {"cloth": settings_hash(motion.settings)})
    normal = mean_normal(motion.positions, motion.faces, pattern.normal())
    views = ring_views(motion.positions, normal, video)
    frames = len(motion.positions)
    wanted = {frame_name(camera, frame): (camera, frame) for frame in range(frames) for camera in range(len(views))}
    missing = missing_pictures(folder, list(wanted))
    if missing:
        studio = _studio(pattern, video)
        for name in ("images", "masks"):
            for camera in range(len(views)):
                (folder / name / f"camera{camera}").mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            shown = None
            for name in missing:
                camera, frame = wanted[name]
                if frame != shown:
                    studio.move(motion.positions[frame])
                    shown = frame
                studio.photograph(views[camera], Path(scratch) / "picture.png")
                rgba = np.asarray(Image.open(Path(scratch) / "picture.png"))
                with atomic(folder / mask_name(camera, frame)) as temporary:
                    Image.fromarray(np.where(rgba[..., 3] >= 128, 255, 0).astype(np.uint8)).save(temporary)
                picture = add_noise(composite(rgba, video.background), video, (camera, frame))
                with atomic(folder / name) as temporary:
                    temporary.write_bytes(compress(picture, video.quality))
    write_json(folder / "transforms.json", video_fields(views, frames, pattern.fps))
    return len(missing)


def _studio(pattern: FlagPattern, video: FitVideo) -> Studio:
    """The cloth, and a lamp on each side, so that both sides are lit alike."""
    grid, center, size = pattern.grid(), pattern.center(), 0.5 * pattern.longer_side
    light = np.array(video.light) / np.linalg.norm(video.light)
    lamps = np.stack([center + side * 6.0 * pattern.longer_side * light for side in (1, -1)])
    texture = draw_texture(pattern, 640)
    return Studio(
        grid.faces(),
        grid.uv(),
        texture,
        lamps,
        center,
        size,
        video.samples,
        transparent=True,
        threads=video.threads,
        ambient=video.ambient,
    )


def make_case(name: str, pattern: FlagPattern, folder: Path, video: FitVideo, law: str) -> None:
    """Make what is missing of one case."""

    def report(line: str) -> None:
        print(f"{name}: {line}", flush=True)

    started = time.time()
    if solve_pattern(pattern, folder / "cloth.npz"):
        report(f"cloth solved in {time.time() - started:.0f} s")
    write_json(folder / "truth.json", truth_fields(pattern, video))
    _write_yaml(folder / "scene.yaml", scene_settings(pattern, video, law, folder.as_posix()))
    _write_yaml(folder / "fit.yaml", fit_settings(folder.as_posix()))
    started = time.time()
    made = make_pictures(pattern, folder, video)
    seconds = time.time() - started
    report(f"{made} pictures in {seconds:.0f} s" + (f", {seconds / made:.2f} s each" if made else ""))


def _write_yaml(path: Path, settings: dict[str, Any]) -> None:
    write_text(path, yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=110))


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add, base = parser.add_argument, FitVideo()
    add("--out", type=Path, default=Path("outputs/fit_data"), help="folder to write (default: %(default)s)")
    add("--case", nargs="+", choices=sorted(CASES), default=list(CASES), help="which (default: all)")
    add("--cameras", type=int, default=base.cameras, help="cameras, 1 to 8 (2)")
    add("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), default=base.size, help="pixels (480 270)")
    add("--samples", type=int, default=base.samples, help="light paths per pixel (1)")
    add("--noise", type=float, default=1.0, help="times the noise of a phone (1)")
    add("--quality", type=int, default=base.quality, help="of the JPEG files (85)")
    add("--seed", type=int, default=base.seed, help="of the noise (0)")
    add("--cells", type=int, help="cells of the mesh along the longer side (50, or 60)")
    add("--frames", type=int, help="number of frames, the first at rest (97)")
    add("--law", choices=LAWS, default="projected", help="force law in scene.yaml (projected)")
    add("--uncertainty", action="store_true", help="solve the motions otherwise, too, and compare")
    add("--threads", type=int, default=base.threads, help="threads to render with; 0 for all (1)")
    add("--preview", action="store_true", help="coarse mesh, small pictures, one second")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = parse(argv)
    try:
        base = FitVideo()
        video = replace(
            base,
            cameras=options.cameras,
            size=(160, 90) if options.preview else tuple(options.size),
            samples=options.samples,
            read_noise=options.noise * base.read_noise,
            shot_noise=options.noise**2 * base.shot_noise,
            quality=options.quality,
            seed=options.seed,
            threads=options.threads,
        )
        cells = options.cells or (20 if options.preview else None)
        frames = options.frames or (25 if options.preview else None)
        require_bpy()
        for name in options.case:
            pattern = case_of(name, cells, frames)
            if options.uncertainty:
                found = make_uncertainty(pattern, options.out / name, list(UNCERTAINTY), print, every=1)
                for variant, row in found["variants"].items():
                    print(f"{name}: {variant}: {100 * row['corresponding']:.2f} % of the longer side", flush=True)
            else:
                make_case(name, pattern, options.out / name, video, options.law)
    except (ImportError, ValueError, ArithmeticError) as error:
        print(f"make_fit_data.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
