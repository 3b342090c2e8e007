"""The command line of ``gaussian-swaying preview``: report, picture and a first configuration."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from argparse import ArgumentError
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_swaying.cli import program
from gaussian_swaying.cli.errors import parser_sentence, run_command
from gaussian_swaying.cli.shipped import with_shipped
from gaussian_swaying.cli.suggestions import guessing
from gaussian_swaying.cli.yaml_limits import check_config_files
from gaussian_swaying.gaussians.compact import read_gaussians
from gaussian_swaying.gaussians.ply import GaussianCloud
from gaussian_swaying.simulation.calibration import (
    SWAY,
    Setting,
    apply_setting,
    calibrate,
    check_sway,
    measure_motion,
)
from gaussian_swaying.simulation.config import build_parser, build_pipeline
from gaussian_swaying.simulation.cost import Cost, Stopwatch, estimate_cost
from gaussian_swaying.simulation.doubts import doubts
from gaussian_swaying.simulation.pipeline import SimulationPipeline
from gaussian_swaying.simulation.preview import Suggestion, gaussian_statistics, suggest
from gaussian_swaying.simulation.preview_capture import captured_from
from gaussian_swaying.simulation.preview_picture import classify, conditions, mean_flow, preview_picture
from gaussian_swaying.simulation.progress import duration
from gaussian_swaying.simulation.shape import DIRECTIONS, bounds
from gaussian_swaying.simulation.starter import draft_yaml, region_dict, starter_yaml

LOADED = time.process_time()  # s; the interpreter and the imports so far, which a run takes too


@dataclass(frozen=True)
class Preview:
    """Everything that is found before anything is written.

    Attributes:
        report: Text for people.
        data: The same as plain numbers, for preview.json.
        picture: 8-bit RGB, shape (H, W, 3).
        configurations: Their names and YAML, ``draft`` and ``starter``; none with ``--config``.
    """

    report: str
    data: dict[str, Any]
    picture: np.ndarray
    configurations: dict[str, str]


def build_options() -> argparse.ArgumentParser:
    """The options."""
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
    add("--capture", metavar="DIR", help="photos' cameras (COLMAP or transforms.json): they tell up and the object")
    add("--output", metavar="DIR", help="folder of the results; default: outputs/preview/<name of the splat>")
    add("--up", nargs="+", metavar="UP", help="+x, -x, ... -z or 3 numbers, instead of a guess")
    add("--hold", metavar="END", help="end that is held: top, bottom, none, +x, -x, ... or -z, instead of a guess")
    add("--region", nargs=6, type=float, metavar="V", help="box to simulate: lower and upper corner [scene units]")
    add("--longest-side", type=float, default=1.0, metavar="M", help="length of the longest side of the object [m]")
    add("--wind", type=float, default=6.0, metavar="M/S", help="speed of the wind in the configuration [m/s]")
    add(
        "--sway",
        type=float,
        default=SWAY,
        metavar="SHARE",
        help="largest displacement in that wind, as a share of the longest side; stiffness and thickness follow",
    )
    add("--frames", type=int, default=250, help="frames of the configuration")
    add("--height", type=int, default=540, help="height of the picture [pixels]")
    add("--device", default="auto", choices=("auto", "cpu", "cuda"), help="auto takes a GPU if there is one")
    return parser


def preview_scene(options: argparse.Namespace, folder: Path) -> Preview:
    """Guess a configuration for a splat, try its stiffness in short runs, and look at it.

    Args:
        options: From :func:`build_options`.
        folder: Where the configurations will be, for the report.

    Returns:
        The preview.

    Raises:
        ValueError: If the splat or an option is bad, or the configuration does not run.
        FileNotFoundError: If there is no such splat.
    """
    check_sway(options.sway)
    cloud = read_gaussians(options.scene)
    up = None if options.up is None else _up(options.up)
    region = None if options.region is None else (options.region[:3], options.region[3:])
    capture = None if options.capture is None else captured_from(options.capture)
    found = suggest(cloud, up, options.hold, region, options.longest_side, options.wind, capture)
    begin = Stopwatch()
    draft, settings = _pipeline(["--device", options.device], draft_yaml(found, options.scene))
    startup = LOADED + begin.quiet
    if settings.scene.ply != str(Path(options.scene).resolve()):
        raise ValueError(f"The path {options.scene!r} means something else in YAML: rename the file, without a colon.")
    found = _calibrated(found, draft, options.sway)
    texts = {
        "draft": draft_yaml(found, options.scene),
        "starter": starter_yaml(found, options.scene, options.frames),
    }
    pipeline, starter = _pipeline(["--device", options.device], texts["starter"])
    costs = {
        "draft": estimate_cost(draft, settings.frames, startup_seconds=startup),
        "starter": estimate_cost(pipeline, starter.frames, startup_seconds=startup),
    }
    data: dict[str, Any] = {
        "splat": str(options.scene),
        "bounds": bounds(cloud.means),
        "gaussians": gaussian_statistics(cloud),
        "suggestion": suggestion_dict(found),
        "run": run_dict(pipeline),
        "cost": _cost_dict(costs["starter"]),
        "draft_cost": _cost_dict(costs["draft"]),
    }
    report = [*_splat_lines(options.scene, cloud, data), *_suggestion_lines(found)]
    if pipeline.scene.loose:
        words = f"{pipeline.scene.loose:,} specks hang on nothing or by a thread; they follow their nearest neighbours"
        report.append(f"  note: {words} (scene.loose: carry)")
    report += [f"  {line}" for line in doubts(found, options, build_options().parse_args([]))]
    report += _cost_lines(costs["starter"])
    output, stem = Path("outputs"), splat_name(options.scene)
    report.append("")
    for name, what, where in (
        ("draft", "a first look", output / f"{stem}_draft"),
        ("starter", "the starter", output / stem),
    ):
        pictures = f"{_seconds_of(texts[name])}, {duration(costs[name].total_seconds)} here"
        report.append(f"{what} ({pictures}):")
        report.append(f"  {shlex.join(program.words('sim'))} --config {folder / name}.yaml --output {where}")
    return Preview("\n".join(report), data, preview_picture(pipeline, options.height, whole=found.whole), texts)


def _calibrated(found: Suggestion, draft: SimulationPipeline, sway: float) -> Suggestion:
    """The suggestion with the stiffness, thickness and wind that short runs of its draft ask for; the draft too."""
    if found.pin is None or not any(found.flow):
        return found
    start, wanted = Setting(found.youngs_modulus, found.thickness), None if found.sheet else sway
    best = calibrate(lambda tried: measure_motion(draft, tried, start, wanted), start, found.longest_side, wanted)
    apply_setting(draft, best.setting, start)
    return replace(
        found,
        youngs_modulus=best.setting.E,
        thickness=best.setting.thickness,
        flow=tuple(round(c * best.setting.wind, 2) for c in found.flow),
        stiffness_reason=best.reason,
    )


def preview_config(options: argparse.Namespace) -> Preview:
    """Look at a given configuration.

    Args:
        options: From :func:`build_options`, with ``config``.

    Returns:
        The preview.

    Raises:
        ValueError: If the configuration is bad or does not run.
    """
    arguments = [*(item for file in options.config for item in ("--config", file)), "--device", options.device]
    if options.scene is not None:
        arguments += ["--scene.ply", options.scene]
    begin = Stopwatch()
    pipeline, settings = _pipeline(arguments)
    startup = LOADED + begin.quiet
    cost = estimate_cost(pipeline, settings.frames, picture=settings.recorder.images, startup_seconds=startup)
    cloud = pipeline.scene.model.to_cloud().to("cpu")
    data: dict[str, Any] = {
        "config": options.config,
        "splat": None if options.scene is None else str(options.scene),
        "bounds": bounds(cloud.means),
        "gaussians": gaussian_statistics(cloud),
        "run": run_dict(pipeline),
        "cost": _cost_dict(cost),
    }
    report = [
        *_splat_lines(options.scene or options.config[-1], cloud, data),
        *_run_lines(data["run"]),
        *_cost_lines(cost),
    ]
    return Preview("\n".join(report), data, preview_picture(pipeline, options.height), {})


def _pipeline(arguments: list[str], text: str | None = None) -> tuple[SimulationPipeline, Any]:
    """The run of a configuration, given by options or as text, and its settings."""
    parser = build_parser()
    check_config_files(arguments)
    try:
        with guessing(parser):
            settings = parser.parse_args(arguments) if text is None else _parse_text(parser, arguments, text)
    except ArgumentError as error:
        raise ValueError(parser_sentence(str(error), arguments)) from error
    return build_pipeline(parser, settings)[0], settings


def _parse_text(parser: Any, arguments: list[str], text: str) -> Any:
    """Settings from YAML text and options after it."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "starter.yaml"
        path.write_text(text, encoding="utf-8")
        return parser.parse_args(["--config", str(path), *arguments])


