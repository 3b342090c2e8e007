"""The command line of ``gaussian-swaying preview``: report, picture and a first configuration."""

from __future__ import annotations

import argparse
import time
from argparse import ArgumentError
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gaussian_swaying import _program as program
from gaussian_swaying.cli.errors import DEVICE, guessing, parser_sentence, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.config.material_names import NAMES
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.measures import DIRECTIONS
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.cost import Stopwatch
from gaussian_swaying.suggestion.kinds import KINDS
from gaussian_swaying.suggestion.starter import splat_name, write_config_preview, write_preview
from gaussian_swaying.suggestion.suggest import QUALITIES, suggest
from gaussian_swaying.wind.turbulence import LOOKS

LARGE = 256_000_000  # bytes of a file of which only the constant colours are read
LOADED = time.process_time()  # s; for the interpreter and the imports so far, which a run needs too
OPTIONS = ("up", "hold", "longest_side", "look", "wind", "kind", "material", "quality", "capture", "device")
"""Options that are those of :func:`suggest`."""


def build_options() -> argparse.ArgumentParser:
    """The options of the command."""
    told = "Up axis, region, pins, kind, grid and cost of a splat; a picture of them; and a first configuration."
    parser = argparse.ArgumentParser(prog=program.name("preview"), description=told)
    add = parser.add_argument
    add("scene", nargs="?", metavar="SCENE.ply", help="the splat; may be left out if --config names one")
    add("--config", action="append", metavar="FILE", help="show what this configuration does, instead of guessing one")
    add("--capture", metavar="DIR", help="cameras of the photos (COLMAP or transforms.json): they show up and object")
    add("--output", metavar="DIR", help="folder of the results; default: outputs/preview/<name of the splat>")
    add("--up", nargs="+", metavar="UP", help="+x, -x, ... -z or 3 numbers, instead of a guess")
    add("--hold", metavar="END", help="end that is held: top, bottom, none, +x, -x, ... or -z, instead of a guess")
    add("--region", nargs=6, type=float, metavar="V", help="box to simulate: lower and upper corner [scene units]")
    add("--move", metavar="N[,M]", help="things of a place that move, by their numbers; default: the likeliest one")
    add("--longest-side", type=float, metavar="M", help="length of the longest side [m]; default: usual for its kind")
    add("--look", default="breeze", choices=tuple(LOOKS), help="mean speed and turbulence (default: breeze)")
    add("--wind", type=float, metavar="M/S", help="mean speed of the wind [m/s], instead of that of the look")
    add("--kind", choices=tuple(KINDS), help="what it is, which decides frequency, mass and damping; default: a guess")
    add("--material", metavar="NAME", help=f"the numbers of a material, instead of those of its kind: {NAMES}")
    add("--frames", type=int, default=250, help="frames of the configuration")
    add("--quality", default="normal", metavar="Q", help=f"grid: {', '.join(QUALITIES)} (default: normal)")
    add("--verbose", action="store_true", help="print all numbers and reasons, not only what was guessed")
    add("--height", type=int, default=540, help="height of the picture [pixels]")
    add("--device", **DEVICE)
    return parser


def main(arguments: Sequence[str]) -> int:
    """Preview, print the report and write the files."""
    arguments = joined(arguments)
    parser = build_options()
    return run_command(
        lambda: print("\n".join(_preview(parser.parse_args(with_shipped(arguments, "sim"))))),
        stopped="Stopped; nothing was written.",
        memory="a smaller --region, or fewer Gaussians",
        arguments=arguments,
    )


def joined(arguments: Sequence[str]) -> list[str]:
    """The command line with ``--up=-y`` for ``--up -y``, where argparse would take -y for an option."""
    words: list[str] = []
    for argument in arguments:
        if words and words[-1] in ("--up", "--hold") and argument in DIRECTIONS:
            words[-1] += f"={argument}"
        else:
            words.append(argument)
    return words


def _preview(options: argparse.Namespace) -> list[str]:
    if options.scene is None and options.config is None:
        raise ValueError("There is nothing to preview: give SCENE.ply, or --config with a scene.")
    for name in ("capture", "move"):
        if options.config is not None and getattr(options, name) is not None:
            raise ValueError(
                f"`--{name}` is for suggestions, and `--config` is shown unchanged: leave out one of them."
            )
    if options.frames < 1:
        raise ValueError(f"Expected `--frames` to be at least 1, but got {options.frames}.")
    if not 64 <= options.height <= 4320:
        raise ValueError(f"Expected `--height` from 64 to 4320 pixels, but got {options.height}.")
    folder = Path(options.output or Path("outputs/preview") / splat_name(options.scene or options.config[-1]))
    told, begin = (folder, options.height, options.verbose), Stopwatch()
    if options.config is not None:
        words = [*(word for file in options.config for word in ("--config", file)), "--device", options.device]
        words += [] if options.scene is None else ["--scene.ply", options.scene]
        parser = Simulation.parser()
        try:
            with guessing(parser):
                settings = parser.parse_args(words)
        except ArgumentError as error:
            raise ValueError(parser_sentence(str(error), words)) from error
        simulation = Simulation.from_settings(parser, settings)
        return write_config_preview(simulation, *told, LOADED + begin.on(simulation.device))
    given = {name: getattr(options, name) for name in OPTIONS}
    if options.region is not None:
        given["region"] = (options.region[:3], options.region[3:])
    if options.move is not None:
        try:
            given["move"] = list(dict.fromkeys(map(int, options.move.split(","))))
        except ValueError:
            told_move = f"Expected `--move` to be numbers of things, such as 1 or 1,3, but got {options.move!r}."
            raise ValueError(told_move) from None
    path = Path(options.scene).resolve()  # as in the YAML, so that it warns once
    large = path.is_file() and path.stat().st_size > LARGE
    cloud, seconds = read_gaussians(path, 0 if large else None), begin.quiet
    found = suggest(cloud, **given)
    found = replace(found, path=path, seconds=found.seconds + seconds)
    return write_preview(found, options.scene, *told, options.frames, LOADED, large)
