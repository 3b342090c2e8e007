"""Tables and values of ``bench.py accuracy``, from the rows of all its records."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import Any

from bench.cases.accuracy import SINGLE, VARIANTS
from bench.tables.accuracy_goals import goal_rows, mobilised
from bench.tables.markdown import measured, stack
from bench.tables.render import BECAUSE, Row, Rows, table, value
from bench.tables.rows import all_rows, order, own_order, select

PAGE = "validation.md"
Results = list[Row]


def _table(name: str, rows: Rows, columns: str, **more: Any) -> None:
    table(PAGE, f"accuracy.{name}", "accuracy_*", rows, columns, together=True, **more)


def _of(results: Results, problem: str, **parameters: Any) -> list[Row]:
    return select(all_rows(results), problem, **parameters)


def _problems(results: Results) -> Iterator[Row]:
    for result in results:
        names = ", ".join(sorted({row["problem"] for row in result["rows"]}))
        yield {"names": names, "told": f"{result['device']}; {stack(result)}.{measured(result)}"}


_table("devices", _problems, "- {names}: {told}")
_table("goals", goal_rows, BECAUSE)


def _orders(results: Results, problem: str, **parameters: Any) -> Iterator[Row]:
    """The rows of each variant by cells, with the order of the last halving."""
    for variant in (*VARIANTS, *SINGLE):
        found = _of(results, problem, variant=variant, **parameters)
        for row, before in _by_cells(found):
            yield row | {"order": "" if before is None or row["result"]["error"] <= 0 else order(before, row)}


def _by_cells(rows: list[Row]) -> Iterator[tuple[Row, Row | None]]:
    """Each row, in ascending number of cells, and the one before."""
    found = sorted(rows, key=lambda row: row["parameters"]["cells"])
    return zip(found, [None, *found], strict=False)


_LOSS = "amplitude lost per period = {result.loss:.3g}"
_SHIFT = "apparent outward shift of the pin [cells] = {result.end_shift:.3g}"
for _name, _problem, _more, _parameters in (
    ("free_bar", "vibrating bar", (_LOSS,), {"ends": "free"}),
    ("pinned_bar", "vibrating bar", (_LOSS, _SHIFT), {"ends": "fixed-free"}),
    ("unconfined_bar", "unconfined bar", (_SHIFT,), {}),
    ("hanging_bar", "hanging bar", (), {"clamp": "mirror"}),
    ("hanging_pinned_bar", "hanging bar", (_SHIFT,), {"clamp": "pin"}),
    ("bar_at_points", "bar held at points", (_LOSS, _SHIFT), {}),
    ("hanging_bar_at_points", "hanging bar held at points", (_SHIFT,), {}),
    ("vortex", "vortex", (), {}),
):
    _convergence = ("variant = `{parameters.variant}` | cells = {parameters.cells} | "
                    "relative error = {result.error:.2e} | order = {order:.2f}")  # fmt: skip
    _table(_name, partial(_orders, problem=_problem, **_parameters), " | ".join([_convergence, *_more]))

_table("free_block", partial(_of, problem="free block"), """
    variant = `{parameters.variant}` | final / initial energy = {result.kept:.3g} |
    largest change = {result.error:.3g} | largest rise of any single state = {result.growth:.3g} |
    change of linear momentum = {result.linear:.3g} | change of angular momentum = {result.angular:.3g} |
    substeps = {result.substeps:.3g}
    """)  # fmt: skip


def _strips(results: Results) -> Iterator[Row]:
    for layers, hold in product((3, 1), ("hinge", "clamp", "nodes")):
        for row, before in _by_cells(_of(results, "hinged strip", hold=hold, layers=layers)):
            moment = row["result"].get("moment", "")  # one layer has none at its faces
            yield row | {"order": order(before, row) if before and hold == "hinge" else "", "moment": moment}


_table("hinged_strip", _strips, """
    layers = {parameters.layers} | kind of the pins = `{parameters.hold}` | cells = {parameters.cells} |
    error of the sag = {result.error:.2e} | order = {order:.2f} | slope at the end / exact = {result.slope:.4f} |
    error of the moment in the last cell / moment in the middle = {moment:.3g}
    """)  # fmt: skip
_table("hinged_plate", partial(_of, problem="hinged plate"), """
    variant = `{parameters.variant}` | law = `{parameters.law}` | k = {parameters.k} |
    angle [deg] = {result.angle:.2f} | exact [deg] = {result.exact:.2f} | error [deg] = {result.error:.2f}
    """)  # fmt: skip
_table("reconfiguration", partial(_of, problem="plate that bends in a flow"), """
    law = `{parameters.law}` | C = {parameters.cauchy:g} | cells = {parameters.cells} | R = {result.drag:.4f} |
    R of the elastica = {result.exact:.4f} | error = {result.error:.2f %} | tip = {result.tip:.4f} |
    tip of the elastica = {result.exact_tip:.4f}
    """)  # fmt: skip
_table("divergence", partial(_orders, problem="inverted flag"), """
    cells = {parameters.cells} | pressure at which it diverges = {result.kappa:.3f} | exact = {result.exact:.3f} |
    error = {result.error:.2f %} | order = {order:.2f} | rate in 0.9 of the exact pressure = {result.below:.4f} |
    in 1.1 of it = {result.above:.4f}
    """)  # fmt: skip
_table("fabrics", partial(_of, problem="strip of a fabric that hangs"), """
    fabric = {parameters.fabric} | mass [g/m²] = {result.grams:.0f} | D [µN m] = {result.micro:.0f} |
    E h [N/m] = {parameters.stretch:g} | layers = {parameters.layers} | cells = {parameters.cells} |
    outer layers apart [cells] = {result.span:.2f} |
    drop / L = {result.drop:.4f} | drop of the elastica = {result.exact:.4f} | error = {result.error:.2f %}
    """, order=[f"parameters.{name}" for name in ("fabric", "stretch", "layers", "cells")])  # fmt: skip
_table("surface_drag", partial(_of, problem="surface drag"), """
    surface = {parameters.shape} | Gaussians = {parameters.count} | overlap = {parameters.overlap} |
    *areas `{parameters.area}`, law `{parameters.law}` = {result.share:.3f}
    """, order=[f"parameters.{name}" for name in ("shape", "count", "overlap", "area", "law")])  # fmt: skip
_table("cantilever", partial(_of, problem="cantilever"), """
    variant = `{parameters.variant}` | b = {parameters.b} | cells through the thickness = {parameters.cells} |
    drop / L = {result.drop:.3g} | error of the drop = {result.error:.3g} | part from shear = {result.shear:.3g} |
    part from quadrature = {result.quadrature:.3g} | unexplained part = {result.unexplained:.3g} |
    error of the shortening = {result.shortening_error:.3g}
    """)  # fmt: skip
_table("held_cantilever", partial(_of, problem="held cantilever"), """
    thickness [cells] = {parameters.thickness:g} |
    *held depth {parameters.depth:g} = {result.lowest:.3f} to {result.highest:.3f}
    """, order=["parameters.thickness", "parameters.depth"])  # fmt: skip


def _ends(results: Results) -> Iterator[Row]:
    found = _of(results, "clamped end")
    for k, row in enumerate(found):
        yield row | {"order": own_order(found[k - 2 : k + 1]) if k > 1 else ""}


_table("clamped_end", _ends, """
    cells through the thickness = {parameters.cells} | frequency over Timoshenko's = {result.ratio:.5f} |
    order of the last three = {order:.2f}
    """)  # fmt: skip


_HOW = {"apart": "each a piece", "base": "held ends one piece", "shared": "shared nodes"}


def _combs(results: Results) -> Iterator[Row]:
    for row in _of(results, "comb"):
        time = 1e6 * row["result"]["wall_s"] / row["result"]["substeps"]
        yield row | {"how": _HOW[row["parameters"]["how"]], "time": time}


_table("comb", _combs, """
    thickness [cells] = {parameters.thickness:g} | beams = {how} | lowest ratio = {result.lowest:.4g} |
    highest ratio = {result.highest:.4g} | nodes of the box = {result.nodes:.0f} | time of a substep [µs] = {time:.0f}
    """)  # fmt: skip
_table("close_sheets", partial(_of, problem="close sheets"), """
    layers of points = {parameters.layers} | difference from a sheet alone = {result.error:.2g %} |
    on shared nodes = {result.shared:.3g %} | time of a substep over that on shared nodes = {result.cost:.2f}
    """)  # fmt: skip


_table("joints", partial(_of, problem="joined beams"), """
    stiffness against turning, κ L / (E I) = {parameters.turning:g} |
    frequency over that of Euler's beams = {result.ratio:.4f} | substeps = {result.substeps:.0f}
    """)  # fmt: skip
_table("pendulum", partial(_of, problem="pendulum on a hinge"), """
    frequency over that of the rigid bar = {result.ratio:.4f} | substeps = {result.substeps:.0f}
    """)  # fmt: skip


_table("thin_rod", partial(_of, problem="thin rod"), """
    diameter [cells] = {parameters.diameter:g} |
    *{parameters.around} points in a section = {result.lowest:.3f} to {result.highest:.3f}
    """, order=["parameters.diameter", "parameters.around"])  # fmt: skip


def _angles(results: Results) -> Iterator[Row]:
    """Friction angles of the sand law, for an element and for a layer."""
    tests = {"shear": "simple shear", "triaxial": "triaxial compression", "plane_strain": "plane strain"}
    for result in (row["result"] for row in _of(results, "sand element")):
        for name, theory in mobilised().items():
            yield {"test": tests[name], "angle": result[f"{name}_deg"], "theory": theory}
    slides = "a layer that slides down an incline, from its acceleration"
    for result in (row["result"] for row in _of(results, "sand slope")):
        yield {"test": slides, "angle": result["friction_deg"], "theory": result["exact"]}
        steepest, least = ("a layer on an incline: steepest on which it stands",
                           "a layer on an incline: least steep on which it flows")  # fmt: skip
        yield {"test": steepest, "angle": result["stands"], "theory": None}
        yield {"test": least, "angle": result["flows"], "theory": None}


_table("sand_angles", _angles, """
    test, with phi of 30 degrees = {test} | angle [deg] = {angle:.4g} | theory [deg] = {theory:.4g}
    """)  # fmt: skip


def _columns(results: Results) -> Iterator[Row]:
    for row in _of(results, "sand column"):
        kind = "round" if row["parameters"].get("planar") is False else "planar"
        yield row | {"kind": kind, "corrected": row["parameters"].get("volume_correction", True)}


_table("sand_columns", _columns, """
    column = {kind} | a = {parameters.aspect} | cells = {parameters.cells} | volume correction = {corrected} |
    run-out = {result.runout:.3g} | Lube = {result.lube:.3g} | Lajeunesse = {result.lajeunesse or '-':.3g} |
    height / L0 = {result.height:.3g} | slope [deg] = {result.slope_deg:.3g} |
    final / initial volume = {result.volume_ratio:.3g} | particles = {result.particles:.3g}
    """)  # fmt: skip


def _exponents(results: Results) -> Iterator[Row]:
    """The exponent of the run-out in the aspect ratio, from the finest grid that has both aspects."""
    for kind in ("planar", "round"):
        own = [row for row in _columns(results) if row["kind"] == kind and row["corrected"]]
        own.sort(key=lambda row: row["parameters"]["cells"])
        finest = {row["parameters"]["aspect"]: row["result"] for row in own}
        for low, high in ((0.5, 1.0), (1.0, 2.0), (1.0, 3.0)):
            if low in finest and high in finest:
                ratios = {name: math.log(finest[high][name] / finest[low][name]) for name in ("runout", "lube")}
                exponents = {name: ratio / math.log(high / low) for name, ratio in ratios.items()}
                yield {"kind": kind, "low": low, "high": high} | exponents


_table("sand_exponents", _exponents,
       "- {kind}, a from {low} to {high}: run-out as a^{runout:.2f}; Lube's fit a^{lube:.2f}.")  # fmt: skip
_table("soft_flag", partial(_of, problem="soft flag"), """
    dx [m] = {parameters.dx} | density [kg/m³] = {parameters.density} | substeps = {result.substeps:,.0f} |
    torn = {result.torn:.0f} | singular values of F = [{result.stretch_min:.2f}, {result.stretch_max:.2f}] |
    seconds = {result.wall_s:.0f}
    """)  # fmt: skip


def _band(results: Results) -> Row:
    """The largest ratio between Lube's and Lajeunesse's run-outs, over the round columns."""
    found = (row["result"] for row in _of(results, "sand column", planar=False))
    return {"most": max(max(one["lube"] / one["lajeunesse"], one["lajeunesse"] / one["lube"]) for one in found)}


value("accuracy.band", "accuracy_*", "{most:.1f}", _band, together=True)
value("accuracy.plane_strain_angle", "accuracy_*", "{result.plane_strain_deg:.0f}",
      lambda results: _of(results, "sand element")[0], together=True)  # fmt: skip
