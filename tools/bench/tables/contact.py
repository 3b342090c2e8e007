"""Tables of ``bench.py contact``."""

from __future__ import annotations

from typing import Any

from bench.cases.contact import CASES
from bench.slots import table
from bench.tables.markdown import grid, source

Row = dict[str, Any]
PAGE = "contact.md"


@table(PAGE, "contact.cost", "contact_*")
def cost(result: Row) -> list[str]:
    """Time of a substep without contact, with it but nothing near, and with everything in contact."""
    head = ["points", *(f"{case} [ms]" for case in CASES), "pairs listed for all", "a fifth / off", "all / off"]
    lines = []
    for points in sorted({row["wanted"] for row in result["rows"]}):
        of = {row["case"]: row for row in result["rows"] if row["wanted"] == points}
        if set(of) != set(CASES):
            continue
        times = [of[case]["median_ms"] for case in CASES]
        shown = [f"{time:.3g}" for time in times]
        ratios = [f"{time / times[0]:.2f}" for time in times[-2:]]
        lines.append([f"{of['off']['points']:,}", *shown, f"{of[CASES[-1]]['pairs']:,}", *ratios])
    return [source(result), "", *grid(head, lines)]


@table(PAGE, "contact.collisions", "contact_*")
def collisions(result: Row) -> list[str]:
    """How close two sheets come that collide."""
    head = ["speed [m/s]", "pairs of all frames", "closest", "closer than half", "crossings", "momentum lost"]
    lines = [
        [
            f"{row['speed_m_s']:g}",
            f"{row['pairs']:,}",
            f"{row['closest']:.2f} thicknesses",
            f"{100 * row['closer_than_half']:.3f} %",
            str(row["crossings"]),
            f"{row['momentum_change']:.1e}",
        ]
        for row in result["collisions"]
    ]
    return [source(result), "", *grid(head, lines)]


@table(PAGE, "contact.pile", "contact_cuda")
def pile(result: Row) -> list[str]:
    """How a pile rests: its first second, and every tenth."""
    rows = result.get("pile", [])
    if not rows:
        return ["Not recorded."]
    first, lines = rows[0], []
    for row in [first, *(row for row in rows if round(row["time"]) % 10 == 0)]:
        lines.append(
            [
                f"{row['time']:.0f}",
                f"{row['kinetic']:.1e}",
                f"{row['elastic'] - first['elastic']:+.1e}",
                f"{row['potential'] - first['potential']:+.1e}",
                f"{row['top'] - first['top']:+.4f}",
                f"{1e3 * (row['slid'] - first['slid']):+.2f}",
                f"{row['rounds']:.1f}" if "rounds" in row else "-",
            ]
        )
    head = ["time [s]", "motion", "bending", "height", "top layer [thicknesses]", "slid [mm]", "iterations"]
    return [source(result), "", *grid(head, lines)]
