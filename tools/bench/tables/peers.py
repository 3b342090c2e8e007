"""Table of other solvers, whose figures were measured outside the project."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import grid, source

Row = dict[str, Any]
PAGE = "benchmarks.md"


@table(PAGE, "peers.rows", "peers")
def rows(result: Row) -> list[str]:
    """Time of a substep of each solver and number of points."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in result["rows"]:
        found.setdefault((row["case"], row["solver"]), []).append(f"{row['points']:,}: {row['ms']:g}")
    shown = [[case, solver, "; ".join(times)] for (case, solver), times in sorted(found.items())]
    lines = [result["note"], "", f"{source(result)} {result['made']}", ""]
    return [*lines, *grid(["what", "solver", "points: time of a substep [ms]"], shown)]
