"""Tables of ``bench.py pins``: how well a held edge is modelled."""

from __future__ import annotations

from typing import Any

from bench.cases.flags import PATTERNS as PAPER
from bench.cases.flags import Flag
from bench.cases.pins import PATTERNS, ROWS
from bench.slots import table
from bench.tables import flags
from bench.tables.markdown import grid, source, yes_no

Row = dict[str, Any]
PAGE = "flag_benchmark.md"

_NAMES: dict[Flag, str] = {4: "pattern 4 (curtain)", 5: "pattern 5 (light, stiff)", "light": "light, stiff"}
_SHARES: dict[Flag, float] = {4: 0.015, 5: 0.015, "curtain": 0.02, "light": 0.02}  # goals, of the longer side


def _name(pattern: Flag) -> str:
    return _NAMES.get(pattern, flags.named(pattern))


def goals(results: list[Row]) -> list[tuple[str, str, bool | None]]:
    """The goals, the measured values, and whether each goal is reached; None for what was not measured.

    The motion of a flag does not depend on the device, so a row may come from any record.
    """
    rows: Row = {}
    for name in ROWS:
        for one in results:
            rows[name] = one["rows"].get(name, {}) | rows.get(name, {})
    known = {"uncertainty": flags.uncertainty(results)}
    found: list[tuple[str, str, bool | None]] = []
    for pattern in PATTERNS:
        hinge = flags.complete(rows, "hinge_04", pattern)
        named = f"{_name(pattern)}: hinges at dx = 0.04 m"
        if pattern in PAPER:
            nodes = flags.complete(rows, "nodes", pattern)
            goal = f"{named} no farther than held nodes on the finer grid"
            if hinge is None or nodes is None:
                found.append((goal, "-", None))
                continue
            one, other = hinge["chamfer_share"], nodes["chamfer_share"]
            found.append((goal, f"{100 * one:.2f} %, {100 * other:.2f} % at {nodes['dx_m']:g} m", one <= other))
        else:
            goal = f"{named} within {100 * _SHARES[pattern]:g} % of the longer side"
            if hinge is None:
                found.append((goal, "-", None))
                continue
            share = hinge["chamfer_share"]
            found.append((goal, f"{100 * share:.2f} %{flags.doubt(known, pattern)}", share <= _SHARES[pattern]))
    return found


@table(PAGE, "pins.device", "pins_*")
def device(result: Row) -> list[str]:
    """The device and versions of the runs, and notes about them."""
    lines = [source(result)]
    lines += [f"Other options of `tools/sim.py`: `{result['more']}`."] if result.get("more") else []
    return [*lines, result["note"]] if result.get("note") else lines


@table(PAGE, "pins.rows", "pins_*")
def rows_table(result: Row) -> list[str]:
    """Distance of each row and pattern."""
    rows = result["rows"]
    return grid(
        ["", *map(_name, PATTERNS)],
        [
            [pin.title(), *(flags.chamfer(rows[name].get(str(p))) for p in PATTERNS)]
            for name, pin in ROWS.items()
            if name in rows
        ],
    )


@table(PAGE, "pins.goals", "pins_*", together=True)
def goal_table(results: list[Row]) -> list[str]:
    """The goals."""
    rows = [[goal, measured, yes_no(reached)] for goal, measured, reached in goals(results)]
    return grid(["goal", "measured", "reached"], rows)


@table(PAGE, "pins.costs", "pins_*")
def costs(result: Row) -> list[str]:
    """Points and time of each row."""
    rows = result["rows"]

    def cell(row: Row | None) -> str:
        return f"{row['particles']:,}; {row['ms_per_frame']:.1f}" if row and "particles" in row else "-"

    return grid(
        ["points; time per frame [ms]", *map(_name, PATTERNS)],
        [
            [pin.title(), *(cell(rows[name].get(str(p))) for p in PATTERNS)]
            for name, pin in ROWS.items()
            if name in rows
        ],
    )


@table(PAGE, "pins.reference", "pins_*", together=True)
def reference(results: list[Row]) -> list[str]:
    """Uncertainty of the references that only these rows use."""
    found = flags.uncertainty(results)
    return flags.uncertainty_lines({p: v for p, v in found.items() if p not in map(str, PAPER)})
