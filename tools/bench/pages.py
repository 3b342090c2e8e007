"""Fill the pages of the documentation that show records, in place."""

from __future__ import annotations

import json
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

from bench import record, slots, stamps
from bench.tables import (  # noqa: F401  each registers its slots
    accuracy,
    air,
    benchmarks,
    blender,
    contact,
    fit,
    flag_benchmark,
    goals,
    materials,
    measured,
    nature,
    others,
    plots,
    refinement,
    stability,
    training,
    validation,
)
from gaussian_swaying._files import write_text

PLOTS: dict[str, Callable[[list[record.Row], Path], None]] = {
    "accuracy_*": plots.accuracy,
    "blender_*": blender.plot,
    "contact_*": contact.plot,
    "nature_*": nature.plot,
    "pareto_*": plots.pareto,
    "refinement_*": refinement.plot,
    "speed_*": plots.speed,
    "stability_*": stability.plot,
}
"""Functions that draw into the folder of the pictures, by the records that they need."""


def fill(docs: Path, records: slots.Records, only: str | None = None) -> dict[Path, str]:
    """Fill the pages of a folder that have slots, and the README beside it, without writing them.

    Args:
        docs: Folder of the pages.
        records: The records.
        only: Name of a single page to fill, which may lack slots; None fills all pages, which may not.

    Returns:
        The text of each page.

    Raises:
        SlotError: If a page cannot be filled, or lacks a slot that a record needs.
    """
    if only is None:
        for page in sorted({slot.page for slot in slots.SLOTS.values() if slot.page}):
            if (docs / page).exists():
                slots.check_complete(page, (docs / page).read_text(), records)
            elif missing := slots.wanted(page, records):
                raise slots.SlotError(f"There is no {docs / page}, which has to show the slot `{missing[0]}`.")
    paths = [*sorted(docs.glob("*.md")), *docs.parent.glob("README.md")] if only is None else [docs / only]
    texts = {path: path.read_text() for path in paths}
    return {path: slots.fill(path.name, text, records) for path, text in texts.items() if slots.used(text)}


def refill(results: Path, only: str | None = None, age: bool = False) -> None:
    """Fill the pages next to a folder of results and draw their plots; with ``only``, one page if it exists.

    With ``age``, what has changed since each row was measured is found anew first. Otherwise the pages say what was
    found last, so that they depend on the files in the folder and not on the code.
    """
    docs = results.parent
    if only is not None and not (docs / only).exists():
        return
    if age:
        write_text(results / record.AGES, json.dumps(stamps.ages(record.read(results)), indent=2) + "\n")
    records = record.read(results)
    for path, text in fill(docs, records, only).items():
        write_text(path, text)
        print(f"wrote {path}")
    for pattern, draw in PLOTS.items():
        if found := [row for name, row in records.items() if fnmatch(name, pattern)]:
            draw(found, docs / "pictures")
