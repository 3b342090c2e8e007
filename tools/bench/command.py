"""The commands of ``bench.py``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from bench import pages, record, show
from bench.case import Case, Option, option
from bench.slots import SlotError

_OWN = (
    "speed live accuracy pareto points backward gradients surfaces flags pins contact fit soft folds gallery previews "
    "area blender places frames detail drawn leaves refinement web sweeps winds stability nature air registration "
    "film_fit handheld fit_films hand_films"
)
_FILES = {name: f"{name}.CASE" for name in _OWN.split()}
_FILES |= {"substep": "runs.SUBSTEP", "sim": "runs.SIM", "train": "training.CASE"}


def _case(place: str) -> Case:
    module, name = place.split(".")
    return getattr(import_module(f"bench.cases.{module}"), name)


CASES: dict[str, Case] = {name: _case(place) for name, place in _FILES.items()}
"""What is measured, by the names of the commands; most have the name of their file in ``bench/cases``."""


def fill_pages(options: argparse.Namespace) -> None:
    """Fill the slots of the pages next to the results."""
    pages.refill(Path(options.results), age=not options.keep_ages)


AGES = option("--keep_ages", "leave what is known of rows older than the code", action="store_true")
SHOWN: dict[str, tuple[str, Callable[[argparse.Namespace], None], tuple[Option, ...]]] = {
    "pages": ("Fill the slots of the pages next to the results, and find which rows are older than the code.",
              fill_pages, (AGES,)),
    "pictures": ("A strip of frames of a finished run.", show.pictures, show.PICTURES),
    "film": ("An animated WebP of finished runs side by side.", show.film, show.FILM),
}  # fmt: skip
"""The other commands: what they do, the function that does it, and its options."""


def build_parser(description: str) -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="command")
    results = option("--results", "folder of the recorded JSON", default=str(record.RESULTS))
    device = option("--device", "where to measure", choices=["auto", "cpu", "cuda"], default="auto")
    told = {name: (case.help, (device, *case.options) if case.device else case.options) for name, case in CASES.items()}
    told |= {name: (what, own) for name, (what, _, own) in SHOWN.items()}
    for name, (what, own) in told.items():
        command = commands.add_parser(name, help=what)
        for flag, settings in (results, *own):
            command.add_argument(flag, **settings)
    return parser


def main(description: str, arguments: list[str] | None = None) -> None:
    """Parse and run one command, then refill the page that shows its record."""
    options = build_parser(description).parse_args(arguments)
    try:
        if case := CASES.get(options.command):
            case.run(options.command, options)
            if case.page:
                pages.refill(Path(options.results), case.page)
        else:
            SHOWN[options.command][1](options)
    except SlotError as error:
        raise SystemExit(f"error: {error}") from error
