"""Convert a splat for other programs, or write the frames of a run: ``gaussian-swaying export outputs/flag flag.usdc``.

With ``--web``, a recorded run becomes a film that a browser plays: ``gaussian-swaying export --web outputs/flag``. With
``--live-web``, a configuration becomes a page that simulates it: ``gaussian-swaying export --live-web flag``.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying import _program as program
from gaussian_swaying._checks import check_positive
from gaussian_swaying._files import atomic
from gaussian_swaying.cli.errors import run_command  # first, as it sets up threads
from gaussian_swaying.gaussians.bones import INFLUENCES, fit_bones
from gaussian_swaying.gaussians.formats import (
    FORMATS,
    Format,
    endings,
    export_cloud,
    export_frames,
    format_of,
    numbered,
    read_gaussians,
)
from gaussian_swaying.gaussians.gltf import encode_skinned_gltf
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.gaussians.spz import WRITTEN
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.player.film.page import write_film, write_player
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.simulation import RecordedRun

TAKEN = {
    "a film": "",
    "the frames of a run": "apart spz_version fps box bones proxy",
    "a splat": "up metres_per_unit spz_version",
}
"""The options of each kind of export; a format may have fewer."""


def build_options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog=program.name("export"), description=__doc__)
    add, known = parser.add_argument, ", ".join(endings(written=True))
    add("source", help=f"a splat ({', '.join(endings())}), or the folder of a run")
    add(
        "target",
        nargs="?",
        help=f"file to write: {known}, for a run, unless it is USD, with # for the digits of the frame, as in "
        "frame_####.spz; or .sway for a film; or with --web .html (default: film.html in the folder of the run)",
    )
    add("--web", action="store_true", help="write a run as a film that a browser plays by itself")
    add("--live-web", action="store_true", help="write a page that simulates; `export --live-web --help` has more")
    add(
        "--player",
        action="store_true",
        help="write what plays .sway files elsewhere into the folder `source`: modules for three.js with Spark and for "
        "PlayCanvas, and the element <gaussian-swaying>, which also shows pages that simulate",
    )
    apart = "write the Gaussians that never move once, with `still` for the number, and the others for each frame"
    add("--apart", action="store_true", default=None, help=apart)
    add(
        "--fps",
        type=float,
        help="frames a second of the export, by which those of the run can be divided; default: all",
    )
    box = ("X0", "Y0", "Z0", "X1", "Y1", "Z1")
    add("--box", nargs=6, type=float, metavar=box, help="write only the Gaussians that are in this box at rest")
    add("--bones", type=int, help="write a run as one .glb, a skin with so many bones (48 is good for most)")
    add("--proxy", action="store_true", default=None, help="with --bones, write a mesh that moves instead of Gaussians")
    add("--up", nargs=3, type=float, metavar=("X", "Y", "Z"), help="up in the scene, for USD and glTF; default: z")
    add("--metres-per-unit", type=float, help="length of a scene unit [m], for USD and glTF; default: 1")
    add("--spz-version", type=int, choices=WRITTEN, help="of an .spz file; default: 3, which most programs read")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Parse and convert; 2 on bad input."""
    given = sys.argv[1:] if arguments is None else arguments

    def act() -> None:
        if "--live-web" in given:
            from gaussian_swaying.cli.live_web import export_live_web  # a conversion needs no simulation

            export_live_web(given)
        else:
            export(build_options().parse_args(given))

    return run_command(act, stopped="Stopped; nothing was written.", memory="fewer Gaussians")


def export(options: argparse.Namespace) -> None:
    """Convert, and report the file."""
    if options.player:
        return print("\n".join(f"wrote {path}" for path in write_player(Path(options.source))))
    plays = options.web or Path(options.target or "").suffix == ".sway"
    if options.target is None and not plays:
        raise ValueError(f"Expected a file to write, whose name ends in one of {', '.join(endings(written=True))}.")
    what = "a film" if plays else "the frames of a run" if Path(options.source).is_dir() else "a splat"
    format = None if plays else FORMATS[format_of(options.target)]
    known = () if format is None else (*format.options, "apart", "fps", "box", *(["up"] if format.in_metres else []))
    known = (*known, "bones", "proxy") if format is FORMATS["glb"] else known
    for name in ("up", "metres_per_unit", "spz_version", "apart", "fps", "box", "bones", "proxy"):
        if vars(options)[name] is not None and name not in {*TAKEN[what].split()}.intersection(known):
            where = f" as {Path(options.target).suffix}" if format else ""
            raise ValueError(f"--{name.replace('_', '-')} is not for {what}{where}: leave it out.")
    place: dict[str, Any] = {"spz_version": options.spz_version or 3}
    if format is None:
        target = Path(options.target or Path(options.source) / "film.html")
        film = write_film(Path(options.source), target)
        print("".join(f"note: {note}\n" for note in film.notes), end="")
        print("{count:,} Gaussians, {frames:,} frames of {nodes:,} nodes".format(**film.head))
        print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)")
    elif what == "a splat":
        metres = 1.0 if options.metres_per_unit is None else options.metres_per_unit
        check_positive("--metres-per-unit", metres)
        frame = SimFrame.fit(torch.zeros(1, 3), options.up or (0.0, 0.0, 1.0), metres_per_unit=metres)
        place |= {"metres_per_unit": metres, "rotation": frame.rotation}
        export_cloud(options.target, read_gaussians(options.source), **place)
        if format.in_metres:
            tell(frame, "by default" if options.up is None and options.metres_per_unit is None else "as given")
        print(f"wrote {options.target}")
    else:
        export_run(options, format, place)


