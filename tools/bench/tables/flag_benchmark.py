"""Tables of flag_benchmark.md: ``bench.py flags`` and ``bench.py pins``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import Any

from bench import slots
from bench.cases import pins
from bench.cases.flags import PATTERNS, REFERENCES, VARIANTS, Flag
from bench.tables.render import GOAL, Goal, Row, fill, judged, table, value

PAGE = "flag_benchmark.md"
Results = list[Row]

SAME_MASS = 1e-5
"""Two sums of up to 1e5 masses in float32, each in pairs: 17 roundings of 6e-8 each, and a few more of their terms."""
_HEAVIER = 0.03
"""A row farther than this from the mass of ours is marked; another grid changes the mass by up to 2 % by itself."""
# dB over PhysGaussian's way, and share of its distance; flags that are not the paper's: no farther than that
_GAIN: dict[Flag, tuple[float, float]] = {1: (1.7, 0.83), 2: (0.3, 0.96), 3: (4.2, 0.25)}
_OTHER = {  # variants of the reference that are other flags, so that they tell nothing about its error
    "hardly bending": "with a fiftieth of its bending stiffness",
    "self-contact": "with self-contact",
}
WAY = ("to_volume", "to_layer", "to_law", "to_area", "to_wind", "particle")
"""The rows between ours and PhysGaussian's way, each with one change more than the one before."""
_SHARE = 0.03  # goal for Chamfer distances with splats made in code, as a share of the longer side
_TRAINED: dict[Flag, float] = {1: 0.025, 2: 0.020, 3: 0.012}  # with trained splats
_PIN_SHARES: dict[Flag, float] = {4: 0.015, 5: 0.015, "curtain": 0.02, "light": 0.02}  # of the longer side
_PIN_NAMES: dict[Flag, str] = {4: "pattern 4 (curtain)", 5: "pattern 5 (light, stiff)", "light": "light, stiff"}


def named(flag: Flag) -> str:
    """Name of a flag in the tables."""
    return f"pattern {flag}" if isinstance(flag, int) else flag


def recorded(rows: Row) -> list[Flag]:
    """The flags that a record has, in their order."""
    return [flag for flag in REFERENCES if any(str(flag) in row for row in rows.values())]


def chamfer(row: Row | None) -> str:
    """The mean distance as a share of the longer side, or why there is none."""
    if row is None:
        return "-"
    if row.get("failed"):
        return "failed"
    if row["status"] != "complete":
        return f"stopped at frame {row['frames']}"
    torn = f" ({row['torn_particles']} torn)" if row["torn_particles"] else ""
    return fill("{chamfer_share:.2f %}" + torn, row) if "chamfer_share" in row else "-"


def mass_ratio(rows: Row, name: str, flag: Flag) -> float | None:
    """Mass of a row as a multiple of that of ours; None if one of them was not recorded."""
    own, ours = (rows.get(key, {}).get(str(flag), {}).get("mass_kg") for key in (name, "ours"))
    return own / ours if own and ours else None


def _same_splat(rows: Row, name: str, flag: Flag) -> bool:
    """Whether a row has the splat of ours, or one of its own on purpose: the account of the training tells."""
    own, ours = (rows.get(key, {}).get(str(flag), {}).get("training", {}) for key in (name, "ours"))
    return bool(VARIANTS[name].training) or own.get("seconds", 0) == ours.get("seconds", 0) or not ours or not own


def complete(rows: Row, name: str, flag: Flag) -> Row | None:
    """A row that ran to its end and was compared, with the splat of ours."""
    row = rows.get(name, {}).get(str(flag))
    done = row and row.get("status") == "complete" and "chamfer_share" in row
    return row if done and (name not in VARIANTS or _same_splat(rows, name, flag)) else None


def uncertainty(results: Results) -> Row:
    """That of all references, from the first record that has it."""
    found: Row = {}
    for result in results:
        found = result.get("uncertainty", {}) | found
    return found


def doubt(known: Row, flag: Flag) -> str:
    """How far the reference is from itself at most, in brackets, or nothing."""
    own = [way["chamfer"] for name, way in known.get(str(flag), {}).items() if name not in _OTHER]
    return f" (reference itself: {100 * max(own):.2f} %)" if own else ""


