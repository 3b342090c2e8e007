"""Tables and findings of ``bench.py accuracy``."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from bench.cases.accuracy import SINGLE, VARIANTS
from bench.slots import table, value
from bench.tables.accuracy_goals import GOALS
from bench.tables.markdown import grid, measured, stack
from bench.tables.rows import Row, order, own_order, select

PAGE = "validation.md"


def _value(value: Any) -> str:
    return "-" if value is None else f"{value:.3g}" if isinstance(value, (int, float)) else str(value)


def rows_table(name: str) -> Callable[[Callable[[list[Row]], list[str]]], Any]:
    """Register a table of the rows of all records."""

    def register(make: Callable[[list[Row]], list[str]]) -> Any:
        def of_results(results: list[Row]) -> list[str]:
            return make([row for result in results for row in result["rows"]])

        table(PAGE, name, "accuracy_*", together=True)(of_results)
        return make

    return register


@table(PAGE, "accuracy.devices", "accuracy_*", together=True)
def devices(results: list[Row]) -> list[str]:
    """Which problems were measured where."""
    lines = []
    for result in results:
        problems = ", ".join(sorted({row["problem"] for row in result["rows"]}))
        lines.append(f"- {problems}: {result['device']}; {stack(result)}.{measured(result)}")
    return lines


@rows_table("accuracy.goals")
def goals(rows: list[Row]) -> list[str]:
    """The goals, and the measurements that failed."""
    found = [(goal, goal.judge(rows)) for goal in GOALS]
    told = [[goal.name, goal.wanted, goal.why, one[0], "yes" if one[1] else "**no**"] for goal, one in found if one]
    lines = grid(["goal", "wanted", "where this comes from", "measured", "reached"], told)
    failed = [row for row in rows if "failed" in row["result"]]
    told = [f"- failed: {row['problem']} {row['parameters']}: {row['result']['failed']}" for row in failed]
    return [*lines, "", *told] if told else lines


def _convergence(rows: list[Row], problem: str, columns: dict[str, str], **parameters: Any) -> list[str]:
    """Error against cells for each variant, with the order of the last halving, and further columns."""
    shown = []
    for variant in (*VARIANTS, *SINGLE):
        found = sorted(select(rows, problem, variant=variant, **parameters), key=lambda r: r["parameters"]["cells"])
        for k, row in enumerate(found):
            observed = f"{order(found[k - 1], row):.2f}" if k and row["result"]["error"] > 0 else ""
            extra = [_value(row["result"].get(name)) for name in columns]
            shown.append(
                [f"`{variant}`", str(row["parameters"]["cells"]), f"{row['result']['error']:.2e}", observed, *extra]
            )
    return grid(["variant", "cells", "relative error", "order", *columns.values()], shown)


_LOSS = {"loss": "amplitude lost per period"}
_SHIFT = {"end_shift": "apparent outward shift of the pin [cells]"}

CONVERGENCE: dict[str, tuple[str, dict[str, str], dict[str, str]]] = {
    "accuracy.free_bar": ("vibrating bar", _LOSS, {"ends": "free"}),
    "accuracy.pinned_bar": ("vibrating bar", _LOSS | _SHIFT, {"ends": "fixed-free"}),
    "accuracy.unconfined_bar": ("unconfined bar", _SHIFT, {}),
    "accuracy.hanging_bar": ("hanging bar", {}, {"clamp": "mirror"}),
    "accuracy.hanging_pinned_bar": ("hanging bar", _SHIFT, {"clamp": "pin"}),
    "accuracy.bar_at_points": ("bar held at points", _LOSS | _SHIFT, {}),
    "accuracy.hanging_bar_at_points": ("hanging bar held at points", _SHIFT, {}),
    "accuracy.vortex": ("vortex", {}, {}),
}
"""Slots of the tables of convergence: problem, further columns, and parameters."""

for _name, (_problem, _columns, _parameters) in CONVERGENCE.items():
    rows_table(_name)(lambda rows, p=_problem, c=_columns, q=_parameters: _convergence(rows, p, c, **q))


@rows_table("accuracy.free_block")
def free_block(rows: list[Row]) -> list[str]:
    """Energy and momenta of the free block."""
    names = {
        "kept": "final / initial energy",
        "error": "largest change",
        "growth": "largest rise of any single state",
        "linear": "change of linear momentum",
        "angular": "change of angular momentum",
        "substeps": "substeps",
    }
    return grid(
        ["variant", *names.values()],
        [
            [f"`{row['parameters']['variant']}`", *(_value(row["result"].get(n)) for n in names)]
            for row in select(rows, "free block")
        ],
    )


@rows_table("accuracy.hinged_strip")
def hinged_strip(rows: list[Row]) -> list[str]:
    """The sag of a strip on hinges, and of strips that are held in other ways."""
    shown = []
    for hold in ("hinge", "clamp", "nodes"):
        found = sorted(select(rows, "hinged strip", hold=hold), key=lambda row: row["parameters"]["cells"])
        for k, row in enumerate(found):
            observed = f"{order(found[k - 1], row):.2f}" if k and hold == "hinge" else ""
            result = row["result"]
            numbers = [f"{result['error']:.2e}", observed, f"{result['slope']:.4f}", _value(result["moment"])]
            shown.append([f"`{hold}`", str(row["parameters"]["cells"]), *numbers])
    names = ["slope at the end / exact", "error of the moment in the last cell / moment in the middle"]
    return grid(["kind of the pins", "cells", "error of the sag", "order", *names], shown)


@rows_table("accuracy.hinged_plate")
def hinged_plate(rows: list[Row]) -> list[str]:
    """The angle at which a plate hangs in the wind."""
    return grid(
        ["variant", "law", "k", "angle [deg]", "exact [deg]", "error [deg]"],
        [
            [
                f"`{row['parameters']['variant']}`",
                f"`{row['parameters']['law']}`",
                str(row["parameters"]["k"]),
                *(f"{row['result'][n]:.2f}" for n in ("angle", "exact", "error")),
            ]
            for row in select(rows, "hinged plate")
        ],
    )


@rows_table("accuracy.surface_drag")
def surface_drag(rows: list[Row]) -> list[str]:
    """Drag on surfaces made of Gaussians, as a share of the exact drag."""
    places: dict[tuple[Any, ...], dict[str, str]] = {}
    for row in select(rows, "surface drag"):
        p = row["parameters"]
        place = places.setdefault((p["shape"], p["count"], p["overlap"]), {})
        place[f"{p['area']}, {p['law']}"] = f"{row['result']['share']:.3f}"
    names = [f"{area}, {law}" for area in ("coverage", "paper") for law in ("paper", "projected")]
    header = [
        "surface",
        "Gaussians",
        "overlap",
        *(f"areas `{n.split(', ')[0]}`, law `{n.split(', ')[1]}`" for n in names),
    ]
    return grid(header, [[*map(str, key), *(place.get(n, "-") for n in names)] for key, place in places.items()])


@rows_table("accuracy.cantilever")
def cantilever(rows: list[Row]) -> list[str]:
    """Drop of a cantilever, and the sources of its error."""
    names = {
        "drop": "drop / L",
        "error": "error of the drop",
        "shear": "part from shear",
        "quadrature": "part from quadrature",
        "unexplained": "unexplained part",
        "shortening_error": "error of the shortening",
    }
    return grid(
        ["variant", "b", "cells through the thickness", *names.values()],
        [
            [
                f"`{row['parameters']['variant']}`",
                str(row["parameters"]["b"]),
                str(row["parameters"]["cells"]),
                *(_value(row["result"].get(n)) for n in names),
            ]
            for row in select(rows, "cantilever")
        ],
    )


@rows_table("accuracy.held_cantilever")
def held_cantilever(rows: list[Row]) -> list[str]:
    """Frequencies of cantilevers held in a region, over that of a clamped beam, by thickness and depth."""
    found = select(rows, "held cantilever")
    depths = sorted({row["parameters"]["depth"] for row in found})
    lines = []
    for thickness in sorted({row["parameters"]["thickness"] for row in found}):
        own = select(found, "held cantilever", thickness=thickness)
        cells = {row["parameters"]["depth"]: row["result"] for row in own}
        told = [f"{r['lowest']:.3f} to {r['highest']:.3f}" if (r := cells.get(depth)) else "-" for depth in depths]
        lines.append([f"{thickness:g}", *told])
    return grid(["thickness [cells]", *(f"held depth {depth:g}" for depth in depths)], lines)


@rows_table("accuracy.clamped_end")
def clamped_end(rows: list[Row]) -> list[str]:
    """Frequency of a clamped beam over that of Timoshenko's, by cells through its thickness."""
    found = select(rows, "clamped end")
    lines = []
    for k, row in enumerate(found):
        observed = f"{own_order(found[k - 2 : k + 1]):.2f}" if k > 1 else ""
        lines.append([str(row["parameters"]["cells"]), f"{row['result']['ratio']:.5f}", observed])
    return grid(["cells through the thickness", "frequency over Timoshenko's", "order of the last three"], lines)


