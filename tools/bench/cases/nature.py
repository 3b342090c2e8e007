"""What ``bench.py nature`` measures: trees, crowns, plates that fall and fabrics that drape, beside what is known."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import product
from typing import Any

from bench.case import Case, Measurement, option
from bench.clock import guarded
from bench.problems import crowns, drapes, falling, trees, wrinkles
from bench.problems.fabrics import FABRICS
from bench.problems.settings import Result, Settings
from bench.record import Row

LEAVES = 180.0
"""Area of one side of the leaves of the tree [m²], by which it loses the frequency that the measured one loses."""
PULL = 1.2
"""Of its top [m]."""
FOLDS = 5
"""Of a draped fabric: with so many the energy of all four is least."""
THIN = 2e-7
"""Bending stiffness of the sheet that wrinkles [N m]."""


def cases(settings: Settings) -> Iterable[tuple[str, Row, Callable[[], Result]]]:
    """The name, the parameters and the function of each measurement."""

    def case(name: str, function: Callable[..., Result], **parameters: Any) -> tuple[str, Row, Callable[[], Result]]:
        return name, parameters, lambda: function(settings=settings, **parameters)

    for leaf_area, dx in product((0.0, LEAVES), (1.0, 0.5, 0.25)):
        yield case("tree, frequency", trees.frequency, leaf_area=leaf_area, dx=dx)
    for dx in (0.5, 0.25):
        yield case("tree, damping", trees.damping, leaf_area=0.0, pull=PULL, breeze=0.0, dx=dx)
        yield case("tree, damping", trees.damping, leaf_area=LEAVES, pull=PULL, breeze=0.0, dx=dx)
    for pull, breeze in ((0.3, 0.0), (0.6, 0.0), (2.0, 0.0), (0.3, 0.3)):
        yield case("tree, damping", trees.damping, leaf_area=LEAVES, pull=pull, breeze=breeze, dx=0.5)
    for species, cells in product(crowns.CROWNS, (8, 16)):
        yield case("crown", crowns.crown, species=species, cells=cells)
    for species, diameter in (
        *product(("birch",), (0.009, 0.010, 0.011, 0.012, 0.014)),
        *product(("Sitka spruce",), (0.014, 0.015, 0.016, 0.018)),
    ):
        yield case("crown of elasticas", crowns.of_elasticas, species=species, diameter=diameter)
    for law, tilt in product(("projected", "cross_flow"), (0.0, 30.0, 60.0)):
        yield case("falling plate", falling.fall, law=law, tilt=tilt)
    for cells in (8, 16, 32):
        yield case("falling plate that turns", falling.fall, law="cross_flow", spin=0.2, cells=cells)
    for cells, fabric in product((6, 8), FABRICS):
        yield case("drape", drapes.drape, fabric=fabric, folds=FOLDS, cells=cells)
    yield case("drape", drapes.drape, fabric="ponte", folds=FOLDS, cells=12)
    for cells, fabric in product((6, 8), FABRICS):
        yield case("drape", drapes.drape, fabric=fabric, folds=FOLDS, cells=cells, layers=1)
    for fabric, folds in product(FABRICS, (4, 5, 6, 7)):
        yield case("draped shell", drapes.of_shell, fabric=fabric, folds=folds)
    yield case("draped shell", drapes.of_shell, fabric="ponte", folds=FOLDS, cells=20)
    yield case("draped shell", drapes.of_shell, fabric="ponte", folds=FOLDS, stretch=1000.0)
    yield case("wrinkled shell", wrinkles.of_shell, bending=THIN)
    yield case("wrinkled shell", wrinkles.of_shell, bending=THIN, cells=56)
    for factor in (2.0, 0.5, 0.25):
        yield case("wrinkled shell", wrinkles.of_shell, bending=factor * THIN)
    for length in (0.4, 0.7):
        yield case("wrinkled shell", wrinkles.of_shell, bending=0.5 * THIN, length=length)
    for strain in (0.025, 0.1):
        yield case("wrinkled shell", wrinkles.of_shell, bending=0.5 * THIN, strain=strain)
    for cells in (32, 48, 64, 80):
        yield case("wrinkles", wrinkles.wrinkles, bending=THIN, cells=cells)
    for cells in (32, 48):
        yield case("wrinkles", wrinkles.wrinkles, bending=THIN, cells=cells, layers=1)


def _result(function: Callable[[], Row]) -> Row:
    return {"result": guarded(function)}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """The cases that are asked for; one that fails is recorded with its message."""
    only = options.only or ""
    if not options.missing:
        result["rows"] = [row for row in result.get("rows", []) if only and only not in row["problem"]]
    known = [(row["problem"], row["parameters"]) for row in result.get("rows", [])]
    for name, parameters, function in cases(Settings(device=options.device)):
        if only in name and (name, parameters) not in known:
            place = {"problem": name, "parameters": parameters}
            yield ("rows", place), partial(_result, function)


CASE = Case(
    "Measure trees, crowns, falling plates and draped fabrics beside what is known of them.",
    rows,
    (
        option("--only", "only the problems whose name contains this"),
        option("--missing", "only what the record lacks", action="store_true"),
    ),
    page="nature.md",
    keeps="any",
)
