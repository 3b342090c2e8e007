"""The command line of ``gaussian-swaying preview``: report, picture and a first configuration."""

from __future__ import annotations

import argparse
import sys
import time
from argparse import ArgumentError
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gaussian_swaying import _program as program
from gaussian_swaying._checks import check_positive
from gaussian_swaying.cli.errors import guessing, parser_sentence, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.config.material_names import NAMES
from gaussian_swaying.config.parser import parse_text
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.preview.apart import why_apart
from gaussian_swaying.preview.cost import (
    Cost,
    Stopwatch,
    estimate_cost,
    finest_within,
    scaled_seconds,
    with_whole,
)
from gaussian_swaying.preview.kinds import KINDS
from gaussian_swaying.preview.photos import captured_from
from gaussian_swaying.preview.picture import preview_picture, things_picture
from gaussian_swaying.preview.place import Place, excerpt, near_things, sky, survey
from gaussian_swaying.preview.report import (
    area_line,
    cost_dict,
    cost_lines,
    doubts,
    place_dict,
    place_lines,
    quality_lines,
    run_dict,
    run_lines,
    shortened,
    splat_lines,
    suggestion_dict,
    suggestion_lines,
)
from gaussian_swaying.preview.results import Preview, splat_name, write
from gaussian_swaying.preview.shape import DIRECTIONS, bounds
from gaussian_swaying.preview.starter import FRAME_DT, PICTURE, starter_yaml
from gaussian_swaying.preview.suggest import (
    QUALITIES,
    Suggestion,
    as_its_kind,
    at_quality,
    finest_spacing,
    gaussian_statistics,
    of_material,
    suggest,
)
from gaussian_swaying.simulation.measure import duration
from gaussian_swaying.simulation.simulation import Simulation, classify
from gaussian_swaying.wind.turbulence import LOOKS

LARGE = 256_000_000  # bytes of a file of which only the constant colours are read
LOADED = time.process_time()  # s; for the interpreter and the imports so far, which a run needs too


def build_options() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = argparse.ArgumentParser(
        prog=program.name("preview"),
        description="Bounds, up axis, Gaussians, region, pins, grid and cost of a splat; a picture of them; and a "
        "first configuration.",
    )
    add = parser.add_argument
    add("scene", nargs="?", metavar="SCENE.ply", help="the splat; may be left out if --config names one")
    add(
        "--config",
        action="append",
        metavar="FILE",
        help="show what this configuration does, instead of guessing one; may be given several times, as for sim.py",
    )
    add(
        "--capture",
        metavar="DIR",
        help="cameras of the photos (COLMAP or transforms.json), to find up and the object",
    )
    add("--output", metavar="DIR", help="folder of the results; default: outputs/preview/<name of the splat>")
    add("--up", nargs="+", metavar="UP", help="+x, -x, ... -z or 3 numbers, instead of a guess")
    add("--hold", metavar="END", help="end that is held: top, bottom, none, +x, -x, ... or -z, instead of a guess")
    add("--region", nargs=6, type=float, metavar="V", help="box to simulate: lower and upper corner [scene units]")
    add("--move", metavar="N[,M]", help="things of a place that move, by their numbers; default: the likeliest one")
    add("--longest-side", type=float, metavar="M", help="length of the longest side [m]; default: usual for its kind")
    add(
        "--look", default="breeze", choices=tuple(LOOKS), help="mean speed and turbulence of the wind (default: breeze)"
    )
    add("--wind", type=float, metavar="M/S", help="mean speed of the wind [m/s], instead of that of the look")
    add("--kind", choices=tuple(KINDS), help="what it is, which decides frequency, mass and damping; default: a guess")
    add(
        "--connected",
        default="auto",
        choices=("auto", "grid", "surface"),
        help="what shares nodes of the grid: with surface, leaves closer than a cell move apart; auto: for a plant "
        "with such leaves",
    )
    add("--material", metavar="NAME", help=f"the numbers of a material, instead of those of its kind: {NAMES}")
    add("--frames", type=int, default=250, help="frames of the configuration")
    add("--quality", metavar="Q", help=f"grid of the starter: {', '.join(QUALITIES)}; default: normal")
    add("--minutes", type=float, metavar="N", help="instead: the finest grid whose run takes at most this long here")
    add("--verbose", action="store_true", help="print all numbers and reasons, not only what was guessed")
    add("--height", type=int, default=540, help="height of the picture [pixels]")
    add("--device", default="auto", choices=("auto", "cpu", "cuda"), help="auto takes a GPU if there is one")
    return parser


