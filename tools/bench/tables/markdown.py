"""Building blocks of the tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def grid(head: list[str], rows: Iterable[list[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(head)} |", "|" + "---|" * len(head), *(f"| {' | '.join(row)} |" for row in rows)]


def stack(result: dict[str, Any]) -> str:
    """The software versions of a record."""
    return ", ".join(f"{name} {version}" for name, version in result["versions"].items())


def source(result: dict[str, Any]) -> str:
    """One line: the device, the versions and the seed of a record, and when it was measured."""
    seed = f"; seed {result['seed']}" if "seed" in result else ""
    return f"{result['device']}; {stack(result)}{seed}.{measured(result)}"


def measured(result: dict[str, Any]) -> str:
    """A sentence: the days on which the rows were measured, and how many are older than the code that they measure."""
    stamps = [stamp for stamp in result.get("measured", {}).values() if stamp["date"]]
    if not stamps:
        return ""
    days = sorted({stamp["date"][:10] for stamp in stamps})
    told = f" Measured {days[0] if len(days) == 1 else f'from {days[0]} to {days[-1]}'}"
    old = [stamp for stamp in stamps if stamp.get("older")]
    if not old:
        return f"{told}."
    count, of = (sum(len(stamp["rows"]) for stamp in part) for part in (old, stamps))
    parts = ", ".join(sorted({part for stamp in old for part in stamp["older"]}))
    which = "" if count == of else f"{count} of {of} rows "
    return f"{told}, {which}[before the last change](benchmarks.md#when-it-was-measured) of {parts}."


def yes_no(reached: bool | None) -> str:
    """``yes``, ``no``, or a dash for None."""
    return "-" if reached is None else "yes" if reached else "no"


def gib(size: float | None, digits: int = 2) -> str:
    """Bytes as GiB; a dash for None."""
    return "-" if size is None else f"{size / 2**30:.{digits}f}"


def digits(value: float | None) -> str:
    """Three digits, without exponents; a dash for None."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
