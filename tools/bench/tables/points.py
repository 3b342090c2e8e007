"""Table of ``bench.py points``."""

from __future__ import annotations

from typing import Any

from bench.cases.points import NUDGE, configuration
from bench.slots import table, value
from bench.tables.markdown import grid, source, yes_no

Row = dict[str, Any]
PAGE = "validation.md"
GOAL = 0.01
"""Largest mean distance from one point to a Gaussian, as a share of the largest mean displacement."""


def _title(way: str) -> str:
    if way == "gaussian":
        return "one point to a Gaussian"
    if way == "nudged":
        return f"the same, dx {100 * (NUDGE - 1):.0f} % larger"
    return f"`grid`, {way.removeprefix('grid ')} along the side of a cell"


@table(PAGE, "points.rows", "points_*")
def rows(result: Row) -> list[str]:
    """Error and time against the points of a cell."""
    head = ["scene", "points", "number", "mean distance", "at the end", "ms a frame", "substeps"]
    found = []
    for row in result["rows"]:
        error = [f"{100 * row[name]:.2f} %" if name in row else "-" for name in ("error", "error_last")]
        if "failed" in row:
            found.append([row["scene"], _title(row["way"]), "-", "diverged", "-", "-", "-"])
            continue
        number = f"{row['points']:,}" + (f" of {row['gaussians']:,} Gaussians" if row["way"] == "gaussian" else "")
        found.append(
            [row["scene"], _title(row["way"]), number, *error, f"{row['ms_per_frame']:.1f}", f"{row['substeps']:,}"]
        )
    return [source(result), "", *grid(head, found)]


@table(PAGE, "points.goals", "points_*")
def goals(result: Row) -> list[str]:
    """What each scene is configured with against the goal, and against what a slightly larger dx changes."""
    head = ["scene", "goal", "as configured", "reached", f"dx {100 * (NUDGE - 1):.0f} % larger"]
    by = {(row["scene"], row["way"]): row for row in result["rows"]}
    found = []
    for scene in dict.fromkeys(row["scene"] for row in result["rows"]):
        configured = configuration(scene, None)["scene"]
        way = "gaussian" if configured.get("points") == "gaussian" else f"grid {configured.get('points_per_cell', 2)}"
        own, nudged = (by.get((scene, name), {}).get("error") for name in (way, "nudged"))
        shown = ["diverged" if e is None else f"{100 * e:.2f} %" for e in (own, nudged)]
        reached = own is not None and own <= GOAL
        found.append([scene, f"at most {100 * GOAL:.0f} %", f"{shown[0]} ({_title(way)})", yes_no(reached), shown[1]])
    return grid(head, found)


@value("points.frames", "points_*")
def frames(result: Row) -> str:
    """Frames of the runs."""
    return str(result["rows"][0]["frames"])
