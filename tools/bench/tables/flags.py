"""Tables and findings of ``bench.py flags``."""

from __future__ import annotations

import math
from typing import Any

from bench.cases.flags import PATTERNS, REFERENCES, VARIANTS, Flag
from bench.slots import table, value
from bench.tables.markdown import gib, grid, source, yes_no

Row = dict[str, Any]
PAGE = "flag_benchmark.md"


def chamfer(row: Row | None) -> str:
    """A cell of a table: the mean distance as a share of the longer side, or why there is none."""
    if row is None:
        return "-"
    if row.get("failed"):
        return "failed"
    if row["status"] != "complete":
        return f"stopped at frame {row['frames']}"
    value = row.get("chamfer_share")
    torn = f" ({row['torn_particles']} torn)" if row["torn_particles"] else ""
    return "-" if value is None else f"{100 * value:.2f} %{torn}"


_SAME_MASS = 1e-5
"""Two sums of up to 1e5 masses in float32, each in pairs: 17 roundings of 6e-8 each, and a few more of their terms."""
_HEAVIER = 0.03
"""A row farther than this from the mass of ours is marked; another grid changes the mass by up to 2 % by itself."""


def mass_ratio(rows: Row, name: str, pattern: Flag) -> float | None:
    """Mass of a row as a multiple of that of ours; None if one of them was not recorded."""
    own, ours = (rows.get(key, {}).get(str(pattern), {}).get("mass_kg") for key in (name, "ours"))
    return own / ours if own and ours else None


def _cell(rows: Row, name: str, pattern: Flag) -> str:
    """The distance of a row, with its mass where that is not ours."""
    ratio, text = mass_ratio(rows, name, pattern), chamfer(rows[name].get(str(pattern)))
    text += " (another splat)" * (not _same_splat(rows, name, pattern))
    return text if ratio is None or abs(ratio - 1) <= _HEAVIER else f"{text} ({ratio:.2f} times the mass)"


def _same_splat(rows: Row, name: str, pattern: Flag) -> bool:
    """Whether a row has the splat of ours, or one of its own on purpose: the account of the training tells."""
    own, ours = (rows.get(key, {}).get(str(pattern), {}).get("training", {}) for key in (name, "ours"))
    return bool(VARIANTS[name].training) or own.get("seconds", 0) == ours.get("seconds", 0) or not ours or not own


def _psnr(row: Row | None) -> str:
    value = None if row is None else row.get("mean", {}).get("psnr_db")
    return "-" if value is None else f"{value:.2f}"


# dB over PhysGaussian's way, and share of its distance
_GAIN: dict[Flag, tuple[float, float]] = {1: (1.7, 0.83), 2: (0.3, 0.96), 3: (4.2, 0.25)}
_OTHER = {  # variants of the reference that are other flags, so that they tell nothing about its error
    "hardly bending": "with a fiftieth of its bending stiffness",
    "self-contact": "with self-contact",
}
_WAY = ("to_volume", "to_layer", "to_law", "to_area", "to_wind", "particle")
"""The rows between ours and PhysGaussian's way, each with one change more than the one before."""
_SHARE = 0.03  # goal for Chamfer distances with splats made in code, as a share of the longer side
_TRAINED: dict[Flag, float] = {1: 0.025, 2: 0.020, 3: 0.012}  # with trained splats


def complete(rows: Row, name: str, pattern: Flag) -> Row | None:
    """A row that ran to its end and was compared, with the splat of ours."""
    row = rows.get(name, {}).get(str(pattern))
    done = row and row.get("status") == "complete" and "chamfer_share" in row
    return row if done and (name not in VARIANTS or _same_splat(rows, name, pattern)) else None


def doubt(result: Row, pattern: Flag) -> str:
    """How far the reference is from itself at most, in brackets, or nothing."""
    known = {n: v for n, v in result.get("uncertainty", {}).get(str(pattern), {}).items() if n not in _OTHER}
    return f" (reference itself: {100 * max(v['chamfer'] for v in known.values()):.2f} %)" if known else ""


def named(pattern: Flag) -> str:
    """Name of a flag in the tables."""
    return f"pattern {pattern}" if isinstance(pattern, int) else pattern


def recorded(rows: Row) -> list[Flag]:
    """The flags that a record has, in their order."""
    return [flag for flag in REFERENCES if any(str(flag) in row for row in rows.values())]