def _cells(result: Row) -> Iterator[Row]:
    """Each row of each flag, with its title, and with its distance as it is told."""
    rows, flags = result["rows"], recorded(result["rows"])
    for name, variant in VARIANTS.items():
        ratios = [mass_ratio(rows, name, flag) for flag in flags]
        for flag, ratio in zip(flags, ratios, strict=True) if name in rows else ():
            own = rows[name].get(str(flag))
            told = chamfer(own) + " (another splat)" * (not _same_splat(rows, name, flag))
            told += f" ({ratio:.2f} times the mass)" if ratio is not None and abs(ratio - 1) > _HEAVIER else ""
            seen = {"seen": named(flag)} if own and own.get("mean", {}).get("psnr_db") is not None else {}
            about = {"name": name, "title": variant.title, "flag": named(flag), "told": told, "ratios": ratios}
            yield (own or {}) | about | seen


def _costs(result: Row) -> Iterator[Row]:
    for row in _cells(result):
        if row["name"] in ("ours", "particle", "own_volumes") and "substeps" in row:
            yield row | {"title": row["title"].removeprefix("... and no shading: ")}


def _beside_ours(result: Row) -> Iterator[Row]:
    """Ours of each flag, with the differences of the rows that goals are about."""
    rows, trained = result["rows"], result["splats"].startswith("trained")
    for flag in recorded(rows):
        if (ours := complete(rows, "ours", flag)) is None:
            continue
        share, more = ours["chamfer_share"], dict[str, Any]()
        decibels, factor = _GAIN.get(flag, (0, 1))
        others = {name: complete(rows, name, flag) for name in ("particle", "no_surface", "no_shading")}
        for name, other in others.items():
            if other is not None:
                more[name] = {"ratio": share / other["chamfer_share"], "times": other["chamfer_share"] / share}
                if "psnr_db" in ours["mean"] and "psnr_db" in other["mean"]:
                    gain = ours["mean"]["psnr_db"] - other["mean"]["psnr_db"]
                    more[name] |= {"gain": gain, "loss": -gain}
        if others["particle"] is not None:
            weight = mass_ratio(rows, "particle", flag) or math.nan
            more["particle"] |= {"weight": weight, "off": abs(weight - 1)}
        known = doubt(result.get("uncertainty", {}), flag)
        yield more | {"flag": named(flag), "share": share, "most": _TRAINED[flag] if trained else _SHARE,
                      "doubt": known, "decibels": decibels, "factor": factor}  # fmt: skip


GOALS = [
    Goal("{flag}: Chamfer distance within {limit:g %} of the longer side", "{share:.2f %}{doubt}", "share <= most"),
    Goal("{flag}: PhysGaussian's way has the mass of ours", "{particle.weight:.6f} times",
         f"particle.off <= {SAME_MASS}"),
    Goal("{flag}: Chamfer distance {factor:g} times that of PhysGaussian's way", "{particle.ratio:.2f} times",
         "particle.ratio <= factor"),
    Goal("{flag}: PSNR {decibels:+g} dB over PhysGaussian's way", "{particle.gain:+.2f} dB",
         "particle.gain >= decibels"),
    Goal("{flag}: Chamfer distance at least twice as large without surface modelling", "{no_surface.times:.2f} times",
         "no_surface.times >= 2"),
    Goal("{flag}: lower PSNR without shading", "{no_shading.loss:+.2f} dB", "no_shading.loss < 0"),
]  # fmt: skip


def _changes(result: Row) -> Iterator[Row]:
    """When each flag leaves its reference, and which changes move it closer or further away."""
    rows = result["rows"]
    for flag in recorded(rows):
        if (ours := complete(rows, "ours", flag)) is None:
            continue
        distances = [each for each in ours.get("chamfer_per_frame_m", []) if each is not None]
        longer, third = ours["mean"]["chamfer_m"] / ours["chamfer_share"], len(distances) // 3
        if third:
            parts = distances[:third], distances[third : 2 * third], distances[2 * third :]
            shares = [f"{100 * sum(part) / len(part) / longer:.2f} %" for part in parts]
            yield {"flag": named(flag), "what": "distance in each third of the run", "told": ", ".join(shares)}
        found = {name: row for name in ("ours", *rows) if (row := complete(rows, name, flag))}
        way = [name for name in ("ours", *WAY) if name in found]
        steps = [(new, found[new]["chamfer_share"] - found[old]["chamfer_share"]) for old, new in pairwise(way)]
        single = [(name, row["chamfer_share"] - ours["chamfer_share"]) for name, row in found.items()
                  if name not in ("ours", "own_volumes", "no_surface", *WAY)]  # fmt: skip
        single.sort(key=lambda one: one[1])
        added, effect = "what each further change adds", "effect of a single change on the distance"
        for what, all_changes in ((added, steps), (effect, single)):
            told = [f"{VARIANTS[n].title.removeprefix('... and ')} {100 * change:+.2f}" for n, change in all_changes]
            if told:
                yield {"flag": named(flag), "what": f"{what} [% of the longer side]", "told": "; ".join(told)}


