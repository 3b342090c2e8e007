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
    """One line: the device, the versions and the seed of a record."""
    seed = f"; seed {result['seed']}" if "seed" in result else ""
    return f"{result['device']}; {stack(result)}{seed}."


def yes_no(reached: bool | None) -> str:
    """``yes``, ``no``, or a dash for None."""
    return "-" if reached is None else "yes" if reached else "no"


def gib(size: float | None, digits: int = 2) -> str:
    """Bytes as GiB; a dash for None."""
    return "-" if size is None else f"{size / 2**30:.{digits}f}"