def goals(result: Row) -> list[tuple[str, str, bool]]:
    """The goals, the measured values, and whether each goal is reached."""
    rows, found = result["rows"], []
    trained = result["splats"].startswith("trained")
    for pattern in recorded(rows):
        ours = complete(rows, "ours", pattern)
        if ours is None:
            continue
        share, wanted = ours["chamfer_share"], _TRAINED[pattern] if trained else _SHARE
        known, flag = doubt(result, pattern), named(pattern)
        found.append(
            (
                f"{flag}: Chamfer distance within {100 * wanted:g} % of the longer side",
                f"{100 * share:.2f} %{known}",
                share <= wanted,
            )
        )
        decibels, factor = _GAIN.get(pattern, (0, 1))  # of the flags that are not the paper's: no farther than that
        other = complete(rows, "particle", pattern)
        if other is not None:
            weight = mass_ratio(rows, "particle", pattern) or math.nan
            goal = f"{flag}: PhysGaussian's way has the mass of ours"
            found.append((goal, f"{weight:.6f} times", abs(weight - 1) <= _SAME_MASS))
            ratio = share / other["chamfer_share"]
            goal = f"{flag}: Chamfer distance {factor:g} times that of PhysGaussian's way"
            found.append((goal, f"{ratio:.2f} times", ratio <= factor))
            if "psnr_db" in ours["mean"] and "psnr_db" in other["mean"]:
                gain = ours["mean"]["psnr_db"] - other["mean"]["psnr_db"]
                goal = f"{flag}: PSNR {decibels:+g} dB over PhysGaussian's way"
                found.append((goal, f"{gain:+.2f} dB", gain >= decibels))
        other = complete(rows, "no_surface", pattern)
        if other is not None:
            ratio = other["chamfer_share"] / share
            goal = f"{flag}: Chamfer distance at least twice as large without surface modelling"
            found.append((goal, f"{ratio:.2f} times", ratio >= 2))
        other = complete(rows, "no_shading", pattern)
        if other is not None and "psnr_db" in ours["mean"]:
            gain = ours["mean"]["psnr_db"] - other["mean"]["psnr_db"]
            found.append((f"{flag}: lower PSNR without shading", f"{-gain:+.2f} dB", gain > 0))
    return found


def pattern_lines(rows: Row, pattern: Flag) -> list[str]:
    """When a flag leaves its reference, and which changes move it closer or further away."""
    ours = complete(rows, "ours", pattern)
    if ours is None:
        return []
    distances = [value for value in ours.get("chamfer_per_frame_m", []) if value is not None]
    longer = ours["mean"]["chamfer_m"] / ours["chamfer_share"]
    third = len(distances) // 3
    lines = []
    if third:
        parts = [distances[:third], distances[third : 2 * third], distances[2 * third :]]
        told = ", ".join(f"{100 * sum(part) / len(part) / longer:.2f} %" for part in parts)
        lines.append(f"- {named(pattern)}, distance in each third of the run: {told}")
    share, way = ours["chamfer_share"], []
    for name in _WAY:
        if row := complete(rows, name, pattern):
            way.append(f"{VARIANTS[name].title.removeprefix('... and ')} {100 * (row['chamfer_share'] - share):+.2f}")
            share = row["chamfer_share"]
    if way:
        told = "; ".join(way)
        lines.append(f"- {named(pattern)}, what each further change adds [% of the longer side]: {told}")
    changes = {
        VARIANTS[name].title: row["chamfer_share"] - ours["chamfer_share"]
        for name in rows
        if name not in ("ours", "own_volumes", "no_surface", *_WAY) and (row := complete(rows, name, pattern))
    }
    if changes:
        order = sorted(changes, key=lambda name: changes[name])
        told = "; ".join(f"{name} {100 * changes[name]:+.2f}" for name in order)
        lines.append(f"- {named(pattern)}, effect of a single change on the distance [% of the longer side]: {told}")
    return lines


@table(PAGE, "flags.device", "flags_c*")
def device(result: Row) -> list[str]:
    """The devices and versions of the runs, and notes about them."""
    lines = [f"Splats {result['splats']}; {source(result)}"]
    lines += [f"Other options of `tools/sim.py`: `{result['more']}`."] if result.get("more") else []
    return [*lines, result["note"]] if result.get("note") else lines