def _dropped(result: Row) -> Iterator[Row]:
    """Rows that were recorded once and are not measured again, beside ours of that time."""
    rows = result.get("dropped", {})
    for name, variant in VARIANTS.items():
        for flag in REFERENCES:
            if name != "ours" and str(flag) in rows.get(name, {}):
                own, ours = (chamfer(rows[key].get(str(flag))) for key in (name, "ours"))
                yield {"title": variant.title, "flag": named(flag), "own": own, "ours": ours}


_DEVICE = "[[Splats {splats}; ]]{source}[[\nOther options of `tools/sim.py`: `{more}`.]][[\n{note}]]"
table(PAGE, "flags.device", "flags_c*", before=_DEVICE)
table(PAGE, "flags.rows", "flags_c*", _cells, """
    = {title} | *{flag}: Chamfer = {told} | *{seen}: PSNR [dB] = {mean.psnr_db:.2f} |
    mass / mass of ours = {ratios:.2f}
    """)  # fmt: skip
table(PAGE, "flags.goals", "flags_c*", judged(GOALS, _beside_ours), GOAL)
table(PAGE, "flags.changes", "flags_c*", _changes, "- {flag}, {what}: {told}")
table(PAGE, "flags.costs", "flags_c*", _costs, """
    = {title}, {flag} | particles = {particles:,} | substeps = {substeps:,} |
    time per frame [ms] = {ms_per_frame:.1f} | device memory [GiB] = {device_memory_bytes:.2f (GiB)}
    """)  # fmt: skip
table(None, "flags.dropped", "flags_*", _dropped, """
    dropped = {title} | flag = {flag} | distance then = {own} | ours then = {ours}
    """, empty="", before="These rows were recorded once, with edges held by grid nodes. Hinges hold them now, "
    "ours was measured again and these were not, so they cannot be compared with the rows above:")  # fmt: skip


@slots.table(PAGE, "flags.made", "flags_made_*", together=True)
def made(results: Results) -> list[str]:
    """All of the above for splats made in code."""
    parts = ("device", "rows", "goals", "changes", "costs", "dropped")
    return [line for one in results for part in parts for line in ("", *slots.SLOTS[f"flags.{part}"].make(one))]


@slots.table(PAGE, "flags.pictures", "flags_c*")
def pictures(result: Row) -> list[str]:
    """The figures, with the row that stands for PhysGaussian's way in them."""
    lines: list[str] = []
    for pattern, shown in sorted(result.get("figures", {}).items()):
        way = "PhysGaussian's way" + " with its own volumes" * (shown["way"] == "own_volumes")
        lines += ["", f"![Pattern {pattern} at five times: the reference, ours, {way}](pictures/{shown['file']})"]
        lines += ["", f"Pattern {pattern}: the reference, ours, {way}, and our error."]
    return lines


def _references(results: Results, paper: bool) -> Iterator[Row]:
    """Each reference solved otherwise, compared with itself; and other flags."""
    way = "{name} ({cells} cells, {quality} steps, {frames_compared} frames) {chamfer:.2f %}"
    for flag, ways in sorted(uncertainty(results).items()):
        if (flag in map(str, PATTERNS)) == paper:
            for other, what in ((False, ""), (True, ", another flag")):
                told = [fill(way, one | {"name": _OTHER.get(name, name)})
                        for name, one in ways.items() if (name in _OTHER) == other]  # fmt: skip
                if told:
                    title = f"pattern {flag}" if flag.isdigit() else flag
                    yield {"flag": title + what, "told": ", ".join(told)}


