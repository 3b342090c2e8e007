"""Tables of ``bench.py folds``: a flag that folds onto itself, against other cloth solvers."""

from __future__ import annotations

from typing import Any

from bench.cases.folds import REFERENCES, ROWS
from bench.slots import table
from bench.tables.markdown import grid, source, yes_no

Row = dict[str, Any]
PAGE = "contact.md"

_ABOVE = 0.02  # goal: how much farther from a reference than it is from itself, as a share of the longer side


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f} %"


def _count(row: Row) -> str:
    """Crossings in all counted frames; a dash if none were counted."""
    return str(sum(row["crossings"])) if row["crossings"] else "-"


def _doubt(known: Row) -> float | None:
    """The largest distance of a reference from itself, solved otherwise."""
    found = [row["chamfer"] for row in known.get("uncertainty", {}).values()]
    return max(found) if found else None


def _apart(result: Row, one: str, other: str) -> float | None:
    return result["apart"].get(f"{one} {other}", result["apart"].get(f"{other} {one}"))


@table(PAGE, "folds.rows", "folds_*")
def rows_table(result: Row) -> list[str]:
    """Distances of our rows and of the references to each reference, and crossings."""
    known = result["references"]
    names = [name for name in REFERENCES if name in known]
    lines = []
    for name, fold in ROWS.items():
        row = result.get("rows", {}).get(name)
        if row is None:
            continue
        if "failed" in row or row["status"] != "complete":
            lines.append([fold.title(), *("failed" for _ in names), "-"])
            continue
        near = [_share(row["to"].get(other, {}).get("chamfer_share")) for other in names]
        lines.append([fold.title(), *near, _count(row)])
    for name in names:
        near = ["" if other == name else _share(_apart(result, name, other)) for other in names]
        lines.append([REFERENCES[name], *near, _count(known[name])])
    lines.append(["the reference itself, solved otherwise", *(_share(_doubt(known[name])) for name in names), ""])
    return [source(result), "", *grid(["", *(REFERENCES[name] for name in names), "crossings"], lines)]


@table(PAGE, "folds.references", "folds_*")
def references_table(result: Row) -> list[str]:
    """Meshes and steps of the references."""
    lines = [
        [REFERENCES[name], f"{row['cells']}", f"{row['quality']}", f"{row['frames']}", _variants(row)]
        for name, row in result["references"].items()
    ]
    return grid(["reference", "cells along the flag", "steps per frame", "frames", "solved otherwise"], lines)


def _variants(row: Row) -> str:
    found = row.get("uncertainty", {})
    return "; ".join(
        f"{name} ({one['cells']} cells, {one['quality']} steps) {_share(one['chamfer'])}" for name, one in found.items()
    )


@table(PAGE, "folds.goals", "folds_*")
def goals(result: Row) -> list[str]:
    """The goal for each row, against the reference with the same contact."""
    lines = []
    for name, fold in ROWS.items():
        row = result.get("rows", {}).get(name, {})
        other = "blender_contact" if fold.contact else "blender"
        doubt = _doubt(result["references"].get(other, {}))
        near = row.get("to", {}).get(other, {}).get("chamfer_share")
        if near is None or doubt is None:
            continue
        goal = f"{fold.title()}: within {100 * _ABOVE:g} % above the uncertainty of {REFERENCES[other]}"
        lines.append([goal, f"{_share(near)}, {_share(doubt)} + {100 * _ABOVE:g} %", yes_no(near <= doubt + _ABOVE)])
    return grid(["goal", "measured", "reached"], lines) if lines else ["This record has none of our flags."]
