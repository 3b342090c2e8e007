"""Convert a splat for other programs, or write the frames of a run: ``gaussian-swaying export outputs/flag flag.usdc``.

With ``--web``, a recorded run becomes a film that a browser plays: ``gaussian-swaying export --web outputs/flag``. With
``--live-web``, a configuration becomes a page that simulates it: ``gaussian-swaying export --live-web flag``.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import torch

from gaussian_swaying import _program as program
from gaussian_swaying._checks import check_positive
from gaussian_swaying.cli.errors import run_command  # first, as it sets up threads
from gaussian_swaying.gaussians.formats import (
    FORMATS,
    endings,
    export_cloud,
    export_frames,
    format_of,
    numbered,
    read_gaussians,
)
from gaussian_swaying.gaussians.spz import VERSIONS
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.player.film.page import write_film, write_player
from gaussian_swaying.simulation.simulation import RecordedRun


def build_options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog=program.name("export"), description=__doc__)
    parser.add_argument(
        "source",
        help=f"A splat ({', '.join(endings())}); or the folder of a run, for its frames as splats or, with --web, as a "
        "page.",
    )
    parser.add_argument(
        "target",
        nargs="?",
        help=f"File to write; its name ends in one of {', '.join(endings(written=True))}, for a run, unless it is USD, "
        "with # for the digits of the frame, as in frame_####.spz; or .sway for a film; or with "
        "--web .html (default: film.html in the folder of the run).",
    )
    parser.add_argument(
        "--web",
        action="store_true",
        help="Write the run in the folder `source` as a film that a browser plays by itself.",
    )
    parser.add_argument(
        "--live-web",
        action="store_true",
        help="Write the scene `source` as a page that simulates it in a browser; `export --live-web --help` has its "
        "options.",
    )
    parser.add_argument(
        "--player",
        action="store_true",
        help="Write what plays .sway files elsewhere into the folder `source`: modules for three.js with Spark "
        "and for PlayCanvas, and the element <gaussian-swaying>, which also shows pages that simulate.",
    )
    parser.add_argument(
        "--apart",
        action="store_true",
        help="Write the Gaussians of a run that never move once, with `still` for the number, and the others for each "
        "frame.",
    )
    parser.add_argument(
        "--up",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="Direction in the scene that points up, for USD and glTF; default: that of the run, or z.",
    )
    parser.add_argument(
        "--metres-per-unit",
        type=float,
        help="Length of a scene unit [m], for USD and glTF; default: that of the run, or 1.",
    )
    parser.add_argument(
        "--spz-version",
        type=int,
        choices=VERSIONS,
        help="Version of an .spz file; default: 3, which most programs read.",
    )
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
    given = {"--up": options.up, "--metres-per-unit": options.metres_per_unit}
    if options.web or Path(options.target or "").suffix == ".sway":
        refuse("a film", given | {"--spz-version": options.spz_version, "--apart": options.apart or None})
        return export_web(options)
    if options.target is None:
        raise ValueError(f"Expected a file to write, whose name ends in one of {', '.join(endings(written=True))}.")
    format = FORMATS[format_of(options.target)]
    if "spz_version" not in format.options and options.spz_version is not None:
        raise ValueError("--spz-version is only for .spz files: leave it out.")
    if Path(options.source).is_dir():
        refuse("a run", given)
        return export_run(options)
    if options.apart:
        raise ValueError("--apart is only for the frames of a run: leave it out.")
    if not format.in_metres and any(value is not None for value in given.values()):
        raise ValueError(
            "--up and --metres-per-unit are only for USD and glTF, as other formats have no up direction: leave them "
            "out, or use a target that ends in .usdc or .glb."
        )
    metres = 1.0 if options.metres_per_unit is None else options.metres_per_unit
    check_positive("--metres-per-unit", metres)
    frame = SimFrame.fit(torch.zeros(1, 3), options.up or (0.0, 0.0, 1.0), metres_per_unit=metres)
    place: dict[str, Any] = {"metres_per_unit": metres, "rotation": frame.rotation}
    export_cloud(options.target, read_gaussians(options.source), spz_version=options.spz_version or 3, **place)
    if format.in_metres:
        tell(frame, "as given" if any(given.values()) else "by default")
    print(f"wrote {options.target}")


def refuse(what: str, given: dict[str, Any]) -> None:
    """Raise ValueError if an option was given that only other exports have."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"{name} is not for {what}, which needs none: leave it out.")


def tell(frame: SimFrame, origin: str) -> None:
    """Print the frame of a file in metres."""
    up = [round(v, 3) + 0.0 for v in frame.rotation[2].tolist()]
    print(f"up {up}, 1 scene unit = {frame.metres_per_unit:.6g} m ({origin})")


def export_run(options: argparse.Namespace) -> None:
    """Write the frames of a run, and report the files."""
    target, format = Path(options.target), FORMATS[format_of(options.target)]
    run = RecordedRun(Path(options.source))
    frame, fps = run.simulation.scene.frame, 1 / run.simulation.frame_dt
    place: dict[str, Any] = {"metres_per_unit": frame.metres_per_unit, "rotation": frame.rotation}
    place["spz_version"] = options.spz_version or 3
    still = target.with_name(numbered(target.name, "still"))
    apart = options.apart and not format.film and not run.simulation.scene.all_move
    frames = (moved.part_to_cloud(moving=True) if apart else moved.to_cloud() for moved in run.frames())
    files = export_frames(target, frames, fps, **place)
    if apart:
        export_cloud(still, run.simulation.scene.rest().part_to_cloud(moving=False), **place)
        print(f"wrote {still}, which never moves")
    if format.in_metres:
        tell(frame, "from the run")
    print(f"wrote {target}, {len(files)} files" if len(files) > 1 else f"wrote {target}")


def export_web(options: argparse.Namespace) -> None:
    """Write the film of a run, and report its size."""
    run = Path(options.source)
    target = run / "film.html" if options.target is None else Path(options.target)
    film = write_film(run, target)
    if film.notes:
        print("\n".join(f"note: {note}" for note in film.notes))
    head = film.head
    print(f"{head['count']:,} Gaussians, {head['frames']:,} frames of {head['nodes']:,} nodes")
    print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)")