def _mobilised(degrees: float) -> float:
    """Strength of the cone, fitted to an angle in triaxial compression, where one principal stress is the mean."""
    sine = math.sin(math.radians(degrees))
    return 6 * sine / (math.sqrt(3) * (3 - sine))


@rows_table("accuracy.sand_angles")
def sand_angles(rows: list[Row]) -> list[str]:
    """Friction angles of the sand law, for an element and for a layer."""
    strength = _mobilised(30.0)
    exact = {"shear": math.degrees(math.atan(strength)), "plane": math.degrees(math.asin(strength))}
    shown = []
    for result in (row["result"] for row in select(rows, "sand element")):
        shown += [
            ["simple shear", f"{result['shear_deg']:.1f}", f"{exact['shear']:.1f}"],
            ["triaxial compression", f"{result['triaxial_deg']:.1f}", "30.0"],
            ["plane strain", f"{result['plane_strain_deg']:.1f}", f"{exact['plane']:.1f}"],
        ]
    for result in (row["result"] for row in select(rows, "sand slope")):
        angles = [f"{result['friction_deg']:.2f}", f"{result['exact']:.2f}"]
        shown += [["a layer that slides down an incline, from its acceleration", *angles]]
        shown += [["a layer on an incline: steepest on which it stands", f"{result['stands']:.0f}", "-"]]
        shown += [["a layer on an incline: least steep on which it flows", f"{result['flows']:.0f}", "-"]]
    return grid(["test, phi = 30 degrees", "angle [deg]", "theory [deg]"], shown)


