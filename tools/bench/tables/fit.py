"""Tables of ``bench.py fit``: what was found from videos, and how far it is from the truth."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.markdown import grid, source, yes_no

Row = dict[str, Any]

OWN = (0.01, 1.0, 0.01)
TWO, ONE = (0.05, 3.0, 0.10), (0.10, 6.0, 0.20)
"""Goals: error of the speed, angle between the winds [degrees], error of E."""
ABLATIONS = ("tracks alone", "pixels alone", "without patches")
"""Rows that have no goal."""


@table("fit.md", "fit.own", "fit_*")
def own(result: Row) -> list[str]:
    """Fits of videos that this package made."""
    rows = result.get("own", {})
    if not rows:
        return [source(result), "", "Not measured on this device."]
    head = ["", "speed", "direction", "E", "predicted frames", "time", "within 1 % and 1 degree"]
    found = [[name, *_cells(row), "" if name in ABLATIONS else _reached(row, OWN)] for name, row in rows.items()]
    one = next(iter(rows.values()))
    told = f"{one['points']:,} points, videos of {one['size'][0]} x {one['size'][1]}, {one['until_s']:.3g} s fitted."
    return [source(result), "", told, "", *grid(head, found)]


@table("fit.md", "fit.blender", "fit_*")
def blender(result: Row) -> list[str]:
    """Fits of videos of Blender's cloth."""
    rows = result.get("blender", {})
    if not rows:
        return [source(result), "", "Not measured on this device."]
    head = ["", "speed", "direction", "E", "predicted frames", "time", "goal reached"]
    found = [[name, *_cells(row), _reached(row, ONE if "one camera" in name else TWO)] for name, row in rows.items()]
    return [source(result), "", *grid(head, found)]


def _cells(row: Row) -> list[str]:
    if "refused" in row:
        return ["refused", "", "", "", ""]
    stiffness = row.get("material.E_error")
    return [
        f"{100 * row['speed_error']:+.2f} %",
        f"{row['direction_error_deg']:.2f}°",
        "" if stiffness is None else f"{100 * stiffness:+.2f} %",
        "" if row["psnr_predicted_db"] is None else f"{row['psnr_predicted_db']:.1f} dB",
        f"{row['seconds']:.0f} s",
    ]


def _reached(row: Row, goal: tuple[float, float, float]) -> str:
    if "refused" in row:
        return "no"
    speed, angle, stiffness = goal
    return yes_no(
        abs(row["speed_error"]) <= speed
        and row["direction_error_deg"] <= angle
        and abs(row.get("material.E_error", 0.0)) <= stiffness
    )
