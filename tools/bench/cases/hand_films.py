"""``bench.py hand_films``: films by Blender of things in wind, from a phone in a hand, fitted in one command."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bench.case import Case, Measurement, option
from bench.cases.film_fit import COMMAND
from bench.clock import command
from bench.record import Row

NAMES = {"wind.speed": "speed", "wind.azimuth": "azimuth", "material.E": "E"}
"""What is sought, and its name in ``truth.json``."""


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The films in the folder."""
    folder = Path(options.films)
    found = sorted(path.parent for path in folder.glob("*/*/fit.yaml"))
    wanted = [one for one in found if not options.film or f"{one.parent.name}/{one.name}" in options.film]
    if not wanted:
        raise SystemExit(f"{folder} has no such films: make them with tools/datasets/make_hand_films.py")
    for one in wanted:
        yield ("rows", f"{one.parent.name.replace('_', ' ')}, {one.name}"), partial(measured, one)


def measured(folder: Path) -> Row:
    """Fit a film, into ``fit`` beside it: errors, standard errors, verdict and why, time of the processor, memory."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    folder = folder.resolve()
    shutil.rmtree(folder / "fit", ignore_errors=True)
    words = ["fit", "--config", str(folder / "fit.yaml"), "--output", "fit", "--device", "cpu"]
    took = command([sys.executable, "-c", COMMAND, *words], folder)
    row = {"processor_s": took["processor_s"], "wall_s": took["seconds"], "peak_bytes": took["bytes"]}
    if took["code"]:  # it was refused
        return row | {"verdict": "failed", "why": took["told"].strip().splitlines()[-1:]}
    told = json.loads((folder / "fit/result.json").read_text(encoding="utf-8"))
    values = {one["name"]: one for one in told["values"]}
    errors = {
        name: found["value"] - truth[own] if own == "azimuth" else found["value"] / truth[own] - 1
        for (name, own), found in ((pair, values[pair[0]]) for pair in NAMES.items())
    }
    return row | {
        "errors": errors,
        "standard_errors": {
            name: values[name]["standard_error"] / (1 if own == "azimuth" else truth[own])
            for name, own in NAMES.items()
        },
        "start": values["film.start"]["value"],
        "true_start": truth["start"],
        "verdict": told["verdict"],
        "why": told["why"],
        "explained": min(told["motion_explained"].values()),
    }


CASE = Case(
    "Find wind and material from films by Blender that a phone in a hand takes, from bad starts.",
    rows,
    (
        option("--films", "folder of tools/datasets/make_hand_films.py", default="outputs/hand_films"),
        option("--film", "only this one, such as banner/still; repeatable", action="append"),
    ),
    page="fit.md",
    device=False,
)
