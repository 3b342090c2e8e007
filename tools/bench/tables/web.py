"""Table of ``bench.py web``: films for the web."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import grid, source

Row = dict[str, Any]


@table("web.md", "web.films", "web_*")
def films(result: Row) -> list[str]:
    """Size, error and speed of films."""
    head = ["film", "Gaussians", "nodes", "frames", "file [MB]", "largest error [% of the size]", "pictures a second"]
    found = [
        [
            name,
            f"{row['gaussians']:,}",
            f"{row['nodes']:,}",
            f"{row['frames']:,}",
            f"{row['bytes'] / 1e6:.1f}",
            f"{100 * row['error']:.4f}",
            f"{row['pictures_per_s']:.1f}",
        ]
        for name, row in result["films"].items()
    ]
    return [source(result), "", *grid(head, found)]
