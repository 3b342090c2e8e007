"""``bench.py fit_films``: small films of things in wind, fitted: begun in motion, from bad starts, and many of them."""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any

from bench.case import Case, Measurement, apart, names, option
from bench.problems.fit_films import KINDS, Film, drawn, make, speeds
from bench.record import Row
from gaussian_swaying.fitting.fit import fit
from gaussian_swaying.fitting.scale import SCALE
from gaussian_swaying.fitting.unknowns import FILM_START

UNTIL, SEARCH, TRACKS = 1.0, 32, 200
"""Fitted part of a film [s], simulations of the coarse search, and most tracks."""
GUSTY, GUSTS = 3.0, (0.25, 0.5)
"""Length of a film with gusts [s], and their intensity and time scale [s]."""
GOALS = {"wind.speed": 0.05, "wind.azimuth": 5.0, "material.E": 0.15}
"""Largest errors that are wanted: shares, and degrees."""
NEAR = 1.15
"""How far off the start values of the films are that only test the standard errors."""
INDEPENDENT = 200
"""Number of the first film that nobody looked at while the fit was made; thresholds are those of earlier numbers."""
PARTS = ("starts", "verdicts", "alone", "coverage", "winds", "scales", "gusts")


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Fits of the films of each part, in processes of their own if there are several."""
    if options.processes == 1:
        yield from _fits(options)
        return
    os.environ["OMP_NUM_THREADS"] = "1"  # before a process imports torch
    yield from apart(options.processes, _fits(options))


def _fits(options: argparse.Namespace) -> Iterator[Measurement]:
    kinds, numbers = options.kinds, range(options.first, options.films)
    section, shift = ("independent_", INDEPENDENT) if options.independent else ("", 0)
    if "starts" in options.parts:
        for kind in kinds:
            for start in (0.2, -0.2):
                film = drawn(kind, 2, start=start)
                told = f"{kind}, {'still' if start > 0 else 'moving'} for {abs(start):g} s"
                yield ("starts", told), partial(fitted, film, {FILM_START: [-0.5, 0.5]})
    for name, told, search in (("verdicts", "", SEARCH), ("alone", ", from this start alone", 0)):
        for number in numbers if name in options.parts else ():
            kind, which = list(kinds)[number % len(kinds)], shift + number // len(kinds)
            work = partial(fitted, drawn(kind, which), {}, off=3.0, search=search)
            yield (f"{section}verdicts", f"{kind} {which}{told}"), work
    if "coverage" in options.parts:
        for number in numbers:
            kind = list(kinds)[number % len(kinds)]
            film = drawn(kind, 100 + shift + number, seconds=UNTIL)
            yield (f"{section}coverage", f"{kind} {shift + number}"), partial(fitted, film, {}, off=NEAR, search=0)
    if "winds" in options.parts:
        for kind in kinds:
            for ramp in (1.0, 2.0):
                film = drawn(kind, 3, ramp=ramp)
                told = f"{kind}, {ramp:g} times the speed"
                yield ("winds", told), partial(fitted, film, {}, wind_changes=True)
    if "scales" in options.parts:
        for kind in kinds:
            yield ("scales", kind), partial(fitted, drawn(kind, 4), {SCALE: [1 / 3, 3.0]})
    if "gusts" in options.parts:
        for kind in kinds:
            film = drawn(kind, 5, seconds=GUSTY, gusts=GUSTS)
            yield ("gusts", kind), partial(fitted, film, {}, wind_changes=True, until=GUSTY)


def fitted(film: Film, more: dict[str, Any], off: float = 1.0, search: int = SEARCH, **settings: Any) -> Row:
    """A film's fit: errors, standard errors, and the verdict with its reasons."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        make(film, folder)
        begin = time.process_time()
        settings = {"until": UNTIL, "search": search, "tracks": TRACKS} | settings
        unknowns = film.unknowns(off) | {name: {"range": ends} for name, ends in more.items()}
        try:
            found = fit(
                folder / "base.yaml", folder, unknowns, folder / "fit", device="cpu", progress=False, **settings
            )
        except ValueError as error:
            return {"verdict": "failed", "why": [str(error)], "processor_s": time.process_time() - begin}
    failed, doubtful = found.doubts()
    return {
        "errors": errors(film, found.values),
        "standard_errors": errors(film, {n: film.truth[n] + found.errors[n] for n in film.truth}),
        "further": {name: [found.values[name], found.errors[name]] for name in found.values if name not in film.truth},
        "gain_at_the_end": found.values.get(f"wind.speed@{UNTIL:.4g}", 1.0),
        "true_gain": 1 + (film.ramp - 1) * UNTIL / film.seconds,
        "gusts": None if found.gusts is None else asdict(found.gusts) | {"told": found.gusts.told},
        "true_mean": fmean(speed for _, speed in speeds(film)),
        "verdict": found.verdict,
        "why": [*failed, *doubtful],
        "explained": min(found.followed.values()),
        "seconds": found.seconds,
        "processor_s": time.process_time() - begin,
    }


def errors(film: Film, values: dict[str, float]) -> dict[str, float]:
    """Errors of speed and E as shares, of the azimuth in degrees."""
    found = {}
    for name, true in film.truth.items():
        found[name] = values[name] - true if name == "wind.azimuth" else values[name] / true - 1
    return found


def misses(row: Row, times: float = 1.0) -> bool:
    """Whether an error is so many times what is wanted; a fit that was refused misses."""
    if "errors" not in row:
        return True
    return any(not abs(row["errors"][name]) <= times * most for name, most in GOALS.items())


def counted(rows: list[Row]) -> Row:
    """Numbers of films: within the goals, of each verdict, and called good though more than twice the goals off."""
    verdicts = [row["verdict"] for row in rows]
    found: Row = {name: verdicts.count(name) for name in ("good", "doubtful", "failed")}
    wrong = sum(row["verdict"] == "good" and misses(row, 2) for row in rows)
    found |= {"films": len(rows), "within": sum(not misses(row) for row in rows), "wrong": wrong}
    return found | {"processor_s": median(row["processor_s"] for row in rows)}


def covered(rows: list[Row]) -> dict[str, float]:
    """Share of the errors within two standard errors, of each unknown and of all."""
    known = [row for row in rows if "errors" in row]
    found = {
        name: [abs(row["errors"][name]) <= 2 * abs(row["standard_errors"][name]) for row in known] for name in GOALS
    }
    every = [inside for own in found.values() for inside in own]
    shares = {name: sum(own) / len(own) if own else math.nan for name, own in (found | {"all": every}).items()}
    return shares | {"films": float(len(known))}


CASE = Case(
    "Find wind and material from small films: begun in motion, from bad starts, of a wind that changes, and many.",
    rows,
    (
        names("--parts", PARTS, default=("starts", "verdicts")),
        names("--kinds", list(KINDS), default=list(KINDS)),
        option("--films", "films of each of the parts that have many, in all", type=int, default=8),
        option("--first", "number of the first of these films", type=int, default=0),
        option("--independent", "films on which nothing was tuned, apart from the others", action="store_true"),
        option("--processes", "films that are fitted at the same time", type=int, default=1),
    ),
    page="fit.md",
    device=False,
)
