"""Tables of ``bench.py soft``: our motion of a soft body beside Newton's, and what fits find."""

from __future__ import annotations

from typing import Any

from bench.slots import table
from bench.tables.fit import HEAD, cells
from bench.tables.markdown import grid, source

Row = dict[str, Any]


@table("fit.md", "fit.soft_motion", "soft_*", together=True)
def soft_motion(results: list[Row]) -> list[str]:
    """Motions at the true values beside Newton's, and Newton's on other meshes."""
    lines: list[str] = []
    for result in results:
        rows = []
        for name, row in result.get("motion", {}).items():
            rows.append([f"ours, {name}; {row['points']:,} points", *_moved(row)])
        for name, row in result.get("reference", {}).items():
            rows.append([f"Newton, {name}", *_moved(row)])
        if rows:
            head = ["", "mean distance", "largest distance", "first swing", "deflection later"]
            lines += ["", source(result), "", *grid(head, rows)]
    return lines[1:] or ["Not measured yet."]


@table("fit.md", "fit.soft", "soft_*", together=True)
def soft(results: list[Row]) -> list[str]:
    """Fits of the videos, on each device."""
    lines: list[str] = []
    for result in results:
        if rows := result.get("fits", {}):
            found = []
            for name, row in rows.items():
                base = [f"{row['until_s']:.3g} s", *(f"`{key}` {value}" for key, value in row["known"].items())]
                more = ["", ""]
                if "refused" not in row:
                    more = [f"{row['processor_s']:.0f} s", f"{row['psnr_rest_db']:.1f} dB"]
                found.append([name, *cells(row), *more, "; ".join(base)])
            head = [*HEAD, "of the processor", "splat at rest", "fitted; changes of scene.yaml"]
            lines += ["", source(result), "", *grid(head, found)]
    return lines[1:] or ["Not measured yet."]


def _moved(row: Row) -> list[str]:
    distances = [f"{1e3 * row['mean_m']:.2f} mm", f"{1e3 * row['largest_m']:.1f} mm"]
    return [*distances, _share(row["swing"]), _share(row["deflection"])]


def _share(value: float) -> str:
    return f"{100 * (value - 1):+.1f} %"