def splat_name(path: str | Path) -> str:
    """What a splat is called: its file, or the folder of a ``point_cloud.ply``, as trainings write it.

    A folder ``iteration_30000`` and one called ``point_cloud``, as 3DGS makes them, are passed over.
    """
    file = Path(path)
    if file.stem != "point_cloud":
        return file.stem
    folders = [part.name for part in file.resolve().parents]
    passed = ("point_cloud", "iteration_")
    return next((name for name in folders if name and not name.startswith(passed)), file.stem)


def _up(values: Sequence[str]) -> list[float] | str:
    """An up direction from the command line."""
    if len(values) == 1:
        return values[0]
    try:
        return [float(value) for value in values]
    except ValueError:
        raise ValueError(f"Expected `--up` to be +x, -x, ... -z or 3 numbers, but got {' '.join(values)}.") from None


def _joined(arguments: Sequence[str]) -> list[str]:
    """The command line with ``--up -y`` as ``--up=-y``, which argparse would take for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in ("--up", "--hold") and argument in DIRECTIONS:
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


# ---- as plain numbers


def suggestion_dict(found: Suggestion) -> dict[str, Any]:
    """A suggestion without its masks."""
    region = found.region.region()
    return {
        "up": {
            "direction": list(found.up.direction),
            "confidence": found.up.confidence,
            "scores": found.up.scores,
            "reasons": found.up.reasons,
            "floor_gaussians": int(found.up.ground.sum()),
        },
        "region": {
            "region": None if region is None else region_dict(region),
            "simulated": int(found.region.simulated.sum()),
            "opacity_threshold": found.region.opacity_threshold,
            "specks": found.region.specks,
            "reason": found.region.reason,
        },
        "hold": asdict(found.hold) | {"region": None if found.pin is None else region_dict(found.pin)},
        "longest_side_m": found.longest_side,
        "metres_per_unit": found.metres_per_unit,
        "size_m": list(found.size),
        "spacing_m": found.spacing,
        "dx_m": found.dx,
        "sheet": found.sheet,
        "azimuth": found.azimuth,
        "flow": list(found.flow),
        "youngs_modulus_Pa": found.youngs_modulus,
        "thickness_m": found.thickness,
        "stiffness_reason": found.stiffness_reason,
    }


def run_dict(pipeline: SimulationPipeline) -> dict[str, Any]:
    """What a run simulates, holds and blows at."""
    parts, scene = classify(pipeline), pipeline.scene
    return {
        "gaussians": len(scene.model.means),
        "simulated": int(parts.simulated.sum()),
        "carried": int(parts.carried.sum()),
        "loose": scene.loose,
        "held": int(parts.pinned.sum()),
        "conditions": parts.names,
        "regions": [repr(b.region) for b in conditions(pipeline) if hasattr(b, "region")],
        "frame": scene.frame.describe(),
        "box_min": [float(v) for v in scene.bounds[0]],
        "box_max": [float(v) for v in scene.bounds[1]],
        "mass_kg": float(scene.points.mass.sum()),
        "area_m2": float(scene.patch_area.sum()),
        "filled": scene.filled,
        "points": scene.points.count,
        "further": scene.on_surface - len(scene.simulated),
        "dx_m": pipeline.solver.dx,
        "formulation": pipeline.solver.formulation,
        "flow": mean_flow(pipeline).tolist(),
    }


# ---- for people


def _splat_lines(name: str, cloud: GaussianCloud, data: dict[str, Any]) -> list[str]:
    corner, own = data["bounds"], data["gaussians"]
    below = ", ".join(f"{share:.0%} below {t}" for t, share in own["opacity_below"].items())
    normals = "with normals" if own["normals"] else "without normals (the smallest axes are taken)"
    return [
        f"{name}: {len(cloud):,} Gaussians, SH degree {own['sh_degree']}, {normals}",
        f"  bounds        {_numbers(corner['min'])} to {_numbers(corner['max'])} (scene units)",
        f"  without 1 %   {_numbers(corner['robust_min'])} to {_numbers(corner['robust_max'])}",
        "  5, 50 and 95 % of the Gaussians have at most",
        f"    opacity     {_numbers(own['opacity'])}; {below}",
        f"    S1 / S2     {_numbers(own['S1_over_S2'])}   (needles are above 10)",
        f"    S2 / S3     {_numbers(own['S2_over_S3'])}   (surface patches are above 3)",
        f"    S1 / side   {_numbers(own['size_share'])}   (of the longest side; haze is above 0.1)",
    ]


def _suggestion_lines(found: Suggestion) -> list[str]:
    region = "all of space"
    if found.region.box is not None:
        region = json.dumps(dict(zip(("min", "max"), found.region.box, strict=True)))
    count = int(found.region.simulated.sum())
    lines = [
        f"up              {_numbers(found.up.direction)}, {_why(found.up.confidence, '; '.join(found.up.reasons))}",
        f"region          {region}: {found.region.reason}",
        f"opacity         {found.region.opacity_threshold:g} and above is simulated: {count:,} particles",
        f"held            at the {found.hold.end}, {_why(found.hold.confidence, found.hold.reason)}"
        if found.pin is not None
        else "held            nowhere: it will fall",
    ]
    if found.pin is not None:
        lines.append(f"  pin           {_short(region_dict(found.pin))}")
    lines += [
        f"size            {_numbers(found.size)} m along the axes with z up; 1 scene unit = "
        f"{found.metres_per_unit:.4g} m, as the longest side is taken as {found.longest_side:g} m",
        f"grid            dx = {found.dx:g} m: {found.longest_side / found.dx:.0f} cells along the longest side, "
        f"{found.dx / max(found.spacing, 1e-30):.1f} times the particle spacing of {found.spacing:.3g} m",
        "further points  "
        + ("none needed" if found.fill_spacing is None else f"every {found.fill_spacing:g} m on large Gaussians"),
        f"material        {_material(found)}",
        f"wind            {_numbers(found.flow)} m/s, z up",
    ]
    return ["", "guesses (each can be given instead, see --help)", *(f"  {line}" for line in lines)]


def _run_lines(run: dict[str, Any]) -> list[str]:
    return [
        "",
        "this configuration",
        f"  simulated       {run['simulated']:,} of {run['gaussians']:,} Gaussians, {run['mass_kg']:.3g} kg, "
        f"{run['area_m2']:.3g} m^2; box {_numbers(run['box_min'])} to {_numbers(run['box_max'])} (scene units)",
        f"  follow them     {run['carried']:,} faint or loose ones",
        f"  fill the inside {run['filled']:,} points; {run['further']:,} further points on large Gaussians",
        f"  conditions      {'; '.join(run['conditions']) or 'none: it will fall'}",
        *(f"                  {region}" for region in run["regions"]),
        f"  frame           {run['frame']}",
        f"  grid            dx = {run['dx_m']:g} m, {run['formulation']}",
        f"  wind            {_numbers(run['flow'])} m/s, z up, before modulations",
    ]


def _cost_lines(cost: Cost) -> list[str]:
    frame = cost.substeps * cost.substep_seconds
    picture = ""
    if cost.picture_seconds is not None:
        picture = f" + {duration(cost.picture_seconds)} for its pictures"
    return [
        "",
        f"cost on this machine ({cost.device})",
        f"  substep         {cost.substep:.3g} s, {cost.substeps} a frame (stable up to {cost.stable_substep:.3g} s; "
        f"waves of {cost.wave_speed:.3g} m/s)",
        f"  work            {cost.particles:,} particles x {cost.substeps} substeps x {cost.frames} frames = "
        f"{cost.particles * cost.substeps * cost.frames:.2g}; grid of {' x '.join(map(str, cost.grid))} nodes",
        f"  a frame         {duration(frame)}{picture}, from {duration(cost.substep_seconds)} a substep at rest",
        f"  the run         about {duration(cost.total_seconds)}, if nothing else runs",
    ]


def _numbers(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value + 0.0:.3g}" for value in values) + "]"


def _material(found: Suggestion) -> str:
    what = "cloth" if found.sheet else "rubber"
    return f"{what}, E = {found.youngs_modulus:.1e} Pa, {found.thickness:.2g} m thick: {found.stiffness_reason}"


def _seconds_of(text: str) -> str:
    """Length and picture of the video of a configuration, in words."""
    import yaml

    given = yaml.safe_load(text)
    size = given["camera"]["init_args"]
    return f"{given['frames'] * given['frame_dt']:.3g} s at {size['width']} x {size['height']}"


def _cost_dict(cost: Cost) -> dict[str, Any]:
    return asdict(cost) | {"total_seconds": cost.total_seconds}


def _why(confidence: str, reason: str) -> str:
    return "given" if confidence == "given" else f"confidence {confidence}: {reason}"


def _short(region: dict[str, Any]) -> str:
    return json.dumps(region["init_args"]) if region["class_path"] == "Box" else json.dumps(region)


# ---- the command


def main(arguments: Sequence[str] | None = None) -> int:
    """Look, report, write.

    Args:
        arguments: Command line; that of the process if None.

    Returns:
        0 if all went well, 2 on bad input, 130 if stopped with Ctrl-C. With the environment variable
        ``GAUSSIAN_SWAYING_DEBUG=1`` errors keep their traceback.
    """
    arguments = _joined(sys.argv[1:] if arguments is None else arguments)
    parser = build_options()
    return run_command(
        lambda: _preview(parser.parse_args(with_shipped(arguments, "sim"))),
        stopped="Stopped; nothing was written.",
        memory="a smaller --region, or fewer Gaussians",
        arguments=arguments,
    )


def _preview(options: argparse.Namespace) -> None:
    """Look, report, write."""
    if options.scene is None and options.config is None:
        raise ValueError("Nothing to look at: give SCENE.ply, or --config with a scene of its own.")
    if options.capture is not None and options.config is not None:
        raise ValueError("`--capture` is for guesses, but `--config` is shown as it is: leave out one of them.")
    if options.frames < 1:
        raise ValueError(f"Expected `--frames` to be at least 1, but got {options.frames}.")
    if not 64 <= options.height <= 4320:
        raise ValueError(f"Expected `--height` from 64 to 4320 pixels, but got {options.height}.")
    folder = Path(options.output or Path("outputs/preview") / splat_name(options.scene or options.config[-1]))
    found = preview_scene(options, folder) if options.config is None else preview_config(options)
    print(found.report)
    for path in write(found, folder):
        print(f"wrote {path}")


def write(found: Preview, folder: Path) -> list[Path]:
    """Write preview.json, preview.png and, if they were guessed, draft.yaml and starter.yaml.

    A configuration that is there and differs is kept as ``starter.1.yaml``, ``starter.2.yaml``, ...: someone may
    have edited it.

    Returns:
        The files.
    """
    import imageio.v3 as iio

    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "preview.json", folder / "preview.png"]
    files[0].write_text(json.dumps(found.data, indent=1) + "\n", encoding="utf-8")
    iio.imwrite(files[1], found.picture)
    for name, text in found.configurations.items():
        path = folder / f"{name}.yaml"
        if path.exists() and path.read_text(encoding="utf-8") != text:
            number = 1
            while (folder / f"{name}.{number}.yaml").exists():
                number += 1
            path.rename(folder / f"{name}.{number}.yaml")
        path.write_text(text, encoding="utf-8")
        files.append(path)
    return files
