"""Tables of ``bench.py fit``: what was found from videos, and how far it is from the truth."""

from __future__ import annotations

import math
from typing import Any

from bench.slots import table, value
from bench.tables.markdown import grid, source, yes_no
from gaussian_swaying.fitting.report import ASTRAY

Row = dict[str, Any]

OWN = (0.01, 1.0, 0.01)
TWO, ONE = (0.05, 3.0, 0.10), (0.10, 6.0, 0.20)
"""Goals: error of the speed, angle between the winds [degrees], error of E."""
ABLATIONS = ("tracks alone", "pixels alone", "without patches")
"""Rows that have no goal."""
LOST = 100.0
"""Distance [pixels] above which a simulation with the true values does not show the same motion at all."""

HEAD = ["", "speed", "direction", "E", "predicted frames", "time"]
SHARP = 28.0
"""Least PSNR of the predicted frames [dB], unless the splat at rest has less."""


@table("fit.md", "fit.own", "fit_*", together=True)
def own(results: list[Row]) -> list[str]:
    """Fits of videos that this package made, on each device."""
    lines: list[str] = []
    for result in results:
        if rows := result.get("own", {}):
            found = [
                [_named(n, row), *cells(row), "" if n in ABLATIONS else _reached(row, OWN)] for n, row in rows.items()
            ]
            one = next(row for row in rows.values() if "points" in row)
            width, height = one["size"]
            told = f"{one['points']:,} points, videos of {width} x {height}, {one['until_s']:.3g} s fitted."
            table_ = grid([*HEAD, "within 1 % and 1 degree"], found)
            lines += ["", source(result), "", told, "", *table_]
    return lines[1:] or ["Not measured yet."]


@table("fit.md", "fit.blender", "fit_*", together=True)
def blender(results: list[Row]) -> list[str]:
    """Fits of videos of Blender's cloth, on each device."""
    lines: list[str] = []
    for result in results:
        if rows := result.get("blender", {}):
            found = []
            for name, row in sorted(rows.items()):
                free = name.split(", ")[-1] in ABLATIONS
                goal = _reached(row, ONE if "one camera" in name else TWO)
                sharp = ["", ""] if "refused" in row else [_decibels(row.get("psnr_rest_db")), _sharp(row)]
                found.append([_named(name, row), *cells(row), *sharp, _base(row), "" if free else goal])
            head = [
                *HEAD,
                "splat at rest",
                "28 dB, or as at rest",
                "fitted; mesh; changes of scene.yaml",
                "goal reached",
            ]
            lines += ["", source(result), "", *grid(head, found)]
    return lines[1:] or ["Not measured yet."]


@value("fit.within", "fit_*")
def within(result: Row) -> str:
    """How many fits of Blender's cloth are within the goals of speed, direction and E."""
    reached = [_reached(row, ONE if "one camera" in name else TWO) for name, row in _with_goals(result).items()]
    return f"{reached.count('yes')} of {len(reached)}"


@value("fit.sharp", "fit_*")
def sharp(result: Row) -> str:
    """How many of them predict frames as sharp as wanted."""
    reached = ["no" if "refused" in row else _sharp(row) for row in _with_goals(result).values()]
    return f"{reached.count('yes')} of {len(reached)}"


def _with_goals(result: Row) -> Row:
    rows = result.get("blender", {})
    return {name: row for name, row in rows.items() if name.split(", ")[-1] not in ABLATIONS}


@table("fit.md", "fit.bias", "fit_*", together=True)
def bias(results: list[Row]) -> list[str]:
    """How far faults of the model alone move the values, on each device."""
    lines: list[str] = []
    for result in results:
        if rows := result.get("bias", {}):
            found = [[_options(name), *_moved(row), f"{row['points']:,}"] for name, row in rows.items()]
            head = ["case and grid", "distance", "speed", "azimuth", "E", "points"]
            lines += ["", source(result), "", *grid(head, found)]
    return lines[1:] or ["Not measured yet."]


@table("fit.md", "fit.reference", "fit_*", together=True)
def reference(results: list[Row]) -> list[str]:
    """What a splat predicts that is not fitted: moved as the reference, or simulated with the true values."""
    lines: list[str] = []
    for result in results:
        if rows := result.get("reference", {}):
            cases, motions = (list(dict.fromkeys(n.split(", ", 1)[k] for n in sorted(rows))) for k in (0, 1))
            found = [
                [case, *(_decibels(rows.get(f"{case}, {m}", {}).get("psnr_predicted_db")) for m in motions)]
                for case in cases
            ]
            head = ["predicted frames", *(m.removeprefix("uncertainty/") for m in motions)]
            lines += ["", source(result), "", *grid(head, found)]
    return lines[1:] or ["Not measured yet."]


def _options(name: str) -> str:
    """The case, and its options by their last word."""
    case, *options = name.split(", ")
    return ", ".join([case, *(f"`{option.split('.', option.split(' ')[0].count('.'))[-1]}`" for option in options)])


def _moved(row: Row) -> list[str]:
    if row["rms_px"] > LOST:
        return ["the simulation diverged", "", "", ""]
    return [
        f"{row['rms_px']:.2f} pixels",
        f"{100 * row['speed_error']:+.2f} %",
        f"{row['azimuth_error_deg']:+.2f}°",
        f"{100 * row['material.E_error']:+.2f} %",
    ]


def _named(name: str, row: Row) -> str:
    """The name of a row, and whether its fit has not settled or does not follow the video."""
    lost = row.get("psnr_rest_db", 0.0) - row.get("psnr_fitted_db", math.inf) > ASTRAY
    return name + " (not settled)" * bool(row.get("not_settled")) + " (not followed)" * lost


def cells(row: Row) -> list[str]:
    """What a fit found: errors of speed, direction and E, predicted frames, and the time it took."""
    if "refused" in row:
        return ["refused", "", "", "", ""]
    stiffness = row.get("material.E_error")
    return [
        f"{100 * row['speed_error']:+.2f} %",
        f"{row['direction_error_deg']:.2f}°",
        "" if stiffness is None else f"{100 * stiffness:+.2f} %",
        _decibels(row["psnr_predicted_db"]),
        f"{row['seconds']:.0f} s",
    ]


def _decibels(psnr: float | None) -> str:
    return "" if psnr is None else f"{psnr:.1f} dB"


def _sharp(row: Row) -> str:
    """Whether the predicted frames are as sharp as wanted."""
    return yes_no(row["psnr_predicted_db"] >= min(SHARP, row.get("psnr_rest_db", SHARP)))


def _base(row: Row) -> str:
    """How much of the video was fitted, the mesh of the reference, and what was changed in the case's configuration."""
    cells = f"; {row['cells']} cells" if row.get("cells") else ""
    known = ", ".join(f"`{name}` {value}" for name, value in row.get("known", {}).items())
    return (f"{row['until_s']:.3g} s" if "until_s" in row else "") + cells + (f"; {known}" if known else "")


def _reached(row: Row, goal: tuple[float, float, float]) -> str:
    if "refused" in row:
        return "no"
    speed, angle, stiffness = goal
    return yes_no(
        abs(row["speed_error"]) <= speed
        and row["direction_error_deg"] <= angle
        and abs(row.get("material.E_error", 0.0)) <= stiffness
    )
