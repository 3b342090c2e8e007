"""Make films of things in wind as a phone in a hand takes them, whose wind and material are known.

``python tools/datasets/make_hand_films.py``                     a curtain, a banner, a flag on a pole, a soft post
``python tools/datasets/make_hand_films.py --case banner --preview``

Needs Blender as a Python module: ``pip install 'gaussian-swaying[blender]'``, Python 3.11; ``post`` also needs the
extra ``peers``. Everything runs on the CPU.

Each motion makes two films of the same length: ``still`` begins 0.2 s before it, ``moving`` 0.2 s into it. Each has a
folder with ``film.mp4``; ``transforms.json``, with the camera as it was aimed, but not how it shakes; ``splat.ply``, of
the thing at rest and the room; ``scene.yaml`` and ``fit.yaml``, with start values far off; and ``truth.json``, with the
true cameras. Pictures that are there are not made again.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import fit_cases
import make_fit_data
import numpy as np
import soft_case
import torch
from blender_cloth import require_bpy
from blender_images import View, look_at
from fit_cases import CASES, FitVideo, flag
from fit_video import add_noise, view_of_all, write_h264
from flag_motion import solve_pattern
from flag_pictures import lens_fields
from flag_reference import FlagPattern, least_quality
from make_fit_data import Filmed, write_yaml
from make_flag_dataset import claim, missing_pictures
from newton_soft import require_newton
from room import Square, block, mesh, splat, squares, tile
from soft_case import SoftPattern, solve_soft

from gaussian_swaying._files import write_json
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.ply import write_ply
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.scenes.patches import sheet, to_cloud
from gaussian_swaying.scenes.printed_cloth import printed_colours
from gaussian_swaying.scenes.procedural import both

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.problems.films import opengl, shaken

FPS, FRAMES, SHIFT = 30, 90, 6
"""Frames a second; frames of a film; and how many of them a film begins before or into the motion."""
FILMS = {"still": 1, "moving": -1}
"""Films that begin before and into the motion."""
SHAKE, EARLIER = 1.0, 15
"""Shake of the hand, root mean square [degrees], and frames since it was aimed when the first picture is taken."""
AROUND, ASIDE, ABOVE = 1.7, 36.0, 10.0
"""Height and width of the picture in lengths of the motion, and where the camera is: degrees from the normal of the
cloth at rest, and above the horizon."""
SEEN = 1.25
"""Part of the room that is in the splat, in widths and heights of the picture."""
FINE = 0.009
"""Distance of the Gaussians of the room, in lengths of the motion. Where Gaussians overlap the nearer ones are seen, so
that a wall appears to be moved by a part of this: with 0.018 a camera was 0.4 pixels off."""
OFF, TURNED = 3.0, 60.0
"""How far the start values of a fit are off: factor, and degrees."""
UNTIL = 1.0
"""Length of the motion that is fitted [s]."""
CLOTHS: dict[str, FlagPattern] = {
    "curtain": CASES["curtain"],
    "banner": replace(flag((1.0, 2.3, 0.0), "b"), density=50.0, pinned="sides", cells=50),
    "pole_flag": replace(
        flag((3.1, 2.6, 0.0), "b"), youngs_modulus=8e3, density=25.0, pinned="left", width=0.6, height=0.4, cells=60
    ),
}
"""Cloths. The banner is as heavy as real ones. On the flag, which folds up as it falls, meshes of Blender's cloth agree
to millimetres; on the larger ones of :data:`fit_cases.CASES` they are centimetres apart after 0.3 s."""
CELLS = 12
"""Cells of the grid of a fit along the longer side of a cloth."""
POST = "post"
RANGES = {"wind.speed": (0.5, 16.0), "wind.azimuth": (-80.0, 160.0), "material.E": (1e3, 4e4)}
"""Where a fit looks for the values of a cloth; E of the post is ten times as large."""


@dataclass(frozen=True)
class Thing:
    """Something that moves, and what a fit is to know of it.

    Attributes:
        cloud: The splat of it at rest.
        region: Box around it, of which the room has nothing: lower and upper corner [m].
        supports: What holds it, as surfaces.
        ground: Height of the ground [m].
        spacing: Distance of the Gaussians of the room [m].
        truth: For ``truth.json``.
        scene: For ``scene.yaml``, with what is simulated and how.
    """

    motion: Filmed
    cloud: GaussianCloud
    region: tuple[list[float], list[float]]
    supports: list[Square]
    ground: float
    spacing: float
    truth: dict[str, Any]
    scene: dict[str, Any]
    ranges: dict[str, tuple[float, float]]

    @property
    def room(self) -> list[Square]:
        """The still surfaces."""
        low, high = self.motion.positions.min((0, 1)), self.motion.positions.max((0, 1))
        return [*squares(low.astype(float), high.astype(float), self.ground), *self.supports]

    @property
    def size(self) -> float:
        """Longest side of the box around the motion [m]."""
        return float(np.ptp(self.motion.positions, (0, 1)).max())


# ---- cloth


def lattice(pattern: FlagPattern, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Borders of the patches of a cloth along x and z [m], with a row of patches in the middle of each held edge."""
    both_sides = pattern.pinned == "sides"
    columns, rows = round(pattern.width / spacing), round(pattern.height / spacing)
    x = np.linspace(0, pattern.width, columns + 1)
    z = np.linspace(0, pattern.height, rows + 1)
    if pattern.pinned in ("left", "sides"):
        step = pattern.width / (columns - (1 if both_sides else 0.5))
        x = -0.5 * step + step * np.arange(columns + 1)
    if pattern.pinned == "top":
        z = pattern.height / (rows - 0.5) * np.arange(rows + 1)
    return x, z


