"""Sections of pages that are made from records: ``python tools/bench.py report [--check]``.

A page has ``<!-- begin: NAME -->`` and ``<!-- end -->`` around what :func:`table` has declared under this name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace

from bench.runner import ROOT, read

SECTIONS: dict[str, Callable[[], str]] = {}


def table(
    name: str,
    records: str,
    head: str,
    row: Callable[[SimpleNamespace], str],
    where: Callable[[SimpleNamespace], bool] = lambda run: True,
) -> None:
    """Declare a table with one row for each run."""

    def make() -> str:
        runs = [run for run in read(records) if not hasattr(run, "failed") and where(run)]
        return grid(head, map(row, runs)) + "\n\n" + source(runs)

    SECTIONS[name] = make


def grid(head: str, rows: Iterable[str]) -> str:
    """A table of Markdown."""
    return "\n".join([f"| {head} |", "|" + "---|" * (head.count(" | ") + 1), *(f"| {row} |" for row in rows)])


def source(runs: list[SimpleNamespace]) -> str:
    """Where, when and with which commits it was measured."""
    told = []
    for device in dict.fromkeys(run.device for run in runs):
        own = sorted((run.date, run.commit) for run in runs if run.device == device)
        days, commits = (list(dict.fromkeys(part)) for part in zip(*own, strict=True))
        when, which = (part[0] if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in (days, commits))
        told.append(f"{device}, {when}, commit{'s' * (len(commits) > 1)} {which}.")
    return " ".join(told)


def reached(answer: bool) -> str:
    """Whether a goal is reached; what misses it is in bold."""
    return "yes" if answer else "**no**"


def filled(text: str) -> str:
    """A page with its sections made anew."""

    def one(found: re.Match[str]) -> str:
        return f"<!-- begin: {found[1]} -->\n\n{SECTIONS[found[1]]()}\n\n<!-- end -->"

    return re.sub(r"(?<!`)<!-- begin: ([\w.]+) -->\n.*?<!-- end -->", one, text, flags=re.DOTALL)


def report(check: bool = False, folder: Path = ROOT / "docs") -> list[str]:
    """Fill the pages of a folder, or only name those that differ from their records."""
    stale = []
    for path in sorted(folder.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        if (new := filled(text)) != text:
            stale.append(path.name)
            if not check:
                path.write_text(new, encoding="utf-8")
    return stale
