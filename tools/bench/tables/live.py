"""The table of ``bench.py live``."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import grid, source

Row = dict[str, Any]
GOALS = {("flag", "cpu"): 10.0, ("guitar", "cpu"): 5.0, ("large flag", "cuda"): 25.0}
"""Pictures a second that are wanted on two cores, and on an H200."""


@table("live.md", "live.rates", "live_*")
def rates(result: Row) -> list[str]:
    """Pictures a second, how fast simulated time passes, and how soon a control shows."""
    head = ["scene", "Gaussians", "points", "window", "picture", "pictures a second", "wanted", "KB a picture"]
    head += ["simulated seconds per second", "step [s]", "a control shows after [ms]"]
    kind = "cpu" if "CPU" in result["device"] else "cuda"
    rows = []
    for row in result["rows"]:
        wanted = GOALS.get((row["name"], kind))
        rows.append(
            [
                row["name"],
                f"{row['gaussians']:,}",
                f"{row['points']:,}",
                "x".join(map(str, row["window"])),
                row["picture"] or "-",
                f"{row['pictures_per_s']:.1f}",
                "-" if wanted is None else f"{wanted:g}",
                "-" if row["picture_bytes"] is None else f"{row['picture_bytes'] / 1e3:.0f}",
                f"{row['real_time']:.2g}",
                f"{row['step_s']:.3g}",
                f"{row['latency_ms']:.0f}",
            ]
        )
    return [source(result), "", "Received by one client on the same machine, without a browser.", "", *grid(head, rows)]