def tell(frame: SimFrame, origin: str) -> None:
    """Print the frame of a file in metres."""
    up = [round(v, 3) + 0.0 for v in frame.rotation[2].tolist()]
    print(f"up {up}, 1 scene unit = {frame.metres_per_unit:.6g} m ({origin})")


def export_run(options: argparse.Namespace, format: Format, place: dict[str, Any]) -> None:
    """Write the frames of a run, and report the files."""
    target, run = Path(options.target), RecordedRun(Path(options.source))
    scene, fps = run.simulation.scene, 1 / run.simulation.frame_dt
    place |= {"metres_per_unit": scene.frame.metres_per_unit, "rotation": scene.frame.rotation}
    every = 1 if options.fps is None else max(round(fps / options.fps), 1) if options.fps > 0 else 0
    if not every or abs(every * (options.fps or fps) - fps) > 1e-6 * fps:
        raise ValueError(
            f"The run has {fps:g} frames a second: --fps {fps / (every or 1):g} is the nearest that can be."
        )
    inside = torch.ones(len(scene.model), dtype=torch.bool)
    if options.box is not None:
        inside = Box(options.box[:3], options.box[3:]).contains(scene.model.means)
    if not bool(inside.any()):
        raise ValueError("--box holds no Gaussian of the run: enlarge it, or leave it out.")
    if options.apart and (options.box is not None or options.bones is not None):
        raise ValueError("--apart cannot be combined with --box or --bones: leave it out.")
    if options.proxy and options.bones is None:
        raise ValueError("--proxy is a mesh that bones move: give their number, as in --bones 48.")
    motion = islice(run.frames(), 0, None, every)
    if options.bones is not None:
        return export_bones(options, target, motion, scene, inside, fps / every, place)
    apart = options.apart and not format.film and not scene.all_move
    frames = (moved.part_to_cloud(True) if apart else moved.to_cloud() for moved in motion)
    frames = frames if options.box is None else (cloud.select(inside) for cloud in frames)
    files = export_frames(target, frames, fps / every, **place)
    if apart:
        still = target.with_name(numbered(target.name, "still"))
        export_cloud(still, scene.rest().part_to_cloud(moving=False), **place)
        print(f"wrote {still}, which never moves")
    if format.in_metres:
        tell(scene.frame, "from the run")
    print(f"wrote {target}, {len(files)} files" if len(files) > 1 else f"wrote {target}")


def export_bones(
    options: argparse.Namespace, target: Path, motion: Iterator[DeformedGaussians], scene: SimulatedScene,
    inside: Tensor, fps: float, place: dict[str, Any],
) -> None:  # fmt: skip
    """Write a run as a skin, and report what it misses."""
    moving = scene.moving[inside[scene.moving]]
    if not 2 <= options.bones <= min(256, len(moving) - 1):
        raise ValueError(f"Expected --bones from 2 to 256, and fewer than the {len(moving):,} Gaussians that move.")
    cloud, rest = scene.model.to_cloud(), scene.model.means[moving].double()
    places = torch.stack([moved.means[moving] for moved in motion])
    bones = fit_bones(rest, places, options.bones)
    error = bones.error(rest, places.double())
    weight = torch.zeros(len(inside), INFLUENCES, dtype=torch.float64)
    index = torch.zeros_like(weight, dtype=torch.long)
    weight[:, 0] = 1.0  # what does not move follows the bone that stays
    index[moving], weight[moving] = bones.index, bones.weight
    bones = replace(bones, index=index[inside], weight=weight[inside])
    del place["spz_version"]
    with atomic(target) as temporary:
        temporary.write_bytes(encode_skinned_gltf(cloud.select(inside), bones, fps, **place, proxy=options.proxy))
    print(f"{options.bones} bones, {error:.2%} of the motion missed")
    if cloud.sh_degree:
        print("note: colours that depend on the direction of view are the same from all sides.")
    print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)")