def cloth_cloud(pattern: FlagPattern, spacing: float) -> GaussianCloud:
    """The cloth at rest as flat Gaussians, without light."""
    x, z = (torch.from_numpy(part) for part in lattice(pattern, spacing))

    def surface(v: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        at = [low[0] + share * (low[-1] - low[0]) for low, share in ((x, u), (z, v))]
        points = pattern.rest(torch.stack([at[0] / pattern.width, at[1] / pattern.height], -1).numpy())[0]
        return torch.from_numpy(points)

    patches = sheet(surface, len(z) - 1, len(x) - 1)
    print_ = printed_colours(patches.center[:, 0], patches.center[:, 2])
    return to_cloud(patches.painted(print_), overlap=0.55, ambient=1.0, opacity=0.99)


def filmed_cloth(pattern: FlagPattern, folder: Path, video: FitVideo, spacing: float, dx: float) -> Thing:
    """A cloth whose motion is ``cloth.npz`` of a folder."""
    motion = make_fit_data.filmed_cloth(pattern, folder, video)
    size = float(np.ptp(motion.positions, (0, 1)).max())
    ground = float(motion.positions[..., 2].min()) - 0.25 * size
    scene = fit_cases.scene_settings(pattern, video, "linear", "")
    del scene["scene"]["generator"]
    width, height = pattern.width, pattern.height
    near = 0.3 * spacing
    ends: dict[str, list[tuple[list[float | None], list[float | None]]]] = {
        "top": [([None, None, height - near], [None] * 3)],
        "left": [([None] * 3, [near, None, None])],
        "sides": [([None] * 3, [near, None, None]), ([width - near, None, None], [None] * 3)],
    }
    pins = [{"class_path": "Box", "init_args": {"min": low, "max": high}} for low, high in ends[pattern.pinned]]
    scene["scene"]["layers"] = 1
    scene["solver"] |= {
        "dx": dx,
        "boundaries": [{"class_path": "PinnedRegion", "init_args": {"kind": None, "region": pin}} for pin in pins],
    }
    return Thing(
        motion,
        cloth_cloud(pattern, spacing),
        ([-0.005, -0.03, -0.01], [width + 0.005, 0.03, height + 0.005]),
        supports(pattern, ground),
        ground,
        FINE * size,
        fit_cases.truth_fields(pattern, video),
        scene,
        RANGES,
    )


def supports(pattern: FlagPattern, ground: float) -> list[Square]:
    """A rod above a cloth that hangs, or poles beside it."""
    thick, off = 0.03, 0.012
    width, height = pattern.width, pattern.height
    if pattern.pinned == "top":
        return block([-0.1, -0.5 * thick, height + off], [width + 0.1, 0.5 * thick, height + off + thick])
    poles = [-off - thick, width + off][: 2 if pattern.pinned == "sides" else 1]
    return [side for x in poles for side in block([x, -0.5 * thick, ground], [x + thick, 0.5 * thick, height + 0.05])]


# ---- the soft post


def filmed_post(pattern: SoftPattern, folder: Path, video: FitVideo, spacing: float, dx: float) -> Thing:
    """A soft post whose motion is ``motion.npz`` of a folder."""
    motion = make_fit_data.filmed_soft(pattern, folder, video)
    half = 0.5 * pattern.side + 0.003
    scene = soft_case.scene_settings(pattern, video, "")
    scene["scene"]["filling"] = {"spacing": 0.25 * dx}
    scene["solver"]["dx"] = dx
    return Thing(
        motion,
        soft_case.splat(pattern, spacing),
        ([-half, -half, -0.002], [half, half, pattern.height + 0.003]),
        [],
        -0.006,
        FINE * float(np.ptp(motion.positions, (0, 1)).max()),
        soft_case.truth_fields(pattern, video),
        scene,
        RANGES | {"material.E": (1e4, 4e5)},
    )


# ---- pictures


def aimed(thing: Thing, video: FitVideo) -> View:
    """The camera as it is aimed: from the side of a cloth that the wind does not blow to, and above."""
    turn, rise = math.radians(ASIDE - 90), math.radians(ABOVE)
    ray = np.array([math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise)])
    low, high = thing.motion.positions.min((0, 1)).astype(float), thing.motion.positions.max((0, 1)).astype(float)
    middle = 0.5 * (low + high)
    around = middle + AROUND * (thing.motion.positions.reshape(-1, 3) - middle)
    return view_of_all(look_at(ray, np.zeros(3))[:3, :3], around, *video.size, math.radians(video.angle))


