"""Tables of ``bench.py backward``."""

from __future__ import annotations

from typing import Any

from bench.cases.backward import LONG, SOUGHT
from bench.slots import table
from bench.tables.markdown import gib, grid, source, yes_no

Row = dict[str, Any]
PAGE = "validation.md"
MOST_TIMES, MOST_GIB, GOAL_POINTS = 4, 2, 90_000
"""Goals: backward per forward of a substep, and memory of a long rollout, of a sheet of about 100,000 points."""


def _by(row: Row) -> str:
    return row["by"] if "by" in row else row["transfer"]


@table(PAGE, "backward.rows", "backward_*")
def rows(result: Row) -> list[str]:
    """Time of a substep without a gradient, with one, and backward."""
    head = ["points", "held", "law", "computed by", "without gradient [ms]", "forward [ms]", "backward [ms]", "ratio"]
    found = []
    for row in result["rows"]:
        named = [f"{row['points']:,}", row["pin"] or "no", row["law"], _by(row)]
        if "failed" in row:
            found.append([*named, f"failed: {row['failed']}", "-", "-", "-"])
            continue
        times = [f"{row[name]['median_ms']:.3g}" for name in ("plain", "forward", "backward")]
        found.append([*named, *times, f"{row['ratio']:.1f}"])
    return [source(result), "", *grid(head, found)]


@table(PAGE, "backward.memory", "backward_*")
def memory(result: Row) -> list[str]:
    """Memory and time of the gradient through a long rollout."""
    head = ["points", "substeps", "computed by", "`checkpoint`", "memory [GiB]", "seconds"]
    found = []
    for row in result["memory"]:
        named = [f"{row['points']:,}", f"{row['steps']:,}", _by(row), str(row["checkpoint"] or "chosen")]
        if "failed" in row:
            found.append([*named, f"failed: {row['failed']}", "-"])
            continue
        found.append([*named, gib(row["memory_bytes"]), f"{row['seconds']:.2f}"])
    return grid(head, found)


@table(PAGE, "backward.agreement", "backward_*")
def agreement(result: Row) -> list[str]:
    """Difference of gradients in float32 from those of torch in float64."""
    found = []
    for row in result["agreement"]:
        if "failed" in row:
            found.append([f"{row['points']:,}", row["pin"], f"failed: {row['failed']}", *["-"] * len(SOUGHT)])
            continue
        for name in (name for name in ("kernels", "torch") if name in row):
            errors = [f"{row[name][key]:.1e}" for key in SOUGHT]
            found.append([f"{row['points']:,}", row["pin"], name, *errors])
    return grid(["points", "held", "float32 by", *SOUGHT], found)


@table(PAGE, "backward.goals", "backward_*")
def goals(result: Row) -> list[str]:
    """The goals."""
    found = []
    for row in result["rows"]:
        if row["points"] >= GOAL_POINTS and _by(row) == "kernels" and "failed" not in row:
            name = f"backward of a substep of {row['points']:,} points, held: {row['pin'] or 'no'}, {row['law']}"
            reached = yes_no(row["ratio"] <= MOST_TIMES)
            found.append([name, f"at most {MOST_TIMES} forward", f"{row['ratio']:.1f}", reached])
    for row in result["memory"]:
        if _by(row) == "kernels" and row["steps"] >= LONG and "failed" not in row:
            size = row["memory_bytes"]
            reached = yes_no(None if size is None else size <= MOST_GIB * 2**30)
            found.append(
                [f"memory of {row['steps']:,} substeps", f"at most {MOST_GIB} GiB", f"{gib(size)} GiB", reached]
            )
    return grid(["goal", "wanted", "measured", "reached"], found)
