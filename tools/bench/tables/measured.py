"""Table of when, and from which code, each row of every record was measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from bench import stamps
from bench.tables.markdown import stack
from bench.tables.render import Row, table

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


def _stamps(results: list[Row]) -> Iterator[Row]:
    """Every stamp of every record, with its rows."""
    for result in results:
        for stamp in sorted(result.get("measured", {}).values(), key=lambda one: str(one["date"])):
            tree = {True: "clean", False: "changed", None: "not recorded"}[stamp["clean"]]
            commit = f"recorded in {stamp['commit'][:7]}" if stamp.get("from_history") else str(stamp["commit"])[:7]
            made = stack(stamp) or "not recorded"
            yield stamp | {"rows": labels(result, stamp["rows"]), "tree": tree, "commit": commit, "made": made,
                           "changed": stamp["older"] or None}  # fmt: skip


# no page must have it: a folder of a few results has no page for them
table(None, "measured.rows", "*", _stamps, """
    record = {record} | rows = {rows} | date (UTC) = {date or 'not recorded'} | commit = {commit} | tree = {tree} |
    versions = {made} | changed since = {changed}
    """, together=True)  # fmt: skip
