"""Convert a splat for viewers: ``gaussian-swaying export scene.ply scene.splat``, or the ``ply`` folder of a run.

With ``--web``, a recorded run becomes a film that a browser plays: ``gaussian-swaying export --web outputs/flag``. With
``--live-web``, a configuration becomes a page that simulates it: ``gaussian-swaying export --live-web flag``.
"""

import argparse
import json
import sys
from pathlib import Path

import torch

from gaussian_swaying import _program as program
from gaussian_swaying._checks import check_positive
from gaussian_swaying.cli.errors import run_command  # first, as it sets up threads
from gaussian_swaying.gaussians.export import SUFFIXES, convert, format_of
from gaussian_swaying.gaussians.formats import READABLE
from gaussian_swaying.gaussians.spz import VERSIONS
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.viewer.film.page import write_film


def build_options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog=program.name("export"), description=__doc__)
    parser.add_argument(
        "source",
        help=f"A {READABLE}; or a folder of .ply for an animated USD or numbered files; with --web the folder of a"
        " run.",
    )
    parser.add_argument(
        "target",
        nargs="?",
        help=f"File to write; its name ends in one of {', '.join(SUFFIXES.values())}, for a folder with # for the "
        "digits of the frame, as in frame_####.spz; or with --web in .html (default: film.html in the folder of the "
        "run).",
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
    parser.add_argument("--fps", type=float, help="Frames per second of a folder; default: those of its run, or 25.")
    parser.add_argument(
        "--up",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="Direction in the scene that points up, for USD and glTF; default: that of the run that wrote the source,"
        " or z.",
    )
    parser.add_argument(
        "--metres-per-unit",
        type=float,
        help="Length of a scene unit [m], for USD and glTF; default: that of the run that wrote the source, or 1.",
    )
    parser.add_argument(
        "--spz-version",
        type=int,
        choices=VERSIONS,
        help="Version of an .spz file; default: 3, which most programs read.",
    )
    return parser


def run_of(source: Path) -> Path | None:
    """The summary of the run that wrote a splat or a folder of splats; None if they are not from a run."""
    for folder in (source.parent, source.parent.parent):
        if (folder / "summary.json").is_file() and (folder / "run.json").is_file():
            return folder / "summary.json"
    return None


def still_of(source: Path) -> Path | None:
    """The file with what never moves, beside a folder of frames that a run wrote; None if there is none."""
    file = source.parent / f"still{SUFFIXES.get(source.name)}"
    return file if source.is_dir() and run_of(source) is not None and file.is_file() else None


def placement(options: argparse.Namespace) -> tuple[float, SimFrame, str]:
    """Frames per second, frame and the source of both, for a USD or glTF file."""
    if options.metres_per_unit is not None:
        check_positive("--metres-per-unit", options.metres_per_unit)
    fps, frame, origin = 25.0, SimFrame(torch.zeros(3), torch.eye(3, dtype=torch.float64), 1.0), "by default"
    summary = run_of(Path(options.source).resolve())
    given = [options.up is not None, options.metres_per_unit is not None]
    if summary is not None and not (all(given) and options.fps is not None):
        try:
            known = json.loads(summary.read_text(encoding="utf-8"))
            frame, fps = SimFrame.from_summary(known), 1 / float(known["frame_dt_s"])
        except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError) as error:
            raise ValueError(
                f"{summary} cannot be used ({error}): set --up, --metres-per-unit and --fps instead."
            ) from error
        origin = f"from {summary.name} of the run"
    metres = frame.metres_per_unit if options.metres_per_unit is None else options.metres_per_unit
    if options.up is not None:
        frame = SimFrame.fit(torch.zeros(1, 3), options.up, metres_per_unit=metres)
    if any(given):
        origin = "as given" if all(given) else f"as given, the rest {origin}"
    return options.fps or fps, SimFrame(frame.origin, frame.rotation, metres), origin


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
    if options.fps is not None:
        check_positive("--fps", options.fps)
    if options.web:
        export_web(options)
        return
    if options.target is None:
        raise ValueError(f"Expected a file to write, whose name ends in one of {', '.join(SUFFIXES.values())}.")
    format, still = format_of(options.target), still_of(Path(options.source).resolve())
    if format != "spz" and options.spz_version is not None:
        raise ValueError("--spz-version is only for .spz files: leave it out.")
    if format not in ("usd", "glb"):
        if options.up is not None or options.metres_per_unit is not None:
            raise ValueError(
                "--up and --metres-per-unit are only for USD and glTF, as other formats have no up direction: leave "
                "them out, or use a target that ends in .usdc or .glb."
            )
        convert(options.source, options.target, spz_version=options.spz_version or 3, still=still)
    else:
        fps, frame, origin = placement(options)
        convert(options.source, options.target, fps, frame.metres_per_unit, frame.rotation, still=still)
        up = [round(v, 3) + 0.0 for v in frame.rotation[2].tolist()]
        print(f"up {up}, 1 scene unit = {frame.metres_per_unit:.6g} m ({origin})")
    print(f"wrote {options.target}")


def export_web(options: argparse.Namespace) -> None:
    """Write the film of a run, and report its size."""
    given = {"--fps": options.fps, "--up": options.up, "--metres-per-unit": options.metres_per_unit}
    given["--spz-version"] = options.spz_version
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"{name} is not for --web, which takes it from the run: leave it out.")
    run = Path(options.source)
    target = run / "film.html" if options.target is None else Path(options.target)
    film = write_film(run, target)
    if film.notes:
        print("\n".join(f"note: {note}" for note in film.notes))
    head = film.head
    print(f"{head['count']:,} Gaussians, {head['frames']:,} frames of {head['nodes']:,} nodes")
    print(f"wrote {target} ({target.stat().st_size / 1e6:.1f} MB)")
