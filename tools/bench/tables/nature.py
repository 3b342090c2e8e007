"""Tables, goals and the plot of ``bench.py nature``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.problems.crowns import CROWNS
from bench.problems.trees import tree
from bench.tables.plots import save_figure, subplots
from bench.tables.render import WANTED, Goal, Row, judged, table

PAGE = "nature.md"
GROWTH = 2.4
"""The damping ratio of a tree with leaves over that without (T. D. Jackson, WindAndTrees_NaturalFrequencies)."""


def _of(result: Row, problem: str) -> list[Row]:
    return [row["parameters"] | row["result"] for row in result["rows"] if row["problem"] == problem]


def _damping(result: Row) -> Iterator[Row]:
    """Of each row its damping ratio over that of the bare tree on its grid, and the error of its frequency."""
    found = _of(result, "tree, damping")
    bare = {row["dx"]: row["ratio"] for row in found if row["leaf_area"] == 0}
    frame = {row["leaf_area"]: row["exact"] for row in _of(result, "tree, frequency")}
    for row in sorted(found, key=lambda row: (row["dx"], row["leaf_area"], row["breeze"], row["pull"])):
        yield row | {"over": row["ratio"] / bare[row["dx"]], "faster": row["hertz"] / frame[row["leaf_area"]] - 1}


table(PAGE, "nature.frequency", "nature_*",
      lambda result: sorted(_of(result, "tree, frequency"), key=lambda row: (row["leaf_area"], -row["dx"])), """
    area of leaves [m²] = {leaf_area:g} | mass of wood [kg] = {wood:.0f} | mass of leaves [kg] = {leaves:.0f} |
    dx [m] = {dx:g} | frequency [Hz] = {hertz:.4f} | of the frame [Hz] = {exact:.4f} | error = {error:.1f %}
    """, before="{source}")  # fmt: skip
table(PAGE, "nature.damping", "nature_*", _damping, """
    area of leaves [m²] = {leaf_area:g} | pull [m] = {pull:g} | breeze [m/s] = {breeze:g} | dx [m] = {dx:g} |
    damping ratio = {ratio:.4f} | of the mode alone = {exact:.4f} | error = {error:.1f %} |
    error of the frequency = {faster:.1f %} | over that without leaves = {over:.2f}
    """)  # fmt: skip
table(PAGE, "nature.crowns", "nature_*", lambda result: _of(result, "crown"), """
    crown = {species} | cells along a branch = {cells} | R at 10 m/s = {R_10:.3f} | at 15 = {R_15:.3f} |
    at 20 = {R_20:.3f} | at 25 = {R_25:.3f} | of elasticas at 25 = {exact_25:.3f} | n = {exponent:.3f} |
    n of elasticas = {elastica:.3f} | n of the species = {known:.3f}
    """)  # fmt: skip
table(PAGE, "nature.thickness", "nature_*", lambda result: _of(result, "crown of elasticas"), """
    crown = {species} | thickness of a branch [mm] = {diameter:.1f (mm)} | C at 10 m/s = {cauchy_10:.1f} |
    C at 25 m/s = {cauchy_25:.1f} | n of elasticas = {exponent:.2f} | n of the species = {known:.3f}
    """)  # fmt: skip
table(PAGE, "nature.falling", "nature_*", lambda result: _of(result, "falling plate"), """
    law = `{law}` | tilt [degrees] = {tilt:g} | speed across the plate at the end [m/s] = {speed:.4f} |
    exact = {exact:.4f} | largest error on the way = {error:.3f %} | along the plate [m/s] = {along:.2f} |
    turned by [degrees] = {turned:.4f}
    """)  # fmt: skip
table(PAGE, "nature.turning", "nature_*", lambda result: _of(result, "falling plate that turns"), """
    cells along a side = {cells} | rate at which its spin decays [1/s] = {speed:.3f} | exact = {exact:.3f} |
    error = {error:.1f %}
    """)  # fmt: skip


def _draped(result: Row) -> list[Row]:
    """The fabrics from the softest to the stiffest, each on finer and finer grids."""
    rows = [{"layers": 3} | row for row in _of(result, "drape")]
    return sorted(rows, key=lambda row: (row["length"], row["cells"], -row["layers"]))


table(PAGE, "nature.drape", "nature_*", _draped, """
    fabric = {fabric} | bending length [mm] = {length:.1f (mm)} | cells along the free width = {cells} |
    layers = {layers} | points = {points:,.0f} | outer layers apart [cells] = {span:.2f} |
    drape coefficient = {drape:.1f %} | of the shell = {exact:.1f %} | error = {error:.1f %} |
    folds at rest = {folds_found:.0f}
    """)  # fmt: skip
table(PAGE, "nature.shells", "nature_*",
      lambda result: [{"cells": 8, "stretch": 100.0} | row for row in _of(result, "draped shell")], """
    fabric = {fabric} | folds = {folds} | E h [N/m] = {stretch:g} | cells of the shell = {cells} |
    drape coefficient = {drape:.1f %} | energy [mJ] = {energy:.4f}
    """)  # fmt: skip


SHELL = {"strain": 0.05, "length": 0.5, "cells": 40}
"""What a wrinkled shell has if nothing else is said."""


def _shells(result: Row) -> list[Row]:
    rows = [SHELL | row for row in _of(result, "wrinkled shell")]
    return [row | {"off": row["wavelength"] / (row["formula"] * math.sqrt(row["reach"])) - 1} for row in rows]


def _pulled(result: Row) -> list[Row]:
    """The points that wrinkle, three layers first, each on finer and finer grids."""
    rows = [{"layers": 3} | row for row in _of(result, "wrinkles")]
    return sorted(rows, key=lambda row: (-row["layers"], row["cells"]))


table(PAGE, "nature.wrinkles", "nature_*", _pulled, """
    layers = {layers} | cells across the width = {cells} | points = {points:,.0f} |
    outer layers apart [cells] = {span:.3f} | wavelength [mm] = {wavelength:.1f (mm)} |
    of the shell = {exact:.1f (mm)} | error = {error:.1f %} | amplitude [thicknesses] = {amplitude:.1f} |
    of the shell's = {exact_amplitude:.1f} | its change in the last tenth = {drift:.1f %} | time [s] = {wall_s:.0f}
    """)  # fmt: skip
table(PAGE, "nature.wrinkled_shells", "nature_*", _shells, """
    bending stiffness [N m] = {bending:.2e} | length [m] = {length:g} | strain = {strain:.1f %} |
    cells of the shell = {cells} | wavelength [mm] = {wavelength:.1f (mm)} |
    of the formula = {formula:.1f (mm)} | from the formula's = {error:.1f %} | reach over the length = {reach:.2f} |
    from the formula's with the reach for L = {off:.1f %} | amplitude [thicknesses] = {amplitude:.1f}
    """)  # fmt: skip


def _formulas(result: Row) -> Iterator[Row]:
    """The largest difference of the shell from the formula, as it stands and with the reach for the length."""
    rows = [row for row in _shells(result) if row["wavelength"] > 0]
    for told, name, most in (("with the reach for L", "off", 0.05), ("as it stands", "error", 0.1)):
        if rows:
            yield {"told": told, "worst": max((row[name] for row in rows), key=abs), "most": most}


def _finest(result: Row, problem: str, size: str) -> list[Row]:
    found = list(_damping(result)) if problem == "tree, damping" else _of(result, problem)
    leafy = [row for row in found if row.get("leaf_area") != 0]
    best = (min if size == "dx" else max)((row[size] for row in leafy), default=0)
    return [row for row in found if row[size] == best]


def _grown(result: Row) -> Iterator[Row]:
    for row in _finest(result, "tree, damping", "dx"):
        if row["leaf_area"] > 0:
            yield row | {"off": row["over"] / GROWTH - 1}


table(PAGE, "nature.goals", "nature_*", judged([
    Goal("tree, frequency, {leaf_area:g} m² of leaves, dx {dx:g} m", "{error:.1f %}", "|error| <= 0.05",
         lambda r: _finest(r, "tree, frequency", "dx"),
         more={"wanted": "within 5 % of the frame's with the same masses"}),
    Goal("tree, damping with leaves over without, pulled by {pull:g} m, dx {dx:g} m", "{over:.2f}", "|off| <= 0.2",
         _grown, more={"wanted": "2.4 within 20 %, as measured"}),
    Goal("tree, damping ratio, {leaf_area:g} m² of leaves, dx {dx:g} m", "{error:.1f %}", "|error| <= 0.05",
         lambda r: _finest(r, "tree, damping", "dx"), more={"wanted": "within 5 % of that of its mode alone"}),
    Goal("crown of a {species}, n, {cells} cells", "{exponent:.3f}", "|off| <= 0.15",
         lambda r: [row | {"off": row["exponent"] - row["known"]} for row in _finest(r, "crown", "cells")],
         more={"wanted": "{known:.3f} within 0.15"}),
    Goal("crown of a {species}, drag at 25 m/s, {cells} cells", "{error:.1f %}", "|error| <= 0.05",
         lambda r: _finest(r, "crown", "cells"), more={"wanted": "within 5 % of the elasticas'"}),
    Goal("falling plate, `{law}`, tilted by {tilt:g} degrees", "{error:.3f %}", "|error| <= 0.01",
         lambda r: _of(r, "falling plate"), more={"wanted": "speed within 1 % of the exact one at any time"}),
    Goal("falling plate that turns, {cells} cells", "{error:.1f %}", "|error| <= 0.02",
         lambda r: _finest(r, "falling plate that turns", "cells"),
         more={"wanted": "decay of its spin within 2 % of the exact one"}),
    Goal("drape coefficient, {fabric}, {cells} cells, layers: {layers}", "{error:.1f %}", "|error| <= 0.1", _draped,
         more={"wanted": "within 10 % of the shell's"}),
    Goal("wavelength of wrinkles, layers: {layers}, {cells} cells across", "{error:.1f %}", "|error| <= 0.1",
         _pulled, more={"wanted": "within 10 % of the shell's"}),
    Goal("wavelength of the shell's wrinkles, and the formula {told}", "{worst:.1f %}", "|worst| <= most", _formulas,
         more={"wanted": "within {most:.0f %} of each other"}),
    ]), WANTED)  # fmt: skip


def plot(results: list[Row], pictures: Path) -> None:
    """Draw ``trees.png`` of a record: the tree, its frequency and damping, the crowns and their drag."""
    (result,) = results
    figure, (first, second) = subplots(2, 3, figsize=(13, 8.4))
    _sketch(first[0])
    _frequencies(first[1], _of(result, "tree, frequency"))
    _dampings(first[2], list(_damping(result)))
    _crowns(second[0])
    _drags(second[1], _finest(result, "crown", "cells"))
    _plates(second[2], _of(result, "falling plate"))
    for axis in (*first, *second):
        axis.title.set_fontsize(10)
    save_figure(figure, pictures / "trees.png")
    figure, (curve, grids) = subplots(1, 2, figsize=(9.2, 3.9))
    _drapes(curve, [row for row in _draped(result) if row["layers"] == 3], _of(result, "draped shell"))
    _finer_drapes(grids, [row for row in _draped(result) if row["layers"] == 3])
    save_figure(figure, pictures / "drape.png")
    figure, (stiffnesses, grids) = subplots(1, 2, figsize=(9.2, 3.9))
    _wrinkles(stiffnesses, _shells(result))
    _finer_wrinkles(grids, _pulled(result))
    save_figure(figure, pictures / "wrinkles.png")


def _wrinkles(axis: Any, rows: list[Row]) -> None:
    own = sorted((row for row in rows if all(row[k] == v for k, v in SHELL.items()) and row["wavelength"] > 0),
                 key=lambda row: row["bending"])  # fmt: skip
    stiff = [row["bending"] for row in own]
    axis.loglog(stiff, [1e3 * row["formula"] for row in own], color="0.5", linestyle=":", label="Cerda and Mahadevan")
    axis.loglog(stiff, [1e3 * row["wavelength"] for row in own], "o-", color="tab:blue", label="shell")
    axis.set_yticks([15, 20, 30, 40], ["15", "20", "30", "40"])
    axis.minorticks_off()
    axis.set(title="Wrinkles of a stretched sheet", xlabel="bending stiffness [N m]", ylabel="wavelength [mm]")
    axis.legend(fontsize=8)


def _finer_wrinkles(axis: Any, rows: list[Row]) -> None:
    own = sorted((row for row in rows if row["wavelength"] > 0), key=lambda row: row["cells"])
    if own:
        exact = 1e3 * own[-1]["exact"]
        axis.axhspan(0.9 * exact, 1.1 * exact, color="0.93")
        axis.axhline(exact, color="tab:blue", label="shell (band: 10 %)")
        axis.axhline(1e3 * own[-1]["formula"], color="0.5", linestyle=":", label="Cerda and Mahadevan")
        for layers, told in ((3, "points in three layers"), (1, "points in one layer")):
            some = [row for row in own if row["layers"] == layers]
            axis.plot([r["cells"] for r in some], [1e3 * r["wavelength"] for r in some], "o-", label=told,
                      color="tab:orange" if layers == 3 else "tab:green", markerfacecolor="none")  # fmt: skip
        axis.legend(fontsize=8)
    axis.set(title="On finer grids", xlabel="cells across the width", ylabel="wavelength [mm]", ylim=(0, None))


def _drapes(axis: Any, rows: list[Row], shells: list[Row]) -> None:
    length = {row["fabric"]: 1e3 * row["length"] for row in rows}
    plain = [row for row in shells if row.get("stretch", 100.0) == 100.0 and "cells" not in row]
    for folds in sorted({row["folds"] for row in plain}):
        own = sorted((length[r["fabric"]], r["drape"]) for r in plain if r["folds"] == folds)
        axis.plot(*zip(*own, strict=True), color="tab:blue", linewidth=2 if folds == rows[0]["folds"] else 0.7,
                  label=f"shell, {folds} folds" if folds == rows[0]["folds"] else None)  # fmt: skip
        axis.annotate(f"{folds} folds", own[-1], xytext=(4, -3), textcoords="offset points", fontsize=7)
    for cells, marker in zip(sorted({row["cells"] for row in rows}), "sov", strict=False):
        own = [row for row in rows if row["cells"] == cells]
        axis.plot([1e3 * r["length"] for r in own], [r["drape"] for r in own], marker, color="tab:orange",
                  markerfacecolor="none", label=f"points, {cells} cells along the free width")  # fmt: skip
    for name, place in length.items():
        axis.annotate(name, (place, 0.01), xycoords=("data", "axes fraction"), rotation=90, fontsize=7, va="bottom")
    axis.set(title="Cusick's test", xlabel="bending length [mm]", ylabel="drape coefficient", xlim=(None, 28.2))
    axis.legend(fontsize=7, loc="upper left")


def _finer_drapes(axis: Any, rows: list[Row]) -> None:
    for fabric in dict.fromkeys(row["fabric"] for row in rows):
        own = [row for row in rows if row["fabric"] == fabric]
        axis.plot([r["cells"] for r in own], [100 * r["error"] for r in own], "o-", label=fabric)
    axis.axhspan(-10, 10, color="0.93")
    axis.axhline(0, color="0.5", linewidth=0.8)
    axis.set(title="Error against the shell with as many folds (band: 10 %)", xlabel="cells along the free width",
             ylabel="%", ylim=(-12, 12))  # fmt: skip
    axis.title.set_fontsize(10)
    axis.legend(fontsize=8)


def _sketch(axis: Any) -> None:
    for number, piece in enumerate(tree(1.0)):
        (x0, _, z0), (x1, _, z1) = piece.start, piece.end
        axis.plot([x0, x1], [z0, z1], color="sienna", linewidth=3 if number == 0 else 1.5)
        if piece.leaves:
            x, z = x0 + (x1 - x0) / 3, z0 + (z1 - z0) / 3
            axis.plot([x, x1], [z, z1], color="tab:green", linewidth=7, alpha=0.35, solid_capstyle="round")
    axis.set(title="The tree: wood, and where its leaves are", xlabel="x [m]", ylabel="height [m]")
    axis.set_aspect("equal")


def _frequencies(axis: Any, rows: list[Row]) -> None:
    for leafy, color in ((False, "sienna"), (True, "tab:green")):
        own = sorted((row for row in rows if (row["leaf_area"] > 0) is leafy), key=lambda row: row["dx"])
        axis.plot([row["dx"] for row in own], [row["hertz"] for row in own], "o-", color=color,
                  label="with leaves" if leafy else "bare")  # fmt: skip
        axis.axhline(own[0]["exact"], color=color, linestyle=":", label="frame of beams")
        axis.axhspan(0.95 * own[0]["exact"], 1.05 * own[0]["exact"], color=color, alpha=0.12)
    axis.set(title="Lowest frequency (bands: 5 %)", xlabel="dx [m]", ylabel="Hz", xlim=(0, None))
    axis.legend(fontsize=8)


def _dampings(axis: Any, rows: list[Row]) -> None:
    axis.axhspan(0.8 * GROWTH, 1.2 * GROWTH, color="0.9")
    axis.axhline(GROWTH, color="0.5", linestyle=":", label="one tree, measured (band: 20 %)")
    still = [row for row in rows if row["leaf_area"] > 0 and row["breeze"] == 0]
    for dx, marker in ((0.5, "s-"), (0.25, "o")):
        own = sorted((row for row in still if row["dx"] == dx), key=lambda row: row["pull"])
        axis.plot([r["pull"] for r in own], [r["over"] for r in own], marker, color="tab:green",
                  markerfacecolor="none", label=f"air at rest, dx {dx:g} m")  # fmt: skip
    for row in (row for row in rows if row["breeze"] > 0):
        axis.plot(row["pull"], row["over"], "*", color="tab:blue", markersize=11,
                  label=f"in a breeze of {row['breeze']:g} m/s")  # fmt: skip
    axis.set(title="Damping ratio, with leaves over without", xlabel="pull at the top [m]", xlim=(0, None),
             ylim=(1, None))  # fmt: skip
    axis.legend(fontsize=8)


COLORS = {"Sitka spruce": "tab:blue", "birch": "tab:green"}


def _crowns(axis: Any) -> None:
    for place, (name, kind) in enumerate(CROWNS.items()):
        axis.plot([4 * place, 4 * place], [0, 6], color="sienna", linewidth=3)
        for number, way in enumerate(kind.length * kind.ways(12)):
            foot = 5.2 * number / 12 + 0.6 * (kind.rise < 0)
            axis.plot([4 * place, 4 * place + way[0]], [foot, foot + way[2]], color=COLORS[name], linewidth=2.5)
        axis.text(4 * place, -0.6, name, ha="center", fontsize=9)
    axis.set(title="The two crowns, without wind", xlim=(-2, 6), ylim=(-1, 7))
    axis.set_aspect("equal")
    axis.axis("off")


def _drags(axis: Any, rows: list[Row]) -> None:
    speeds = (10, 15, 20, 25)
    for row in rows:
        color, name = COLORS[row["species"]], row["species"]
        told = f"{name}: n = {row['exponent']:.2f} (species: {row['known']:.2f})"
        axis.loglog(speeds, [row[f"R_{u}"] for u in speeds], "o", color=color, label=told)
        axis.loglog(speeds, [row[f"exact_{u}"] for u in speeds], color=color, linewidth=1, label="sum of elasticas")
    axis.set_xticks(speeds, [str(u) for u in speeds])
    axis.set_yticks([0.2, 0.3, 0.5, 0.7, 1.0], ["0.2", "0.3", "0.5", "0.7", "1"])
    axis.minorticks_off()
    axis.set(title="Drag over that of the stiff crown", xlabel="wind [m/s]")
    axis.legend(fontsize=8)


def _plates(axis: Any, rows: list[Row]) -> None:
    for law, marker, color in (("projected", "o", "tab:orange"), ("cross_flow", "s", "tab:blue")):
        own = sorted((row for row in rows if row["law"] == law), key=lambda row: row["tilt"])
        axis.plot([r["tilt"] for r in own], [r["speed"] for r in own], marker, color=color, label=f"{law}, across")
        axis.plot([r["tilt"] for r in own], [r["exact"] for r in own], color=color, linewidth=1, label="exact")
    axis.set(title="A plate falls: speed across itself at the end", xlabel="tilt [degrees]", ylabel="m/s",
             ylim=(0, None))  # fmt: skip
    axis.legend(fontsize=8)
