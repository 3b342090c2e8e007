"""Find the wind and the material from video: ``gaussian-swaying fit --config FIT.yaml``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gaussian_swaying import _program as program
from gaussian_swaying.cli.errors import command, guessing, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.runs.signals import stop_signals
from gaussian_swaying.simulation.simulation import Simulation

MEMORY = "a smaller `search`, fewer `tracks`, a coarser `solver.dx` or smaller videos"


def build_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(
        prog=program.name("fit"),
        description="Find the wind and the material of a splat from videos of its motion: a table of values with "
        "errors, pictures of what is left, and a configuration for `sim`.",
    )
    add = parser.add_argument
    add("--config", required=True, help="YAML file with base, videos, unknowns and, if needed, known; docs/fit.md")
    add("--output", help="folder for the results; outputs/fits/<name of the file> if left out")
    add("--resume", action="store_true", help="continue the fit in the folder after its last iteration")
    add("--device", default="auto", choices=("auto", "cpu", "cuda"), help="auto takes a GPU if there is one")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and fit.

    Returns:
        0 on success, 2 on bad input or if the video cannot tell the unknowns apart, 130 if stopped with Ctrl-C, 143 by
        SIGTERM. With ``GAUSSIAN_SWAYING_DEBUG=1`` errors keep their traceback.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = build_parser()
    begun: list[Path] = []

    def advice(error: BaseException) -> str | None:
        """Return the command that continues the fit, if the user stopped it."""
        stopped = isinstance(error, KeyboardInterrupt) and begun and (begun[0] / "fit.json").exists()
        return f"To continue it:\n  {command(arguments, '--resume')}" if stopped else None

    return run_command(
        lambda: fit(parser.parse_args(arguments), begun),
        stopped="Stopped; the last complete iteration is kept.",
        memory=MEMORY,
        arguments=arguments,
        advice=advice,
    )


def fit(options: argparse.Namespace, begun: list[Path]) -> int:
    """Fit and print the table; the folder is put into ``begun`` once it is the fit's."""
    from gaussian_swaying.fitting.fit import OURS, run_fit
    from gaussian_swaying.fitting.plan import read_plan

    file = Path(with_shipped(["--config", options.config], "fit")[1])
    plan = read_plan(file, lambda name: with_shipped(["--config", name], "sim")[1])
    folder = Path(options.output or Path("outputs") / "fits" / file.stem)
    with guessing(Simulation.parser()), stop_signals():
        result = run_fit(
            plan, folder, resume=options.resume, device=options.device, started=lambda: begun.append(folder)
        )
    print(result.text())
    for name in OURS[1:]:
        print(f"wrote {folder / name}")
    return 0
