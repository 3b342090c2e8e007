"""The command line of ``gaussian-swaying preview``: report, picture and a first configuration."""

from __future__ import annotations

import argparse
import json
import sys
import time
from argparse import ArgumentError
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gaussian_swaying import _program as program
from gaussian_swaying.cli.errors import DEVICE, guessing, parser_sentence, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.config.material_names import NAMES
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.gaussians.measures import DIRECTIONS
from gaussian_swaying.geometry.origin import counted_from
from gaussian_swaying.simulation.measure import duration
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.cost import Cost, Stopwatch, estimate_cost
from gaussian_swaying.suggestion.kinds import KINDS
from gaussian_swaying.suggestion.picture import preview_picture
from gaussian_swaying.suggestion.starter import write_starter
from gaussian_swaying.suggestion.suggest import QUALITIES, suggest
from gaussian_swaying.suggestion.suggestion import (
    FRAME_DT,
    PICTURE,
    Suggestion,
    as_plain,
    cost_lines,
    run_lines,
    things_lines,
)
from gaussian_swaying.wind.turbulence import LOOKS

LARGE = 256_000_000  # bytes of a file of which only the constant colours are read
LOADED = time.process_time()  # s; for the interpreter and the imports so far, which a run needs too
SHORT = ("up", "region", "held", "size", "kind", "wind")
"""Guesses that are printed without ``--verbose``."""
OPTIONS = ("up", "hold", "longest_side", "look", "wind", "kind", "material", "quality", "capture", "device")
"""Options that are those of :func:`suggest`."""


def build_options() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = argparse.ArgumentParser(
        prog=program.name("preview"),
        description="Up axis, region, pins, kind, grid and cost of a splat; a picture of them; and a first "
        "configuration.",
    )
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


def suggested(options: argparse.Namespace) -> Suggestion:
    """The suggestion of the options, of a large file without the colours that change with the view."""
    path = Path(options.scene).resolve()  # as in the YAML, so that it warns once
    given = {name: getattr(options, name) for name in OPTIONS}
    if options.up is not None:
        given["up"] = up_of(options.up)
    if options.region is not None:
        given["region"] = (options.region[:3], options.region[3:])
    if options.move is not None:
        given["move"] = _numbers(options.move)
    begin = Stopwatch()
    cloud = read_gaussians(path, 0 if _large(path) else None)
    seconds = begin.quiet
    found = suggest(cloud, **given)
    return replace(found, path=path, seconds=found.seconds + seconds)


