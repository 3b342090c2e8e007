"""Tables and the plot of ``bench.py blender``: the same flags by Blender's cloth and by ours."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from pathlib import Path

from bench.cases.blender import REFERENCES, quickest
from bench.tables.plots import plain_numbers, save_figure, subplots
from bench.tables.render import Goal, Row, judged, table

PAGE = "benchmarks.md"
SOLVERS = {"blender": "Blender", "ours": "ours"}
FINER = {"blender": "Blender's finer mesh", "ours": "our finer grid"}
"""The references, as the table and the plot call them."""
COLOURS = {"blender": "tab:orange", "ours": "tab:blue"}


def _rows(result: Row) -> Iterator[Row]:
    order = list(SOLVERS)
    for row in sorted(result["rows"], key=lambda row: (row["flag"], order.index(row["solver"]), row["cells"])):
        yield row | {"by": SOLVERS[row["solver"]]}


table(PAGE, "blender.rows", "blender_*", _rows, """
    flag = {flag} | solver = {by} | cells along the longer side = {cells} | points = {points:,} | steps = {steps:,} |
    solver [s per simulated s] = {per_simulated_s:digits} |
    process [s] = {process_s:.1f} | distance to Blender's finer mesh = {to.blender.chamfer:.2f %} |
    distance to our finer grid = {to.ours.chamfer:.2f %}
    """, before="{source}\n\n{frames} frames; medians of {rounds} rounds.[[ {note}]]")  # fmt: skip

table(PAGE, "blender.references", "blender_*",
      lambda result: [row | {"flag": flag} for flag, row in result["references"].items()],
      "- flag {flag}: Blender's finer mesh ({cells.blender} cells along the longer side) and our finer grid "
      "({cells.ours} cells) are {chamfer:.2f %} apart, and {same_places:.2f %} between the same places on the cloth; "
      "the shapes at rest {first:.5f %} at most")  # fmt: skip


def _equal(result: Row) -> Iterator[Row]:
    """Each row of Blender's, beside the quickest of ours that is as close to a reference or closer."""
    rows = [row for row in _rows(result) if "failed" not in row]
    for row in (row for row in rows if row["solver"] == "blender"):
        for to in REFERENCES:
            ours = quickest(rows, row, to)
            found = {"row": row, "to": FINER[to], "near": row["to"][to]["chamfer"], "ours": ours}
            if ours is None:
                found["failed"] = "no grid is as close"
            else:
                found |= {name: row[name] / ours[name] for name in ("seconds", "process_s")}
                found["nearer"] = ours["to"][to]["chamfer"]
            yield found


table(PAGE, "blender.equal", "blender_*", judged([
    Goal("{row.flag}", "{seconds:.1f} times", "seconds >= 5", stretch="seconds >= 8", always=True, more={
        "cells": "{row.cells}", "to": "{to}", "near": "{near:.2f %}", "process": "{process_s or '-':.1f}",
        "ours": "{ours.cells or '-'}[[ cells, {nearer:.2f %}]]"})], _equal), """
    flag = {goal} | Blender's cells = {cells} | reference = {to} | its distance = {near} |
    quickest of ours at no larger distance = {ours} | solver: Blender's time / ours = {measured} |
    5 times = {reached} | 8 times = {stretched} | process: Blender's time / ours = {process}
    """)  # fmt: skip


def plot(results: list[Row], pictures: Path) -> None:
    """Draw ``blender.png`` of a record: distance from each reference against time, flag by flag."""
    (result,) = results
    rows = [row for row in result["rows"] if "failed" not in row]
    flags = sorted({row["flag"] for row in rows})
    figure, axes = subplots(
        len(FINER), len(flags), figsize=(4.2 * len(flags), 7), sharex="col", sharey=True, squeeze=False
    )
    for axis, (to, flag) in zip(axes.flat, product(FINER, flags), strict=True):
        for solver, name in SOLVERS.items():
            own = [row for row in rows if (row["flag"], row["solver"]) == (flag, solver)]
            marks = sorted((row["per_simulated_s"], 100 * row["to"][to]["chamfer"], row["cells"]) for row in own)
            times, distances, _ = zip(*marks, strict=True)
            axis.loglog(times, distances, "o-", color=COLOURS[solver], label=name)
            for time, distance, cells in marks:
                below = {"blender": 4, "ours": -11}[solver]
                place = {"xytext": (4, below), "textcoords": "offset points", "fontsize": 8, "color": COLOURS[solver]}
                axis.annotate(str(cells), (time, distance), **place)
        between = 100 * result["references"][str(flag)]["chamfer"]
        axis.axhline(between, color="gray", linestyle=":", label="from one reference to the other")
        axis.margins(0.1)
        axis.set_title(f"flag {flag}, distance from {FINER[to]}", fontsize=10)
        axis.grid(True, which="major", linewidth=0.4, alpha=0.6)
        plain_numbers(axis)
    for axis in axes[:, 0]:
        axis.set_ylabel("distance [% of the longer side]")
    for axis in axes[-1]:
        axis.set_xlabel("seconds per simulated second")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    figure.suptitle(
        "The numbers are cells along the longer side. Further left: faster; further down: closer.", fontsize=10
    )
    save_figure(figure, pictures / "blender.png")
