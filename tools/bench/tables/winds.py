"""Tables of ``bench.py winds``."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import grid, source, yes_no

Row = dict[str, Any]
PAGE = "wind.md"
LARGEST = {"cuda": 1.15, "cpu": 1.3}
"""Goals: time of a substep in turbulence, per that in uniform gusts."""
BOX = {"cuda": 0.2, "cpu": 2.0}
"""Goals: time to make a box [s]; on a CPU, with two cores."""


def _kind(result: Row) -> str:
    return "cuda" if "CPU" not in result["device"] else "cpu"


def _sheets(result: Row, part: str, what: str) -> list[str]:
    """A table of substeps: sheets in the order of their size, and what they are in or on."""
    found = []
    for row in sorted(result.get(part, []), key=lambda row: (row["formulation"], row["particles"])):
        name = f"`{row['formulation']}`, {row['particles']:,} points"
        if "failed" in row:
            found.append([name, f"failed: {row['failed']}", "-", "-", "-"])
            continue
        found.append([name, row[what], row["path"], f"{row['median_ms']:.3g}", f"{row['ratio']:.2f}"])
    first = {"wind": "per that in uniform gusts", "obstacle": "per that without"}[what]
    head = ["sheet", what, "runs in", "substep [ms]", first]
    return [source(result), "", *grid(head, found)] if found else ["Not recorded yet."]


@table(PAGE, "winds.rows", "winds_*")
def rows(result: Row) -> list[str]:
    """Time of a substep in each wind."""
    return _sheets(result, "rows", "wind")


@table(PAGE, "winds.obstacles", "winds_*")
def obstacles(result: Row) -> list[str]:
    """Time of a substep of a sheet that lies on each obstacle."""
    return _sheets(result, "obstacles", "obstacle")


@table(PAGE, "winds.goals", "winds_*")
def goals(result: Row) -> list[str]:
    """The goals."""
    kind = _kind(result)
    found = []
    for row in result.get("rows", []):
        if row["wind"] == "turbulence":
            name = f"substep in turbulence, `{row['formulation']}`, {row['particles']:,} points"
            reached = yes_no(row["ratio"] <= LARGEST[kind])
            found.append([name, f"at most {LARGEST[kind]} times uniform gusts", f"{row['ratio']:.2f}", reached])
    box = result.get("box", {"cells": []})
    size = " x ".join(map(str, box["cells"]))
    for name in [name for name in ("isotropic", "sheared") if f"{name}_s" in box]:
        seconds = box[f"{name}_s"]
        found.append(
            [f"box of {size}, {name}", f"at most {BOX[kind]} s", f"{seconds:.2f} s", yes_no(seconds <= BOX[kind])]
        )
    return grid(["goal", "wanted", "measured", "reached"], found)