def _large(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > LARGE


def preview_scene(options: argparse.Namespace, folder: Path) -> list[str]:
    """Suggest a configuration for a splat, write it with a picture and the numbers, and say what was guessed."""
    import imageio.v3 as iio

    found = suggested(options)
    simulation, cloud = found.simulation, found.cloud
    assert simulation is not None
    cost = estimate_cost(simulation, options.frames, LOADED + found.seconds, cloud=cloud if found.place else None)
    names = write_starter(found, folder, options.frames)
    iio.imwrite(folder / "preview.png", found.picture(options.height))
    things = found.things()
    if things is not None:
        iio.imwrite(folder / "things.png", things)
    told = {name: value for name, value in vars(found).items() if name not in ("cloud", "simulation")}
    _write_numbers(folder, cost, splat=str(options.scene), suggestion=told)
    names = ["preview.json", "preview.png", *(["things.png"] if things is not None else []), *names]
    degree = "only constant colours were read" if _large(Path(options.scene)) else f"SH degree {cloud.sh_degree}"
    lines = [f"{options.scene}: {len(cloud):,} Gaussians{f', {degree}' if options.verbose else ''}"]
    if any(cloud.origin):
        lines.append(f"  origin          {counted_from(cloud.origin)}")
    lines += things_lines(found) if options.verbose else [line for line in things_lines(found) if " moves " in line]
    for name, text in found.reasons.items():
        if options.verbose or (name in SHORT and (name != "region" or found.place is None)):
            lines.append(f"  {name:<16}{text if options.verbose else text.split(';')[0]}")
    if simulation.scene.loose and options.verbose:
        specks = f"{simulation.scene.loose:,} specks hang on nothing or by a thread"
        lines.append(f"  note: {specks}; they follow their nearest neighbours (scene.loose: carry)")
    lines += [f"  {line}" for line in doubts(found)]
    lines += run_lines(simulation) + cost_lines(cost) if options.verbose else []
    film = f"{options.frames * FRAME_DT:.3g} s at {PICTURE[0]} x {PICTURE[1]}"
    where = Path("outputs") / (Path(options.output).name if options.output else splat_name(options.scene))
    lines.append(f"the starter ({film}, {duration(cost.total_seconds)} here):")
    lines.append("  " + program.command("sim", "--config", folder / "starter.yaml", "--output", where))
    return [*lines, _wrote(folder, names, options.verbose)]


def preview_config(options: argparse.Namespace, folder: Path) -> list[str]:
    """Draw what a given configuration does, and say what it simulates and how long it takes."""
    import imageio.v3 as iio

    arguments = [*(item for file in options.config for item in ("--config", file)), "--device", options.device]
    if options.scene is not None:
        arguments += ["--scene.ply", options.scene]
    begin, parser = Stopwatch(), Simulation.parser()
    try:
        with guessing(parser):
            settings = parser.parse_args(arguments)
    except ArgumentError as error:
        raise ValueError(parser_sentence(str(error), arguments)) from error
    simulation = Simulation.from_settings(parser, settings)
    cost = estimate_cost(simulation, simulation.frames_wanted, LOADED + begin.on(simulation.device))
    picture = preview_picture(simulation, options.height)
    folder.mkdir(parents=True, exist_ok=True)
    iio.imwrite(folder / "preview.png", picture)
    _write_numbers(folder, cost)
    return [*run_lines(simulation), *cost_lines(cost), _wrote(folder, ["preview.png", "preview.json"], options.verbose)]


def _wrote(folder: Path, names: Sequence[str], verbose: bool) -> str:
    return f"wrote {', '.join(str(folder / name) for name in names)}" + ("" if verbose else "; --verbose says more")


def _write_numbers(folder: Path, cost: Cost, **more: Any) -> None:
    told = more | {"cost": vars(cost) | {"total_seconds": cost.total_seconds}}
    text = json.dumps(told, indent=1, default=as_plain)
    (folder / "preview.json").write_text(text + "\n", encoding="utf-8")


def doubts(found: Suggestion) -> list[str]:
    """Warnings about guesses that are weak or disappoint, each with the option that replaces it."""
    lines: list[str] = []
    count, box = int(found.moving.simulated.sum()), found.moving.box
    if found.moving.confidence == "low" and box is not None:
        corners = " ".join(f"{value:g}" for corner in box for value in corner)
        what = f"that these {count:,} Gaussians are the object is a weak guess"
        lines.append(f"warning: {what}: check the picture, or give another box than --region {corners}")
    held = f"that it is held at the {found.hold.name} is"
    for name, what, guess in (("up", "the up axis is", found.up), ("hold", held, found.hold)):
        if guess.confidence == "low":
            other = "".join(f"; the next best is --{name} {value}" for value in guess.options[1:])
            lines.append(f"warning: {what} a weak guess: check the picture{other}")
    if found.kind == "rigid":
        lines.append("note: little of it sways; if it hangs, add --kind hanging")
    return lines


def splat_name(path: str | Path) -> str:
    """The name of a splat: that of its file, or of the folder of ``point_cloud.ply`` (training) or ``meta.json`` (SOG).

    Folders ``iteration_30000`` and ``point_cloud``, as 3DGS makes them, are skipped.
    """
    file = Path(path)
    if file.stem not in ("point_cloud", "meta"):
        return file.stem
    folders = [part.name for part in file.resolve().parents]
    passed = ("point_cloud", "iteration_")
    return next((name for name in folders if name and not name.startswith(passed)), file.stem)


def _numbers(move: str) -> list[int]:
    try:
        return list(dict.fromkeys(int(number) for number in move.split(",")))
    except ValueError:
        raise ValueError(f"Expected `--move` to be numbers of things, such as 1 or 1,3, but got {move!r}.") from None


def up_of(values: Sequence[str]) -> list[float] | str:
    """An up direction from the command line."""
    if len(values) == 1:
        return values[0]
    try:
        return [float(value) for value in values]
    except ValueError:
        raise ValueError(f"Expected `--up` to be +x, -x, ... -z or 3 numbers, but got {' '.join(values)}.") from None


def joined(arguments: Sequence[str]) -> list[str]:
    """The command line with ``--up=-y`` for ``--up -y``, where argparse would take -y for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in ("--up", "--hold") and argument in DIRECTIONS:
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def main(arguments: Sequence[str] | None = None) -> int:
    """Preview, print the report and write the files."""
    arguments = joined(sys.argv[1:] if arguments is None else arguments)
    parser = build_options()
    return run_command(
        lambda: _preview(parser.parse_args(with_shipped(arguments, "sim"))),
        stopped="Stopped; nothing was written.",
        memory="a smaller --region, or fewer Gaussians",
        arguments=arguments,
    )


def _preview(options: argparse.Namespace) -> None:
    if options.scene is None and options.config is None:
        raise ValueError("There is nothing to preview: give SCENE.ply, or --config with a scene.")
    given = [name for name in ("capture", "move") if getattr(options, name) is not None]
    if options.config is not None and given:
        raise ValueError(
            f"`--{given[0]}` is for suggestions, and `--config` is shown unchanged: leave out one of them."
        )
    if options.frames < 1:
        raise ValueError(f"Expected `--frames` to be at least 1, but got {options.frames}.")
    if not 64 <= options.height <= 4320:
        raise ValueError(f"Expected `--height` from 64 to 4320 pixels, but got {options.height}.")
    folder = Path(options.output or Path("outputs/preview") / splat_name(options.scene or options.config[-1]))
    print("\n".join((preview_scene if options.config is None else preview_config)(options, folder)))
