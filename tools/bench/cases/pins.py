"""``bench.py pins``: how well a held edge is modelled, on flags made in code, compared with Blender's cloth."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import yaml

from bench.case import DATASET, FRAMES, MORE, NOTE, POINTS, Case, Measurement, names, option
from bench.cases import flags
from bench.cases.flags import REFERENCES, Flag, Variant
from bench.record import Row

PATTERNS: tuple[Flag, ...] = tuple(flag for flag in REFERENCES if flag != "pennant")
"""The paper's three flags, two that leave their held edge at an angle, and two that nothing was tuned for."""


@dataclass(frozen=True)
class Pin:
    """One way to hold a flag.

    Attributes:
        kind: What is held: the ``nodes`` of the grid, or places on the cloth (``hinge``).
        dx: Grid spacing [m]; None for that of the configuration.
        linear: Whether the drag is linear in the velocity of the cloth, as in the reference.
    """

    kind: str
    dx: float | None
    linear: bool = False

    def title(self) -> str:
        """The name in the tables."""
        what = {"nodes": "nodes held", "hinge": "hinges"}[self.kind]
        law = ", linear law" if self.linear else ""
        return f"{what}, dx = {f'{self.dx:g} m' if self.dx else '0.015 to 0.025 m'}{law}"


ROWS = {
    f"{kind}{name}": Pin(kind, dx)
    for kind in ("nodes", "hinge")
    for name, dx in (("", None), ("_02", 0.02), ("_025", 0.025), ("_04", 0.04), ("_08", 0.08))
} | {
    f"{kind}{name}_linear": Pin(kind, dx, linear=True)
    for kind in ("nodes", "hinge")
    for name, dx in (("_02", 0.02), ("_04", 0.04))
}
"""All rows, by name."""

_EDGES: dict[Flag, str] = {
    1: "max=[0.00625,9,9]", 3: "min=[-9,-9,1.19]", 5: "min=[-9,-9,0.794]", "light": "min=[-9,-9,0.994]"
}  # fmt: skip
"""Edge of the held box [m] for hinges: one row of Gaussians, because a hinge lies in the middle of what is held.
Pattern 2 holds squares; pattern 4 and the curtain hold one row already."""


def grid_spacing(pin: Pin, pattern: Flag) -> float:
    """The grid spacing of a row [m]."""
    files = flags.matched_configs(pattern)
    return float(pin.dx or yaml.safe_load(files[-1].read_text())["solver"]["dx"])


def variant(pin: Pin, pattern: Flag) -> Variant:
    """A row as a variant of the flag benchmark, with the Gaussians of the configuration."""
    options = flags.grid_options(pin.dx) if pin.dx else ()
    held = "--solver.boundaries.init_args"  # of the last boundary: each flag has one
    options += (f"{held}.kind={pin.kind}",)
    options += ("--aero.law=linear",) if pin.linear else ()
    if pin.kind == "hinge" and pattern in _EDGES:
        options += (f"{held}.region.init_args.{_EDGES[pattern]}",)
    return Variant(pin.title(), options=options)


def _row(name: str, pattern: Flag, options: argparse.Namespace) -> Row:
    pin = ROWS[name]
    with tempfile.TemporaryDirectory() as scratch:
        found = flags.run_row(pattern, variant(pin, pattern), options, None, Path(scratch) / "run", pictures=False)
    return found | {"dx_m": grid_spacing(pin, pattern)}


def rows(options: argparse.Namespace, result: Row) -> Iterator[Measurement]:
    """Each way to hold each flag."""
    patterns = flags.flags_named(options.patterns)
    flags.open_dataset(Path(options.dataset), patterns, result)
    result |= {"more": options.more} | ({"note": options.note} if options.note else {})
    for name in options.rows:
        yield from ((("rows", name, str(pattern)), partial(_row, name, pattern, options)) for pattern in patterns)


CASE = Case(
    "Compare ways to hold an edge on flags made in code, with Blender's cloth.",
    rows,
    (
        DATASET,
        names("--rows", ROWS),
        option("--patterns", "separated by commas", default=",".join(map(str, PATTERNS))),
        FRAMES,
        POINTS,
        MORE,
        NOTE,
    ),
)
