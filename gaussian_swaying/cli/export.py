"""Convert a splat for other programs, or write the frames of a run: ``gaussian-swaying export outputs/flag flag.usdc``.

With ``--web``, a recorded run becomes a film that a browser plays: ``gaussian-swaying export --web outputs/flag``. With
``--live-web``, a configuration becomes a page that simulates it: ``gaussian-swaying export --live-web flag``.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying import _program as program
from gaussian_swaying._checks import check_positive
from gaussian_swaying.cli.errors import run_command  # first, as it sets up threads
from gaussian_swaying.gaussians.formats import FORMATS, endings, export_cloud, format_of, read_gaussians
from gaussian_swaying.gaussians.spz import WRITTEN
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.player.film.page import write_film, write_player
from gaussian_swaying.simulation.export import export_run

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
    add("--fps", type=float, help="frames a second, by which those of the run can be divided; default: all")
    box = ("X0", "Y0", "Z0", "X1", "Y1", "Z1")
    add("--box", nargs=6, type=float, metavar=box, help="write only the Gaussians that are in this box at rest")
    add("--bones", type=int, help="write a run as one .glb, a skin with so many bones (48 is good for most)")
    add("--proxy", action="store_true", default=None, help="with --bones, write a mesh that moves instead of Gaussians")
    add("--up", nargs=3, type=float, metavar=("X", "Y", "Z"), help="up in the scene, for USD and glTF; default: z")
    add("--metres-per-unit", type=float, help="length of a scene unit [m], for USD and glTF; default: 1")
    add("--spz-version", type=int, choices=WRITTEN, help="of an .spz file; default: 3, which most programs read")
    return parser


def main(arguments: Sequence[str]) -> int:
    """Parse and convert; 2 on bad input."""

    def act() -> None:
        if "--live-web" in arguments:
            from gaussian_swaying.cli.live_web import export_live_web  # a conversion needs no simulation

            export_live_web(arguments)
        else:
            export(build_options().parse_args(arguments))

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
        place: dict[str, Any] = {
            "spz_version": options.spz_version or 3,
            "metres_per_unit": metres,
            "rotation": frame.rotation,
        }
        export_cloud(options.target, read_gaussians(options.source), **place)
        if format.in_metres:
            how, up = "as given", [round(v, 3) + 0.0 for v in frame.rotation[2].tolist()]
            how = "by default" if options.up is None and options.metres_per_unit is None else how
            print(f"up {up}, 1 scene unit = {metres:.6g} m ({how})")
        print(f"wrote {options.target}")
    else:
        own = {name: vars(options)[name] for name in ("fps", "box", "bones")}
        own |= {"apart": bool(options.apart), "proxy": bool(options.proxy), "spz_version": options.spz_version or 3}
        print("\n".join(export_run(Path(options.source), Path(options.target), **own)))
