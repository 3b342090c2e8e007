"""What ``bench.py area`` measures: areas of bodies with a known skin, of captures, and the time that they take."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bench.case import Case, Measurement, option
from bench.problems.bodies import BODIES, area_shares, cluttered_sphere, of_cloud
from bench.record import Row
from gaussian_swaying.gaussians.formats import read_gaussians
from gaussian_swaying.geometry.directions import hull_area

REPEATS = 3


def _body(name: str) -> Row:
    body = BODIES[name]()
    return area_shares(body) | {"known": body.area is not None}


def _timed(gaussians: int) -> Row:
    """The fastest of some times."""
    return min((area_shares(cluttered_sphere(gaussians)) for _ in range(REPEATS)), key=lambda row: row["open_s"])


def _capture(file: str) -> Row:
    body = of_cloud(read_gaussians(file))
    return area_shares(body) | {"hull": hull_area(body.means)}


def rows(options: argparse.Namespace, _: Row) -> Iterator[Measurement]:
    """The bodies, the time of one of them, and the captures."""
    yield from ((("bodies", name), partial(_body, name)) for name in options.body or BODIES)
    if options.timed:
        yield ("timed",), partial(_timed, options.timed)
    yield from ((("captures", Path(file).stem), partial(_capture, file)) for file in options.ply)


CASE = Case(
    "Measure the areas of bodies with a known skin, of captures, and the time that they take.",
    rows,
    (
        option("--body", "only this one; repeatable", action="append", choices=list(BODIES)),
        option("--ply", "a captured splat, without known area; repeatable", action="append", default=[]),
        option("--timed", "Gaussians of the body that is timed", type=int, default=150_000),
    ),
    page="validation.md",
    device=False,
)