def camera_of(view: View) -> Camera:
    """The same camera in OpenCV's axes, float64."""
    pose = torch.from_numpy(view.pose * np.array([1.0, -1.0, -1.0, 1.0]))
    lens = [[view.focal, 0, 0.5 * view.width], [0, view.focal, 0.5 * view.height], [0, 0, 1]]
    return Camera(torch.linalg.inv(pose), torch.tensor(lens, dtype=torch.float64), view.width, view.height)


def in_hand(thing: Thing, view: View, pictures: int, seed: int) -> list[View]:
    """The cameras of all pictures."""
    middle = thing.motion.positions.reshape(-1, 3).mean(0).tolist()
    cameras = shaken(camera_of(view), EARLIER + pictures, SHAKE, seed, middle)[EARLIER:]
    return [replace(view, pose=opengl(camera).numpy()) for camera in cameras]


def make_pictures(thing: Thing, folder: Path, video: FitVideo, views: Sequence[View]) -> int:
    """Draw what each camera sees, the thing at rest and then in motion; returns the number of pictures made."""
    settings = {name: getattr(video, name) for name in ("size", "angle", "samples", "light", "ambient", "seed")}
    claim(folder / "pictures", settings | {"motion": thing.motion.hash, "pictures": len(views), "shake": SHAKE})
    names = [f"pictures/{number:04d}.png" for number in range(len(views))]
    missing = missing_pictures(folder, names)
    if missing:
        studio = thing.motion.studio()
        studio.add_room(*mesh(thing.room, thing.size), tile())
        for name in missing:
            number = names.index(name)
            studio.move(thing.motion.positions[max(0, number - SHIFT)])
            studio.photograph(views[number], folder / name)
    return len(missing)


def write_film(thing: Thing, case: Path, folder: Path, video: FitVideo, view: View, views: Sequence[View]) -> None:
    """Write a film of pictures that are there, and what a fit is to know of it, into its folder."""
    import imageio.v3 as iio

    sign = FILMS[folder.name]
    first = 0 if sign > 0 else 2 * SHIFT
    frames = range(first, first + len(views) - 2 * SHIFT)
    pictures = (iio.imread(case / f"pictures/{k:04d}.png")[..., :3] / 255.0 for k in frames)
    noisy = (add_noise(picture, video, (k,)) for k, picture in zip(frames, pictures, strict=True))
    write_h264(folder / "film.mp4", noisy, video.size, FPS)
    start = sign * SHIFT / FPS
    entry = {
        "video_path": "film.mp4",
        "time": 0.0,
        "seconds": 0.3 + _until(sign),
        "transform_matrix": view.pose.tolist(),
    }
    write_json(folder / "transforms.json", lens_fields(view) | {"frames": [entry]})
    place = folder.resolve().as_posix()
    write_ply(folder / "splat.ply", both(thing.cloud, _seen(thing, video, view)))
    scene = dict(thing.scene)
    low, high = thing.region
    region = {"class_path": "Box", "init_args": {"min": low, "max": high}}
    scene["scene"] = scene["scene"] | {"ply": f"{place}/splat.ply", "region": region}
    scene["camera"]["init_args"]["path"] = f"{place}/transforms.json"
    write_yaml(folder / "scene.yaml", scene)
    write_yaml(folder / "fit.yaml", fit_settings(thing, sign))
    write_json(
        folder / "truth.json", thing.truth | {"start": start, "cameras": [views[k].pose.tolist() for k in frames]}
    )


