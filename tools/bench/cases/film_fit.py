"""``bench.py film_fit``: from a film to a fit in one command, with its time and memory for short and long films."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bench.case import Case, Measurement, option
from bench.clock import command
from bench.problems.flag_film import POLE, TRUTH, write_case
from bench.record import Row

SIZE = (540, 960)
MOVING = 2.5
"""Time in motion at the end of each film [s]."""
COMMAND = "import sys; from gaussian_swaying.cli.main import main; sys.exit(main(sys.argv[1:]))"


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The whole command for films of some lengths [s]."""
    for seconds in options.seconds or (3.0, 60.0):
        yield ("rows", {"film": f"{seconds:g} s"}), partial(measured, seconds, options.device)


def measured(seconds: float, device: str) -> Row:
    """Make a film and fit it; time, memory of the largest process, and what is found."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_case(folder, SIZE, seconds - MOVING, MOVING)
        words = [
            "fit",
            "film.mp4",
            "--splat",
            "my.ply",
            "--length",
            "pole",
            str(POLE),
            "--output",
            "out",
            "--device",
            device,
        ]
        took = command([sys.executable, "-c", COMMAND, *words], folder)
        if took["code"]:
            raise RuntimeError(f"fit ended with {took['code']}: {took['told']}")
        told = json.loads((folder / "out/result/result.json").read_text(encoding="utf-8"))
    values = {row["name"]: row["value"] for row in told["values"]}
    return {
        "frames": round(30 * seconds),
        "size": list(SIZE),
        "wall_s": took["seconds"],
        "processor_s": took["processor_s"],
        "peak_bytes": took["bytes"],
        "speed_error": values["wind.speed"] / TRUTH["wind.speed"] - 1,
        "azimuth_error_deg": abs(values["wind.azimuth"] - TRUTH["wind.azimuth"]),
        "E_error": values["material.E"] / TRUTH["material.E"] - 1,
        "verdict": told["verdict"],
    }


CASE = Case(
    "Measure time and memory of a fit from a film, in one command.",
    rows,
    (option("--seconds", "length of a film; repeatable", action="append", type=float),),
    page="fit.md",
)
