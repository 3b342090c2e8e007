"""The commands of ``bench.py``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import pages, record, show
from bench.cases import (
    accuracy,
    area,
    backward,
    contact,
    fit,
    flags,
    folds,
    gallery,
    gradients,
    live,
    pareto,
    pins,
    points,
    previews,
    runs,
    soft,
    speed,
    surfaces,
    sweeps,
    training,
    web,
    winds,
)
from bench.slots import SlotError


def _going_on(name: str, measure: Callable[..., None]) -> Callable[[argparse.Namespace], None]:
    """A command that adds to an earlier record of the same device."""

    def run(options: argparse.Namespace) -> None:
        device, result = record.start(options.device)
        options.device = device.type
        if name in ("gallery", "previews"):
            options.preset = options.preset or ("preview" if device.type == "cpu" else None)
        made = "_made" if name == "flags" and options.splats == "made" else ""
        record.go_on(options, f"{name}{made}_{device.type}", result, measure)

    return run


def fill_pages(options: argparse.Namespace) -> None:
    """Fill the slots of the pages next to the results."""
    pages.refill(Path(options.results), age=not options.keep_ages)


def add_pages_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py pages``."""
    command.add_argument("--keep_ages", action="store_true", help="leave what is known of rows older than the code")


@dataclass(frozen=True)
class Command:
    """One command of ``bench.py``.

    Attributes:
        help: What it does.
        run: The function that does it.
        add_arguments: Adds its own options.
        device: Whether it has the option ``--device``.
        page: The page to refill afterwards.
    """

    help: str
    run: Callable[[argparse.Namespace], None]
    add_arguments: Callable[[argparse.ArgumentParser], None] | None = None
    device: bool = True
    page: str | None = None


COMMANDS = {
    "substep": Command("Measure one elastic substep.", runs.substep),
    "speed": Command("Measure rollouts of many sizes, sand, batches and frames, with memory and error.",
                     speed.run, speed.add_arguments),
    "sim": Command("Measure whole runs: the default flag and a captured object.", runs.sim, runs.add_arguments),
    "live": Command("Measure the pictures a second of the live page.", live.live, live.add_arguments, page="live.md"),
    "accuracy": Command("Measure errors against exact solutions and experiments.",
                        accuracy.run, accuracy.add_arguments, page="validation.md"),
    "pareto": Command("Measure speed against error over the settings of the solver.",
                      pareto.run, pareto.add_arguments, page="validation.md"),
    "points": Command("Measure error and time against the points of a cell.", points.run, points.add_arguments),
    "backward": Command("Measure the gradient through substeps of total: time, memory and agreement with torch.",
                        backward.run, backward.add_arguments, page="validation.md"),
    "gradients": Command("Measure the memory of gradients through long rollouts, and fit a flag.",
                         gradients.run, device=False, page="validation.md"),
    "surfaces": Command("Measure how trained normals are tilted, by which losses, and what it does to a flag.",
                        _going_on("surfaces", surfaces.measure), surfaces.add_arguments, page="training.md"),
    "train": Command("Measure training: a bare gsplat loop and Lightning, and the effect of the surface losses.",
                     _going_on("train", training.measure), training.add_arguments),
    "flags": Command("Train, simulate and compare the flags of the paper with Blender's cloth.",
                     _going_on("flags", flags.measure), flags.add_arguments),
    "pins": Command("Compare ways to hold an edge on flags made in code, with Blender's cloth.",
                    _going_on("pins", pins.measure), pins.add_arguments),
    "contact": Command("Measure what contact costs, and how close surfaces come.",
                       _going_on("contact", contact.measure), contact.add_arguments, page="contact.md"),
    "fit": Command("Find wind and material from videos, and compare with the truth.",
                   _going_on("fit", fit.measure), fit.add_arguments, page="fit.md"),
    "soft": Command("Compare a soft body with Newton's, and find its wind and material from video.",
                    _going_on("soft", soft.measure), soft.add_arguments, page="fit.md"),
    "folds": Command("Compare a flag that folds onto itself with other cloth solvers, with and without contact.",
                     _going_on("folds", folds.measure), folds.add_arguments, page="contact.md"),
    "gallery": Command("Run the paper's scenes and make pictures of them.",
                       _going_on("gallery", gallery.measure), gallery.add_arguments),
    "previews": Command("Compare the times that previews announce with those of runs.",
                        _going_on("previews", previews.measure), previews.add_arguments),
    "area": Command("Measure the areas of bodies with a known skin, of captures, and the time that they take.",
                    area.run, area.add_arguments, device=False, page="validation.md"),
    "web": Command("Measure films for the web: size, error, and speed in headless Chromium.",
                   _going_on("web", web.measure), web.add_arguments, page="web.md"),
    "sweeps": Command("Measure disturbed sweeps, many small flags and training, on one and several GPUs.",
                      _going_on("sweeps", sweeps.measure), sweeps.add_arguments, page="many.md"),
    "winds": Command("Measure substeps in winds that differ from place to place, and a box of turbulence.",
                     _going_on("winds", winds.measure), winds.add_arguments, page="wind.md"),
    "pages": Command("Fill the slots of the pages next to the results, and find which rows are older than the code.",
                     fill_pages, add_pages_arguments, device=False),
    "pictures": Command("A strip of frames of a finished run.",
                        show.pictures, show.add_pictures_arguments, device=False),
    "film": Command("An animated WebP of finished runs side by side.",
                    show.film, show.add_film_arguments, device=False),
}  # fmt: skip


def build_parser(description: str) -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for name, command in COMMANDS.items():
        own = commands.add_parser(name, help=command.help)
        own.set_defaults(command=command)
        own.add_argument("--results", default=str(record.RESULTS), help="folder of the recorded JSON")
        if command.device:
            own.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
        if command.add_arguments:
            command.add_arguments(own)
    return parser


def main(description: str, arguments: list[str] | None = None) -> None:
    """Parse and run one command, then refill the page that shows its record."""
    options: Any = build_parser(description).parse_args(arguments)
    try:
        options.command.run(options)
        if options.command.page:
            pages.refill(Path(options.results), options.command.page)
    except SlotError as error:
        raise SystemExit(f"error: {error}") from error
