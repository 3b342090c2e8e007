"""The renderer: tables, values within sentences and goals, declared by templates that are filled from rows of records.

A template is text with fields. ``{wall_s.writing:.1f}`` is a place within the row and a format; ``{bytes:.2f GiB}`` has
a unit too, for which the number is scaled; ``{bytes:.2f (GiB)}`` is scaled likewise and leaves the unit to the heading.
``{by or transfer or 'none'}`` is the first that is there. What is recorded as null is a dash; what is not recorded is
an error. ``[[ of {all} Gaussians]]`` is left out if one of its fields is null or not there. Lists are told one by one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench import slots
from bench.tables.markdown import digits, grid, measured, source, stack, yes_no

Row = dict[str, Any]
Rows = str | Callable[[Any], Iterable[Row]]
"""Rows of a record (or of a list of records): their place, where the rows of a table get their name as ``key``, or a
function that makes them."""

SCALES = {"%": 100, "mm": 1e3, "min": 1 / 60, "GiB": 2**-30, "MiB": 2**-20,
          "KB": 1e-3, "MB": 1e-6, "10⁶": 1e-6, "GB": 1e-9, "GB/s": 1e-9}  # fmt: skip
"""How numbers are scaled for a unit; for other units they are left as they are."""

_ABOUT: dict[str, Callable[[Row], str]] = {"source": source, "stack": stack, "dates": measured}
_FIELD = re.compile(r"{([^{}:]*)(?::([^{}]*))?}")
_OPTIONAL = re.compile(r"\[\[(.*?)\]\]", re.DOTALL)
_FORMAT = re.compile(r"(?P<form>\S*?)(?: (?P<shown>[^() ]+)| \((?P<hidden>[^() ]+)\))?")
_COMPARED = {
    "<=": lambda a, b: a <= b,
    ">=": lambda a, b: a >= b,
    "<": lambda a, b: a < b,
    ">": lambda a, b: a > b,
    "is": lambda a, b: a == b,
    "not": lambda a, b: a != b,
}


def find(row: Mapping[str, Any], place: str) -> Any:
    """What a row has at a place such as ``wall_s.writing or 'none'``; numbers, truths and quoted words are themselves.

    Raises:
        KeyError: If it has nothing there.
    """
    *first, last = place.split(" or ")
    for one in first:
        try:
            if (value := find(row, one)) is not None:
                return value
        except KeyError:
            continue
    if last[:1] == "'":
        return last.strip("'")
    if last in ("True", "False"):
        return last == "True"
    if re.fullmatch(r"[-+.\d][-+.\de]*", last) and last not in row:
        return float(last)
    if last in row:
        return row[last]
    names = last.split(".")
    for count in range(1, len(names)):  # a name may have dots itself
        if isinstance(inner := row.get(".".join(names[:count])), Mapping):
            return find(inner, ".".join(names[count:]))
    raise KeyError(last)


def told(value: Any, form: str = "") -> str:
    """A value in a format, with a unit; a dash for None, ``yes`` or ``no`` for a truth, each of a list."""
    if value is None or isinstance(value, bool):
        return f"**{yes_no(value)}**" if value is False and form == "bold" else yes_no(value)
    if isinstance(value, str):
        return value
    if isinstance(value, (list, tuple)):
        return ", ".join(told(one, form) for one in value)
    parts = _FORMAT.fullmatch(form)
    assert parts is not None, form
    unit = parts["shown"] or parts["hidden"]
    value = value * SCALES[unit] if unit in SCALES else value
    text = digits(value) if parts["form"] == "digits" else format(value, parts["form"])
    return text + (" " * (unit != "°") + unit if parts["shown"] else "")


def fill(template: str, row: Mapping[str, Any]) -> str:
    """A template filled from a row."""
    kept = _OPTIONAL.sub(lambda part: part[1] * all(_is_there(row, place) for place, _ in _FIELD.findall(part[1])),
                         template)  # fmt: skip
    return _FIELD.sub(lambda field: told(find(row, field[1]), field[2] or ""), kept)


def _is_there(row: Mapping[str, Any], place: str) -> bool:
    return find(row, f"{place} or ''") != ""


def holds(row: Mapping[str, Any], condition: str) -> bool | None:
    """Whether a condition such as ``ratio <= 1.5 and wind is 'gusts'`` holds; None if something is recorded as null.

    Of lists, whether it holds for each; ``|error| <= 0.1`` is about a size.
    """
    for part in condition.split(" and "):
        left, name, right = part.rsplit(" ", 2)
        value, limit = find(row, left.strip("|")), find(row, right)
        if value is None or limit is None:
            return None
        each = value if isinstance(value, list) else [value]
        if not all(_COMPARED[name](abs(one) if left[0] == "|" else one, limit) for one in each):
            return False
    return True


def rows_of(record: Any, rows: Rows) -> list[Row]:
    """The rows of a record; none where it has nothing."""
    if callable(rows):
        return list(rows(record))
    found = find(record, rows) if _is_there(record, rows) else []
    return [row | {"key": key} for key, row in found.items()] if isinstance(found, dict) else found


def columns_of(columns: str) -> list[list[str]]:
    """Headings and templates of columns in the form ``heading = template | heading = template``."""
    return [[part.strip() for part in re.split(r"=\s", column, maxsplit=1)] for column in re.split(r"\s\|\s", columns)]


def lines(rows: Iterable[Row], columns: str) -> list[str]:
    """A table of rows in Markdown.

    Each row fills the templates of the columns. A row that ``failed`` says so in its first cell that cannot be filled.
    Headings are filled from the first row. Where one begins with a star, it is filled from each: rows that are equal in
    the other columns become one, with a column for each of these headings. A row that cannot fill such a heading has
    no cell there.
    """
    rows, named = list(rows), columns_of(columns)
    merged: dict[Any, dict[Any, str]] = {}
    heads: list[dict[str, None]] = [{} for _ in named]
    for number, row in enumerate(rows):
        cells, failed = {}, [f"failed: {row['failed']}".replace("\n", " ")] if "failed" in row else []
        for place, (head, template) in enumerate(named):
            try:
                name = fill(head[1:], row) if head[:1] == "*" else ""
            except KeyError:
                continue
            heads[place][name] = None
            try:
                cells[place, name] = fill(template, row)
            except KeyError:
                if "failed" not in row:
                    raise
                cells[place, name] = failed.pop() if failed else "-"
        plain = tuple(text for (_, name), text in cells.items() if not name)
        merged.setdefault(plain if len(plain) < len(named) else number, {}).update(cells)
    pivots = [head[:1] == "*" for head, _ in named]
    shown = [(place, name) for place, names in enumerate(heads) for name in names or [""] * (not pivots[place])]
    told = [name or (fill(named[place][0], rows[0]) if rows else named[place][0]) for place, name in shown]
    return grid(told, ([cells.get(key, "-") for key in shown] for cells in merged.values()))


def table(
    page: str | None,
    name: str,
    records: str,
    rows: Rows | None = None,
    columns: str = "",
    *,
    before: str | Callable[[Any], str] = "",
    after: str = "",
    order: Sequence[str] = (),
    together: bool = False,
    each: bool = False,
    empty: str | None = None,
) -> None:
    """Declare a table, which ``page`` must have once for each record.

    Args:
        page: The page; None if no page must have it.
        name: Name of its slot.
        records: Pattern of the records.
        rows: Its rows; None for text alone.
        columns: Its columns, see :func:`columns_of`; a template that begins with ``- `` makes a list instead.
        before: Template of what stands before it, or a function that makes it; ``{source}`` is the device, the versions
            and the dates, ``{stack}`` the versions and ``{dates}`` the dates.
        after: Template of what stands after it.
        order: Places by which the rows are sorted.
        together: Whether it is one table of all records.
        each: Whether the page has one slot, with a table for each record that has such rows.
        empty: What stands there if there are no rows; None for a table without rows.
    """

    def one(record: Any) -> list[str]:
        found = [] if rows is None else rows_of(record, rows)
        found = sorted(found, key=lambda row: [find(row, place) for place in order])
        if rows is not None and not found and (each or empty is not None):
            return []
        first = before(record) if callable(before) else before
        about = ({} if together else record) | {
            name: make(record) for name, make in _ABOUT.items() if f"{{{name}}}" in first
        }
        listed = columns[:2] == "- " or rows is None
        body = [fill(columns, row) for row in found] if listed else lines(found, columns)
        parts = [fill(first, about)] * bool(first), body, [fill(after, about)] * bool(after)
        return [line for part in parts if part for line in ("", *part)][1:]

    def make(record: Any) -> list[str]:
        blocks = [one(single) for single in record] if each else [one(record)]
        return [line for block in blocks if block for line in ("", *block)][1:] or ([empty] if empty else [])

    slots.table(page, name, records, together or each)(make)


def value(
    name: str, records: str, template: str, rows: Callable[[Any], Row] | None = None, together: bool = False
) -> None:
    """Declare a value within a sentence.

    Args:
        name: Name of its slot.
        records: Pattern of the records.
        template: Its template; ``$1`` and so on are the further words of the slot.
        rows: Function of the record that makes the row; None for the record itself.
        together: Whether it is about all records.
    """

    def make(record: Any, *words: str) -> str:
        own = template
        for number, word in enumerate(words, 1):
            own = own.replace(f"${number}", word)
        return fill(own, rows(record) if rows else record)

    slots.SLOTS[name] = slots.Slot(name, None, records, together, make, len(set(re.findall(r"\$\d", template))))


@dataclass(frozen=True)
class Goal:
    """A goal for each of some rows.

    Attributes:
        goal: Template that says what is wanted; ``{limit}`` is the last number of the condition.
        measured: Template of what was measured.
        reached: Condition.
        rows: The rows; those that lack what the goal needs have none.
        where: Condition of the rows that have the goal.
        more: Templates of further cells, by name.
        stretch: Condition of a further goal.
        always: Whether a row that lacks what it needs has the goal too: missed if it failed, or not measured.
    """

    goal: str
    measured: str
    reached: str
    rows: Rows = "rows"
    where: str = ""
    more: Mapping[str, str] | None = None
    stretch: str = ""
    always: bool = False

    def of(self, rows: Iterable[Row]) -> Iterator[Row]:
        """For each row, one of a table of goals, with ``goal``, ``measured``, ``reached`` and ``stretched``."""
        for row in rows:
            most = self.reached.rsplit(" ", 1)[1]
            about = row | {"limit": find(row, most) if _is_there(row, most) else None}
            try:
                if not self.where or holds(row, self.where):
                    cells = {"measured": fill(self.measured, about), "reached": holds(row, self.reached)}
                    stretched = holds(row, self.stretch) if self.stretch else None
                    yield self._cells(about) | cells | {"stretched": stretched}
            except KeyError:
                if self.always:
                    missed = False if "failed" in row else None
                    cells = {"measured": row.get("failed", "-"), "reached": missed}
                    yield self._cells(about) | cells | {"stretched": missed if self.stretch else None}

    def _cells(self, row: Row) -> Row:
        return {name: fill(text, row) for name, text in (("goal", self.goal), *(self.more or {}).items())}


GOAL = "goal = {goal} | measured = {measured} | reached = {reached}"
BECAUSE = """goal = {goal} | wanted = {wanted} | where this comes from = {why} | measured = {measured} |
    reached = {reached:bold}"""
WANTED = "goal = {goal} | wanted = {wanted} | measured = {measured} | reached = {reached}"


def judged(goals: Sequence[Goal], rows: Rows | None = None) -> Callable[[Any], list[Row]]:
    """The rows of a table of goals, goal by goal; with ``rows``, which all of them are about, row by row."""
    if rows is None:
        return lambda record: [row for goal in goals for row in goal.of(rows_of(record, goal.rows))]
    return lambda record: [row for one in rows_of(record, rows) for goal in goals for row in goal.of([one])]
