"""Tables of ``bench.py area``: the area that the wind can reach."""

from __future__ import annotations

from typing import Any

from bench.slots import table, value
from bench.tables.markdown import grid, source, yes_no

Row = dict[str, Any]

SHEETS = {"plate": "a plate", "faint plate": "a faint plate", "flag": "a flag", "leafy": "leafy branches",
          "crown": "crowns of leaves", "open ball": "leaves spread over a ball, leaf area index up to 2",
          "dense ball": "the same, leaf area index from 3"}  # fmt: skip
"""How the names of bodies begin that are no closed skins, and what they are."""


@table("validation.md", "area.goals", "area_*")
def goals(result: Row) -> list[str]:
    """What was wanted, and what was measured."""
    rows = result["bodies"]
    off = {name: 100 * (row["open"] - 1) for name, row in rows.items() if not name.startswith(tuple(SHEETS))}
    found = []
    for what, unresolved in (
        ("closed skins, with layers, haze and clutter behind them", False),
        ("the same, beyond what is resolved", True),
    ):
        worst = max((n for n in off if n.startswith("unresolved") == unresolved), key=lambda n: abs(off[n]))
        measured = f"{off[worst]:+.1f} % at worst ({worst.removeprefix('unresolved: ')})"
        found.append([what, "the area of the skin within 5 %", measured, yes_no(abs(off[worst]) <= 5)])
    for kind, what in SHEETS.items():
        least = min(row["open"] for name, row in rows.items() if name.startswith(kind))
        found.append([what, "at least 95 % of the area", f"{100 * least:.1f} %", yes_no(least >= 0.95)])
    timed = result["timed"]
    found.append([f"time for {timed['gaussians']:,.0f} Gaussians on 2 cores, beyond `coverage`", "at most 2 s",
                  f"{timed['open_s']:.2f} s, {timed['open_cpu_s']:.2f} s of processor time "
                  f"(`coverage`: {timed['coverage_s']:.1f} s)",
                  yes_no(timed["open_s"] <= 2)])  # fmt: skip
    return [source(result), "", *grid(["what", "wanted", "measured", "reached"], found)]


@table("validation.md", "area.bodies", "area_*")
def bodies(result: Row) -> list[str]:
    """Areas of bodies, over the true area."""
    head = ["body", "Gaussians", "area [m²]", "`coverage`", "`open`"]
    found = [
        [
            name,
            f"{row['gaussians']:,.0f}",
            f"{row['area']:.2f}" + ("" if row["known"] else " (as `coverage` finds)"),
            f"{row['coverage']:.3f}",
            f"{row['open']:.3f}",
        ]
        for name, row in result["bodies"].items()
    ]
    return grid(head, found)


@value("area.capture", "area_*")
def capture(result: Row, name: str, kind: str) -> str:
    """An area of a captured splat in its own units: of ``coverage``, ``open`` or of the ``hull``."""
    row = result["captures"][name]
    return f"{row['hull'] if kind == 'hull' else row['area'] * row[kind]:.1f}"
