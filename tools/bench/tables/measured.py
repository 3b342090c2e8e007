"""Table of when, and from which code, each row of every record was measured."""

from __future__ import annotations

from collections import Counter
from typing import Any

from bench import stamps
from bench.slots import value
from bench.tables.markdown import grid

Row = dict[str, Any]
_NAMES = ("problem", "solver", "name", "scene", "case", "wind", "obstacle", "variant", "formulation", "dx_m")


def labels(result: Row, places: dict[str, str]) -> str:
    """The rows of a stamp: of a list how many of each kind, of a table their names."""
    of, grouped = dict(stamps.rows(result)), dict[str, Counter[str]]()
    for place in places:
        first, _, last = place.rpartition("/")
        if isinstance(result.get(first), list) and place in of:
            last = str(next((of[place][name] for name in _NAMES if of[place].get(name) is not None), first))
        grouped.setdefault(first.removeprefix("rows").removeprefix("/"), Counter())[last] += 1
    told = []
    for first, names in grouped.items():
        listed = "; ".join(f"{name} ({times})" if times > 1 else name for name, times in names.items())
        told.append(f"{first}: {listed}" if first else listed)
    return ". ".join(told)


@value("measured.rows", "*", together=True)  # optional: a folder of a few results has no page for them
def rows(results: list[Row]) -> list[str]:
    """Every stamp of every record, with its rows."""
    head = ["record", "rows", "date (UTC)", "commit", "tree", "versions", "changed since"]
    shown = []
    for result in results:
        for stamp in sorted(result.get("measured", {}).values(), key=lambda one: str(one["date"])):
            tree = {True: "clean", False: "changed", None: "not recorded"}[stamp["clean"]]
            commit = f"recorded in {stamp['commit'][:7]}" if stamp.get("from_history") else str(stamp["commit"])[:7]
            made = ", ".join(f"{name} {version}" for name, version in stamp["versions"].items()) or "not recorded"
            shown.append([stamp["record"], labels(result, stamp["rows"]), stamp["date"] or "not recorded",
                          commit, tree, made, ", ".join(stamp["older"]) or "-"])  # fmt: skip
    return grid(head, shown)