@value("accuracy.plane_strain_angle", "accuracy_*", together=True)
def plane_strain_angle(results: list[Row]) -> str:
    """Friction angle of the law in plane strain [degrees]."""
    row = select([row for result in results for row in result["rows"]], "sand element")[0]
    return f"{row['result']['plane_strain_deg']:.0f}"


@value("accuracy.band", "accuracy_*", together=True)
def band(results: list[Row]) -> str:
    """The largest ratio between Lube's and Lajeunesse's run-outs, over the round columns."""
    rows = select([row for result in results for row in result["rows"]], "sand column", planar=False)
    pairs = [sorted((row["result"]["lube"], row["result"]["lajeunesse"])) for row in rows]
    return f"{max(high / low for low, high in pairs):.1f}"


@rows_table("accuracy.sand_columns")
def sand_columns(rows: list[Row]) -> list[str]:
    """Run-out of collapsing columns of sand."""
    names = {
        "runout": "run-out",
        "lube": "Lube",
        "lajeunesse": "Lajeunesse",
        "height": "height / L0",
        "slope_deg": "slope [deg]",
        "volume_ratio": "final / initial volume",
        "particles": "particles",
    }
    return grid(
        ["column", "a", "cells", "volume correction", *names.values()],
        [
            [
                "round" if row["parameters"].get("planar") is False else "planar",
                str(row["parameters"]["aspect"]),
                str(row["parameters"]["cells"]),
                "no" if row["parameters"].get("volume_correction") is False else "yes",
                *(_value(row["result"].get(n)) for n in names),
            ]
            for row in select(rows, "sand column")
        ],
    )


@rows_table("accuracy.sand_exponents")
def sand_exponents(rows: list[Row]) -> list[str]:
    """The exponent of the run-out in the aspect ratio, from the finest grid that has all aspects."""
    lines = []
    for planar in (True, False):
        own = [row for row in select(rows, "sand column") if row["parameters"].get("planar", True) == planar]
        own = [row for row in own if row["parameters"].get("volume_correction", True)]
        for low, high in ((0.5, 1.0), (1.0, 2.0), (1.0, 3.0)):
            finest: dict[float, Row] = {}
            for row in sorted(own, key=lambda r: r["parameters"]["cells"]):
                finest[row["parameters"]["aspect"]] = row
            if low in finest and high in finest:
                values = [finest[a]["result"] for a in (low, high)]
                found, lube = (math.log(values[1][n] / values[0][n]) / math.log(high / low) for n in ("runout", "lube"))
                kind = "planar" if planar else "round"
                lines.append(f"- {kind}, a from {low} to {high}: run-out as a^{found:.2f}; Lube's fit a^{lube:.2f}.")
    return lines


@rows_table("accuracy.soft_flag")
def soft_flag(rows: list[Row]) -> list[str]:
    """Whether the softest of the paper's flags keeps all its particles and does not tear."""
    return grid(
        ["dx [m]", "density [kg/m³]", "substeps", "torn", "singular values of F", "seconds"],
        [
            [
                str(row["parameters"]["dx"]),
                str(row["parameters"]["density"]),
                f"{row['result']['substeps']:,.0f}",
                f"{row['result']['torn']:.0f}",
                f"[{row['result']['stretch_min']:.2f}, {row['result']['stretch_max']:.2f}]",
                f"{row['result']['wall_s']:.0f}",
            ]
            for row in select(rows, "soft flag")
        ],
    )