table(PAGE, "flags.reference", "flags_*", partial(_references, paper=True), "- {flag}: {told}", together=True)
table(PAGE, "pins.reference", "pins_*", partial(_references, paper=False), "- {flag}: {told}", together=True)


def _mean(rows: Row, name: str, flags: list[Flag]) -> float | None:
    """Mean distance of a row over flags, as a share of the longer side; None if one of them was not recorded."""
    found = [row["chamfer_share"] for flag in flags if (row := complete(rows, name, flag))]
    return sum(found) / len(found) if flags and len(found) == len(flags) else None


@slots.value("flags.headline", "flags_*", together=True)
def headline(results: Results) -> str:
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


def _doubts(results: Results) -> Row:
    """The largest distance of a reference from itself."""
    known = uncertainty(results)
    own = [one["chamfer"] for ways in known.values() for name, one in ways.items() if name not in _OTHER]
    return {"most": max(own, default=None)}


def _at_rest(_: Results) -> Row:
    """Of each flag: its ripple, the angle between the wind and its plane, and the pressure that a degree changes."""
    found: Row = {}
    for name, flag in REFERENCES.items():
        row = found[str(name)] = {"ripple": flag.ripple}
        if any(flag.flow):
            angle = math.asin(abs(sum(flag.flow * flag.normal())) / math.hypot(*flag.flow))
            row |= {"degrees": math.degrees(angle), "steep": math.radians(1) / math.tan(angle) if angle else math.inf}
    return found


value("flags.reference_doubt", "flags_*", "{most:.2f %}", _doubts, together=True)
value("flags.distance", "flags_*", "{rows.$1.$2.chamfer_share:.2f %}")
value("flags.tilt", "flags_*", "{rows.$1.$2.tilt.neighbours.tilt_40cm_deg:.2f} degrees")
value("flags.ripple", "flags_*", "{$1.ripple:g mm}", _at_rest, together=True)
value("flags.incidence", "flags_*", "{$1.degrees:.0f} degrees", _at_rest, together=True)
value("flags.per_degree", "flags_*", "{$1.steep:.0f %}", _at_rest, together=True)


def _pins(result: Row) -> Iterator[Row]:
    """Each row of each flag, where it was recorded."""
    for name, pin in pins.ROWS.items():
        for flag in pins.PATTERNS if name in result["rows"] else ():
            own = result["rows"][name].get(str(flag))
            cost = fill("{particles:,}; {ms_per_frame:.1f}", own) if own and "particles" in own else "-"
            yield {"title": pin.title(), "flag": _PIN_NAMES.get(flag, named(flag)), "told": chamfer(own), "cost": cost}


def _hinges(results: Results) -> Iterator[Row]:
    """Hinges of each flag, beside held nodes; the motion does not depend on the device, so any record may have them."""
    rows: Row = {}
    for name in ("hinge_04", "nodes"):
        for one in results:
            rows[name] = one["rows"].get(name, {}) | rows.get(name, {})
    for flag in pins.PATTERNS:
        found = {name: one for name in rows if (one := complete(rows, name, flag))}
        row = {name: one["chamfer_share"] for name, one in found.items()}
        row |= {"flag": _PIN_NAMES.get(flag, named(flag)), "paper": flag in PATTERNS, "most": _PIN_SHARES.get(flag)}
        dx = found["nodes"]["dx_m"] if "nodes" in found else None
        yield row | {"doubt": doubt(uncertainty(results), flag), "dx": dx}


PIN_GOALS = [
    Goal("{flag}: hinges at dx = 0.04 m no farther than held nodes on the finer grid",
         "{hinge_04:.2f %}, {nodes:.2f %} at {dx:g} m", "hinge_04 <= nodes", where="paper is True", always=True),
    Goal("{flag}: hinges at dx = 0.04 m within {limit:g %} of the longer side", "{hinge_04:.2f %}{doubt}",
         "hinge_04 <= most", where="paper is False", always=True),
]  # fmt: skip
table(PAGE, "pins.device", "pins_*", before=_DEVICE)
table(PAGE, "pins.rows", "pins_*", _pins, " = {title} | *{flag} = {told}")
table(PAGE, "pins.costs", "pins_*", _pins, "points; time per frame [ms] = {title} | *{flag} = {cost}")
table(PAGE, "pins.goals", "pins_*", judged(PIN_GOALS, _hinges), GOAL, together=True)
