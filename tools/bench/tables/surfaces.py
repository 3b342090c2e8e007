"""Tables of ``bench.py surfaces``."""

from __future__ import annotations

from typing import Any

from bench.cases.surfaces import WAYS
from bench.cases.trained import NORMALS, SIZES
from bench.slots import table
from bench.tables.markdown import grid, source, yes_no

Row = dict[str, Any]
PAGE = "training.md"
TILT, SHARE, LOSS, TIMES = 0.1, 0.02, 0.2, 1.6
"""Goals: tilt of a patch of 40 cm [degrees], distance to the reference as a share of the longer side, PSNR lost [dB],
and time per that of the paper's losses."""

MEANT = ("fade", "views")
"""Ways that are meant to reach the goals; the first that was measured counts."""


def _all(values: list[float], form: str) -> str:
    """The values of all seeds."""
    return ", ".join(form.format(value) for value in values)


def _runs(result: Row, way: str) -> list[Row]:
    return [row for _, row in sorted(result["rows"].get(way, {}).items()) if "tilt" in row]


def goals(result: Row) -> list[tuple[str, str, bool]]:
    """The goals, the measured values of the way that is meant to reach them, and whether all runs do."""
    runs = next((found for way in MEANT if (found := _runs(result, way))), [])
    if not runs:
        return []
    tilt = [row["tilt"]["neighbours"]["tilt_40cm_deg"] for row in runs]
    share = [row["chamfer"]["neighbours"] for row in runs]
    pattern, plain = result["pattern"], _runs(result, "paper")
    found = [
        (f"tilt over 40 cm at most {TILT:g}°", _all(tilt, "{:.2f}°"), max(tilt) <= TILT),
        (
            f"pattern {pattern}: Chamfer distance at most {100 * SHARE:g} % of the longer side",
            _all([100 * value for value in share], "{:.2f} %"),
            max(share) <= SHARE,
        ),
    ]
    if len(plain) == len(runs) and all("seconds" in row and row["psnr_db"] for row in [*plain, *runs]):
        lost = [before["psnr_db"] - row["psnr_db"] for before, row in zip(plain, runs, strict=True)]
        times = [row["seconds"] / before["seconds"] for before, row in zip(plain, runs, strict=True)]
        found.append((f"PSNR at most {LOSS:g} dB lower", _all(lost, "{:.2f} dB"), max(lost) <= LOSS))
        found.append((f"training at most {TIMES:g} times as long", _all(times, "{:.2f} times"), max(times) <= TIMES))
    return found


@table(PAGE, "surfaces.goals", "surfaces_*")
def goal_table(result: Row) -> list[str]:
    """The device, and the goals with the two-view losses and normals of neighbouring centres."""
    rows = [[goal, measured, yes_no(reached)] for goal, measured, reached in goals(result)]
    return [source(result), "", *grid(["goal", "measured, one value for each seed", "reached"], rows)]


@table(PAGE, "surfaces.rows", "surfaces_*")
def rows_table(result: Row) -> list[str]:
    """Tilt, height, PSNR, time and distance of each way to train, one value for each seed."""
    head = ["losses", "normals", *(f"tilt over {round(100 * size)} cm [°]" for size in SIZES), "median angle [°]"]
    head += ["height [mm rms]", "Chamfer [%]", "PSNR [dB]", "seconds"]
    rows = []
    for way, (title, _) in WAYS.items():
        runs = _runs(result, way)
        if not runs:
            continue
        for normals, origin in NORMALS.items():
            tilt = [row["tilt"][normals] for row in runs]
            first = normals == next(iter(NORMALS))
            cells = [title if first else "", origin]
            cells += [_all([t[f"tilt_{round(100 * size)}cm_deg"] for t in tilt], "{:.2f}") for size in SIZES]
            cells.append(_all([t["median_deg"] for t in tilt], "{:.2f}"))
            cells.append(_all([row["tilt"]["height_rms_mm"] for row in runs], "{:.2f}") if first else "")
            cells.append(_all([100 * row["chamfer"][normals] for row in runs], "{:.2f}"))
            cells.append(_all([row["psnr_db"] for row in runs if row["psnr_db"]], "{:.1f}") if first else "")
            cells.append(_all([row["seconds"] for row in runs if "seconds" in row], "{:.0f}") if first else "")
            rows.append(cells)
    note = (
        f"Pattern {result['pattern']} of the flag benchmark, {result['steps']:,} images, {result['at_once']} training "
    )
    return [note + "runs at a time on the GPU, one value for each seed.", "", *grid(head, rows)]


@table(PAGE, "surfaces.limits", "surfaces_*")
def limits_table(result: Row) -> list[str]:
    """What the cameras allow at best."""
    head = [
        "cameras",
        "see the patch",
        "height [mm]",
        "height, windows of a photo err alike [mm]",
        "tilt over 40 cm [°]",
    ]
    rows = [
        [
            f"{name} ({found['all_views']})",
            f"{found['views']:.0f}",
            f"{1e3 * found['height']:.4f}",
            f"{1e3 * found['height_common']:.3f}",
            f"{found['tilt_deg']:.4f}",
        ]
        for name, found in result["limits"].items()
    ]
    return grid(head, rows)