@table(PAGE, "flags.rows", "flags_c*")
def rows_table(result: Row) -> list[str]:
    """Distance, PSNR and mass of each row and flag."""
    rows = result["rows"]
    flags = recorded(rows)
    seen = [flag for flag in flags if any(_psnr(row.get(str(flag))) != "-" for row in rows.values())]
    head = [""]
    for flag in flags:
        head += [f"{named(flag)}: Chamfer"] + ["PSNR [dB]"] * (flag in seen)
    shown = []
    for name, variant in VARIANTS.items():
        if name in rows:
            line, ratios = [variant.title], [mass_ratio(rows, name, flag) for flag in flags]
            for flag in flags:
                line += [_cell(rows, name, flag)] + [_psnr(rows[name].get(str(flag)))] * (flag in seen)
            shown.append([*line, ", ".join("-" if ratio is None else f"{ratio:.2f}" for ratio in ratios)])
    return grid([*head, "mass / mass of ours"], shown)


@table(PAGE, "flags.goals", "flags_c*")
def goal_table(result: Row) -> list[str]:
    """The goals."""
    rows = [[goal, measured, yes_no(reached)] for goal, measured, reached in goals(result)]
    return grid(["goal", "measured", "reached"], rows)


@table(PAGE, "flags.changes", "flags_c*")
def changes(result: Row) -> list[str]:
    """When each flag leaves its reference, and the effects of single changes."""
    return [line for pattern in recorded(result["rows"]) for line in pattern_lines(result["rows"], pattern)]


@table(PAGE, "flags.pictures", "flags_c*")
def pictures(result: Row) -> list[str]:
    """The figures, with the row that stands for PhysGaussian's way in them."""
    lines: list[str] = []
    for pattern, shown in sorted(result.get("figures", {}).items()):
        way = "PhysGaussian's way" + " with its own volumes" * (shown["way"] == "own_volumes")
        lines += ["", f"![Pattern {pattern} at five times: the reference, ours, {way}](pictures/{shown['file']})"]
        lines += ["", f"Pattern {pattern}: the reference, ours, {way}, and our error."]
    return lines


@table(PAGE, "flags.made", "flags_made_*", together=True)
def made(results: list[Row]) -> list[str]:
    """All of the above for splats made in code."""
    lines = []
    for result in results:
        for part in (device, rows_table, goal_table, changes, costs, dropped):
            lines += ["", *part(result)]
    return lines or ["Not recorded yet."]


def dropped(result: Row) -> list[str]:
    """Rows that were recorded once and are not measured again, beside ours of that time."""
    rows = result.get("dropped", {})
    found = [
        [VARIANTS[name].title, named(flag), chamfer(rows[name].get(str(flag))), chamfer(rows["ours"].get(str(flag)))]
        for name in VARIANTS
        for flag in REFERENCES
        if name != "ours" and str(flag) in rows.get(name, {})
    ]
    head = ["dropped", "flag", "distance then", "ours then"]
    why = (
        "These rows were recorded once, with edges held by grid nodes. Hinges hold them now, ours was measured again "
        "and these were not, so they cannot be compared with the rows above:"
    )
    return [why, "", *grid(head, found)] if found else []


@table(PAGE, "flags.costs", "flags_c*")
def costs(result: Row) -> list[str]:
    """Time and memory of ours and of PhysGaussian's way."""
    shown = [
        [
            f"{VARIANTS[name].title.removeprefix('... and no shading: ')}, {named(pattern)}",
            f"{row['particles']:,}",
            f"{row['substeps']:,}",
            f"{row['ms_per_frame']:.1f}",
            gib(row["device_memory_bytes"]),
        ]
        for name in ("ours", "particle", "own_volumes")
        for pattern in recorded(result["rows"])
        if "substeps" in (row := result["rows"].get(name, {}).get(str(pattern), {}))
    ]
    return grid(["", "particles", "substeps", "time per frame [ms]", "device memory [GiB]"], shown)


@table(PAGE, "flags.reference", "flags_*", together=True)
def reference(results: list[Row]) -> list[str]:
    """Uncertainty of the references of the paper's flags."""
    known = uncertainty(results)
    return uncertainty_lines({str(p): known[str(p)] for p in PATTERNS if str(p) in known})


