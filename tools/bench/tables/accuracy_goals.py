"""The goals of ``bench.py accuracy``: each problem has one, and each goal says where its number comes from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from bench.tables.rows import Row, order, own_order, select

Finding = tuple[str, str, bool]
"""What was measured (a variant, for example), the value, and whether it reaches the goal."""


@dataclass(frozen=True)
class Goal:
    """One goal.

    Attributes:
        name: The problem and the number.
        wanted: The goal.
        why: Where its number comes from.
        find: Function of all rows that gives what was measured; nothing if its rows are missing.
    """

    name: str
    wanted: str
    why: str
    find: Callable[[list[Row]], Iterable[Finding]]

    def judge(self, rows: list[Row]) -> tuple[str, bool] | None:
        """All that was measured, with what misses the goal in bold, and whether all of it reaches the goal."""
        found = list(self.find(rows))
        told = [f"{what} {text if reached else f'**{text}**'}".strip() for what, text, reached in found]
        return (", ".join(told), all(reached for *_, reached in found)) if found else None


GOALS: list[Goal] = []


def goal(name: str, wanted: str, why: str) -> Callable[..., Any]:
    """Register a goal by the function that finds what was measured."""

    def register(find: Callable[[list[Row]], Iterable[Finding]]) -> Any:
        GOALS.append(Goal(name, wanted, why, find))
        return find

    return register


def _by(rows: list[Row], name: str = "variant") -> dict[Any, list[Row]]:
    """Rows by a parameter, in ascending number of cells."""
    found: dict[Any, list[Row]] = {}
    for row in sorted(rows, key=lambda row: row["parameters"].get("cells", 0)):
        found.setdefault(row["parameters"].get(name), []).append(row)
    return found


def _percent(value: float, limit: float) -> tuple[str, bool]:
    return f"{100 * value:.3g} %", abs(value) <= limit


SECOND = "quadratic splines blur a field by terms of dx²; a tenth less, for the grids are not infinitely fine"


def _orders(name: str, problem: str, **parameters: Any) -> None:
    """The order between the two finest grids, of each variant."""

    @goal(f"{name}, observed order in dx", "at least 1.8", SECOND)
    def _(rows: list[Row]) -> Iterable[Finding]:
        for variant, found in _by(select(rows, problem, **parameters)).items():
            if len(found) > 1:
                observed = order(found[-2], found[-1])
                yield f"`{variant}`", f"{observed:.2f}", observed >= 1.8


def _errors(name: str, problem: str, cells: int, limit: float, why: str, **parameters: Any) -> None:
    """The error on one grid, of each variant."""

    @goal(name, f"within {100 * limit:g} %", why)
    def _(rows: list[Row]) -> Iterable[Finding]:
        for variant, (row,) in _by(select(rows, problem, cells=cells, **parameters)).items():
            yield f"`{variant}`", *_percent(row["result"]["error"], limit)


def _shifts(name: str, problem: str, **parameters: Any) -> None:
    """Where a pin of whole nodes seems to be, on the finest grid, of each variant."""

    @goal(f"{name}, held by nodes: where the wall seems to be", "within 0.5 cells", "the nearest node holds it")
    def _(rows: list[Row]) -> Iterable[Finding]:
        for variant, found in _by(select(rows, problem, **parameters)).items():
            shift = found[-1]["result"]["end_shift"]
            yield f"`{variant}`", f"{shift:+.2f}", abs(shift) <= 0.5


BEAM = "chosen: a plane body is not Timoshenko's beam (its clamped end is stiffer by the corners' share)"
BLUR = "the variance of a quadratic spline is dx² / 4, so it blurs a wave by (k dx)² / 8; twice that"
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

for _problem, _where in (("hanging bar", "under its own weight"), ("hanging bar held at points", "from points")):
    _errors(
        f"bar hanging {_where}, tip at 32 cells", _problem, 32, 0.00025, "the same blur: 1 / (8 cells²); twice that",
        **({"clamp": "mirror"} if _problem == "hanging bar" else {}),
    )  # fmt: skip


@goal("strip on hinges under a side load, sag at 16 cells", "within 0.4 %", "second order: 1 / cells²")
def _(rows: list[Row]) -> Iterable[Finding]:
    for row in select(rows, "hinged strip", hold="hinge", cells=16):
        yield "", *_percent(row["result"]["error"], 0.004)


@goal(
    "the same strip on clamps and on held nodes, sag as a multiple of that of a clamped strip, finest grid",
    "clamps within 1 / cells² of 1, nodes between (1 -+ 1 / cells)⁴",
    "clamps are of second order; held nodes put each end wrong by half a cell, and the sag grows as L⁴",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for hold in ("clamp", "nodes"):
        if found := _by(select(rows, "hinged strip", hold=hold), "hold").get(hold):
            cells, share = found[-1]["parameters"]["cells"], 5 * (1 - found[-1]["result"]["error"])
            low, high = (1 - 1 / cells) ** 4, (1 + 1 / cells) ** 4
            reached = abs(share - 1) <= 1 / cells**2 if hold == "clamp" else low <= share <= high
            yield f"`{hold}`", f"{share:.3f}", reached


@goal(
    "cantilever, drop, b = 1, by cells through the thickness",
    "within 4 %",
    "the shear that the elastica lacks (0.8 %) and the quadrature of three cells (2.8 %)",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for variant, found in _by(select(rows, "cantilever", b=1.0)).items():
        for row in found:
            yield f"`{variant}` at {row['parameters']['cells']}", *_percent(row["result"]["error"], 0.04)


@goal(
    "cantilever, part of the drop that neither shear nor quadrature explains",
    "within the square of the part from quadrature",
    "the next term of the quadrature's error",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for variant, found in _by(select(rows, "cantilever")).items():
        for row in found:
            p, result = row["parameters"], row["result"]
            name = f"`{variant}` at {p['cells']}" + (f", b = {p['b']:g}" if p["b"] != 1 else "")
            yield name, *_percent(result["unexplained"], result["quadrature"] ** 2)


@goal(
    "cantilevers of 0.3 to 8 cells, held in a region of 0.34 to 3.3 cells, at four places and two angles: frequency",
    "within 3 % of a clamped beam's",
    "second order: the blur of a bending mode is (k dx)² / 8, below 1 %, and a sheet needs some points more on a slant",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for thickness, found in _by(select(rows, "held cantilever"), "thickness").items():
        worst = max(found, key=lambda row: row["result"]["error"])
        yield f"{thickness:g}:", *_percent(worst["result"]["ratio"] - 1, 0.03)


@goal("cantilever clamped in a region, observed order in dx toward its own limit", "at least 1.8", SECOND)
def _(rows: list[Row]) -> Iterable[Finding]:
    for variant, found in _by(select(rows, "clamped end")).items():
        if len(found) > 2:
            observed = own_order(found[-3:])
            yield f"`{variant}`", f"{observed:.2f}", observed >= 1.8


_errors("cantilever clamped in a region, frequency at 8 cells", "clamped end", 8, 0.005, BEAM)


@goal(
    "free elastic block, energy averaged over a period, at the end (`total` after 100 periods, the others after 20)",
    "change below 0.1 %",
    "symplectic steps keep the energy but for terms of the square of the substep; nothing in the problem takes any",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for row in select(rows, "free block"):
        yield f"`{row['parameters']['variant']}`", *_percent(row["result"]["error"], 0.001)


@goal(
    "free elastic block, change of linear and angular momentum",
    "at most a rounding (2.2e-16) for each substep",
    "the transfers keep both exactly",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for row in select(rows, "free block"):
        change = max(row["result"]["linear"], row["result"]["angular"])
        yield f"`{row['parameters']['variant']}`", f"{change:.1e}", change <= 2.2e-16 * row["result"]["substeps"]


@goal(
    "hinged plate, both laws",
    "within 1 degree",
    "chosen: the direction of a wind is hardly known better",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for variant, found in _by(select(rows, "hinged plate")).items():
        worst = max(abs(row["result"]["error"]) for row in found)
        yield f"`{variant}`", f"{worst:.2f} degrees at worst", worst <= 1


@goal(
    "drag on a plate and a sphere, for any set of Gaussians, by area",
    "within 2.5 %",
    "flat patches on a sphere: (spacing / radius)², which is 4 pi / 500 with 500 Gaussians",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for area, found in _by(select(rows, "surface drag"), "area").items():
        yield f"`{area}`", *_percent(max((row["result"]["error"] for row in found), key=abs), 0.025)


@goal(
    "sand element, friction angles",
    "within 0.06 degrees",
    "the return to the cone is exact; the theory is that of small strains, and here the pressure is E / 1000",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    strength = 6 * 0.5 / (math.sqrt(3) * (3 - 0.5))  # of the cone through 30 degrees in triaxial compression
    exact = {"shear": math.degrees(math.atan(strength)), "triaxial": 30.0}
    exact["plane_strain"] = math.degrees(math.asin(strength))
    for row in select(rows, "sand element"):
        for name, angle in exact.items():
            off = row["result"][f"{name}_deg"] - angle
            yield name.replace("_", " "), f"{off:+.4f}", abs(off) <= 0.06


@goal(
    "sand on an incline, angle of friction from its acceleration, and the inclines between which it begins to flow",
    "within 0.5 degrees of theory, and theory between them",
    "half a step of the inclines tried",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for row in select(rows, "sand slope"):
        result = row["result"]
        off = result["friction_deg"] - result["exact"]
        yield "", f"{off:+.2f} degrees", abs(off) <= 0.5
        told = f"stands at {result['stands']}, flows at {result['flows']}"
        yield "", told, result["stands"] <= result["exact"] <= result["flows"]


@goal(
    "collapsing column of sand, run-out as a multiple of Lube's, finest grids",
    "within the factor between Lube's and Lajeunesse's round columns, either way",
    "the scatter of published experiments",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    every = select(rows, "sand column")
    pairs = [sorted((row["result"]["lube"], row["result"]["lajeunesse"]))
             for row in every if row["parameters"].get("planar") is False]  # fmt: skip
    scatter = max((high / low for low, high in pairs), default=None)
    finest: dict[tuple[str, float], Row] = {}
    for row in sorted(every, key=lambda row: row["parameters"]["cells"]):
        p = row["parameters"]
        kind = "round" if p.get("planar") is False else "planar"
        finest[kind + ("" if p.get("volume_correction", True) else " without correction"), p["aspect"]] = row
    for (kind, aspect), row in sorted(finest.items()) if scatter else ():
        share = row["result"]["runout"] / row["result"]["lube"]
        yield f"{kind}, a = {aspect:g}:", f"{share:.2f}", 1 / scatter <= share <= scatter


SOFT = "soft flag, E = 3e3 Pa, 250 frames"


@goal(f"{SOFT}, density 20 to 50, dx 0.08 to 0.01", "no particle torn or lost", "`total` keeps every neighbour")
def _(rows: list[Row]) -> Iterable[Finding]:
    if found := select(rows, "soft flag"):
        torn = sum(row["result"]["torn"] + row["result"]["lost"] for row in found)
        low, high = (f(row["result"][n] for row in found) for f, n in ((min, "stretch_min"), (max, "stretch_max")))
        yield "", f"{torn:.0f} torn or lost, singular values of F in [{low:.2f}, {high:.2f}]", torn == 0 and low > 0


@goal(
    f"{SOFT}, change of the largest stretch by the last halving of dx, as a share of the change by the one before",
    "at most 0.5",
    "first order: each halving changes it by half as much",
)
def _(rows: list[Row]) -> Iterable[Finding]:
    for density, found in _by(select(rows, "soft flag"), "density").items():
        sizes = sorted(found, key=lambda row: -row["parameters"]["dx"])[-3:]
        if len(sizes) == 3:
            first, second, third = (row["result"]["stretch_max"] for row in sizes)
            share = (third - second) / (second - first)
            yield f"{density:g} kg/m³:", f"{share:.2f}", abs(share) <= 0.5
