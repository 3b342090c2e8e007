"""``bench.py pins``: how well a held edge is modelled, on flags made in code, compared with Blender's cloth."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from bench.cases import flags
from bench.cases.flags import REFERENCES, Flag, Variant
from bench.record import chosen

Row = dict[str, Any]

PATTERNS: tuple[Flag, ...] = tuple(REFERENCES)
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


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Options of ``bench.py pins``."""
    command.add_argument("--dataset", required=True, help="folder that tools/datasets/make_flag_dataset.py wrote")
    command.add_argument("--rows", default=",".join(ROWS), help="separated by commas (default: %(default)s)")
    command.add_argument("--patterns", default=",".join(map(str, PATTERNS)), help="separated by commas")
    command.add_argument("--frames", type=int, help="only the first frames")
    command.add_argument("--points", type=int, default=10_000, help="points on the reference's surface")
    command.add_argument("--more", help='other options of tools/sim.py: --more="--frames=25"')
    command.add_argument("--note", help="a sentence for the page about how the rows were measured")


def measure(options: argparse.Namespace, result: Row, save: Callable[[Row], None]) -> None:
    """Fill ``result["rows"]``, saving it after each run; existing rows that are not selected are kept."""
    names = chosen("--rows", options.rows, ROWS)
    patterns = flags.flags_named(options.patterns)
    flags.open_dataset(Path(options.dataset), patterns, result)
    result |= {"more": options.more or ""} | ({"note": options.note} if options.note else {})
    rows = result.setdefault("rows", {})
    for name in names:
        for pattern in patterns:
            with tempfile.TemporaryDirectory() as scratch:
                row = flags.run_row(
                    pattern, variant(ROWS[name], pattern), options, None, Path(scratch) / "run", pictures=False
                )
            rows.setdefault(name, {})[str(pattern)] = row | {"dx_m": grid_spacing(ROWS[name], pattern)}
            shown = {k: v for k, v in row.items() if k != "chamfer_per_frame_m"}
            print(f"pattern {pattern}, {name}: {json.dumps(shown)}", flush=True)
            save(result)
