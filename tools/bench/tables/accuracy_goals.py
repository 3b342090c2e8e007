"""The goals of ``bench.py accuracy``: each problem has one, and each goal says where its number comes from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

from bench.tables.render import Goal, Row, Rows
from bench.tables.rows import all_rows, order, own_order, select

Recorded = list[Row]
GOALS: list[Goal] = []
"""Of all rows; a goal is reached if all that it is about reach it."""


def _goal(name: str, wanted: str, why: str, rows: Rows, what: str, measured: str, reached: str) -> None:
    """Add a goal; ``what`` names each of its rows."""
    GOALS.append(Goal(name, measured, reached, rows, more={"wanted": wanted, "why": why, "what": what}))


def judge(goal: Goal, rows: Recorded) -> Row | None:
    """The goal with all that was measured, in bold what misses it; None if its rows are missing."""
    if not (found := list(goal.of(goal.rows(rows)))):  # type: ignore[operator]
        return None
    told = (f"{one['what']} {one['measured'] if one['reached'] else '**' + one['measured'] + '**'}" for one in found)
    return found[0] | {"measured": ", ".join(map(str.strip, told)), "reached": all(one["reached"] for one in found)}


def goal_rows(results: list[Row]) -> Iterator[Row]:
    """The goals of all records, and the measurements that failed."""
    rows = all_rows(results)
    yield from (found for goal in GOALS if (found := judge(goal, rows)))
    for row in (row for row in rows if "failed" in row["result"]):
        what = f"failed: {row['problem']} {row['parameters']}"
        yield {"goal": what, "wanted": "-", "why": "-", "measured": row["result"]["failed"], "reached": False}


def _by(rows: Recorded, name: str = "variant") -> dict[Any, Recorded]:
    """Rows by a parameter, in ascending number of cells."""
    found: dict[Any, Recorded] = {}
    for row in sorted(rows, key=lambda row: row["parameters"].get("cells", 0)):
        found.setdefault(row["parameters"].get(name), []).append(row)
    return found


def _each(rows: Recorded, problem: str, **parameters: Any) -> Iterator[Row]:
    """The parameters and results of each row, by variant."""
    for found in _by(select(rows, problem, **parameters)).values():
        yield from (row["parameters"] | row["result"] for row in found)


def _finest(rows: Recorded, problem: str, **parameters: Any) -> Iterator[Row]:
    """Each variant on its finest grid, with the order between its two finest ones."""
    for found in _by(select(rows, problem, **parameters)).values():
        orders = {"order": order(found[-2], found[-1])} if len(found) > 1 else {}
        yield found[-1]["parameters"] | found[-1]["result"] | orders


def _worst(rows: Recorded, problem: str, name: str = "variant") -> Iterator[Row]:
    """The row with the largest error, of each variant or other parameter."""
    for found in _by(select(rows, problem), name).values():
        row = max(found, key=lambda row: abs(row["result"]["error"]))
        yield row["parameters"] | row["result"]


VARIANT, ERROR = "`{variant}`", "{error:.3g %}"
SECOND = "quadratic splines blur a field by terms of dx²; a tenth less, for the grids are not infinitely fine"
BEAM = "chosen: beam theory is not exact for a plane body"
BLUR = "the variance of a quadratic spline is dx² / 4, so it blurs a wave by (k dx)² / 8; twice that"


def _orders(name: str, problem: str, **parameters: Any) -> None:
    rows = partial(_finest, problem=problem, **parameters)
    _goal(f"{name}, observed order in dx", "at least 1.8", SECOND, rows, VARIANT, "{order:.2f}", "order >= 1.8")


def _errors(name: str, problem: str, cells: int, limit: float, why: str, **parameters: Any) -> None:
    rows = partial(_each, problem=problem, cells=cells, **parameters)
    _goal(name, f"within {100 * limit:g} %", why, rows, VARIANT, ERROR, f"|error| <= {limit}")


def _shifts(name: str, problem: str, **parameters: Any) -> None:
    rows = partial(_finest, problem=problem, **parameters)
    _goal(f"{name}, held by nodes: where the wall seems to be", "within 0.5 cells", "the nearest node holds it",
          rows, VARIANT, "{end_shift:+.2f}", "|end_shift| <= 0.5")  # fmt: skip


_errors("confined bar with free ends, frequency at 64 cells", "vibrating bar", 64, 0.0006, BLUR, ends="free")
_orders("confined bar with free ends", "vibrating bar", ends="free")
_errors("fixed-free bar held at points of its wall, frequency at 64 cells", "bar held at points", 64, 0.00015, BLUR)
_orders("fixed-free bar held at points of its wall", "bar held at points")
_shifts("fixed-free bar", "vibrating bar", ends="fixed-free")
_shifts("unconfined bar", "unconfined bar")
_orders("bar hanging under its own weight", "hanging bar", clamp="mirror")
_shifts("bar hanging under its own weight", "hanging bar", clamp="pin")
_orders("bar hanging from points of its wall", "hanging bar held at points")
_orders("large-rotation vortex", "vortex")
_TIP = "the same blur: 1 / (8 cells²); twice that"
_errors("bar hanging under its own weight, tip at 32 cells", "hanging bar", 32, 0.00025, _TIP, clamp="mirror")
_errors("bar hanging from points, tip at 32 cells", "hanging bar held at points", 32, 0.00025, _TIP)
_goal("strip on hinges under a side load, sag at 16 cells", "within 0.4 %", "second order: 1 / cells²",
      partial(_each, problem="hinged strip", hold="hinge", cells=16), "{layers} layers", ERROR,
      "|error| <= 0.004")  # fmt: skip


def _strips(rows: Recorded) -> Iterator[Row]:
    """Sags of strips on clamps and on held nodes, as a multiple of that of a clamped strip."""
    for hold in ("clamp", "nodes"):
        for row in _finest(rows, "hinged strip", hold=hold, layers=3):
            share, cell = 5 * (1 - row["error"]), 1 / row["cells"]
            low, high = (1 - cell**2, 1 + cell**2) if hold == "clamp" else ((1 - cell) ** 4, (1 + cell) ** 4)
            yield row | {"share": share, "low": low, "high": high}


_goal("the same strip on clamps and on held nodes, sag as a multiple of that of a clamped strip, finest grid",
      "clamps within 1 / cells² of 1, nodes between (1 -+ 1 / cells)⁴",
      "clamps are of second order; held nodes put each end wrong by half a cell, and the sag grows as L⁴",
      _strips, "`{hold}`", "{share:.3f}", "share >= low and share <= high")  # fmt: skip
_goal("cantilever, drop, b = 1, by cells through the thickness", "within 4 %",
      "the shear that the elastica lacks (0.8 %) and the quadrature of three cells (2.8 %)",
      partial(_each, problem="cantilever", b=1.0), "`{variant}` at {cells}", ERROR, "|error| <= 0.04")  # fmt: skip


def _unexplained(rows: Recorded) -> Iterator[Row]:
    for row in _each(rows, "cantilever"):
        yield row | {"square": row["quadrature"] ** 2, "other": None if row["b"] == 1 else row["b"]}


_goal("cantilever, part of the drop that neither shear nor quadrature explains",
      "within the square of the part from quadrature", "the next term of the quadrature's error", _unexplained,
      "`{variant}` at {cells}[[, b = {other:g}]]", "{unexplained:.3g %}", "|unexplained| <= square")  # fmt: skip


def _held(rows: Recorded) -> Iterator[Row]:
    return (row | {"off": row["ratio"] - 1} for row in _worst(rows, "held cantilever", "thickness"))


_goal("cantilevers of 0.3 to 8 cells, held in a region of 0.34 to 3.3 cells, at four places and two angles: frequency",
      "within 3 % of a clamped beam's", "second order: the blur of a bending mode is (k dx)² / 8, below 1 %, and a "
      "sheet needs some points more on a slant", _held, "{thickness:g}:", "{off:.3g %}", "|off| <= 0.03")  # fmt: skip


def _ends(rows: Recorded) -> Iterator[Row]:
    for found in _by(select(rows, "clamped end")).values():
        if len(found) > 2:
            yield found[-1]["parameters"] | {"order": own_order(found[-3:])}


_goal("cantilever clamped in a region, observed order in dx toward its own limit", "at least 1.8", SECOND, _ends,
      VARIANT, "{order:.2f}", "order >= 1.8")  # fmt: skip
_errors("cantilever clamped in a region, frequency at 8 cells", "clamped end", 8, 0.005, BEAM)


def _combs(rows: Recorded, how: str) -> Iterator[Row]:
    return (row for row in _each(rows, "comb") if row["how"] == how)


for _name, _how in (("each a piece", "apart"), ("held ends one piece", "base")):
    _goal(f"comb of ten beams, gaps of 0.3 cells, {_name}: all frequencies", "within 3 % of a beam alone",
          "chosen: as for one cantilever; shared nodes make one plate of them", partial(_combs, how=_how),
          "{thickness:g} cells thick", ERROR, "error <= 0.03")  # fmt: skip
_goal("rods of 0.05 to 1 cell, 8 points in a section, at any of three places and directions: frequency",
      "within 5 % of a clamped beam's", "chosen: as for a beam of one cell, and a circle has few points",
      partial(_each, problem="thin rod", around=8), "{diameter:g}:", ERROR, "error <= 0.05")  # fmt: skip
_goal("pendulum on a hinge: frequency", "within 1 % of the rigid bar's",
      "chosen: lumped masses have a moment of inertia that is larger by a twentieth of a cell's square each way",
      partial(_each, problem="pendulum on a hinge"), "12 cells long:", ERROR, "error <= 0.01")  # fmt: skip
_goal("two beams of 20 cells and a joint with stiffness: frequency", "within 2 % of Euler's beams'",
      "chosen: a joint holds what lies within a cell of it, a twentieth of each beam",
      partial(_each, problem="joined beams"), "κ L / (E I) = {turning:g}:", ERROR, "error <= 0.02")  # fmt: skip
_goal("two sheets with a gap of 0.2 cells: motion", "within 1 % of each alone", "chosen: rounding in float32 is all",
      partial(_each, problem="close sheets"), "{layers} layers", ERROR, "error <= 0.01")  # fmt: skip
_goal("two sheets with a gap of 0.2 cells: time of a substep", "at most 1.3 times that on shared nodes",
      "chosen: twice as many cells have points, each with half as many", partial(_each, problem="close sheets"),
      "{layers} layers", "{cost:.2f}", "cost <= 1.3")  # fmt: skip
_goal("free elastic block, energy averaged over a period, at the end (`total` after 100 periods, the others after 20)",
      "change below 0.1 %",
      "symplectic steps keep the energy but for terms of the square of the substep; nothing in the problem takes any",
      partial(_each, problem="free block"), VARIANT, ERROR, "|error| <= 0.001")  # fmt: skip


def _momenta(rows: Recorded) -> Iterator[Row]:
    for row in _each(rows, "free block"):
        yield row | {"change": max(row["linear"], row["angular"]), "rounding": 2.2e-16 * row["substeps"]}


_goal("free elastic block, change of linear and angular momentum", "at most a rounding (2.2e-16) for each substep",
      "the transfers keep both exactly", _momenta, VARIANT, "{change:.1e}", "change <= rounding")  # fmt: skip


def _plates(rows: Recorded) -> Iterator[Row]:
    return (row | {"worst": abs(row["error"])} for row in _worst(rows, "hinged plate"))


_goal("hinged plate, both laws", "within 1 degree", "chosen: the direction of a wind is hardly known better", _plates,
      VARIANT, "{worst:.2f} degrees at worst", "worst <= 1")  # fmt: skip


_goal("plate that bends in a flow, drag at 32 cells", "within 1 %", "chosen: an experiment hardly measures more",
      partial(_each, problem="plate that bends in a flow", cells=32), "`{law}`, C = {cauchy:g}", ERROR,
      "|error| <= 0.01")  # fmt: skip
_goal("the same at C = 1,000, drag at 64 cells", "within 1 %", "chosen: as above; what bends is six cells long",
      partial(_each, problem="plate that bends in a flow", cells=64), "`{law}`", ERROR,
      "|error| <= 0.01")  # fmt: skip
_goal("inverted flag, pressure at which it diverges, at 32 cells", "within 2 %", "chosen: that of its wind within 1 %",
      partial(_each, problem="inverted flag", cells=32), "", ERROR, "|error| <= 0.02")  # fmt: skip
_goal("strip of a fabric that hangs over an edge, drop at 16 cells", "within 3 %",
      "chosen: a fabric's stiffness is hardly known better",
      partial(_each, problem="strip of a fabric that hangs", cells=16),
      "{fabric}, E h = {stretch:g} N/m, {layers} layers", ERROR, "|error| <= 0.03")  # fmt: skip
_goal("drag on a plate and a sphere, for any set of Gaussians, by area", "within 2.5 %",
      "flat patches on a sphere: (spacing / radius)², which is 4 pi / 500 with 500 Gaussians",
      partial(_worst, problem="surface drag", name="area"), "`{area}`", ERROR, "|error| <= 0.025")  # fmt: skip


def mobilised() -> dict[str, float]:
    """Friction angles [degrees] of the cone through 30 degrees in triaxial compression."""
    strength = 6 * 0.5 / (math.sqrt(3) * (3 - 0.5))
    shear, plane = math.degrees(math.atan(strength)), math.degrees(math.asin(strength))
    return {"shear": shear, "triaxial": 30.0, "plane_strain": plane}


def _elements(rows: Recorded) -> Iterator[Row]:
    for row in _each(rows, "sand element"):
        for name, angle in mobilised().items():
            yield {"name": name.replace("_", " "), "off": row[f"{name}_deg"] - angle}


_goal("sand element, friction angles", "within 0.06 degrees",
      "the return to the cone is exact; the theory is that of small strains, and here the pressure is E / 1000",
      _elements, "{name}", "{off:+.4f}", "|off| <= 0.06")  # fmt: skip


def _slopes(rows: Recorded) -> Iterator[Row]:
    for row in _each(rows, "sand slope"):
        off = row["friction_deg"] - row["exact"]
        told = f"{off:+.2f} degrees, stands at {row['stands']}, flows at {row['flows']}"
        yield row | {"off": off, "told": told}


_goal("sand on an incline, angle of friction from its acceleration, and the inclines between which it begins to flow",
      "within 0.5 degrees of theory, and theory between them", "half a step of the inclines tried", _slopes, "",
      "{told}", "|off| <= 0.5 and stands <= exact and exact <= flows")  # fmt: skip


def _columns(rows: Recorded) -> Iterator[Row]:
    """The finest grid of each column, and the scatter between Lube's and Lajeunesse's round ones."""
    every = list(_each(rows, "sand column"))
    pairs = [sorted((row["lube"], row["lajeunesse"])) for row in every if row.get("planar") is False]
    scatter = max((high / low for low, high in pairs), default=None)
    finest: dict[tuple[str, float], Row] = {}
    for row in sorted(every, key=lambda row: row["cells"]):
        kind = "round" if row.get("planar") is False else "planar"
        finest[kind + " without correction" * (not row.get("volume_correction", True)), row["aspect"]] = row
    for (kind, _), row in sorted(finest.items(), key=lambda one: one[0]) if scatter else ():
        yield row | {"kind": kind, "share": row["runout"] / row["lube"], "low": 1 / scatter, "high": scatter}


_goal("collapsing column of sand, run-out as a multiple of Lube's, finest grids",
      "within the factor between Lube's and Lajeunesse's round columns, either way",
      "the scatter of published experiments", _columns, "{kind}, a = {aspect:g}:", "{share:.2f}",
      "share >= low and share <= high")  # fmt: skip
SOFT = "soft flag, E = 3e3 Pa, 250 frames"


def _soft(rows: Recorded) -> Iterator[Row]:
    if found := list(_each(rows, "soft flag")):
        low, high = (f(row[n] for row in found) for f, n in ((min, "stretch_min"), (max, "stretch_max")))
        yield {"torn": sum(row["torn"] + row["lost"] for row in found), "low": low, "high": high}


_goal(f"{SOFT}, density 20 to 50, dx 0.08 to 0.01", "no particle torn or lost", "`total` keeps every neighbour",
      _soft, "", "{torn:.0f} torn or lost, singular values of F in [{low:.2f}, {high:.2f}]",
      "torn is 0 and low > 0")  # fmt: skip


def _halvings(rows: Recorded) -> Iterator[Row]:
    for density, found in _by(select(rows, "soft flag"), "density").items():
        sizes = sorted(found, key=lambda row: -row["parameters"]["dx"])[-3:]
        if len(sizes) == 3:
            first, second, third = (row["result"]["stretch_max"] for row in sizes)
            yield {"density": density, "share": (third - second) / (second - first)}


_goal(f"{SOFT}, change of the largest stretch by the last halving of dx, as a share of the change by the one before",
      "at most 0.5", "first order: each halving changes it by half as much", _halvings, "{density:g} kg/m³:",
      "{share:.2f}", "|share| <= 0.5")  # fmt: skip