def preview_scene(options: argparse.Namespace, folder: Path) -> Preview:
    """Suggest a configuration for a splat, find the numbers with which it sways as its kind does, and draw it.

    Args:
        options: From :func:`build_options`.
        folder: Folder where the configurations will be, for the report.

    Returns:
        The preview.
    """
    path = Path(options.scene).resolve()  # as in the YAML, so that it warns once
    reading = Stopwatch()
    large = path.is_file() and path.stat().st_size > LARGE
    cloud = read_gaussians(path, 0 if large else None)
    read = reading.quiet
    up = None if options.up is None else up_of(options.up)
    region = None if options.region is None else (options.region[:3], options.region[3:])
    capture = None if options.capture is None else captured_from(options.capture, cloud.origin)
    quality = options.quality or "normal"
    if options.move is not None and region is not None:
        raise ValueError("`--move` and `--region` both choose what moves: leave out one of them.")
    place = None
    if region is None and capture is None:
        place = survey(cloud, up)
    elif options.move is not None and capture is not None:  # otherwise it is the object that the photos show
        place = survey(cloud, up or capture.up, capture.cameras)
    chosen = _numbers(options.move, place)
    part: GaussianCloud = cloud
    found, around = None, None
    if place is not None:
        part, upward, guess = excerpt(place, cloud, chosen)
        found, around = (upward, guess), near_things(place, cloud, chosen)
    elif region is None and capture is None and bool((far := sky(cloud)).any()):
        part, around = cloud.select(~far), ~far
    suggestion = suggest(
        part, up, options.hold, region, options.longest_side, options.wind, capture, quality, found, options.look,
        options.kind, around is not None,
    )  # fmt: skip
    if options.material is not None:
        suggestion = of_material(suggestion, options.material)
    leafy = suggestion.kind in ("plant", "succulent")  # whose leaves are seen one by one
    wanted = ("surface" if leafy else "grid") if options.connected == "auto" else options.connected
    suggestion = replace(suggestion, connected=wanted)
    begin = Stopwatch()

    def build(of: Suggestion) -> tuple[Simulation, Any]:
        return _tried(of, lambda own: starter_yaml(own, options.scene, options.frames), options.device, part)

    simulation, settings = build(suggestion)
    if options.connected == "auto" and wanted == "surface":
        why = why_apart(simulation.scene, suggestion.dx, classify(simulation).pinned)
        suggestion = replace(suggestion, connected_reason=why or "", connected="grid" if why is None else "surface")
        if why is None:
            simulation, settings = build(suggestion)
    made = {suggestion.dx: _natural(suggestion, simulation, build)}  # the starter with several grids
    startup = LOADED + read + begin.quiet
    if settings.scene.ply != str(Path(options.scene).resolve()):
        raise ValueError(f"The path {options.scene!r} has another meaning in YAML: rename the file, without a colon.")

    def measure(dx: float) -> Cost:
        if dx not in made:
            finer = replace(suggestion, dx=dx)
            made[dx] = _natural(finer, build(finer)[0], build)
        cost = estimate_cost(made[dx][1], options.frames, startup)
        return cost if part is cloud else with_whole(cost, made[dx][1], cloud)

    cost = measure(suggestion.dx)
    grids = {name: at_quality(suggestion, name).dx for name in QUALITIES}
    chosen_quality = suggestion.quality
    if options.minutes is not None:
        wish, finest = 60 * options.minutes, finest_spacing(suggestion)
        cost = finest_within(measure, wish, cost, finest, grids["draft"])
        chosen_quality = f"--minutes {options.minutes:g}"
    suggestion, simulation = made[cost.dx]
    suggestion = replace(suggestion, quality=chosen_quality)
    parts = suggestion.parts
    if parts is not None:
        if around is not None:
            parts = parts.within(around)
        suggestion = replace(suggestion, parts=replace(parts, path=str((folder / "parts.npz").resolve())))
    text = starter_yaml(suggestion, options.scene, options.frames)
    others = {name: scaled_seconds(cost, cost, dx) for name, dx in grids.items() if name != suggestion.quality}
    data: dict[str, Any] = {
        "splat": str(options.scene),
        "bounds": bounds(cloud.means),
        "gaussians": gaussian_statistics(cloud) | ({"sh_degree": None} if large else {}),
        "suggestion": suggestion_dict(suggestion),
        "run": run_dict(simulation),
        "cost": cost_dict(cost),
        "qualities": {name: {"dx_m": grids[name], "total_seconds": time} for name, time in others.items()},
    }
    report = splat_lines(options.scene, cloud, data)
    things = None
    if place is not None:
        data["place"] = place_dict(place, chosen)
        report += place_lines(place, chosen)
        things = things_picture(cloud, place, chosen, simulation.device)
    report += [*suggestion_lines(suggestion, simulation.scene.further)]
    report.append(area_line(data["run"]))
    if simulation.scene.loose:
        specks = f"{simulation.scene.loose:,} specks hang on nothing or by a thread"
        report.append(f"  note: {specks}; they follow their nearest neighbours (scene.loose: carry)")
    report += [f"  {line}" for line in doubts(suggestion, options, build_options().parse_args([]))]
    report += cost_lines(cost)
    report += quality_lines(suggestion, cost, options.minutes, grids, others)
    where = Path("outputs") / splat_name(options.scene)
    film = f"{options.frames * FRAME_DT:.3g} s at {PICTURE[0]} x {PICTURE[1]}"
    report += ["", f"the starter ({film}, {duration(cost.total_seconds)} here):"]
    report.append("  " + program.command("sim", "--config", folder / "starter.yaml", "--output", where))
    picture = preview_picture(simulation, options.height, whole=suggestion.whole)
    labels = None if suggestion.parts is None else suggestion.parts.parts
    return Preview("\n".join(report), data, picture, text, things, labels)


