"""The table of ``bench.py live``."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import grid, source

Row = dict[str, Any]
GOALS = {("flag", "cpu"): 10.0, ("guitar", "cpu"): 5.0}
"""Pictures a second that are wanted on two cores."""


@table("live.md", "live.rates", "live_*")
def rates(result: Row) -> list[str]:
    """Pictures a second, and how fast simulated time passes."""
    head = ["scene", "Gaussians", "points", "picture", "pictures a second", "wanted", "simulated seconds per second"]
    head += ["step [s]", "time of a picture [ms]"]
    kind = "cpu" if "CPU" in result["device"] else "cuda"
    rows = []
    for row in result["rows"]:
        wanted = GOALS.get((row["name"], kind))
        rows.append(
            [
                row["name"],
                f"{row['gaussians']:,}",
                f"{row['points']:,}",
                f"{row['width']}x{row['height']}",
                f"{row['pictures_per_s']:.1f}",
                "-" if wanted is None else f"{wanted:g}",
                f"{row['real_time']:.2g}",
                f"{row['step_s']:.3g}",
                f"{row['picture_ms']:.0f}",
            ]
        )
    return [source(result), "", "The simulation and the drawing, without a browser.", "", *grid(head, rows)]