def uncertainty_lines(known: Row) -> list[str]:
    """A line or two for each flag: the reference solved otherwise, compared with itself; and other flags."""
    lines = []
    for pattern, found in sorted(known.items()):
        told = {
            name: f"{_OTHER.get(name, name)} ({v['cells']} cells, {v['quality']} steps, {v['frames_compared']} frames) "
            f"{100 * v['chamfer']:.2f} %"
            for name, v in found.items()
        }
        flag = f"pattern {pattern}" if pattern.isdigit() else pattern
        lines.append(f"- {flag}: {', '.join(text for name, text in told.items() if name not in _OTHER)}")
        other = [text for name, text in told.items() if name in _OTHER]
        lines += [f"- {flag}, another flag: {', '.join(other)}"] if other else []
    return lines


def uncertainty(results: list[Row]) -> Row:
    """That of all references, from the first record that has it."""
    found: Row = {}
    for result in results:
        found = result.get("uncertainty", {}) | found
    return found


def _mean(rows: Row, name: str, flags: list[Flag]) -> float | None:
    """Mean distance of a row over flags, as a share of the longer side; None if one of them was not recorded."""
    found = [row["chamfer_share"] for flag in flags if (row := complete(rows, name, flag))]
    return sum(found) / len(found) if flags and len(found) == len(flags) else None


@value("flags.headline", "flags_*", together=True)
def headline(results: list[Row]) -> str:
    """Means over all flags for each kind of splat, from the record with most flags; PhysGaussian's way where it is."""
    parts = []
    for kind, told in (("trained", "splats trained on photos"), ("made", "splats made in code")):
        found = [(result["rows"], recorded({"ours": result["rows"].get("ours", {})}))
                 for result in results if result["splats"].startswith(kind)]  # fmt: skip
        rows, flags = max(found, key=lambda one: len(one[1]), default=({}, []))
        if (share := _mean(rows, "ours", flags)) is not None:
            way = "" if (other := _mean(rows, "particle", flags)) is None else (
                f"; PhysGaussian's way, with the same splats and mass, **{100 * other:.2f} %**"
            )  # fmt: skip
            parts.append(f"**{100 * share:.2f} %** with {told} (mean of {len(flags)} flags{way})")
    return " and ".join(parts)


@value("flags.reference_doubt", "flags_*", together=True)
def reference_doubt(results: list[Row]) -> str:
    """The largest distance of a reference from itself, over all flags and all meshes and steps."""
    known = uncertainty(results)
    return f"{100 * max(v['chamfer'] for f in known.values() for n, v in f.items() if n not in _OTHER):.2f} %"


@value("flags.distance", "flags_*")
def distance(result: Row, name: str, pattern: str) -> str:
    """Mean Chamfer distance of a row, as a share of the longer side."""
    return f"{100 * result['rows'][name][pattern]['chamfer_share']:.2f} %"


@value("flags.tilt", "flags_*")
def tilt(result: Row, name: str, pattern: str) -> str:
    """Tilt of the normals of neighbouring centres over 40 cm, from the true ones."""
    return f"{result['rows'][name][pattern]['tilt']['neighbours']['tilt_40cm_deg']:.2f} degrees"


@value("flags.reference_distance", "flags_*", together=True)
def reference_distance(results: list[Row], name: str, pattern: str) -> str:
    """Distance between the reference and a variant of it; ``_`` in the name stands for a space."""
    return f"{100 * uncertainty(results)[pattern][name.replace('_', ' ')]['chamfer']:.2f} %"


@value("flags.ripple", "flags_*", together=True)
def ripple(_: list[Row], pattern: str) -> str:
    """Ripple of the reference at rest."""
    return f"{1e3 * REFERENCES[int(pattern)].ripple:g} mm"


def _incidence(pattern: str) -> float:
    """Angle between the wind and the plane of the flag at rest [radians]."""
    flag = REFERENCES[int(pattern)]
    return math.asin(abs(sum(flag.flow * flag.normal())) / math.hypot(*flag.flow))


@value("flags.incidence", "flags_*", together=True)
def incidence(_: list[Row], pattern: str) -> str:
    """Angle between the wind and the plane of the flag at rest."""
    return f"{math.degrees(_incidence(pattern)):.0f} degrees"


@value("flags.per_degree", "flags_*", together=True)
def per_degree(_: list[Row], pattern: str) -> str:
    """Change of the pressure (proportional to the sine of the incidence) for one degree."""
    return f"{100 * math.radians(1) / math.tan(_incidence(pattern)):.0f} %"