def preview_config(options: argparse.Namespace) -> Preview:
    """Preview a given configuration.

    Args:
        options: From :func:`build_options`, with ``config``.

    Returns:
        The preview.
    """
    arguments = [*(item for file in options.config for item in ("--config", file)), "--device", options.device]
    if options.scene is not None:
        arguments += ["--scene.ply", options.scene]
    begin = Stopwatch()
    simulation, _ = _pipeline(arguments)
    startup = LOADED + begin.quiet
    cost = estimate_cost(simulation, simulation.frames_wanted, startup)
    cloud = simulation.scene.model.to_cloud().to("cpu")
    data: dict[str, Any] = {
        "config": options.config,
        "splat": None if options.scene is None else str(options.scene),
        "bounds": bounds(cloud.means),
        "gaussians": gaussian_statistics(cloud),
        "run": run_dict(simulation),
        "cost": cost_dict(cost),
    }
    report = [
        *splat_lines(options.scene or options.config[-1], cloud, data),
        *run_lines(data["run"]),
        *cost_lines(cost),
    ]
    return Preview("\n".join(report), data, preview_picture(simulation, options.height))


def _natural(
    suggestion: Suggestion, simulation: Simulation, build: Callable[[Suggestion], tuple[Simulation, Any]]
) -> tuple[Suggestion, Simulation]:
    suggestion = as_its_kind(suggestion, simulation)
    if suggestion.sways and not suggestion.by_modes:
        simulation = build(suggestion)[0]
    return suggestion, simulation


def _tried(
    suggestion: Suggestion, text: Callable[[Suggestion], str], device: str, cloud: GaussianCloud
) -> tuple[Simulation, Any]:
    """The simulation of the configuration of a suggestion for some Gaussians, and its settings; it leaves no file."""
    with TemporaryDirectory() as scratch:
        if suggestion.parts is not None:
            path = suggestion.parts.parts.save(Path(scratch) / "parts.npz")
            suggestion = replace(suggestion, parts=replace(suggestion.parts, path=str(path)))
        return _pipeline(["--device", device], text(suggestion), cloud)


def _numbers(move: str | None, place: Place | None) -> list[int]:
    if move is None:
        return [1]
    if place is None:
        raise ValueError("`--move` chooses things of a place, and this splat is one object: leave it out.")
    try:
        return list(dict.fromkeys(int(number) for number in move.split(",")))
    except ValueError:
        raise ValueError(f"Expected `--move` to be numbers of things, such as 1 or 1,3, but got {move!r}.") from None


def _pipeline(
    arguments: list[str], text: str | None = None, cloud: GaussianCloud | None = None
) -> tuple[Simulation, Any]:
    """The simulation of a configuration, given by options or as text, and its settings; of some Gaussians of it."""
    parser = Simulation.parser()
    try:
        with guessing(parser):
            settings = parser.parse_args(arguments) if text is None else parse_text(parser, text, arguments)
    except ArgumentError as error:
        raise ValueError(parser_sentence(str(error), arguments)) from error
    return Simulation.from_settings(parser, settings, **({} if cloud is None else {"cloud": cloud})), settings


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
    """Preview, print the report and write the files.

    Args:
        arguments: Command line; that of the process if None.

    Returns:
        0 if all went well, 2 on bad input, 130 if stopped with Ctrl-C. With the environment variable
        ``GAUSSIAN_SWAYING_DEBUG=1`` errors keep their traceback.
    """
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
    given = [name for name in ("capture", "move", "quality", "minutes") if getattr(options, name) is not None]
    given += ["connected"] if options.connected != "auto" else []
    if options.config is not None and given:
        raise ValueError(
            f"`--{given[0]}` is for suggestions, and `--config` is shown unchanged: leave out one of them."
        )
    if options.quality is not None and options.minutes is not None:
        raise ValueError("`--quality` and `--minutes` both choose the grid of the starter: leave out one of them.")
    if options.minutes is not None:
        check_positive("--minutes", options.minutes)
    if options.frames < 1:
        raise ValueError(f"Expected `--frames` to be at least 1, but got {options.frames}.")
    if not 64 <= options.height <= 4320:
        raise ValueError(f"Expected `--height` from 64 to 4320 pixels, but got {options.height}.")
    folder = Path(options.output or Path("outputs/preview") / splat_name(options.scene or options.config[-1]))
    preview = preview_scene(options, folder) if options.config is None else preview_config(options)
    print(preview.report if options.verbose else shortened(preview.report))
    files = write(preview, folder)
    print(f"wrote {', '.join(map(str, files))}" + ("" if options.verbose else "; --verbose says more"))