def _seen(thing: Thing, video: FitVideo, view: View) -> GaussianCloud:
    cloud = splat(thing.room, thing.size, thing.spacing, video.light, video.ambient)
    camera = camera_of(view)
    pixels, depth = project(cloud.means.double(), camera)
    size = torch.tensor([view.width, view.height])
    inside = ((pixels / size - 0.5).abs() < 0.5 * SEEN).all(-1) & (depth > 0)
    return cloud.select(inside)


def _until(sign: int) -> float:
    """Time of a film up to which it is fitted [s]."""
    return UNTIL + max(0, sign) * SHIFT / FPS


def fit_settings(thing: Thing, sign: int) -> dict[str, Any]:
    """A configuration of ``gaussian-swaying fit``, whose start values are far off."""
    true = {"wind.speed": thing.truth["speed"], "material.E": thing.truth["E"]}
    starts = {"wind.speed": true["wind.speed"] * OFF**-sign, "material.E": true["material.E"] * OFF**sign}
    starts["wind.azimuth"] = thing.truth["azimuth"] - sign * TURNED
    unknowns = {
        name: {"range": list(ends), "start": round(min(max(starts[name], ends[0]), ends[1]), 3)}
        for name, ends in thing.ranges.items()
    }
    return {
        "base": ["scene.yaml"],
        "videos": ["."],
        "unknowns": unknowns | {"film.start": {"range": [-0.5, 0.5]}},
        "until": _until(sign),
        "search": 32,
        "tracks": 200,
    }


# ---- cases


def make_case(name: str, out: Path, video: FitVideo, options: argparse.Namespace) -> None:
    """Make what is missing of one case."""
    folder, started = out / name, time.time()
    pictures = 2 * SHIFT + (options.frames or FRAMES)
    frames = pictures - SHIFT + 1
    if name == POST:
        require_newton()
        post = replace(SoftPattern(), fps=FPS, frames=frames, cells=4 if options.preview else 10)
        solve_soft(post, folder / "motion.npz")
        thing = filmed_post(post, folder, video, *((0.01, 0.06) if options.preview else (0.004, 0.02)))
    else:
        cells = 20 if options.preview else CLOTHS[name].cells
        cloth = replace(CLOTHS[name], fps=FPS, frames=frames, cells=cells)
        cloth = replace(cloth, quality=least_quality(cloth))
        solve_pattern(cloth, folder / "cloth.npz")
        dx = cloth.longer_side / (8 if options.preview else CELLS)
        thing = filmed_cloth(cloth, folder, video, 0.25 * dx, round(dx, 4))
    print(f"{name}: motion in {time.time() - started:.0f} s", flush=True)
    view = aimed(thing, video)
    views = in_hand(thing, view, pictures, video.seed)
    started = time.time()
    made = make_pictures(thing, folder, video, views)
    print(f"{name}: {made} pictures in {time.time() - started:.0f} s", flush=True)
    for film in FILMS:
        write_film(thing, folder, folder / film, video, view, views)


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    add = parser.add_argument
    add("--out", type=Path, default=Path("outputs/hand_films"), help="folder to write (default: %(default)s)")
    add("--case", nargs="+", choices=[*CLOTHS, POST], default=[*CLOTHS, POST], help="which (all)")
    add("--samples", type=int, default=2, help="light paths per pixel (2)")
    add("--frames", type=int, help=f"frames of a film ({FRAMES})")
    add("--seed", type=int, default=0, help="of the noise and the shake (0)")
    add("--threads", type=int, default=1, help="threads to render with; 0 for all (1)")
    add("--preview", action="store_true", help="coarse meshes and small pictures")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = parse(argv)
    try:
        require_bpy()
        size = (108, 192) if options.preview else (540, 960)
        video = FitVideo(1, size, 33.0, options.samples, seed=options.seed, threads=options.threads)
        for name in options.case:
            make_case(name, options.out, video, options)
    except (ImportError, ValueError, ArithmeticError) as error:
        print(f"make_hand_films.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
