"""Table of ``bench.py previews``: what the preview announces, and what the run takes."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import grid, source

Row = dict[str, Any]


@table("benchmarks.md", "previews.rows", "previews_*")
def rows(result: Row) -> list[str]:
    """Announced and taken times of whole processes."""
    head = ["run", "frames", "announced [s]", "taken [s]", "announced / taken", "substeps a frame, announced and taken"]
    found = []
    for name, entry in result["previews"].items():
        run = entry["run"]
        what = f"{name}, `--preset {entry['preset']}`" if entry.get("preset") else name
        found.append(
            [
                what,
                str(run["frames"]),
                f"{run['announced_s']:.0f}",
                f"{run['process_s']:.0f}",
                f"{run['ratio']:.2f}",
                f"{run['announced_substeps']:.0f}, {run['substeps']:.0f}",
            ]
        )
    return [source(result), "", *grid(head, found)]
