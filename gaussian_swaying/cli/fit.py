"""Find the wind and the material from video: ``gaussian-swaying fit FILM --splat SPLAT``, or ``--config FIT.yaml``."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from gaussian_swaying import _program as program
from gaussian_swaying.cli.errors import DEVICE, guessing, run_command
from gaussian_swaying.cli.preview import joined
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.simulation import Simulation

MEMORY = "a smaller `search`, fewer `tracks`, a coarser `solver.dx` or smaller videos"


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    told = "Find the wind and the material of a splat from videos: values, pictures, a configuration for `sim`."
    parser = argparse.ArgumentParser(prog=program.name("fit"), description=told)
    add = parser.add_argument
    add("film", nargs="?", metavar="FILM", help="a film that begins with the object at rest")
    add("--splat", metavar="SPLAT", help="the splat that the film shows")
    add("--length", nargs="+", metavar="LENGTH", help="a known length, NAME METRES: object, a part such as pole, or "
        "X,Y:X,Y, two places in the first frame (pixels); without it, speed and E are not absolute")  # fmt: skip
    add("--up", nargs="+", metavar="UP", help="+x, -x, ... -z or 3 numbers: up in the splat, instead of a guess")
    add("--hold", metavar="END", help="end that is held: top, bottom, none, +x, ... or -z, instead of a guess")
    add("--focal", type=float, metavar="MM", help="focal length as on 35 mm film; else that of its tags, or found")
    add("--config", help="instead of FILM: a YAML file with base, videos, unknowns and, if needed, known; docs/fit.md")
    add("--check", action="store_true", help="only write the files and pictures to look at before the fit")
    add("--output", help="folder for the results; outputs/fits/<name of the film or file> if left out")
    add("--resume", action="store_true", help="with --config: continue the fit in the folder after its last step")
    add("--device", **DEVICE)
    return parser


def main(arguments: Sequence[str]) -> int:
    """Parse and fit.

    Returns:
        0 on success, 2 on bad input or if the video cannot tell the unknowns apart, 130 after Ctrl-C, 143 by SIGTERM.
    """
    arguments = joined(arguments)
    parser, begun = build_parser(), list[str]()

    def after(error: BaseException) -> str | None:
        told = f"All steps that were done are kept. To continue:\n  {begun[0]}" if begun else "Nothing was fitted yet."
        return told if isinstance(error, KeyboardInterrupt) else None

    return run_command(
        lambda: fit(parser.parse_args(arguments), begun), memory=MEMORY, arguments=arguments, advice=after
    )


def fit(options: argparse.Namespace, begun: list[str]) -> int:
    """Fit and print the table; the command that continues the fit is put into ``begun`` once it can."""
    from gaussian_swaying.inverse.fit import OURS, check_fit, run_fit
    from gaussian_swaying.inverse.from_film import RESULT, prepare
    from gaussian_swaying.inverse.plan import read_plan

    _check(options)
    with stop_signals():
        if options.film is None:
            file = Path(with_shipped(["--config", options.config], "fit")[1])
            folder = Path(options.output or Path("outputs") / "fits" / file.stem)
        else:
            whole = Path(options.output or Path("outputs") / "fits" / Path(options.film).stem)
            given = [getattr(options, name) for name in ("up", "hold", "focal", "device")]
            folder, length = whole / RESULT, _length(options.length)
            file = prepare(options.film, options.splat, whole, length, *given)
            print(f"wrote {file}", flush=True)
        again = program.command("fit", "--config", options.config or file, "--output", folder)
        plan = read_plan(file, lambda name: with_shipped(["--config", name], "sim")[1])
        with guessing(Simulation.parser()):
            if options.check:
                for path in check_fit(plan, folder, device=options.device):
                    print(f"wrote {path}")
                print(f"to fit:\n  {again}")
                return 0
            going: dict[str, Any] = {"resume": options.resume, "device": options.device, "in_use": [file]}
            result = run_fit(plan, folder, started=lambda: begun.append(f"{again} --resume"), **going)
    print("\n".join([result.text(), *(f"wrote {folder / name}" for name in OURS[1:])]))
    return 0


def _length(given: Sequence[str] | None) -> Any:
    if given is None:
        return None
    metres = " ".join(given[1:]) or "nothing"
    value = math.nan
    with suppress(ValueError):
        value = float(metres)
    if not 0 < value < math.inf:
        raise ValueError(
            f"Expected `--length` to be a name and a length in metres, such as pole 2.4, but got {metres}."
        )
    return given[0], value


def _check(options: argparse.Namespace) -> None:
    if (options.film is None) == (options.config is None):
        raise ValueError("Expected either a film, as in `fit film.mp4 --splat my.ply`, or `--config` with a fit file.")
    given = [name for name in ("splat", "length", "up", "hold", "focal") if getattr(options, name) is not None]
    if options.film is None and given:
        raise ValueError(f"`--{given[0]}` is for a film, and the file of `--config` says it: leave out one of them.")
    if options.film is not None and options.splat is None:
        raise ValueError(f"There is no splat for {options.film}: add --splat my.ply.")
    if options.film is not None and options.resume:
        raise ValueError("`--resume` continues the fit of a file: give the fit file with --config, and --output.")
    if options.resume and options.check:
        raise ValueError("`--check` stops before a fit, and `--resume` continues one: leave out one of them.")
